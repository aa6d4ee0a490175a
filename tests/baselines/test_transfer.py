from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from baselines import transfer as module
from baselines.checkpoints import load_checkpoint
from baselines.cli import app
from baselines.configs import TrainingConfig
from baselines.transfer import (
    Transfer,
    TransferStudy,
    fine_tuning_of,
    lidars_of,
    measure_transfer,
)
from baselines.transfer_report import describe_transfer, format_transfer, write_transfer
from semantic2d_dataset import open_dataset
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, RPLIDAR_S2, LidarSpec
from tests.generators import SMALL_LIDAR, make_dataset

WIDE = LidarSpec("wide", "Wide", 63, -3.1, 0.1, 0.1, 20.0, (0.0, 0.0, 0.0, 3.1415926, 0.0, 1.0))
CONFIG = replace(TrainingConfig.quick(), epochs=2)
PAIRS = [
    ("small", "small", False),
    ("small", "wide", False),
    ("small", "wide", True),
    ("wide", "small", False),
    ("wide", "small", True),
    ("wide", "wide", False),
]


@pytest.fixture(scope="module")
def data_folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "two"
    make_dataset(folder, environments=("lobby", "office"), lidars=(SMALL_LIDAR, WIDE), scans=50)
    return folder


@pytest.fixture(scope="module")
def study(data_folder: Path) -> TransferStudy:
    data = open_dataset(data_folder)
    return TransferStudy(data, lidars_of(data), CONFIG, fine_tuning_of(CONFIG), samples=2)


@pytest.fixture(scope="module")
def measured(study: TransferStudy, tmp_path_factory) -> tuple[Path, list[Transfer]]:
    """A study that was interrupted in its second fine-tuning, and then finished."""
    folder = tmp_path_factory.mktemp("runs") / "transfer"
    trainings = 0

    def interrupted(*args, **options):
        nonlocal trainings
        trainings += 1
        if trainings == 4:
            raise KeyboardInterrupt
        return train(*args, **options)

    train = module.train
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "train", interrupted)
        with pytest.raises(KeyboardInterrupt):
            measure_transfer(study, folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.json")}
    assert len(before) == 2 * 3
    found = measure_transfer(study, folder)
    assert before.items() <= {p: p.stat().st_mtime_ns for p in folder.rglob("*.json")}.items()
    return folder, found


def test_every_pair_is_measured_and_an_interruption_costs_no_finished_model(measured):
    folder, found = measured
    assert [(run.trained_on, run.tested_on, run.fine_tuned) for run in found] == PAIRS
    names = sorted(path.parent.name for path in folder.rglob("model.json"))
    assert names == ["small", "small--wide", "wide", "wide--small"]
    tuned = load_checkpoint(folder / "fine-tuned" / "small--wide")
    assert tuned.lidar == SMALL_LIDAR
    assert tuned.dataset["reprojected_from"] == "wide"


def test_scores_are_over_the_beams_that_the_tested_lidar_measured(study: TransferStudy, measured):
    by_pair = {(run.trained_on, run.tested_on, run.fine_tuned): run for run in measured[1]}
    points = {b: by_pair[b, b, False].all_beams["points"] for b in ("small", "wide")}
    for (_, tested_on, _), run in by_pair.items():
        assert run.all_beams["points"] == points[tested_on]
    assert by_pair["wide", "small", True].out_of_view == 0
    # 3.6 rad of 6.3 are in view
    assert by_pair["small", "wide", False].out_of_view == pytest.approx(0.42, abs=0.02)
    assert by_pair["small", "wide", False].in_view["Wall"]["ca"] is not None


def test_models_of_other_settings_are_not_taken_for_finished_ones(study: TransferStudy, measured):
    other = replace(study, config=replace(CONFIG, learning_rate=1e-4))
    with pytest.raises(InvalidInputError, match="other settings were used for learning_rate"):
        measure_transfer(other, measured[0])


def test_the_report_is_a_file_a_table_and_a_picture(study, measured, tmp_path: Path):
    paths = write_transfer(tmp_path, study, measured[1])
    assert [path.name for path in paths] == ["transfer.json", "transfer.md", "transfer.png"]
    said = json.loads(paths[0].read_text())
    assert said == json.loads(json.dumps(describe_transfer(study, measured[1])))
    assert [run["out_of_view"] > 0 for run in said["runs"]] == [False, True, True] + 3 * [False]
    table = paths[1].read_text()
    assert table == format_transfer(study, measured[1])
    rows = [line for line in table.splitlines() if line.startswith("| small |")]
    own, other = rows[0].split(" | ")[1:3]
    direct, tuned = (measured[1][i].in_view["mIoU"] for i in (1, 2))
    assert own == f"{100 * measured[1][0].in_view['mIoU']:.2f}"
    assert other == f"{100 * direct:.2f} → {100 * tuned:.2f} |"
    with Image.open(paths[2]) as picture:
        assert picture.width > 1000


def test_lidars_of_the_release_come_first(tmp_path: Path):
    lidars = (RPLIDAR_S2, SMALL_LIDAR, HOKUYO_UTM_30LX_EW)
    make_dataset(tmp_path / "data", environments=("lobby",), lidars=lidars, scans=10)
    expected = ("hokuyo-utm-30lx-ew", "rplidar-s2", "small")
    assert lidars_of(open_dataset(tmp_path / "data")) == expected


def test_a_time_limit_never_decides_over_a_study(study: TransferStudy):
    assert study.config.time_limit_s is None
    assert TrainingConfig.quick().time_limit_s is not None


def run(*words: object) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    if result.exception is not None:
        raise result.exception
    return result.stdout


def test_the_command_reports_a_finished_study_again_as_it_was(
    study: TransferStudy, measured, data_folder: Path
):
    folder, found = measured
    options = ("--data", data_folder, "--preset", "quick", "--epochs", 2, "--samples", 2)
    said = json.loads(run("transfer", "--out", folder, *options, "--json"))
    assert said == json.loads(json.dumps(describe_transfer(study, found)))
    assert json.loads((folder / "transfer.json").read_text()) == said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--model", "other"), "unknown model 'other'"),
        (("--lidars", "small"), "expected at least two different lidars, found small"),
        (("--lidars", "small,small"), "expected at least two different lidars"),
        (("--lidars", "small,none"), "no sequence of the lidar 'none'"),
        (("--epochs", 0), "epochs: expected above 0"),
        (("--tuning-epochs", 0), "epochs: expected above 0"),
        (("--scheme", "none"), "unknown scheme 'none'"),
        (("--device", "abacus"), "device 'abacus' cannot be used here"),
    ],
)
def test_what_cannot_be_studied_is_one_clear_error_and_no_file(
    words, message: str, data_folder: Path, tmp_path: Path
):
    out = tmp_path / "transfer"
    usual = ("--data", data_folder, "--preset", "quick", "--epochs", 1)
    with pytest.raises((InvalidInputError, DatasetNotFoundError), match=message):
        run("transfer", "--out", out, *usual, *words)
    assert not out.exists()


def test_a_lidar_too_small_for_the_model_is_found_before_any_training(tmp_path: Path):
    few = LidarSpec("few", "Few", 21, -1.0, 0.1, 0.1, 20.0)
    make_dataset(tmp_path / "data", environments=("lobby",), lidars=(SMALL_LIDAR, few), scans=50)
    data = open_dataset(tmp_path / "data")
    config = replace(CONFIG, model="unet")
    study = TransferStudy(data, lidars_of(data), config, fine_tuning_of(config))
    with pytest.raises(InvalidInputError, match="unet needs at least 33 beams, and few has 21"):
        measure_transfer(study, tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
