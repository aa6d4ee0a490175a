"""Files of format 1.0 open for good, and files of formats to come say what reads them.

The files in ``old/`` are bytes that a past version wrote (``old/make_1_0.py``); no test writes
them again.
"""

import hashlib
import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from semantic2d_dataset import SequenceReader, load_dataset, open_dataset, read_manifest
from semantic2d_dataset.access.known_datasets import find_known, known_datasets
from semantic2d_dataset.errors import (
    CorruptFileError,
    FormatVersionError,
    InvalidInputError,
    UnsafeFileError,
)
from semantic2d_dataset.format.manifest import find_problems
from semantic2d_dataset.format.schema import FORMAT_MAJOR, FORMAT_MINOR
from semantic2d_dataset.format.splits import read_scheme
from semantic2d_dataset.scoring.predictions import PredictionsReader
from semantic2d_dataset.scoring.submission import score_predictions
from tests.format.old import make_1_0

OLD = Path(__file__).parent / "old" / "1.0"
AT = "dataset/sequences"
MANIFEST = "dataset/dataset.json"
FULL, BARE = "hall--monday--tiny", "hall--tuesday--tiny"
BYTES = {
    "dataset/dataset.json": "183ae49a96e15c92b00f9c8a0606172b57c45b94d1d9dbda7cf28e5a7750282e",
    f"{AT}/{FULL}.h5": "f830d09a7cbf9a31f8788ea7d4416d6c552297dad16dbfa54f69ae0433d58cf1",
    f"{AT}/{BARE}.h5": "ec6be22059cd4f5d5e825bd7bbb508b693a383848a371eabcd5469e7eed13f19",
    "dataset/splits/block.h5": "e01c16d08326c6f7d7067b45416fbb89fdcd3fa3c755c728d7771479ef26c89d",
    "predictions.h5": "a7d583a2eb578aaeecb08667b6f9b8e19067a0ac0d21d7e32aeebda457949397",
    "registry.json": "74ba88aa411c0c1a23e36df67944b5282c775568c638fd8fb7f404c3276bda61",
}
CONTENT = {
    FULL: "9ea40b70979569b3a54afcd171b2f166a88253a2f34ee1d530afce161b104f95",
    BARE: "870a728312f51648430826141ab404b6c49a22cff0fcad83d0ce830375d56f73",
}
BLOCK = "8bf729f50c10269bb7ec292da52c1656787ecebb796c9ef70c2d6f368742384d"
ARRAYS_1_0 = {
    "provenance",
    *(f"scans/{n}" for n in ("ranges", "intensities", "stamps_ns", "labels", "confidence")),
    *("poses/initial", "poses/refined", "commands/velocity", "lines/segments", "lines/offsets"),
    *(f"alignment/{n}" for n in ("residual_m", "inlier_ratio", "accepted", "covariance")),
    *("map/occupancy", "map/labels", "original/zeros"),
    *("streams/odom/stamps_ns", "streams/odom/data", "streams/odom/about"),
    *(f"streams/camera/{n}" for n in ("stamps_ns", "data", "offsets", "about")),
}


