"""Chunks as our threads pack them, beside those that HDF5 packs itself."""

import io
import json
import math
import struct
import zlib

import h5py
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from semantic2d_dataset.errors import CorruptFileError
from semantic2d_dataset.format import writer_process
from semantic2d_dataset.format.chunks import (
    count_cores,
    deflate,
    fletcher32,
    is_intact,
    pack,
    pack_in_order,
)
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.schema import SCHEMAS

SEQUENCE = "semantic2d-sequence"
ROOT = {"format_version": "1.0"}
REQUIRED = {
    "scans/ranges": [np.ones((3, 2), np.float32)],
    "scans/stamps_ns": [np.arange(3)],
}


def message(header, rows=b""):
    text = json.dumps(header).encode()
    return struct.pack("<I", len(text)) + text + rows


def write(path, kind, blocks_of):
    """Write blocks of named arrays as the writing process does, in this process."""
    parts = [message({"op": "attributes", "path": "", "values": ROOT | {"format": kind}})]
    for name, blocks in blocks_of.items():
        for rows in blocks:
            header = {"op": "append", "path": name, "dtype": rows.dtype.str, "shape": rows.shape}
            parts.append(message(header, rows.tobytes()))
    stream = io.BytesIO(b"".join(parts) + message({"op": "commit"}))
    path.unlink(missing_ok=True)
    writer_process.write(stream, SCHEMAS[kind], path.with_suffix(".partial"), path)


def memory_file():
    return h5py.File("memory", "w", driver="core", backing_store=False)


def filter_by_hdf5(file, name, array, chunks):
    """Write an array by HDF5's own filters."""
    rows = file.create_dataset(
        name,
        shape=array.shape,
        maxshape=(None, *array.shape[1:]),
        dtype=array.dtype,
        chunks=chunks,
        compression=4,
        shuffle=True,
        fletcher32=True,
    )
    rows[:] = array


def checksum_by_hdf5(data):
    array = np.frombuffer(data, np.uint8)
    with memory_file() as file:
        stored = file.create_dataset("a", data=array, chunks=array.shape, fletcher32=True)
        return int.from_bytes(stored.id.read_direct_chunk((0,))[1][-4:], "little")


def stored_chunks(array):
    offsets = [(row, *[0] * (array.ndim - 1)) for row in range(0, len(array), array.chunks[0])]
    return [array.id.read_direct_chunk(offset) for offset in offsets]


@st.composite
def files(draw):
    """Arrays of every kind that a file may hold, noise or not, cut into blocks anywhere."""
    kind = draw(st.sampled_from(sorted(SCHEMAS)))
    return kind, {
        path.replace("*", "some"): draw(blocks_of(spec))
        for path, spec in SCHEMAS[kind].arrays.items()
    }


