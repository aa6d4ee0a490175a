"""Names, dtypes, shapes and limits of everything that a file of this package may hold.

A reader refuses what is not listed here; a writer cannot write it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

FORMAT_MAJOR, FORMAT_MINOR = 1, 0
FORMAT_VERSION = f"{FORMAT_MAJOR}.{FORMAT_MINOR}"

CHUNK_ROWS = 64
"""Scans in one chunk of a per-scan array."""

MAX_CHUNK_BYTES = 1 << 26
MAX_ATTRIBUTE_BYTES = 1 << 16
MAX_LINKS = 100_000
_MAX_STREAMED_BYTES = 1 << 40
_MAX_WHOLE_BYTES = 1 << 29

_NUMBERS = ("<f4", "<f8", "|u1", "<u2", "<u4", "<u8", "|i1", "<i2", "<i4", "<i8")


@dataclass(frozen=True)
class ArraySpec:
    """What one array may be.

    Parameters
    ----------
    dtypes
        Admitted dtypes, the first being the usual one.
    ndims
        Admitted ranks.
    per_scan
        Whether axis 0 counts scans, so that its length must be that of the file.
    max_bytes
        Largest size that it may declare, uncompressed.
    """

    dtypes: tuple[str, ...]
    ndims: tuple[int, ...]
    per_scan: bool = False
    max_bytes: int = _MAX_STREAMED_BYTES


@dataclass(frozen=True)
class FileSchema:
    """What one kind of file may hold.

    Parameters
    ----------
    kind
        Value of the root attribute ``format``.
    arrays
        Array specifications by path; ``*`` stands for one path component.
    attributes
        Attribute kinds by path of the group or array ("" is the root), then by name:
        ``str``, ``strs`` (a list), ``int``, ``float``, ``floats`` or ``ints`` (any rank).
    required
        Arrays that must be there.
    max_links
        Entries that one group may have.
    """

    kind: str
    arrays: Mapping[str, ArraySpec]
    attributes: Mapping[str, Mapping[str, str]]
    required: tuple[str, ...] = ()
    max_links: int = MAX_LINKS
    groups: frozenset[str] = field(init=False)

    def __post_init__(self) -> None:
        above = {
            path.rsplit("/", n)[0] for path in self.arrays for n in range(1, path.count("/") + 1)
        }
        object.__setattr__(self, "groups", frozenset(above | set(self.attributes) - {""}))

    def array(self, path: str) -> ArraySpec | None:
        """Return the specification of the array at a path, or None where none may be."""
        return next((spec for p, spec in self.arrays.items() if _matches(path, p)), None)

    def is_group(self, path: str) -> bool:
        """Tell whether a group may be at a path."""
        return any(_matches(path, p) for p in self.groups)

    def attribute_kinds(self, path: str) -> Mapping[str, str]:
        """Return the attributes that the object at a path may have."""
        return next((kinds for p, kinds in self.attributes.items() if _matches(path, p)), {})


def _matches(path: str, pattern: str) -> bool:
    parts, wanted = path.split("/"), pattern.split("/")
    return len(parts) == len(wanted) and all(map(fnmatchcase, parts, wanted))


_ROOT = {"format": "str", "format_version": "str", "generator": "str", "created": "str"}
_JSON_BYTES = ArraySpec(("|u1",), (1,), max_bytes=1 << 24)


def _per_scan(dtype: str, ndim: int) -> ArraySpec:
    """Per-beam arrays are read in blocks; what has a few numbers a scan may be read whole."""
    beams = ndim == 2 and dtype != "<f8"
    limit = _MAX_STREAMED_BYTES if beams else _MAX_WHOLE_BYTES
    return ArraySpec((dtype,), (ndim,), per_scan=True, max_bytes=limit)


SEQUENCE = FileSchema(
    kind="semantic2d-sequence",
    arrays={
        "provenance": _JSON_BYTES,
        "scans/ranges": _per_scan("<f4", 2),
        "scans/intensities": _per_scan("<f4", 2),
        "scans/stamps_ns": _per_scan("<i8", 1),
        "scans/labels": _per_scan("|u1", 2),
        "scans/confidence": _per_scan("|u1", 2),
        "poses/initial": _per_scan("<f8", 2),
        "poses/refined": _per_scan("<f8", 2),
        "alignment/residual_m": _per_scan("<f4", 1),
        "alignment/inlier_ratio": _per_scan("<f4", 1),
        "alignment/accepted": _per_scan("|u1", 1),
        "alignment/covariance": _per_scan("<f8", 3),
        "commands/velocity": _per_scan("<f8", 2),
        "lines/segments": ArraySpec(("<f4",), (2,)),
        "lines/offsets": ArraySpec(("<i8",), (1,), max_bytes=_MAX_WHOLE_BYTES),
        "map/occupancy": ArraySpec(("|u1",), (2,), max_bytes=_MAX_WHOLE_BYTES),
        "map/labels": ArraySpec(("|u1",), (2,), max_bytes=_MAX_WHOLE_BYTES),
        "streams/*/stamps_ns": ArraySpec(("<i8",), (1,), max_bytes=_MAX_WHOLE_BYTES),
        "streams/*/data": ArraySpec(_NUMBERS, (1, 2, 3)),
        "streams/*/offsets": ArraySpec(("<i8",), (1,), max_bytes=_MAX_WHOLE_BYTES),
        "streams/*/about": _JSON_BYTES,
        "original/*": ArraySpec(_NUMBERS, (1, 2, 3)),
    },
    attributes={
        "": _ROOT
        | {"sequence_id": "str", "environment": "str", "recording": "str", "license": "str"},
        "lidar": {
            "name": "str",
            "model": "str",
            "beams": "int",
            "angle_min": "float",
            "angle_increment": "float",
            "range_min": "float",
            "range_max": "float",
            "base_T_lidar": "floats",
        },
        "scans/stamps_ns": {"stamps_source": "str"},
        "map": {"resolution": "float", "origin": "floats"},
        "taxonomy": {
            "names": "strs",
            "colours": "ints",
            "background_id": "int",
            "ignore_id": "int",
        },
    },
    required=("scans/ranges", "scans/stamps_ns"),
)

SPLITS = FileSchema(
    kind="semantic2d-splits",
    arrays={"membership/*": ArraySpec(("|u1",), (1,), max_bytes=_MAX_WHOLE_BYTES)},
    attributes={"": _ROOT | {"scheme": "str", "made_by": "str"}},
)

PREDICTIONS = FileSchema(
    kind="semantic2d-predictions",
    arrays={
        "metadata": _JSON_BYTES,
        "predictions/*/scan_index": ArraySpec(("<i8",), (1,), max_bytes=_MAX_WHOLE_BYTES),
        "predictions/*/labels": ArraySpec(("|u1",), (2,)),
        "predictions/*/probabilities": ArraySpec(("<f2",), (3,)),
        "predictions/*/samples": ArraySpec(("|u1",), (3,)),
    },
    attributes={
        "": _ROOT
        | {
            "dataset": "str",
            "dataset_version": "str",
            "scheme": "str",
            "split": "str",
            "taxonomy_digest": "str",
        }
    },
    max_links=5_000,
)

SCHEMAS = {schema.kind: schema for schema in (SEQUENCE, SPLITS, PREDICTIONS)}
