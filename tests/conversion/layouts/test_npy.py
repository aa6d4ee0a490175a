"""The bytes of .npy files."""

import contextlib
import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from conversion.layouts import npy


def saved(values, **how):
    stream = io.BytesIO()
    np.save(stream, values, **how)
    return stream.getvalue()


def with_header(text, body=b"", version=1):
    length = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + length + text.encode("latin-1") + body


@given(arrays.arrays(arrays.scalar_dtypes(), arrays.array_shapes(min_dims=0, min_side=0)))
def test_what_numpy_saves_is_read_as_numpy_reads_it(values):
    content = saved(values)
    found = npy.read(content)
    assert (found.dtype, found.shape) == (values.dtype, values.shape)
    assert found.tobytes() == values.tobytes()
    assert npy.make_header(values.dtype, values.shape) == content[: len(content) - values.nbytes]


def test_columns_first_are_read():
    values = np.asfortranarray(np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(npy.read(saved(values)), values)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_every_version_of_the_header_is_read(version):
    text = "{'descr': '<i2', 'fortran_order': False, 'shape': (2,), }\n"
    assert npy.read(with_header(text, b"\x01\x00\x02\x00", version)).tolist() == [1, 2]


def test_headers_of_python_2_are_read_in_silence():
    text = "{'descr': '<i2', 'fortran_order': False, 'shape': (2L,), }\n"
    assert npy.read(with_header(text, b"\x01\x00\x02\x00")).tolist() == [1, 2]


@given(st.integers(0, 200))
def test_a_file_cut_off_anywhere_is_refused(length):
    content = saved(np.arange(10.0))
    if length >= len(content):
        npy.read(content)
        return
    with pytest.raises(npy.NpyError, match=r"truncated|empty|begins with"):
        npy.read(content[:length])


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }\n", "pickled Python objects"),
        ("{'descr': [('a', '|O')], 'fortran_order': False, 'shape': (1,), }\n", "pickled"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }\n", r"says \(-1,\)"),
        (f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({10**31},), }}\n", "truncated"),
        ("{'descr': '<f4', 'fortran_order': False}\n", "cannot be read"),
        ("{'descr': 7, 'fortran_order': False, 'shape': (1,), }\n", "cannot be read"),
        ("[" * 3000, "cannot be read"),
        ("__import__('os').abort()\n", "cannot be read"),
        ("{'descr': '|V0', 'fortran_order': False, 'shape': (5,), }\n", "values of a size"),
    ],
)
def test_headers_that_lie_are_refused(text, why):
    with pytest.raises(npy.NpyError, match=why):
        npy.read(with_header(text, b"\0\0\0\0"))


def test_a_header_of_absurd_length_is_refused():
    with pytest.raises(npy.NpyError, match="truncated in its .npy header"):
        npy.read(with_header("{" + " " * 20_000, b"\0"))


@given(st.binary(max_size=200), st.integers(0, 150))
def test_any_bytes_give_an_array_or_our_error(junk, at):
    content = saved(np.arange(3.0))
    with contextlib.suppress(npy.NpyError):
        npy.read(content[:at] + junk + content[at + len(junk) :])