@st.composite
def blocks_of(draw, spec):
    rows, rank = draw(st.integers(1, 200)), draw(st.sampled_from(spec.ndims))
    shape = (rows, *draw(st.tuples(*[st.integers(1, 7)] * (rank - 1))))
    dtype = np.dtype(draw(st.sampled_from(spec.dtypes)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    highest = draw(st.sampled_from((1, 4, 256)))
    values = rng.integers(0, highest, math.prod(shape) * dtype.itemsize, dtype=np.uint8)
    cuts = draw(st.lists(st.integers(0, rows), max_size=6).map(sorted))
    return np.split(values.view(dtype).reshape(shape), cuts)


@settings(max_examples=10)
@given(files())
def test_blocks_of_any_size_read_back_as_hdf5_itself_would_store_them(tmp_path_factory, drawn):
    kind, blocks = drawn
    path = tmp_path_factory.getbasetemp() / "ours.h5"
    write(path, kind, blocks)
    arrays = {name: np.concatenate(parts) for name, parts in blocks.items()}
    with ContainerReader(path, SCHEMAS[kind]) as reader:
        for name, array in arrays.items():
            assert reader.dtype(name) == array.dtype
            assert reader.read(name).tobytes() == array.tobytes()
    with h5py.File(path) as ours, memory_file() as theirs:
        for name, array in arrays.items():
            filter_by_hdf5(theirs, name, array, ours[name].chunks)
            pairs = zip(stored_chunks(ours[name]), stored_chunks(theirs[name]), strict=True)
            for (our_mask, our_chunk), (their_mask, their_chunk) in pairs:
                assert our_mask == their_mask == 0
                assert zlib.decompress(our_chunk[:-4]) == zlib.decompress(their_chunk[:-4])
                assert is_intact(our_chunk)
                assert is_intact(their_chunk)


@pytest.mark.parametrize("rows", [1, 63, 64, 65, 128, 1000])
def test_rows_around_whole_chunks_read_back(rows, tmp_path):
    values = np.arange(rows * 3, dtype=np.float32).reshape(rows, 3)
    write(
        tmp_path / "a.h5",
        SEQUENCE,
        REQUIRED | {"original/x": [values]},
    )
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["original/x"][:], values)
        assert file["original/x"].id.get_num_chunks() == -(-rows // 64)


def test_array_without_rows_is_kept(tmp_path):
    nothing = {"lines/segments": [np.zeros((0, 4), np.float32)]}
    write(tmp_path / "a.h5", SEQUENCE, REQUIRED | nothing)
    with ContainerReader(tmp_path / "a.h5", SCHEMAS[SEQUENCE]) as reader:
        assert reader.shape("lines/segments") == (0, 4)


def test_filters_are_declared_as_they_were(tmp_path):
    write(tmp_path / "a.h5", SEQUENCE, REQUIRED)
    with h5py.File(tmp_path / "a.h5") as file:
        layout = file["scans/ranges"].id.get_create_plist()
        found = [layout.get_filter(i) for i in range(layout.get_nfilters())]
    assert [(code, values) for code, _, values, _ in found] == [
        (h5py.h5z.FILTER_SHUFFLE, (4,)),
        (h5py.h5z.FILTER_DEFLATE, (4,)),
        (h5py.h5z.FILTER_FLETCHER32, ()),
    ]


def test_large_rows_get_small_chunks(tmp_path):
    rows = np.zeros((5, 1000, 2000), np.uint8)
    write(tmp_path / "a.h5", SEQUENCE, REQUIRED | {"streams/camera/data": [rows]})
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["streams/camera/data"].chunks == (2, 1000, 2000)


@pytest.fixture(scope="module")
def two_chunks(tmp_path_factory):
    """A file whose array original/x lies in two chunks, and the file's bytes."""
    path = tmp_path_factory.mktemp("flips") / "a.h5"
    values = np.linspace(0, 9, 300, dtype=np.float32).reshape(100, 3)
    write(path, SEQUENCE, REQUIRED | {"original/x": [values]})
    return path, path.read_bytes()


@settings(max_examples=30)
@given(st.integers(0, 1), st.integers(0), st.integers(0, 7))
def test_flipped_bit_in_a_chunk_is_refused(two_chunks, number, byte, bit):
    path, content = two_chunks
    path.write_bytes(content)
    with h5py.File(path) as file:
        chunk = file["original/x"].id.get_chunk_info(number)
    raw = bytearray(content)
    raw[chunk.byte_offset + byte % chunk.size] ^= 1 << bit
    path.write_bytes(raw)
    assert not is_intact(bytes(raw[chunk.byte_offset : chunk.byte_offset + chunk.size]))
    with ContainerReader(path, SCHEMAS[SEQUENCE]) as reader, pytest.raises(CorruptFileError):
        reader.read("original/x")
    with pytest.raises(CorruptFileError, match="original/x does not hold what was written"):
        writer_process._check(path, SCHEMAS[SEQUENCE])


@given(st.binary(min_size=1, max_size=3000))
@example(b"\0" * 1001)
@example(b"\xff" * 1022)
@example(b"\xff" * 4097)
@example(b"\0" * 9 + b"\1")
def test_checksum_is_that_of_hdf5(data):
    assert fletcher32(data) == checksum_by_hdf5(data)


def test_checksum_of_the_largest_chunk_is_that_of_hdf5():
    data = np.random.default_rng(0).bytes((1 << 24) - 1)
    assert fletcher32(data) == checksum_by_hdf5(data)


def scans(kind):
    """Ranges (64, 1081) of a lidar that sees noise, stands still, drives off, or sees nothing."""
    rng, shape = np.random.default_rng(0), (64, 1081)
    room = 5 + 3 * np.sin(np.linspace(0, 9, 1081))
    values = {
        "noisy": room + rng.normal(0, 0.02, shape),
        "rounded": np.round(room + rng.normal(0, 0.02, shape), 3),
        "still": np.broadcast_to(room, shape),
        "leaving": room + np.maximum(0, np.arange(64)[:, None] - 50) * rng.normal(0, 0.02, shape),
        "arriving": room + np.maximum(0, 14 - np.arange(64)[:, None]) * rng.normal(0, 0.02, shape),
        "nothing": np.full(shape, np.inf),
    }
    return values[kind].astype(np.float32)


@pytest.mark.parametrize("kind", ["noisy", "rounded", "still", "leaving", "arriving", "nothing"])
def test_planes_apart_are_as_small_as_together(kind):
    planes = scans(kind).reshape(-1, 1).view(np.uint8).T.copy()
    ours, plain = deflate(planes), zlib.compress(planes, 4)
    assert zlib.decompress(ours) == planes.tobytes()
    assert len(ours) <= 1.02 * len(plain) + 100  # of 276,736


@pytest.mark.parametrize("bytes_", [8191, 8192, 70_000])
@pytest.mark.parametrize("planes", [1, 2, 8])
def test_planes_of_any_number_and_length_inflate(planes, bytes_):
    noise = np.random.default_rng(0).integers(0, 5, (planes, bytes_), dtype=np.uint8)
    assert zlib.decompress(deflate(noise)) == noise.tobytes()


def test_chunks_keep_their_order():
    rng = np.random.default_rng(0)
    chunks = [rng.integers(0, 50, n) for n in rng.integers(1, 20_000, 200)]
    packed = list(pack_in_order(enumerate(chunks)))
    assert [number for number, _ in packed] == list(range(200))
    assert all(stored == pack(chunk) for (_, stored), chunk in zip(packed, chunks, strict=True))


@pytest.mark.parametrize(
    ("size", "most"), [(1 << 23, 5), (8, 8 * count_cores() + 1)], ids=["large", "small"]
)
def test_few_chunks_are_taken_ahead(size, most):
    taken = []

    def chunks():
        for number in range(10_000):
            taken.append(number)
            yield number, np.zeros(size, np.uint8)

    packed = pack_in_order(chunks())
    next(packed)
    assert len(taken) <= most
    packed.close()


def test_error_in_a_thread_is_raised_where_its_chunk_would_have_been():
    chunks = [(0, np.zeros(3)), (1, np.array([None])), (2, np.zeros(3))]
    packed = pack_in_order(chunks)
    assert next(packed)[0] == 0
    with pytest.raises(TypeError):
        next(packed)
