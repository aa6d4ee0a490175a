"""The files of a field as arrays of a sequence and back."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from conversion.layouts import field_encoding, npy
from conversion.layouts.field_decoding import PlacedDecoder, UnplacedDecoder
from conversion.layouts.field_encoding import FileError, PlacedEncoder, UnplacedEncoder
from conversion.layouts.fields import (
    INTENSITIES,
    LABELS,
    LINES,
    POSITIONS,
    SCANS,
    Form,
    cast,
    places,
    storage_of,
)

BEAMS = 4
PLACES = places(BEAMS)


class Arrays:
    """What `SequenceReader` gives, from memory: thousands of examples need no files."""

    path = "memory.h5"

    def __init__(self, scans, blocks):
        self._scans = scans
        self._arrays = {}
        for block in blocks:
            for name, rows in block.items():
                before = self._arrays.get(name)
                self._arrays[name] = rows if before is None else np.concatenate([before, rows])

    def __len__(self):
        return self._scans

    def __contains__(self, name):
        return name in self._arrays

    def __getitem__(self, name):
        return self._arrays[name]

    def shape(self, name):
        return self._arrays[name].shape

    def read(self, name, start=0, stop=None):
        return self._arrays[name][start:stop].copy()


def saved(values, **how):
    stream = io.BytesIO()
    np.save(stream, values, **how)
    return stream.getvalue()


def encode(encoder, files, block=3):
    """Encode files by blocks; returns the arrays, what is said, and the files kept whole."""
    blocks, whole = [], {}
    for start in range(0, len(files), block):
        encoded = encoder.encode(files[start : start + block])
        blocks.append(encoded.arrays)
        whole |= {start + n: files[start + n] for n in encoded.whole}
    more, said = encoder.finish()
    return Arrays(len(files), [*blocks, more]), said, whole


def decode(decoder, whole, scans, block=2):
    files = []
    for start in range(0, scans, block):
        files += decoder.files(start, min(start + block, scans))
    return [whole.get(n, file) for n, file in enumerate(files)]


def there_and_back(field, files, **how):
    reader, said, whole = encode(PlacedEncoder(field, places(BEAMS, **how)[field]), files)
    decoder = PlacedDecoder(reader, field, places(BEAMS, **how)[field], said)
    assert decoder.is_as_converted
    assert decode(decoder, whole, len(files)) == files
    return reader


NUMBERS = st.sampled_from(
    ["<f4", "<f8", ">f4", ">f8", "<f2", "|b1", "|i1", "|u1", "<i2", ">i4", "<i8", "<u8"]
)
SHAPES = st.sampled_from(
    [(BEAMS,), (1, BEAMS), (BEAMS, 1), (2, 2), (0,), (0, 4), (3, 4), (2, 2, 4)]
)
SPECIAL = [0.0, -0.0, 60.0, 255.0, 9.0, 10.0, 0.5, np.nan, np.inf, -np.inf, 1e39, 1e-310, -1.0]


@st.composite
def files_of_a_field(draw):
    """A file as any tool may have written it: dtype, shape, order, header, values."""
    kind = draw(st.integers(0, 19))
    if kind == 0:
        return None
    if kind == 1:
        return saved(np.array(["text"]))
    if kind == 2:
        return saved(np.zeros(BEAMS, np.complex64))
    values = draw(arrays.arrays(draw(NUMBERS), draw(SHAPES)))
    with np.errstate(all="ignore"):
        for at in draw(st.lists(st.integers(0, max(values.size - 1, 0)), max_size=3)):
            if values.size and values.dtype.kind == "f":
                values.reshape(-1)[at] = draw(st.sampled_from(SPECIAL))
    if kind == 3:
        values = np.asfortranarray(values)
    content = saved(values)
    if kind == 4:
        content += b"more"
    if kind == 5:  # as numpy before 1.14 filled headers up
        header = npy.split(content)[0]
        text = header[10:].rstrip()
        room = -(len(text) + 11) % 16 + len(text) + 1
        content = header[:8] + room.to_bytes(2, "little") + text.ljust(room - 1) + b"\n"
        content += values.tobytes()
    return content


@pytest.mark.parametrize("field", PLACES)
@given(files=st.lists(files_of_a_field(), min_size=1, max_size=8))
def test_any_files_of_a_field_come_back_byte_for_byte(field, files):
    there_and_back(field, files)


@given(
    files=st.lists(files_of_a_field(), min_size=1, max_size=8),
    no_return=st.lists(st.sampled_from([60.0, 9.0, 0.5]), max_size=2),
)
def test_options_change_values_and_not_the_way_back(files, no_return):
    there_and_back(SCANS, files, no_return=tuple(no_return))
    there_and_back(INTENSITIES, files, reversed_intensities=True)


@given(st.data())
def test_any_files_of_a_field_without_place_come_back_byte_for_byte(data):
    files = data.draw(st.lists(files_of_a_field(), min_size=1, max_size=8))
    usual = next((npy.split(file)[1] for file in files if file), None)
    if usual is None:
        return
    reader, said, whole = encode(UnplacedEncoder("extra", usual), files)
    assert decode(UnplacedDecoder(reader, "extra", said), whole, len(files)) == files
    if storage_of(usual) is not None:
        assert len(reader["original/extra"]) == len(files)


def test_ranges_of_0_become_no_return():
    reader = there_and_back(SCANS, [saved(np.array([0, 1.5, 60, 2], "f8"))])
    assert reader["scans/ranges"].tolist() == [[np.inf, 1.5, 60, 2]]
    assert not [name for name in reader._arrays if name.startswith("original/")]
    reader = there_and_back(SCANS, [saved(np.array([0, 1.5, 60, 2], "f4"))], no_return=(60.0,))
    assert reader["scans/ranges"].tolist() == [[np.inf, 1.5, np.inf, 2]]
    assert reader["original/scans_lidar.at"].tolist() == [2]


def test_what_a_float32_cannot_hold_is_kept_beside_it():
    values = np.array([0.1, 1.5, -0.0, np.nan])
    reader = there_and_back(SCANS, [saved(values)])
    assert reader["scans/ranges"].dtype == np.float32
    assert reader["original/scans_lidar.at"].tolist() == [0, 2]
    kept = reader["original/scans_lidar.bits"].view(np.float64)
    assert kept.tolist() == [0.1, -0.0]


def test_labels_that_are_no_classes_are_not_labelled():
    reader = there_and_back(LABELS, [saved(np.array([4, 10, 2.5, np.nan], "f4"))])
    assert reader["scans/labels"].tolist() == [[4, 255, 255, 255]]
    assert reader["original/semantic_label.at"].tolist() == [1, 2, 3]


def test_a_pose_that_is_not_whole_is_none():
    files = [saved(np.array([1, 2, bad])) for bad in (3.0, np.inf, np.nan)]
    poses = there_and_back(POSITIONS, files)["poses/initial"]
    np.testing.assert_array_equal(poses, [[1, 2, 3], [np.nan] * 3, [np.nan] * 3])


def test_a_missing_file_leaves_a_row_that_says_so():
    for field, fill in ((LABELS, 255), (POSITIONS, np.nan), (INTENSITIES, np.nan)):
        width = PLACES[field].width
        file = saved(np.ones(width))
        reader = there_and_back(field, [file, None, file])
        np.testing.assert_array_equal(reader[PLACES[field].array][1], np.full(width, fill))
        assert reader[f"original/{field}.form"].tolist() == [0, 255, 0]


def test_segments_of_any_number_share_one_form():
    files = [saved(np.arange(4.0 * n).reshape(n, 4)) for n in (3, 120, 1, 12)]
    reader = there_and_back(LINES, [*files, saved(np.array([])), None])
    assert reader["lines/offsets"].tolist() == [0, 3, 123, 124, 136, 136, 136]
    assert reader["original/line_segments.form"].tolist() == [0, 0, 0, 0, 1, 255]


def test_a_field_of_more_forms_than_are_counted_is_kept(monkeypatch):
    monkeypatch.setattr(field_encoding, "MAX_FORMS", 2)
    files = [saved(np.ones(BEAMS, dtype)) for dtype in ("f4", "f8", "i2", "u8", "f4")]
    reader = there_and_back(SCANS, files)
    assert reader["original/scans_lidar.form"].tolist() == [0, 1, 254, 254, 0]
    assert reader["scans/ranges"].tolist() == [[1.0] * BEAMS] * 5


@pytest.mark.parametrize("content", [b"", b"text", saved(np.ones(4))[:-1]])
def test_a_damaged_file_is_told_from_the_others(content):
    encoder = PlacedEncoder(SCANS, PLACES[SCANS])
    with pytest.raises(FileError) as caught:
        encoder.encode([saved(np.ones(4)), None, content])
    assert caught.value.which == 2


def test_arrays_made_anew_are_written_as_they_are_now():
    files = [saved(np.array([4, 10, 2, 1], "f8")), None]
    reader, said, whole = encode(PlacedEncoder(LABELS, PLACES[LABELS]), files)
    reader["scans/labels"][:] = [[1, 2, 3, 255], [4, 5, 6, 7]]
    decoder = PlacedDecoder(reader, LABELS, PLACES[LABELS], said)
    assert not decoder.is_as_converted
    found = [npy.read(file) for file in decode(decoder, whole, 2)]
    assert [values.tolist() for values in found] == [[1, 2, 3, 255], [4, 5, 6, 7]]
    assert {values.dtype.str for values in found} == {"<f8"}


def test_integers_saturate_alike_on_every_machine():
    values = np.array([np.nan, np.inf, -np.inf, 300.0, -3.0, 2.9])
    assert cast(values, np.dtype("u1")).tolist() == [0, 255, 0, 255, 0, 2]
    assert cast(values, np.dtype("<i8")).tolist() == [0, 2**63 - 1024, -(2**63), 300, -3, 2]


def test_a_form_of_absurd_length_is_refused():
    said = Form(b"head", b"tail", 100).as_dict()
    assert Form.from_dict(said) == Form(b"head", b"tail", 100)
    with pytest.raises(ValueError, match="a header of 1000000000000 bytes"):
        Form.from_dict(said | {"length": 10**12})
