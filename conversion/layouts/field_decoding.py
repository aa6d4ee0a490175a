"""The files of one field, made again from the arrays that they became."""

from __future__ import annotations

import hashlib
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from conversion.layouts import npy
from conversion.layouts.field_encoding import Said
from conversion.layouts.fields import MISSING, WHOLE, Form, Place, Values, bits_of, cast
from semantic2d_dataset.errors import CorruptFileError
from semantic2d_dataset.format.sequence import SequenceReader

_ROWS = 1 << 12
_SLAB = 1 << 16  # one chunk of an array of one axis
Files = list[bytes | None]


class FieldDecoder(Protocol):
    """Makes the files of a field again, in the order of the scans."""

    is_as_converted: bool
    """Whether they get the bytes that they had."""

    def files(self, start: int, stop: int) -> Files:
        """Return the files of the next scans, None where there is none, or it is kept whole."""
        ...


class PlacedDecoder:
    """Files of a field that has a place in the format.

    Where the array is no longer what it became at the conversion (labels were made anew, say),
    its files are written as it is now, one for every scan.

    Parameters
    ----------
    reader
        The sequence.
    name, place
        The field, and where its values lie.
    said
        What was kept of it at the conversion; None if nothing was.
    """

    def __init__(
        self, reader: SequenceReader, name: str, place: Place, said: Said | None = None
    ) -> None:
        self._reader, self._place = reader, place
        self._offsets = _offsets(reader, place)
        self._forms = [Form.from_dict(form) for form in said["forms"]] if said else []
        self.is_as_converted = said is not None and said["sha256"] == self._digest()
        if self.is_as_converted:
            self._codes = _codes(reader, name, len(self._forms))
        else:
            self._forms = [self._form_of_new_files()]
            self._codes = np.zeros(len(reader), np.uint8)
        self._back = place.back if self.is_as_converted else place.anew
        self._corrections = _Corrections(reader, name if self.is_as_converted else None)

    def files(self, start: int, stop: int) -> Files:
        """Return the files of the next scans."""
        place, width = self._place, self._place.width
        first, last = int(self._offsets[start]), int(self._offsets[stop])
        rows = self._back(self._reader.read(place.array, first, last))
        at, bits = self._corrections.take(last * width)
        row, column = np.divmod(at - first * width, width)
        codes, counts = self._codes[start:stop], np.diff(self._offsets[start : stop + 1])
        files: Files = [None] * (stop - start)
        for code in set(codes.tolist()) & set(range(len(self._forms))):
            ours = np.repeat(codes == code, counts)
            values = np.ascontiguousarray(cast(rows[ours], self._dtype(code)))
            corrected = ours[row]
            position = np.cumsum(ours) - 1
            bits_of(values)[position[row[corrected]], column[corrected]] = bits[corrected]
            _fill(files, self._forms[code], values, codes == code, counts)
        return files

    def _dtype(self, code: int) -> np.dtype[Any]:
        return npy.parse(self._forms[code].header(1)).dtype

    def _form_of_new_files(self) -> Form:
        """Return the first form that holds any values; else the usual one."""
        ragged = self._place.ragged
        for code, form in enumerate(self._forms):
            if self._dtype(code).kind == "f" and (form.tail is not None) == ragged:
                return form
        dtype = np.dtype("<f4" if self._place.dtype == "|u1" else self._place.dtype)
        shape = (1, self._place.width) if ragged else (self._place.width,)
        return Form.of(npy.make_header(dtype, shape), ragged=ragged)

    def _digest(self) -> str:
        digest, rows = hashlib.sha256(), self._reader.shape(self._place.array)[0]
        for start in range(0, rows, _ROWS):
            digest.update(self._reader.read(self._place.array, start, start + _ROWS).data)
        return digest.hexdigest()


class UnplacedDecoder:
    """Files of a field that has no place in the format.

    Parameters
    ----------
    reader
        The sequence.
    name
        The field.
    said
        What was kept of it at the conversion.
    """

    def __init__(self, reader: SequenceReader, name: str, said: Said) -> None:
        self._reader, self._array = reader, f"original/{name}"
        self.is_as_converted = True
        self._forms = [Form.from_dict(form) for form in said["forms"]]
        self._codes = _codes(reader, name, len(self._forms))

    def files(self, start: int, stop: int) -> Files:
        """Return the files of the next scans."""
        codes = self._codes[start:stop]
        files: Files = [None] * (stop - start)
        if self._array not in self._reader:
            return files
        rows = self._reader.read(self._array, start, stop)
        for code in set(codes.tolist()) & set(range(len(self._forms))):
            dtype = npy.parse(self._forms[code].header(1)).dtype
            bits = bits_of(rows[codes == code])
            values = bits.astype(bits_of(np.zeros(0, dtype)).dtype).view(dtype)
            _fill(files, self._forms[code], values, codes == code, np.ones_like(codes, np.int64))
        return files


class _Corrections:
    """The bits that an array cannot hold, read forward."""

    def __init__(self, reader: SequenceReader, name: str | None) -> None:
        self._reader, self._name = reader, f"original/{name}"
        self._left = f"{self._name}.at" in reader if name else False
        self._next = 0
        self._at, self._bits = np.zeros(0, np.int64), np.zeros(0, np.uint64)

    def take(self, stop: int) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
        """Return those before a flat position that were not taken yet."""
        while self._left and (not len(self._at) or self._at[-1] < stop):
            at, bits = (
                self._reader.read(f"{self._name}.{part}", self._next, self._next + _SLAB)
                for part in ("at", "bits")
            )
            self._next, self._left = self._next + len(at), len(at) == _SLAB
            self._at = np.concatenate([self._at, at])
            self._bits = np.concatenate([self._bits, bits])
        count = int(np.searchsorted(self._at, stop))
        taken = self._at[:count], self._bits[:count]
        self._at, self._bits = self._at[count:], self._bits[count:]
        return taken


def _offsets(reader: SequenceReader, place: Place) -> NDArray[np.int64]:
    """Return where the rows of each scan begin and end, (N+1,) i8."""
    if place.ragged:
        return reader.read("lines/offsets")
    return np.arange(len(reader) + 1)


def _codes(reader: SequenceReader, name: str, forms: int) -> NDArray[np.uint8]:
    array = f"original/{name}.form"
    if array not in reader:
        return np.zeros(len(reader), np.uint8)
    codes = reader.read(array)
    if len(codes) != len(reader) or not np.isin(codes, (*range(forms), WHOLE, MISSING)).all():
        raise CorruptFileError(f"{reader.path}: {array} does not fit the scans")
    return codes


def _fill(
    files: Files,
    form: Form,
    values: Values,
    which: NDArray[np.bool_],
    counts: NDArray[np.int64],
) -> None:
    """Put header and values of one form into the places of its files."""
    start = 0
    for n in np.flatnonzero(which):
        items = int(counts[n])
        header = form.header(items)
        ours = values[start : start + items]
        start += items
        layout = npy.parse(header)
        if layout.nbytes != ours.nbytes:
            raise ValueError(f"a header of {layout.shape} before {ours.size} values")
        if layout.fortran:
            files[n] = header + ours.reshape(layout.shape).tobytes(order="F")
        else:
            files[n] = header + ours.tobytes()
