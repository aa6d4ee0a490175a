"""Who trains on a scheme that leaks is warned, once; who compares or knows is left in peace."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

from semantic2d_dataset import load_dataset, open_dataset, publish
from semantic2d_dataset.access import leak_warnings
from semantic2d_dataset.cli import main
from semantic2d_dataset.errors import LeakageWarning
from semantic2d_dataset.format.splits import SplitScheme
from tests.generators import make_sequence


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """As if nobody was warned before."""
    monkeypatch.setattr(leak_warnings, "_warned", set())


def warned(folder, **options):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        load_dataset(folder, lidar="small", in_memory=False, **options)
    return [each for each in found if each.category is LeakageWarning]


def test_training_on_single_scans_warns_once_with_what_to_do(dataset_folder):
    (found,) = warned(dataset_folder, scheme="frame")
    assert str(found.message) == (
        "generated: 89% of the test scans of the scheme 'frame' lie next to a train scan, so its "
        "scores say little about new scans; train a new model on 'block', and use this scheme to "
        "compare with published figures only"
    )
    assert found.filename.endswith("torch_datasets.py")
    assert not warned(dataset_folder, scheme="frame", features="RIA")


@pytest.mark.parametrize("split", ["val", "test", None])
def test_who_does_not_train_is_not_warned(dataset_folder, split):
    assert not warned(dataset_folder, scheme="frame", split=split, features="R")


@pytest.mark.parametrize("scheme", ["block", "environment"])
def test_schemes_that_do_not_leak_do_not_warn(dataset_folder, scheme):
    assert not warned(dataset_folder, scheme=scheme)


def test_what_a_scheme_does_counts_and_not_its_name(tmp_path):
    (tmp_path / "sequences").mkdir()
    make_sequence(tmp_path / "sequences" / "a.h5", 40)
    ids = {"lobby--first--small": np.repeat(np.uint8([0, 1, 2]), (20, 10, 10))}
    mixed = {"lobby--first--small": np.tile(np.uint8([0, 2]), 20)}
    schemes = [SplitScheme("frame", ids, ""), SplitScheme("mine", mixed, "")]
    publish(tmp_path, name="own", version="1.0.0", schemes=schemes)
    assert not warned(tmp_path, scheme="frame")
    assert "100% of the test scans of the scheme 'mine'" in str(
        warned(tmp_path, scheme="mine")[0].message
    )


def test_the_warning_can_be_silenced_by_its_name(dataset_folder):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", category=LeakageWarning)
        load_dataset(dataset_folder, lidar="small", scheme="frame", in_memory=False)


def test_the_command_line_warns_in_one_line(dataset_folder, tmp_path, capsys, monkeypatch):
    words = "baseline train s3net --lidar small --scheme frame --epochs 1 --preset quick --data"
    monkeypatch.setattr(
        "sys.argv",
        ["semantic2d", *words.split(), str(dataset_folder), "--out", str(tmp_path / "m")],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        with pytest.raises(SystemExit) as ended:
            main()
    assert not ended.value.code
    lines = [line for line in capsys.readouterr().err.splitlines() if "next to" in line]
    assert len(lines) == 1
    assert lines[0].startswith("warning: generated: 89% of the test scans")


def test_a_process_of_its_own_shows_it_as_python_does(dataset_folder):
    code = (
        "import sys; from semantic2d_dataset import load_dataset\n"
        "for _ in range(2): load_dataset(sys.argv[1], lidar='small', scheme='frame')"
    )
    command = [sys.executable, "-c", code, str(dataset_folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr.count("LeakageWarning: generated: 89%") == 1


def test_data_sets_are_told_apart(dataset_folder, tmp_path):
    (tmp_path / "sequences").mkdir()
    make_sequence(tmp_path / "sequences" / "a.h5", 40)
    publish(tmp_path, name="own", version="1.0.0")
    assert open_dataset(tmp_path).scheme("frame").neighbour_share("test") > 0.5
    assert warned(dataset_folder, scheme="frame")
    assert warned(tmp_path, scheme="frame")
