"""Files that are damaged or crafted: each is refused before any of its data is used."""

import shutil

import h5py
import numpy as np
import pytest

from semantic2d_dataset.errors import (
    CorruptFileError,
    FormatVersionError,
    InvalidInputError,
    Semantic2DError,
    UnsafeFileError,
)
from semantic2d_dataset.format.container import ContainerReader, load_json
from semantic2d_dataset.format.schema import SEQUENCE
from semantic2d_dataset.format.sequence import SequenceReader
from tests.generators import make_sequence


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    path = tmp_path_factory.mktemp("good") / "good.h5"
    make_sequence(path, 70)
    return path


@pytest.fixture
def copy(good, tmp_path):
    return shutil.copy(good, tmp_path / "copy.h5")


def change(path, action):
    with h5py.File(path, "r+") as file:
        action(file)
    return path


CHUNKED = {"chunks": (64, 37), "fletcher32": True}
LIKE = {"shape": (70, 37), "dtype": "u1", "maxshape": (None, 37)}


def replace_labels(**settings):
    def action(file):
        del file["scans/labels"]
        file["scans"].create_dataset("labels", **(LIKE | CHUNKED | settings))

    return action


def external_storage(file):
    del file["scans/stamps_ns"]
    file["scans"].create_dataset(
        "stamps_ns", (70,), "i8", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    )


def virtual_data(file):
    del file["scans/labels"]
    layout = h5py.VirtualLayout((70, 37), "u1")
    layout[:] = h5py.VirtualSource("/etc/passwd", "x", (70, 37))
    file["scans"].create_virtual_dataset("labels", layout)


def huge_stamps(file):
    del file["scans/stamps_ns"]
    file["scans"].create_dataset(
        "stamps_ns", (1 << 40,), "i8", maxshape=(None,), chunks=(1 << 16,), fletcher32=True
    )


def variable_length_attribute(file):
    file.attrs["license"] = "a text of variable length"


def huge_attribute(file):
    del file.attrs["license"]
    file.attrs.create("license", np.bytes_(b"x" * 65000))
    file["lidar"].attrs["base_T_lidar"] = np.zeros(8100)


CRAFTED = {
    "soft link": lambda f: f["scans"].__setitem__("confidence", h5py.SoftLink("/scans/labels")),
    "external link": lambda f: f.__setitem__("map2", h5py.ExternalLink("/etc/passwd", "/")),
    "soft link to a group": lambda f: f.__setitem__("streams", h5py.SoftLink("/scans")),
    "external storage": external_storage,
    "virtual data": virtual_data,
    "unknown array": lambda f: f["scans"].create_dataset("extra", **LIKE, **CHUNKED),
    "unknown group": lambda f: f.create_group("secret"),
    "a loop of hard links": lambda f: (
        f["streams"].__setitem__("again", f["/"])
        if "streams" in f
        else f.create_group("streams").__setitem__("again", f["/"])
    ),
    "unknown attribute": lambda f: f.attrs.__setitem__("note", np.bytes_(b"hello")),
    "attribute of another type": lambda f: f["lidar"].attrs.__setitem__("beams", 3.5),
    "text of variable length": variable_length_attribute,
    "unchecked data": replace_labels(fletcher32=False),
    "contiguous data": replace_labels(chunks=None, maxshape=None, fletcher32=False),
    "exotic filter": replace_labels(compression="lzf"),
    "wrong dtype": replace_labels(dtype="i8"),
    "text as data": replace_labels(dtype="S4"),
    "big-endian data": replace_labels(dtype=">u2"),
    "wrong rank": replace_labels(shape=(70, 37, 2), maxshape=(None, 37, 2), chunks=(64, 37, 2)),
    "huge array": replace_labels(shape=(1 << 45, 37)),
    "huge chunk": replace_labels(
        shape=(70, 1 << 20), maxshape=(None, 1 << 20), chunks=(128, 1 << 20)
    ),
    "huge stamps": huge_stamps,
    "named type": lambda f: f.__setitem__("lines", np.dtype("f8")),
}


@pytest.mark.parametrize("craft", CRAFTED)
def test_crafted_file_is_refused(craft, copy):
    change(copy, CRAFTED[craft])
    with pytest.raises(UnsafeFileError, match=r"copy\.h5"):
        SequenceReader(copy)


def test_missing_chunk_is_never_read_as_zeros(copy):
    change(copy, replace_labels())  # declared, and no chunk written
    with pytest.raises(CorruptFileError, match="labels: expected 2 chunks, found 0"):
        SequenceReader(copy)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": NaN}', '{"a": 1e999}', '{"a": "\\ud800"}'])
