import multiprocessing
import pickle
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, WriteError
from semantic2d_dataset.format.schema import FORMAT_VERSION
from semantic2d_dataset.format.sequence import (
    SequenceHeader,
    SequenceReader,
    SequenceWriter,
    slug,
)
from semantic2d_dataset.scene.lidars import LIDARS
from tests.generators import SMALL_LIDAR, make_arrays, make_map, make_sequence


def test_everything_reads_back_as_written(tmp_path):
    path = tmp_path / "a.h5"
    written = make_sequence(path, 150)
    with SequenceReader(path) as reader:
        for name, values in written.items():
            np.testing.assert_array_equal(reader.read(name), values)
            assert reader.read(name).dtype == values.dtype
        scene = reader.read_map()
        header = reader.header
    assert scene is not None
    np.testing.assert_array_equal(scene.occupancy, make_map().occupancy)
    np.testing.assert_array_equal(scene.labels, make_map().labels)
    assert (scene.resolution, scene.origin) == (make_map().resolution, make_map().origin)
    assert header.sequence_id == "lobby--first--small"
    assert header.lidar == SMALL_LIDAR
    assert header.provenance == {"source": "generated", "seed": 0}
    assert (header.license, header.stamps_source) == ("CC0-1.0", "synthetic")


@pytest.mark.parametrize("lidar", LIDARS.values(), ids=list(LIDARS))
def test_each_lidar_of_the_release_is_kept_to_the_last_bit(lidar, tmp_path):
    make_sequence(tmp_path / "a.h5", 3, lidar=lidar)
    assert SequenceReader(tmp_path / "a.h5").lidar == lidar


floats = st.floats(width=32, allow_nan=True, allow_infinity=True)


