import pickle

import numpy as np
import pytest

from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.errors import CorruptFileError, DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.format.manifest import publish
from tests.generators import SMALL_LIDAR, make_arrays, make_sequence


@pytest.fixture(scope="module")
def data(dataset_folder):
    return open_dataset(dataset_folder)


def make_source(data, *, in_memory, split="train", scheme="frame"):
    return ScanSource(data, lidar="small", split=split, scheme=scheme, in_memory=in_memory)


def expected_fields(data, source):
    """The scans of the split, in order, straight from the generator."""
    seeds = {"lobby": 0, "corridor": 1, "office": 2}
    parts = []
    for entry in data.sequences():
        arrays = make_arrays(150, seed=seeds[entry.environment])
        rows = data.scheme(source.scheme).scans_of(entry.id, source.split)
        parts.append({name: values[rows] for name, values in arrays.items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("scheme", ["block", "frame", "environment"])
def test_every_scan_of_a_split_is_delivered_once_and_right(data, scheme, in_memory):
    total = 0
    for split in ("train", "val", "test"):
        source = make_source(data, in_memory=in_memory, split=split, scheme=scheme)
        fields, rows = source.fetch(np.arange(len(source)))
        expected = expected_fields(data, source)
        for name in ("ranges", "intensities", "labels"):
            np.testing.assert_array_equal(fields[name][rows], expected[f"scans/{name}"])
        np.testing.assert_array_equal(fields["poses"][rows], expected["poses/refined"])
        total += len(source)
    assert total == 450 or scheme == "block"


@pytest.mark.parametrize("seed", range(3))
def test_streamed_scans_come_in_any_order_asked_for(data, seed):
    streamed, kept = (make_source(data, in_memory=m) for m in (False, True))
    wanted = np.random.default_rng(seed).integers(0, len(kept), 200)
    found, rows = streamed.fetch(wanted)
    memory, there = kept.fetch(wanted)
    np.testing.assert_array_equal(found["labels"][rows], memory["labels"][there])


def test_nothing_wanted_is_nothing_delivered(data):
    for in_memory in (False, True):
        fields, rows = make_source(data, in_memory=in_memory).fetch(np.arange(0))
        assert fields["ranges"][rows].shape == (0, 37)


def test_ids_name_sequence_and_index(data):
    source = make_source(data, in_memory=False, split=None)
    assert len(source) == len(source.scan_ids) == 450
    assert source.scan_ids[[0, 151, 449]].tolist() == [
        "corridor--first--small/0",
        "lobby--first--small/1",
        "office--first--small/149",
    ]


def test_chunk_runs_cover_all_scans_once(data):
    source = make_source(data, in_memory=False)
    runs = source.chunk_runs()
    assert [i for run in runs for i in run] == list(range(len(source)))
    assert len(runs) == 9  # three sequences of 150 scans in chunks of 64


def test_unpickled_source_reads_the_same(data):
    for in_memory in (False, True):
        source = make_source(data, in_memory=in_memory)
        text = pickle.dumps(source)
        assert len(text) < 20_000  # no data travels
        again = pickle.loads(text)
        fields, rows = again.fetch(np.array([3, 1]))
        here, there = source.fetch(np.array([3, 1]))
        np.testing.assert_array_equal(fields["ranges"][rows], here["ranges"][there])


def test_class_counts_leave_out_what_is_unlabelled_or_has_no_return(data):
    source = make_source(data, in_memory=False)
    expected = expected_fields(data, source)
    labels = expected["scans/labels"][SMALL_LIDAR.has_return(expected["scans/ranges"])]
    np.testing.assert_array_equal(source.class_counts(), np.bincount(labels[labels != 255]))


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"lidar": "hokuyo"}, DatasetNotFoundError, "no sequence of the lidar 'hokuyo'; it has"),
        ({"split": "training"}, InvalidInputError, "unknown split 'training'"),
        ({"scheme": "random"}, InvalidInputError, "unknown scheme 'random'; known are block"),
    ],
)
def test_unknown_names_list_the_known_ones(options, error, says, data):
    given = {"lidar": "small", "split": "train", "scheme": "block"}
    with pytest.raises(error, match=says):
        ScanSource(data, **(given | options))