def test_the_files_are_the_ones_that_were_written_then():
    found = {
        str(path.relative_to(OLD)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in OLD.rglob("*")
        if path.is_file()
    }
    assert found == BYTES


def test_every_array_of_1_0_is_read_as_it_was_written():
    with SequenceReader(OLD / f"{AT}/{FULL}.h5") as reader:
        assert set(reader.names) == ARRAYS_1_0
        for name, values in make_1_0.sequence_arrays().items():
            found = reader.read(name)
            assert found.dtype == values.dtype
            np.testing.assert_array_equal(found, values, err_msg=name)


def test_what_describes_a_sequence_is_read_as_it_was_written():
    with SequenceReader(OLD / f"{AT}/{FULL}.h5") as reader:
        assert reader.header == make_1_0.HEADER
        scene = reader.read_map()
        assert scene.occupancy[1].tolist() == [0, 100, 255, 0, 100, 255]
        assert scene.labels[1].tolist() == [255, 9, 255, 255, 9, 255]
        assert (scene.resolution, scene.origin.as_array().tolist()) == (0.05, [-1.0, -0.5, 0.1])
        assert reader.describe_stream("odom")["columns"] == ["x", "y", "yaw"]
        batch = reader.batch(3, 4)
        assert batch.labels[0].tolist() == [2, 8, 4, 1, 7, 3, 9, 5, 1, 8, 4, 0]
        assert (batch.stamps_ns[0], batch.valid[0, :4].tolist()) == (
            1_700_000_000_150_000_000,
            [False, False, False, True],
        )


@pytest.mark.parametrize("name", [FULL, BARE])
def test_content_digests_stay(name):
    with SequenceReader(OLD / f"{AT}/{name}.h5") as reader:
        assert reader.content_digest() == CONTENT[name]
        reader.check_values()


def test_a_data_set_of_1_0_is_whole_and_loads():
    assert find_problems(OLD / "dataset", full=True) == []
    data = open_dataset(OLD / "dataset")
    said = (data.manifest.name, data.manifest.version, data.manifest.license)
    assert said == ("old-data", "1.0.0", "CC0-1.0")
    assert data.manifest.lengths == {FULL: 70, BARE: 5}
    block = data.scheme("block")
    assert (block.digest, block.made_by) == (BLOCK, "by hand")
    assert block.sizes == {"train": 19, "val": 14, "test": 14, "none": 28}


def test_a_data_set_of_1_0_gives_the_features_that_it_gave():
    pytest.importorskip("torch")
    test = load_dataset(OLD / "dataset", lidar="tiny", split="test", in_memory=True)
    assert test[0]["scan_id"] == f"{FULL}/56"
    assert test[0]["ranges"][0].item() == pytest.approx(4.982606, rel=1e-6)
    assert test[0]["label"].tolist() == [3, 9, 5, 1, 7, 4, 0, 6, 2, 8, 4, 1]


def test_predictions_of_1_0_are_scored_as_they_were():
    with PredictionsReader(OLD / "predictions.h5") as reader:
        assert (reader.dataset, reader.dataset_version) == ("old-data", "1.0.0")
        assert (reader.scheme, reader.split) == ("block", "test")
        assert reader.metadata == {"method": "As it was"}
        assert reader.read(FULL, "scan_index").tolist() == list(range(56, 70))
        assert reader.read(FULL, "probabilities").dtype == np.float16
        assert reader.shape(FULL, "samples") == (2, 14, 12)
    result = score_predictions(OLD / "predictions.h5", open_dataset(OLD / "dataset"))
    assert result["mIoU"] == pytest.approx(0.5493475, abs=1e-6)
    assert result["submission"]["digests"]["split"] == BLOCK


def test_a_registry_of_1_0_is_read():
    found = find_known("old-data", OLD / "registry.json")
    assert (found.name, found.doi, found.citation) == ("old-data@1", "10.5281/zenodo.1", "Nobody")
    assert [type(source).__name__ for source in found.sources] == [
        "ZenodoRecord",
        "HuggingFaceFolder",
        "FileTable",
    ]


def open_sequence(folder):
    return SequenceReader(folder / f"{AT}/{FULL}.h5")


def open_splits(folder):
    return read_scheme(folder / "dataset/splits/block.h5", "block", {FULL: 70, BARE: 5})


def open_predictions(folder):
    return PredictionsReader(folder / "predictions.h5")


def open_manifest(folder):
    return read_manifest(folder / "dataset")


def open_registry(folder):
    return known_datasets(folder / "registry.json")


KINDS = {
    f"{AT}/{FULL}.h5": open_sequence,
    "dataset/splits/block.h5": open_splits,
    "predictions.h5": open_predictions,
    MANIFEST: open_manifest,
    "registry.json": open_registry,
}


def alter(path, version, *, unknown):
    """Say that a file is of another format, and give it what this package does not know."""
    if path.suffix == ".h5":
        with h5py.File(path, "r+", libver=("v110", "v110")) as file:
            file.attrs["format_version"] = np.bytes_(version)
            if unknown == "array":
                file["weather"] = np.zeros(3)
            elif unknown:
                file.attrs["weather"] = np.bytes_("rain")
        return
    said = json.loads(path.read_text()) | {"format_version": version}
    path.write_text(json.dumps(said | ({"weather": "rain"} if unknown else {})))


@pytest.fixture(params=list(KINDS), ids=lambda name: Path(name).name)
def altered(request, tmp_path):
    """Change one file of a copy; return how to open it."""
    folder = shutil.copytree(OLD, tmp_path / "copy")

    def change(version, *, unknown=""):
        alter(folder / request.param, version, unknown=unknown)
        return lambda: KINDS[request.param](folder)

    return change


@pytest.mark.parametrize("unknown", ["", "array"])
def test_a_newer_major_format_says_which_version_of_the_package_reads_it(altered, unknown):
    major = FORMAT_MAJOR + 1
    opened = altered(f"{major}.3", unknown=unknown)
    with pytest.raises(FormatVersionError) as told:
        opened()
    assert str(told.value).endswith(
        f": written in format {major}.3, and this package reads up to {FORMAT_MAJOR}.x; "
        f"install semantic2d-dataset {major}.0 or later"
    )


def test_a_newer_minor_format_opens_where_it_adds_nothing(altered):
    altered(f"{FORMAT_MAJOR}.{FORMAT_MINOR + 7}")()


@pytest.mark.parametrize("altered", [k for k in KINDS if k != MANIFEST], indirect=True)
@pytest.mark.parametrize("unknown", ["array", "attribute"])
def test_what_a_newer_minor_format_adds_is_refused_with_what_to_do(altered, unknown):
    version = f"{FORMAT_MAJOR}.{FORMAT_MINOR + 7}"
    opened = altered(version, unknown=unknown)
    with pytest.raises((UnsafeFileError, CorruptFileError, InvalidInputError)) as told:
        opened()
    assert "weather" in str(told.value)
    assert str(told.value).endswith(
        f"; the file is of format {version}, and this package knows "
        f"{FORMAT_MAJOR}.{FORMAT_MINOR}: install a newer semantic2d-dataset"
    )


@pytest.mark.parametrize("altered", [MANIFEST], indirect=True)
def test_what_a_newer_minor_format_adds_to_a_manifest_is_passed_over(altered):
    altered(f"{FORMAT_MAJOR}.{FORMAT_MINOR + 7}", unknown="array")()


def test_what_is_unknown_in_this_format_is_no_question_of_versions(altered):
    opened = altered(f"{FORMAT_MAJOR}.{FORMAT_MINOR}", unknown="array")
    with pytest.raises((UnsafeFileError, CorruptFileError, InvalidInputError)) as told:
        opened()
    assert "install" not in str(told.value)