def test_provenance_that_is_no_sound_json_is_refused(text, copy):
    def replace(file):
        del file["provenance"]
        data = np.frombuffer(text.encode(), np.uint8)
        file.create_dataset("provenance", data=data, chunks=(4,), fletcher32=True)

    change(copy, replace)
    with pytest.raises(CorruptFileError, match="provenance: not JSON"):
        SequenceReader(copy)


def test_refusal_comes_before_any_data_is_read(copy, monkeypatch):
    change(copy, CRAFTED["external link"])
    reads = []
    monkeypatch.setattr(h5py.Dataset, "__getitem__", lambda *args: reads.append(args))
    with pytest.raises(UnsafeFileError):
        ContainerReader(copy, SEQUENCE)
    assert not reads


def test_newer_major_format_says_which_version_reads_it(copy):
    def newer(file):
        file.attrs["format_version"] = np.bytes_(b"2.3")
        file.create_group("of the future")

    change(copy, newer)
    with pytest.raises(FormatVersionError, match="format 2.3.*install semantic2d-dataset 2.0"):
        SequenceReader(copy)


def test_newer_minor_format_of_known_parts_opens(copy):
    change(copy, lambda f: f.attrs.__setitem__("format_version", np.bytes_(b"1.7")))
    assert len(SequenceReader(copy)) == 70


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"", "found an empty file"), (b"not HDF5", "found no HDF5 file"), (b"\x89HDF", "no HDF5")],
)
def test_other_files_are_refused(content, says, tmp_path):
    path = tmp_path / "other.h5"
    path.write_bytes(content)
    with pytest.raises(CorruptFileError, match=says):
        SequenceReader(path)


def test_hdf5_file_of_another_kind_is_refused(tmp_path):
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["x"] = 1
    with pytest.raises(CorruptFileError, match="found an HDF5 file of another kind"):
        SequenceReader(path)


def test_missing_file_and_folder_pass_through(tmp_path):
    with pytest.raises(FileNotFoundError):
        SequenceReader(tmp_path / "none.h5")
    with pytest.raises(IsADirectoryError):
        SequenceReader(tmp_path)


def test_missing_required_array_is_named(copy):
    change(copy, lambda f: f["scans"].__delitem__("stamps_ns"))
    with pytest.raises(CorruptFileError, match="lacks scans/stamps_ns"):
        SequenceReader(copy)


def test_unknown_array_asked_for_lists_the_known(good):
    with ContainerReader(good, SEQUENCE) as reader:
        assert "scans/ranges" in reader
        with pytest.raises(InvalidInputError, match="has no array 'x'; it has commands/velocity"):
            reader.read("x")


def read_all(path):
    with SequenceReader(path) as reader:
        return {name: reader.read(name) for name in reader.names}, reader.content_digest()


def check_damaged(path, data, digest):
    """A damaged file is refused, or everything in it still reads the same."""
    path.write_bytes(data)
    try:
        found = read_all(path)[1]
    except Semantic2DError:
        return True
    assert found == digest
    return False


def check_flips(good, path, positions):
    digest = read_all(good)[1]
    data = bytearray(good.read_bytes())
    refused = 0
    for position in positions:
        data[position] ^= 0xFF
        refused += check_damaged(path, bytes(data), digest)
        data[position] ^= 0xFF
    return refused


def test_flipped_byte_is_never_read_as_other_data(good, tmp_path):
    size = good.stat().st_size
    positions = [*range(0, 512, 7), *range(512, size, size // 250)]
    assert check_flips(good, tmp_path / "flipped.h5", positions) > len(positions) // 2


@pytest.mark.long
def test_no_flipped_byte_anywhere_is_read_as_other_data(good, tmp_path):
    assert check_flips(good, tmp_path / "flipped.h5", range(good.stat().st_size)) > 1000


def test_truncated_sequence_is_never_opened(good, tmp_path):
    path = tmp_path / "cut.h5"
    data = good.read_bytes()
    for size in [*range(0, 200, 9), *range(200, len(data), len(data) // 150), len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(Semantic2DError):
            SequenceReader(path)


def check_all(path):
    with ContainerReader(path, SEQUENCE) as reader:
        reader.read_everything()


def test_reading_everything_reads_every_chunk(good, tmp_path):
    check_all(good)
    with h5py.File(good) as file:
        chunk = file["scans/labels"].id.get_chunk_info(1)
    data = bytearray(good.read_bytes())
    data[chunk.byte_offset + chunk.size // 2] ^= 0xFF
    path = tmp_path / "flipped.h5"
    path.write_bytes(data)
    with pytest.raises(CorruptFileError, match="truncated or damaged"):
        check_all(path)


@pytest.mark.parametrize("text", ['{"a": 1, "a": 1}', '[{"b": {"a": 1, "\\u0061": 2}}]'])
def test_json_in_which_a_member_stands_twice_is_refused(text):
    with pytest.raises(InvalidInputError, match="'a' stands there more than once"):
        load_json(text)