def test_empty_split_is_named(tmp_path):
    (tmp_path / "sequences").mkdir()
    make_sequence(tmp_path / "sequences" / "a.h5", 2)
    publish(tmp_path, name="tiny", version="1.0.0")
    with pytest.raises(DatasetNotFoundError, match="no scan in the split 'val'"):
        ScanSource(open_dataset(tmp_path), lidar="small", split="val", scheme="frame")


def test_sequences_of_one_lidar_must_agree_in_geometry(tmp_path):
    from dataclasses import replace

    (tmp_path / "sequences").mkdir()
    make_sequence(tmp_path / "sequences" / "a.h5", 5)
    other = replace(SMALL_LIDAR, range_max=10.0)
    make_sequence(tmp_path / "sequences" / "b.h5", 5, lidar=other, recording="second")
    publish(tmp_path, name="tiny", version="1.0.0")
    with pytest.raises(CorruptFileError, match="b.h5: its lidar or taxonomy differs"):
        ScanSource(open_dataset(tmp_path), lidar="small", split=None, scheme="frame")


def test_unlabelled_sequence_counts_as_unlabelled(tmp_path):
    (tmp_path / "sequences").mkdir()
    make_sequence(tmp_path / "sequences" / "a.h5", 5, drop=("scans/labels", "scans/intensities"))
    publish(tmp_path, name="tiny", version="1.0.0")
    source = ScanSource(open_dataset(tmp_path), lidar="small", split=None, scheme="frame")
    fields, _ = source.fetch(np.arange(5))
    assert (fields["labels"] == 255).all()
    assert "intensities" not in fields


def test_statistics_of_a_large_split_read_few_chunks(data, monkeypatch):
    whole = make_source(data, in_memory=False).compute_statistics("RIA")
    monkeypatch.setattr("semantic2d_dataset.access.scan_source._STATISTICS_SCANS", 100)
    source = make_source(data, in_memory=False)
    read = []
    one = ScanSource._read
    monkeypatch.setattr(
        ScanSource, "_read", lambda self, *what: (read.append(what[1:]), one(self, *what))[1]
    )
    found = source.compute_statistics("RIA")
    assert len(read) == 2 * 3  # every fourth of nine chunks; labels and poses are not needed
    np.testing.assert_allclose(found.mean, whole.mean, rtol=0.05)
    np.testing.assert_allclose(found.std, whole.std, rtol=0.05)


@pytest.mark.parametrize("scheme", ["block", "frame"])
def test_another_split_reads_from_the_same_files(data, scheme):
    train = make_source(data, in_memory=True, scheme=scheme)
    other = train.of_split("val")
    expected = make_source(data, in_memory=True, split="val", scheme=scheme)
    assert other.scan_ids.tolist() == expected.scan_ids.tolist()
    fields, rows = other.fetch(np.arange(len(other)))
    np.testing.assert_array_equal(
        fields["ranges"][rows], expected_fields(data, other)["scans/ranges"]
    )
    assert train.split == "train"
    with pytest.raises(InvalidInputError, match="unknown split"):
        train.of_split("training")


def test_scans_are_found_by_their_place(data):
    source = make_source(data, in_memory=False, split="val")
    numbers = np.arange(len(source))
    sequences, rows = source.places_of(numbers)
    np.testing.assert_array_equal(source.numbers_at(sequences, rows), numbers)
    places = {*zip(sequences.tolist(), rows.tolist(), strict=True)}
    for sequence, row in ((0, -1), (0, 150), (2, 10_000), (3, 0)):
        assert source.numbers_at(np.array([sequence]), np.array([row])) == -1
    absent = next(row for row in range(150) if (1, row) not in places)
    assert source.numbers_at(np.array([1]), np.array([absent])) == -1
