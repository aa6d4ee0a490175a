import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from semantic2d_dataset.errors import DatasetNotFoundError
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.publishing.contribution import check_contribution
from semantic2d_dataset.publishing.findings import ERROR, NOTE, WARNING
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from tests.generators import make_sequence

HOKUYO = "office--drive-1--hokuyo-utm-30lx-ew"


@pytest.fixture
def office(mini, tmp_path):
    """A function that writes true scans of another office, with whatever is wrong in them."""

    def write(*, header=None, file=None, drop=(), **changes):
        said = {"environment": "other-office", "license": "CC-BY-4.0"} | (header or {})
        with mini.reader(HOKUYO) as reader:
            arrays = {n: reader.read(n) for n in reader.names if n.count("/") == 1}
            arrays = {n: a for n, a in arrays.items() if not n.startswith("map/") and n not in drop}
            noise = np.random.default_rng(0).normal(0, 1e-3, arrays["scans/ranges"].shape)
            arrays["scans/ranges"] += noise.astype(np.float32)
            for name, change in changes.items():
                path = name.replace("__", "/")
                arrays[path] = np.ascontiguousarray(change(arrays[path]))
            made, scene = replace(reader.header, **said), reader.read_map()
        (tmp_path / "mine").mkdir(exist_ok=True)
        path = tmp_path / "mine" / (file or f"{made.sequence_id}.h5")
        with SequenceWriter(path, made) as writer:
            writer.append(arrays)
            writer.set_map(scene)
        return path

    return write


def levels(found, text):
    """Levels of the findings whose text holds some words."""
    return [each.level for each in found.findings if text in str(each)]


def test_true_labels_of_a_new_place_have_no_error_and_no_warning(office, mini):
    found = check_contribution([office()], mini)
    bad = [str(f) for f in found.findings if f.level != NOTE and "at the time of" not in str(f)]
    assert bad == []
    assert found.errors == 0


SPOILT = {
    "labels of the next scan": ("change their class", WARNING, lambda x: np.roll(x, 1, axis=0)),
    "shuffled scans": (
        "change their class",
        ERROR,
        lambda x: x[np.random.default_rng(0).permutation(len(x))],
    ),
    "beams reversed": ("of a mapped object have another class", ERROR, lambda x: x[:, ::-1]),
    "noise": (
        "differ from both neighbours",
        WARNING,
        lambda x: np.where(np.random.default_rng(0).random(x.shape) < 0.02, 1, x).astype(x.dtype),
    ),
    "all person": ("all labels are Person", ERROR, lambda x: np.full_like(x, 4)),
    "classes exchanged": (
        "of a mapped object have another class",
        WARNING,
        lambda x: np.where(x == 1, 7, x).astype(x.dtype),
    ),
    "none": ("every beam is unlabelled", ERROR, lambda x: np.full_like(x, 255)),
    "few": (
        "of the beams with a return are labelled",
        WARNING,
        lambda x: np.where(np.arange(x.shape[1]) < 900, 255, x).astype(x.dtype),
    ),
}


@pytest.mark.parametrize("how", SPOILT)
def test_labels_that_were_spoilt_are_found(how, office):
    says, level, change = SPOILT[how]
    assert level in levels(check_contribution([office(scans__labels=change)]), says)


def test_a_class_where_nothing_was_measured_is_found(office):
    path = office(scans__ranges=lambda x: np.where(np.arange(x.shape[1]) < 50, np.inf, x))
    assert levels(check_contribution([path]), "without a return") == [ERROR]


def test_poses_that_are_off_are_found(office):
    path = office(poses__refined=lambda x: x + np.array([0.5, 0, 0]))
    assert levels(check_contribution([path]), "of a mapped object have another class") == [WARNING]


