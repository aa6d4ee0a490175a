import hashlib

import numpy as np
import pytest

from salsa.dropping import drop_scans, dropped_before, read_drop_list
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from tests.generators import SMALL_LIDAR, make_arrays, make_map, make_sequence

SCANS = 200
CHANGED = {"scans/labels", "scans/confidence", "alignment/accepted"}


def write_labelled(path, scans=SCANS, provenance=None):
    rng = np.random.default_rng(3)
    header = SequenceHeader("lobby", "first", SMALL_LIDAR, provenance=provenance or {})
    arrays = make_arrays(scans)
    more = {
        "scans/confidence": rng.integers(1, 256, (scans, SMALL_LIDAR.beams)).astype(np.uint8),
        "alignment/residual_m": rng.uniform(0, 0.05, scans).astype(np.float32),
        "alignment/inlier_ratio": rng.uniform(0.6, 1, scans).astype(np.float32),
        "alignment/accepted": np.ones(scans, np.uint8),
        "alignment/covariance": rng.uniform(0, 1, (scans, 3, 3)),
        "lines/segments": np.zeros((scans, 4), np.float32),
        "lines/offsets": np.arange(scans + 1),
        "streams/none/stamps_ns": np.zeros(0, np.int64),
        "streams/imu/data": rng.uniform(0, 1, (5000, 2)),
    }
    with SequenceWriter(path, header) as writer:
        writer.append(arrays | more)
        writer.set_map(make_map())
    return arrays | more


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("drop") / "labelled.h5"
    return path, write_labelled(path, provenance={"made": "here", "salsa": {"inputs": 1}})


def test_dropped_scans_lose_their_labels_and_all_else_stays(source, tmp_path):
    path, arrays = source
    drop_scans(path, [3, 150, 151, 3], tmp_path / "out.h5")
    gone = np.isin(np.arange(SCANS), (3, 150, 151))
    with SequenceReader(tmp_path / "out.h5") as reader:
        assert set(reader.names) == {*arrays, "map/occupancy", "map/labels", "provenance"}
        for name, values in arrays.items():
            expected = values.copy()
            if name in CHANGED:
                expected[gone] = 255 if name == "scans/labels" else 0
            np.testing.assert_array_equal(reader.read(name), expected)
        np.testing.assert_array_equal(reader.read_map().labels, make_map().labels)
        said = reader.header.provenance
        assert reader.header.lidar == SMALL_LIDAR
        np.testing.assert_array_equal(dropped_before(reader), gone)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    drop = {"source": {"name": "labelled.h5", "sha256": digest}, "scans": ["3", "150-151"]}
    assert said == {"made": "here", "salsa": {"inputs": 1, "dropped": [drop]}}


def test_dropping_twice_remembers_both(source, tmp_path):
    drop_scans(source[0], [1], tmp_path / "one.h5")
    drop_scans(tmp_path / "one.h5", [7, 8], tmp_path / "two.h5")
    with SequenceReader(tmp_path / "two.h5") as reader:
        assert np.flatnonzero(dropped_before(reader)).tolist() == [1, 7, 8]
        assert not reader.read("alignment/accepted")[[1, 7, 8]].any()


@pytest.mark.parametrize(
    ("scans", "message"),
    [
        ([200, 3], "has 200 scans, from 0 to 199, so none to drop with index 200"),
        ([-1], "with index -1"),
        ([], "at least one index"),
        ([1.5], "float64"),
        ([[1]], r"\(1, 1\)"),
    ],
)
def test_scans_that_are_not_there_are_refused(source, scans, message, tmp_path):
    with pytest.raises(InvalidInputError, match=message):
        drop_scans(source[0], scans, tmp_path / "out.h5")
    assert not list(tmp_path.iterdir())


def test_what_exists_is_replaced_only_by_force_and_the_source_never(source, tmp_path):
    out = tmp_path / "out.h5"
    out.write_bytes(b"mine")
    with pytest.raises(InvalidInputError, match="use --force"):
        drop_scans(source[0], [1], out)
    assert out.read_bytes() == b"mine"
    drop_scans(source[0], [1], out, force=True)
    before = source[0].read_bytes()
    with pytest.raises(InvalidInputError, match="is an input itself"):
        drop_scans(source[0], [1], source[0], force=True)
    assert source[0].read_bytes() == before


def test_a_sequence_that_is_not_labelled_is_an_error(tmp_path):
    make_sequence(tmp_path / "bare.h5", drop=("scans/labels",))
    with pytest.raises(InvalidInputError, match="has no scans/labels, .*; label it first"):
        drop_scans(tmp_path / "bare.h5", [1], tmp_path / "out.h5")
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize(
    "salsa", [5, {"dropped": 7}, {"dropped": [{}]}, {"dropped": [{"scans": ["4-999"]}]}]
)
def test_a_provenance_that_says_nonsense_is_corrupt(salsa, tmp_path):
    write_labelled(tmp_path / "odd.h5", 5, {"salsa": salsa})
    with SequenceReader(tmp_path / "odd.h5") as reader, pytest.raises(CorruptFileError):
        dropped_before(reader)
    with pytest.raises(CorruptFileError):
        drop_scans(tmp_path / "odd.h5", [1], tmp_path / "out.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["odd.h5"]


def test_a_list_holds_indices_ranges_and_comments(tmp_path):
    path = tmp_path / "scans.txt"
    path.write_text("# seen\n\n 7 # blurred\n3-5\n4 - 6\n0", encoding="utf-8")
    assert read_drop_list(path, 8).tolist() == [0, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("#\n\n3-10", "line 3: the sequence has 10 scans, from 0 to 9; found '3-10'"),
        ("# nothing\n", "names no scan to drop"),
    ],
)
def test_a_bad_list_is_refused_with_its_line(text, message, tmp_path):
    path = tmp_path / "scans.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError, match=message):
        read_drop_list(path, 10)
