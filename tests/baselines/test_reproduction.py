from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from baselines.configs import TrainingConfig
from baselines.experiments import Experiment, Method
from baselines.locks import alone_in
from baselines.reproduction import RunResult, Settings, run_experiment
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.manifest import publish
from tests.generators import SMALL_LIDAR, make_sequence

EXPERIMENT = Experiment(
    "pair", "Two rows", (Method("s3net", "R"), Method("s3net", "RIA", every_seed=False))
)
FIRST = Experiment("first", "One row", EXPERIMENT.methods[:1])


def settings_of(dataset_folder: Path, epochs: int = 1, **options) -> Settings:
    config = replace(TrainingConfig.quick(), epochs=epochs, batch_size=64)
    options = {"seeds": (0, 1), "samples": 3} | options
    return Settings(str(dataset_folder), "block", "small", config, **options)


def stamps(folder: Path) -> dict[str, int]:
    """When every file was written."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path): path.stat().st_mtime_ns for path in files}


def comparable(result: RunResult) -> RunResult:
    """A result without what depends on the clock."""
    return replace(result, speed={}, seconds=0.0, beside=1)


@pytest.fixture(scope="module")
def finished(dataset_folder: Path, tmp_path_factory) -> tuple[Path, dict, list[str]]:
    folder, said = tmp_path_factory.mktemp("reproduction") / "runs", []
    results = run_experiment(EXPERIMENT, settings_of(dataset_folder), folder, tell=said.append)
    return folder, results, said


def test_each_method_is_trained_with_its_seeds_and_scored_by_class(finished):
    _, results, _ = finished
    seeds = {method.features: [run.spec.seed for run in runs] for method, runs in results.items()}
    assert seeds == {"R": [0, 1], "RIA": [0]}
    for runs in results.values():
        for run in runs:
            assert len(run.classes) == 9
            assert "Other" not in run.classes
            assert {"All", *run.classes} <= set(run.figures["IoU"])
            assert all(0 <= mean <= 1 for mean, _ in run.figures["CA"].values())
            assert run.speed["one_pass"] > 0
            assert 0 <= run.majority["mIoU"] < 1


def test_every_run_says_that_it_is_done_and_what_remains(finished):
    _, _, said = finished
    assert said[0] == "pair: 3 runs, of which 0 are done"
    assert [line.split(":")[0] for line in said[1:]] == [
        "s3net-R-small-seed0",
        "s3net-R-small-seed1",
        "s3net-RIA-small-seed0",
    ]
    assert "2 to go, about" in said[1]
    assert said[-1].endswith("all done")


def test_what_is_done_is_not_trained_again(finished, dataset_folder: Path):
    folder, results, _ = finished
    before, said = stamps(folder), []
    again = run_experiment(EXPERIMENT, settings_of(dataset_folder), folder, tell=said.append)
    assert said == ["pair: 3 runs, of which 3 are done"]
    assert stamps(folder) == before
    assert again == results


def test_an_interruption_between_runs_loses_none(finished, dataset_folder: Path, tmp_path: Path):
    def interrupt(line: str) -> None:
        if "seed0" in line:
            raise KeyboardInterrupt

    settings = settings_of(dataset_folder)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(EXPERIMENT, settings, tmp_path, tell=interrupt)
    said: list[str] = []
    results = run_experiment(EXPERIMENT, settings, tmp_path, tell=said.append)
    assert said[0] == "pair: 3 runs, of which 1 are done"
    _, whole, _ = finished
    for method, runs in results.items():
        assert [*map(comparable, runs)] == [*map(comparable, whole[method])]


def test_a_killed_training_goes_on_from_its_last_epoch_to_the_same_model(
    dataset_folder: Path, tmp_path: Path
):
    settings = settings_of(dataset_folder, epochs=6, seeds=(0,))
    code = (
        "from tests.baselines.test_reproduction import *\n"
        f"settings = settings_of({str(dataset_folder)!r}, epochs=6, seeds=(0,))\n"
        f"run_experiment(FIRST, settings, Path({str(tmp_path / 'killed')!r}))\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    log = tmp_path / "killed" / "s3net-R-small-seed0" / "log.csv"
    deadline = time.monotonic() + 60
    while not log.exists() and time.monotonic() < deadline:
        time.sleep(0.002)
    process.kill()
    process.wait()
    epochs = len(log.read_text().splitlines()) - 1
    assert 1 <= epochs < 6
    (killed,) = run_experiment(FIRST, settings, tmp_path / "killed").values()
    (whole,) = run_experiment(FIRST, settings, tmp_path / "whole").values()
    assert [*map(comparable, killed)] == [*map(comparable, whole)]


def test_runs_side_by_side_give_what_one_at_a_time_gives(
    finished, dataset_folder: Path, tmp_path: Path
):
    _, whole, _ = finished
    settings = settings_of(dataset_folder)
    results = run_experiment(FIRST, settings, tmp_path, jobs=2)
    for method, runs in results.items():
        assert {run.beside for run in runs} == {2}
        assert [*map(comparable, runs)] == [*map(comparable, whole[method])]


def test_the_number_of_threads_is_left_as_it_was(dataset_folder: Path, tmp_path: Path):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        run_experiment(FIRST, settings_of(dataset_folder, seeds=(0,)), tmp_path)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_other_settings_are_refused_before_anything_runs(finished, dataset_folder: Path):
    folder, _, _ = finished
    before = stamps(folder)
    with pytest.raises(InvalidInputError, match=r"another epochs \(epochs: 1, now 2\)"):
        run_experiment(EXPERIMENT, settings_of(dataset_folder, epochs=2), folder)
    with pytest.raises(InvalidInputError, match="another samples"):
        run_experiment(EXPERIMENT, settings_of(dataset_folder, samples=4), folder)
    assert stamps(folder) == before


@pytest.mark.parametrize(
    ("changes", "method", "message"),
    [
        ({"beams": 20}, Method("unet", "R"), "unet needs at least 33 beams, and own has 20"),
        ({"intensities": False}, Method("s3net", "RI"), "own gives no intensities, and pair needs"),
    ],
)
def test_what_a_lidar_cannot_give_is_found_before_anything_runs(
    changes: dict, method: Method, message: str, tmp_path: Path
):
    lidar = replace(SMALL_LIDAR, name="own", beams=changes.get("beams", 37))
    (tmp_path / "data" / "sequences").mkdir(parents=True)
    drop = () if changes.get("intensities", True) else ("scans/intensities",)
    for number, place in enumerate(("lobby", "corridor", "office")):
        path = tmp_path / "data" / "sequences" / f"{place}--first--own.h5"
        make_sequence(path, 60, lidar=lidar, environment=place, seed=number, drop=drop)
    publish(tmp_path / "data", name="own", version="1.0.0", license="CC0-1.0")
    settings = replace(settings_of(tmp_path / "data"), lidar="own")
    experiment = Experiment("pair", "Two rows", (Method("s3net", "R"), method))
    with pytest.raises(InvalidInputError, match=message):
        run_experiment(experiment, settings, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_second_process_in_the_folder_is_refused(dataset_folder: Path, tmp_path: Path):
    settings = settings_of(dataset_folder)
    with (
        alone_in(tmp_path),
        pytest.raises(InvalidInputError, match="another process works here"),
    ):
        run_experiment(EXPERIMENT, settings, tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"spec": {}}', '{"figures": {"CA": 1}}'])
def test_a_damaged_result_is_one_clear_error(finished, tmp_path: Path, text: str):
    path = tmp_path / "result.json"
    path.write_text(text)
    with pytest.raises(CorruptFileError, match="delete it to run again"):
        RunResult.read(path)


def test_a_time_limit_is_left_out_so_that_a_busy_machine_trains_the_same(finished):
    folder, _, _ = finished
    said = json.loads((folder / "s3net-R-small-seed0" / "run.json").read_text())
    assert TrainingConfig.quick().time_limit_s is not None
    assert said["time_limit_s"] is None


def test_one_sample_has_no_spread(dataset_folder: Path, tmp_path: Path):
    settings = settings_of(dataset_folder, seeds=(0,), samples=1)
    ((run,),) = run_experiment(FIRST, settings, tmp_path).values()
    assert {std for _, std in run.figures["IoU"].values()} == {None}