@pytest.mark.parametrize(
    ("where", "change", "says"),
    [
        ("poses__refined", lambda x: x + (np.arange(len(x)) > 100)[:, None] * (9.0, 0, 0), "m/s"),
        ("poses__refined", lambda x: x * (1, 1, 0) + np.arange(len(x))[:, None] * (0, 0, 1),
         "rad/s at scan"),
        ("scans__stamps_ns", lambda x: x + (np.arange(len(x)) > 100) * 60_000_000_000,
         "nothing for 60.0 s before scan 101"),
        ("scans__stamps_ns", lambda x: x // 10 * 10 - x[0], "after 1970"),
        ("scans__stamps_ns", lambda x: x[0] + (x - x[0]) // 1000, "look at the unit"),
        ("scans__stamps_ns", lambda x: np.repeat(x[::2], 2), "the stamp of the one before"),
    ],
)  # fmt: skip
def test_stamps_and_poses_that_cannot_be_are_found(where, change, says, office):
    assert WARNING in levels(check_contribution([office(**{where: change})]), says)


@pytest.mark.parametrize(
    ("words", "says"),
    [("unknown", "ask who owns the recording"), ("free, I think", "spdx.org/licenses")],
)
def test_a_licence_that_nobody_can_rely_on_is_an_error(words, says, office):
    assert levels(check_contribution([office(header={"license": words})]), says) == [ERROR]


def test_file_name_and_classes_must_be_those_of_the_data_set(office, mini):
    own = Taxonomy((*SEMANTIC2D.names[:-1], "Fence"), SEMANTIC2D.colours)
    found = check_contribution([office(header={"taxonomy": own}, file="x.h5")], mini)
    assert levels(found, "give the file the name <environment>--<recording>--<lidar>.h5") == [ERROR]
    assert levels(found, "label it with the taxonomy of the data set") == [ERROR]


def test_data_that_the_data_set_has_already_are_found(office, mini, tmp_path):
    source = mini.root / "sequences" / f"{HOKUYO}.h5"
    copy = shutil.copy(source, tmp_path / f"{HOKUYO}.h5")
    assert levels(check_contribution([copy], mini), "holds the same data") == [ERROR]
    with SequenceReader(source) as reader:
        ranges = reader.read("scans/ranges")
    part = office(scans__ranges=lambda x: np.concatenate((ranges[:40], x[40:])))
    found = check_contribution([part], mini)
    assert levels(found, "40 scans (11.8%) have the ranges of scans in") == [ERROR]


def test_what_is_near_to_what_the_data_set_has_is_told(office, mini):
    found = check_contribution(
        [office(header={"environment": "office", "recording": "drive-2"})], mini
    )
    assert levels(found, "is of the environment of") == [NOTE]
    assert levels(found, "was recorded at the time of") == [WARNING]
    found = check_contribution([office(header={"environment": "office"})], mini)
    assert levels(found, "a name of its own") == [ERROR]


def test_sequences_are_compared_with_each_other_too(office, tmp_path):
    first = office()
    second = tmp_path / "mine" / "x.h5"
    shutil.copy(first, second)
    assert levels(check_contribution([tmp_path / "mine"]), "holds the same data") == [ERROR]


def test_damaged_files_and_missing_labels_are_findings_like_others(tmp_path):
    make_sequence(tmp_path / "lobby--first--small.h5", drop=("scans/labels",))
    (tmp_path / "broken.h5").write_bytes(b"\x89HDF\r\n\x1a\n nothing")
    found = check_contribution([tmp_path])
    assert levels(found, "semantic2d salsa label") == [ERROR]
    assert levels(found, "broken.h5") == [ERROR]


def test_a_finding_names_a_damaged_file_once(tmp_path):
    path = tmp_path / "empty.h5"
    path.touch()
    assert str(check_contribution([path])).count(str(path)) == 1


def test_what_is_not_there_is_told_from_a_folder_without_sequences(tmp_path):
    with pytest.raises(DatasetNotFoundError, match="nowhere: does not exist"):
        check_contribution([tmp_path / "nowhere"])
    with pytest.raises(DatasetNotFoundError, match="no sequences .* semantic2d convert"):
        check_contribution([tmp_path])


def test_findings_are_the_same_in_words_and_in_json(office):
    found = check_contribution([office(header={"license": "unknown"})])
    said = json.loads(json.dumps(found.as_dict()))
    assert said["errors"] == found.errors == 1
    assert said["findings"][0].keys() == {"level", "where", "found", "expected", "advice"}
    assert str(found).splitlines()[0].startswith("error: ")
