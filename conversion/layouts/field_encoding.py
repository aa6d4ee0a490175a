"""The files of one field as arrays, block by block, nothing of them lost."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from conversion.layouts import npy
from conversion.layouts.fields import (
    MAX_FORMS,
    MISSING,
    WHOLE,
    Form,
    Place,
    Values,
    bits_of,
    cast,
    is_number,
    storage_of,
)
from conversion.plan import Arrays

_NO_USE = 253  # kept whole, and its values fit no row

Said = dict[str, Any]
"""What JSON keeps of a field."""


class Encoded(NamedTuple):
    """What becomes of the files of a block."""

    arrays: Arrays
    whole: list[int]
    """Which of the files have to be kept whole."""


class FieldEncoder(Protocol):
    """Turns the files of a field into arrays, in the order of the scans."""

    def encode(self, files: Sequence[bytes | None]) -> Encoded:
        """Encode the next files, None where a scan has none.

        Raises
        ------
        FileError
            If one is no .npy file, not all of one, or holds pickled objects.
        """
        ...

    def finish(self) -> tuple[Arrays, Said]:
        """Return what is known only at the end."""
        ...


class FileError(ValueError):
    """A file that cannot be read; `which` of those given it is."""

    def __init__(self, which: int, message: str) -> None:
        super().__init__(message)
        self.which = which


class PlacedEncoder:
    """Files of a field that has a place in the format.

    Parameters
    ----------
    name
        The field.
    place
        Where its values lie.
    """

    def __init__(self, name: str, place: Place) -> None:
        self._name, self._place = name, place
        self._forms = _Forms(name, self._items, ragged=place.ragged)
        self._digest = hashlib.sha256()
        self._rows, self._is_first = 0, True

    def encode(self, files: Sequence[bytes | None]) -> Encoded:
        """Encode the next files."""
        place, width = self._place, self._place.width
        codes, counts = self._forms.look(files)
        if not place.ragged:
            counts = np.ones_like(counts)
        rows = np.full((int(counts.sum()), width), place.fill, place.dtype)
        wrong = [(np.zeros(0, np.int64), np.zeros(0, np.uint64))]
        for code in set(codes.tolist()) - {MISSING, _NO_USE}:
            where = np.flatnonzero(np.repeat(codes == code, counts))
            values = self._forms.values(code, codes, files).reshape(-1, width)
            rows[where] = place.into(values)
            if code != WHOLE:
                row, column, bits = _differences(values, place.back(rows[where]))
                wrong.append(((where[row] + self._rows) * width + column, bits))
        arrays = {place.array: rows} | self._offsets(counts) | self._corrections(wrong)
        self._digest.update(rows.data)
        self._rows, self._is_first = self._rows + len(rows), False
        return Encoded(arrays, _whole(codes))

    def finish(self) -> tuple[Arrays, Said]:
        """Return the forms of the files, and the digest of the array that they belong to."""
        arrays, said = self._forms.finish()
        return arrays, said | {"sha256": self._digest.hexdigest()}

    def _items(self, layout: npy.Layout) -> int | None:
        """Return how many rows a file fills; None if its values fit no row."""
        items, rest = divmod(layout.size, self._place.width)
        fits = is_number(layout.dtype) and not rest and (self._place.ragged or items == 1)
        return items if fits else None

    def _offsets(self, counts: NDArray[np.int64]) -> Arrays:
        if not self._place.ragged:
            return {}
        offsets = self._rows + np.cumsum(counts)
        return {"lines/offsets": np.insert(offsets, 0, 0) if self._is_first else offsets}

    def _corrections(self, wrong: list[tuple[NDArray[np.int64], NDArray[np.uint64]]]) -> Arrays:
        at, bits = (np.concatenate(parts) for parts in zip(*wrong, strict=True))
        if not len(at):
            return {}
        order = np.argsort(at)
        return {f"original/{self._name}.at": at[order], f"original/{self._name}.bits": bits[order]}


class UnplacedEncoder:
    """Files of a field that has no place in the format: their values are kept as they are.

    Parameters
    ----------
    name
        The field.
    layout
        What its files are usually like.
    """

    def __init__(self, name: str, layout: npy.Layout) -> None:
        self._name, self._storage = name, storage_of(layout)
        self._forms = _Forms(name, self._items, ragged=False)

    def encode(self, files: Sequence[bytes | None]) -> Encoded:
        """Encode the next files."""
        codes, _ = self._forms.look(files)
        if self._storage is None:
            return Encoded({}, _whole(codes))
        dtype, shape = self._storage
        rows = np.zeros((len(files), *shape), dtype)
        for code in set(codes.tolist()) - {MISSING, WHOLE, _NO_USE}:
            bits = bits_of(self._forms.values(code, codes, files))
            rows[codes == code] = (
                bits.astype(bits.dtype.newbyteorder("<")).view(dtype).reshape(-1, *shape)
            )
        return Encoded({f"original/{self._name}": rows}, _whole(codes))

    def finish(self) -> tuple[Arrays, Said]:
        """Return the forms of the files."""
        return self._forms.finish()

    def _items(self, layout: npy.Layout) -> int | None:
        return 1 if self._storage is not None and storage_of(layout) == self._storage else None


class _Forms:
    """The headers of the files of a field, and which of them each file has."""

    def __init__(
        self, name: str, items: Callable[[npy.Layout], int | None], *, ragged: bool
    ) -> None:
        self._name, self._items, self._ragged = name, items, ragged
        self._forms: list[Form] = []
        self._layouts: list[npy.Layout] = []
        self._known: dict[bytes, tuple[int, int]] = {}
        self._codes: list[NDArray[np.uint8]] = []

    def look(self, files: Sequence[bytes | None]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """Return the form of each file, and how many rows it fills."""
        found = []
        for which, file in enumerate(files):
            try:
                found.append((MISSING, 0) if file is None else self._look(file))
            except npy.NpyError as err:
                raise FileError(which, str(err)) from err
        table = np.array(found, np.int64).reshape(-1, 2)
        codes = table[:, 0].astype(np.uint8)
        self._codes.append(np.where(codes == _NO_USE, np.uint8(WHOLE), codes))
        return codes, table[:, 1]

    def values(self, code: int, codes: NDArray[np.uint8], files: Sequence[bytes | None]) -> Values:
        """Return the values of all files of a form, one after the other, flat."""
        ours = [file for file, other in zip(files, codes, strict=True) if other == code and file]
        if code == WHOLE:
            return np.concatenate([npy.read(file).astype(np.float64).reshape(-1) for file in ours])
        layout, length = self._layouts[code], self._forms[code].length
        if layout.fortran:
            return np.concatenate([npy.read(file).reshape(-1) for file in ours])
        return np.frombuffer(b"".join([file[length:] for file in ours]), layout.dtype)

    def finish(self) -> tuple[Arrays, Said]:
        """Return the codes of all files, unless they are all 0, and the forms."""
        codes = np.concatenate([np.zeros(0, np.uint8), *self._codes])
        arrays = {f"original/{self._name}.form": codes} if codes.any() else {}
        return arrays, {"forms": [form.as_dict() for form in self._forms]}

    def _look(self, file: bytes) -> tuple[int, int]:
        header, layout = npy.split(file)
        known = self._known.get(header)
        if known is None:
            known = self._known[header] = self._admit(header, layout)
        code, items = known
        if code < MAX_FORMS and len(file) != len(header) + layout.nbytes:
            return WHOLE, items
        return known

    def _admit(self, header: bytes, layout: npy.Layout) -> tuple[int, int]:
        items = self._items(layout)
        if items is None:
            return _NO_USE, 0
        # of (k, 4) the number k is that of items; of other shapes all of it belongs to the form
        ragged = self._ragged and len(layout.shape) > 1 and layout.shape[0] == items
        form = Form.of(header, ragged=ragged)
        if form not in self._forms:
            if len(self._forms) == MAX_FORMS:
                return WHOLE, items
            self._forms.append(form)
            self._layouts.append(layout)
        return self._forms.index(form), items


def _differences(values: Values, expected: Values) -> tuple[Values, Values, Values]:
    """Return rows and columns where the bits of a file are not those of the array, and the bits."""
    bits = bits_of(values)
    row, column = np.nonzero(bits != bits_of(cast(expected, values.dtype)))
    return row, column, bits[row, column].astype(np.uint64)


def _whole(codes: NDArray[np.uint8]) -> list[int]:
    return [int(n) for n in np.flatnonzero((codes == WHOLE) | (codes == _NO_USE))]