@settings(max_examples=12)
@given(st.data(), st.integers(0, 70))
def test_any_ranges_labels_and_stamps_survive(data, scans):
    ranges = data.draw(arrays(np.float32, (scans, 37), elements=floats, fill=floats))
    labels = data.draw(arrays(np.uint8, (scans, 37)))
    stamps = np.sort(data.draw(arrays(np.int64, scans)))
    header = SequenceHeader(environment="a", recording="b", lidar=SMALL_LIDAR)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        with SequenceWriter(path, header) as writer:
            for part in (slice(0, scans // 3), slice(scans // 3, None)):
                writer.append(
                    {
                        "scans/ranges": ranges[part],
                        "scans/labels": labels[part],
                        "scans/stamps_ns": stamps[part],
                    }
                )
        with SequenceReader(path) as reader:
            assert reader.read("scans/ranges").tobytes() == ranges.tobytes()
            np.testing.assert_array_equal(reader.read("scans/labels"), labels)
            np.testing.assert_array_equal(reader.read("scans/stamps_ns"), stamps)


def test_block_size_while_writing_changes_nothing(tmp_path):
    written = make_arrays(130)
    digests = []
    for step in (1000, 64, 7):
        path = tmp_path / f"{step}.h5"
        header = SequenceHeader(environment="a", recording="b", lidar=SMALL_LIDAR)
        with SequenceWriter(path, header) as writer:
            for start in range(0, 130, step):
                writer.append({n: a[start : start + step] for n, a in written.items()})
        digests.append(SequenceReader(path).content_digest())
    assert len(set(digests)) == 1


def test_content_digest_ignores_licence_and_provenance_but_no_bit_of_data(tmp_path):
    digests = {}
    for name, seed, kind in (("a", 0, "x"), ("b", 0, "y"), ("c", 1, "x")):
        path = tmp_path / f"{name}.h5"
        header = SequenceHeader(
            environment="a", recording="b", lidar=SMALL_LIDAR, license=kind, provenance={"k": kind}
        )
        with SequenceWriter(path, header) as writer:
            writer.append(make_arrays(10, seed=seed))
        digests[name] = SequenceReader(path).content_digest()
    assert digests["a"] == digests["b"] != digests["c"]


def test_content_digest_tells_dtypes_apart(tmp_path):
    digests = set()
    for dtype in ("<f4", "<i4"):
        path = tmp_path / f"{dtype[1:]}.h5"
        with SequenceWriter(path, SequenceHeader("a", "b", SMALL_LIDAR)) as writer:
            writer.append(make_arrays(4) | {"original/x": np.zeros(4, dtype)})
        digests.add(SequenceReader(path).content_digest())
    assert len(digests) == 2


def test_batch_takes_refined_poses_then_initial_then_none(tmp_path):
    written = make_sequence(tmp_path / "a.h5", 20)
    make_sequence(tmp_path / "b.h5", 20, drop=("poses/refined",))
    make_sequence(tmp_path / "c.h5", 20, drop=("poses/refined", "poses/initial"))
    poses = [SequenceReader(tmp_path / f"{n}.h5").batch(5, 9).poses for n in "abc"]
    np.testing.assert_array_equal(poses[0], written["poses/refined"][5:9])
    np.testing.assert_array_equal(poses[1], written["poses/initial"][5:9])
    assert poses[2].shape == (4, 3)
    assert np.isnan(poses[2]).all()


def test_batch_without_intensities_and_labels_says_so(tmp_path):
    path = tmp_path / "a.h5"
    make_sequence(path, 5, drop=("scans/intensities", "scans/labels"))
    batch = SequenceReader(path).batch()
    assert batch.intensities is None
    assert batch.labels is None
    assert "scans/labels" not in SequenceReader(path)


def read_some(reader, start, queue):
    queue.put(reader.read("scans/ranges", start, start + 10).tobytes())


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_an_open_reader_works_in_other_processes(method, tmp_path):
    path = tmp_path / "a.h5"
    ranges = make_sequence(path, 150)["scans/ranges"]
    reader = SequenceReader(path)
    reader.read("scans/ranges", 0, 1)
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    starts = [0, 60, 120]
    workers = [context.Process(target=read_some, args=(reader, s, queue)) for s in starts]
    for worker in workers:
        worker.start()
    found = {queue.get(timeout=60) for _ in workers}
    for worker in workers:
        worker.join()
    assert found == {ranges[s : s + 10].tobytes() for s in starts}


def test_reader_pickles_without_its_handle(tmp_path):
    make_sequence(tmp_path / "a.h5", 10)
    reader = SequenceReader(tmp_path / "a.h5")
    again = pickle.loads(pickle.dumps(reader))
    reader.close()
    np.testing.assert_array_equal(again.read("scans/labels"), reader.read("scans/labels"))


def test_arrays_that_do_not_fit_each_other_are_refused(tmp_path):
    path = tmp_path / "a.h5"
    make_sequence(path, 10)
    with h5py.File(path, "r+") as file:
        file["scans/labels"].resize(9, axis=0)
    with pytest.raises(CorruptFileError, match="scans/labels: expected 10 rows, found 9"):
        SequenceReader(path)


def test_sequence_id_must_be_that_of_its_parts(tmp_path):
    path = tmp_path / "a.h5"
    make_sequence(path, 10)
    with h5py.File(path, "r+") as file:
        file.attrs["sequence_id"] = np.bytes_(b"lobby--second--small")
    with pytest.raises(CorruptFileError, match="expected the sequence id lobby--first--small"):
        SequenceReader(path)


def test_file_is_marked_with_format_and_readable_by_hdf5_110(tmp_path):
    path = tmp_path / "a.h5"
    make_sequence(path, 10)
    assert path.read_bytes()[8] == 3  # superblock version 3: HDF5 1.10
    with h5py.File(path) as file:
        assert file.attrs["format_version"].decode() == FORMAT_VERSION
        assert file["scans/ranges"].fletcher32


@pytest.mark.parametrize("name", ["Lobby", "a--b", "", "a/b", "-a", "a b", "ä", "a" * 60 + "B"])
def test_names_that_no_sequence_id_may_hold_are_refused_with_a_proposal(name):
    with pytest.raises(InvalidInputError, match="such as"):
        SequenceHeader(environment=name, recording="b", lidar=SMALL_LIDAR)


@given(st.text())
def test_any_text_becomes_a_valid_name(text):
    SequenceHeader(environment=slug(text), recording="b", lidar=SMALL_LIDAR)


def test_unknown_stamps_source_is_refused():
    with pytest.raises(InvalidInputError, match="stamps_source"):
        SequenceHeader(environment="a", recording="b", lidar=SMALL_LIDAR, stamps_source="guess")


def test_stamps_whose_difference_is_beyond_int64_are_in_order(tmp_path):
    wide = make_arrays(3) | {"scans/stamps_ns": np.array([-(2**63), 0, 2**63 - 1])}
    header = SequenceHeader(environment="a", recording="b", lidar=SMALL_LIDAR)
    with SequenceWriter(tmp_path / "a.h5", header) as writer:
        writer.append(wide)
    with SequenceReader(tmp_path / "a.h5") as reader:
        reader.check_values()


def copied(source, out, names=None, header=None):
    with SequenceReader(source) as reader:
        kept = [name for name in reader.names if name != "provenance" and "map/" not in name]
        with SequenceWriter(out, header or reader.header) as writer:
            writer.copy(reader, kept if names is None else names)
            scene = reader.read_map()
            if scene is not None:
                writer.set_map(scene)


def stored(path, name):
    with h5py.File(path) as file:
        array = file[name]
        places = range(0, len(array), array.chunks[0])
        return [array.id.read_direct_chunk((row, *[0] * (array.ndim - 1)))[1] for row in places]


@pytest.mark.parametrize("scans", [1, 64, 150])
def test_a_copy_holds_the_same_chunks_and_more_may_be_added(scans, tmp_path):
    make_sequence(tmp_path / "a.h5", scans)
    copied(tmp_path / "a.h5", tmp_path / "b.h5")
    with SequenceReader(tmp_path / "a.h5") as one, SequenceReader(tmp_path / "b.h5") as other:
        other.check_values()
        assert one.content_digest() == other.content_digest()
        assert other.header.stamps_source == "synthetic"
    for name in ("scans/ranges", "poses/initial"):
        assert stored(tmp_path / "a.h5", name) == stored(tmp_path / "b.h5", name)
    with (
        SequenceReader(tmp_path / "a.h5") as reader,
        SequenceWriter(tmp_path / "c.h5", reader.header) as writer,
    ):
        writer.copy(reader, ["scans/ranges", "scans/stamps_ns"])
        writer.append({"scans/labels": np.ones((scans, SMALL_LIDAR.beams), np.uint8)})
    with SequenceReader(tmp_path / "c.h5") as reader:
        assert (reader.read("scans/labels") == 1).all()


def test_arrays_stored_in_another_way_are_packed_again(tmp_path):
    make_sequence(tmp_path / "a.h5", 150)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        ranges = file["scans/ranges"][:]
        del file["scans/ranges"]
        more = {"fletcher32": True, "compression": "gzip", "maxshape": (None, ranges.shape[1])}
        file.create_dataset("scans/ranges", data=ranges, chunks=(17, ranges.shape[1]), **more)
    copied(tmp_path / "a.h5", tmp_path / "b.h5")
    with h5py.File(tmp_path / "b.h5") as file:
        assert file["scans/ranges"].chunks[0] == 64
        np.testing.assert_array_equal(file["scans/ranges"][:], ranges)


def test_a_damaged_chunk_is_not_copied(tmp_path):
    make_sequence(tmp_path / "a.h5", 150)
    with h5py.File(tmp_path / "a.h5") as file:
        place = file["scans/ranges"].id.get_chunk_info(1)
    data = bytearray((tmp_path / "a.h5").read_bytes())
    data[place.byte_offset + place.size // 2] ^= 0xFF
    (tmp_path / "a.h5").write_bytes(data)
    with pytest.raises(WriteError, match="a.h5: /scans/ranges: a chunk is damaged"):
        copied(tmp_path / "a.h5", tmp_path / "b.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_what_does_not_fit_is_not_copied(tmp_path):
    make_sequence(tmp_path / "a.h5", 20)
    other = SequenceHeader("a", "b", LIDARS["wlr-716"])
    with pytest.raises(InvalidInputError, match="scans/ranges: expected 811 beams, found 37"):
        copied(tmp_path / "a.h5", tmp_path / "b.h5", ["scans/ranges"], other)
    with pytest.raises(InvalidInputError, match="scans/ranges: has rows already"):
        copied(tmp_path / "a.h5", tmp_path / "b.h5", ["scans/ranges", "scans/ranges"])
    with pytest.raises(InvalidInputError, match="has no array 'scans/confidence'"):
        copied(tmp_path / "a.h5", tmp_path / "b.h5", ["scans/confidence"])
    with pytest.raises(InvalidInputError, match="a sequence needs scans/ranges"):
        copied(tmp_path / "a.h5", tmp_path / "b.h5", ["scans/stamps_ns"])
    assert not (tmp_path / "b.h5").exists()
