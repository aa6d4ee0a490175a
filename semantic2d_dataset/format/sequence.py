"""One recording by one lidar in one environment: reading and writing ``sequences/*.h5``."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.schema import SEQUENCE
from semantic2d_dataset.format.writing import ContainerWriter, root_attributes
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

_STAMPS_SOURCES = ("header", "record", "synthetic")
_PART = re.compile(r"[a-z0-9]+(?:[-._][a-z0-9]+)*")
_NOT_IN_DIGEST = {"format", "format_version", "generator", "created", "license"}


@dataclass(frozen=True)
class SequenceHeader:
    """What is said of a sequence besides its arrays.

    Parameters
    ----------
    environment, recording
        Lower-case names of letters, digits and single ``- . _`` between them.
    lidar
        The sensor.
    license
        Licence of the data, ``unknown`` where nobody said.
    stamps_source
        ``header``, ``record``, or ``synthetic`` (index / 20 Hz, for layouts without stamps).
    provenance
        Sources with SHA-256, tool versions, parameters; values that JSON can hold.
    taxonomy
        Classes that labels refer to.

    Raises
    ------
    InvalidInputError
        If a name or value is not of that form.
    """

    environment: str
    recording: str
    lidar: LidarSpec
    license: str = "unknown"
    stamps_source: str = "header"
    provenance: Mapping[str, Any] = field(default_factory=dict)
    taxonomy: Taxonomy = SEMANTIC2D

    def __post_init__(self) -> None:
        parts = {
            "environment": self.environment,
            "recording": self.recording,
            "lidar name": self.lidar.name,
        }
        for what, part in parts.items():
            if not _PART.fullmatch(part):
                raise InvalidInputError(
                    f"{what} {part!r}: expected lower-case letters and digits with single "
                    f"'-', '.' or '_' between them, such as {slug(part)!r}"
                )
        if self.stamps_source not in _STAMPS_SOURCES:
            raise InvalidInputError(
                f"stamps_source must be one of {_STAMPS_SOURCES}, found {self.stamps_source!r}"
            )

    @property
    def sequence_id(self) -> str:
        """``<environment>--<recording>--<lidar>``."""
        return f"{self.environment}--{self.recording}--{self.lidar.name}"


def slug(text: str) -> str:
    """Turn any text into a name that a sequence id may hold.

    >>> slug("Temple Lobby (2)")
    'temple-lobby-2'
    """
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "unnamed"


class SequenceWriter:
    """Write a sequence block by block; the file appears when it is complete and re-read.

    Use it as a context manager. An exception inside the block, a killed process or a full disk
    leaves nothing under the final name. The names of arrays, their dtypes and shapes are those
    of `semantic2d_dataset.format.schema.SEQUENCE`.

    Parameters
    ----------
    path
        The final name, conventionally ``<sequence id>.h5``.
    header
        What is said of the sequence.

    Raises
    ------
    WriteError
        If the file cannot be written.
    """

    def __init__(self, path: Path, header: SequenceHeader) -> None:
        self.header = header
        self._rows: dict[str, int] = {}
        self._last_stamp: int | None = None
        self._container = ContainerWriter(Path(path), SEQUENCE, _attributes_of(header))
        try:
            self._container.append_json("provenance", dict(header.provenance))
        except (TypeError, ValueError) as err:
            self._container.abort()
            raise InvalidInputError(f"{path}: provenance: JSON cannot hold it: {err}") from err

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is None:
            try:
                self._check_complete()
            except InvalidInputError:
                self._container.abort()
                raise
        self._container.__exit__(kind, *error)

    def append(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Append rows to per-scan arrays (and to line features), in blocks of any size.

        Raises
        ------
        InvalidInputError
            If a name, dtype or shape is not of the format, or stamps go backward.
        WriteError
            If the disk is full.
        """
        for name, array in arrays.items():
            self._check_rows(name, array)
        self._container.append(arrays)
        if "scans/stamps_ns" in arrays and not self._rows.get("scans/stamps_ns"):
            self._container.set_attributes(
                "scans/stamps_ns", {"stamps_source": self.header.stamps_source}
            )
        for name, array in arrays.items():
            self._rows[name] = self._rows.get(name, 0) + len(array)

    def copy(self, reader: SequenceReader, names: Iterable[str]) -> None:
        """Copy whole arrays of another sequence as they are stored, which costs little time.

        Raises
        ------
        InvalidInputError
            If rows of an array were written already, or its shape or stamps do not fit.
        WriteError
            If the disk is full, or a chunk of the other file is damaged.
        """
        for name in names:
            where = f"{self._container.path}: {name}"
            if name in _PER_BEAM and reader.lidar.beams != self.header.lidar.beams:
                raise InvalidInputError(
                    f"{where}: expected {self.header.lidar.beams} beams, found {reader.lidar.beams}"
                )
            if name == "scans/stamps_ns" and _goes_backward(reader.read(name)):
                raise InvalidInputError(f"{where}: stamps go backward; split the recording there")
            reader.copy_to(self._container, name)
            self._rows[name] = reader.shape(name)[0]
            if name == "scans/stamps_ns":
                said = {"stamps_source": self.header.stamps_source}
                self._container.set_attributes(name, said)

    def set_map(self, scene: SemanticMap) -> None:
        """Store the map that poses and labels refer to."""
        self._container.append({"map/occupancy": scene.occupancy, "map/labels": scene.labels})
        self._container.set_attributes(
            "map",
            {"resolution": scene.resolution, "origin": scene.origin.as_array().tolist()},
        )

    def _check_rows(self, name: str, array: NDArray[Any]) -> None:
        where = f"{self._container.path}: {name}"
        width = _WIDTHS.get(name)
        if name in _PER_BEAM:
            width = (self.header.lidar.beams,)
        if width is not None and array.shape[1:] != width:
            raise InvalidInputError(f"{where}: expected {('n', *width)}, found {array.shape}")
        if name == "scans/stamps_ns" and array.size:
            late = self._last_stamp is not None and array[0] < self._last_stamp
            if late or _goes_backward(array):
                raise InvalidInputError(f"{where}: stamps go backward; split the recording there")
            self._last_stamp = int(array[-1])

    def _check_complete(self) -> None:
        path = self._container.path
        missing = [name for name in SEQUENCE.required if name not in self._rows]
        if missing:
            raise InvalidInputError(f"{path}: a sequence needs {', '.join(missing)}")
        _check_lengths(path, self._rows)


_PER_BEAM = frozenset(("scans/ranges", "scans/intensities", "scans/labels", "scans/confidence"))
_WIDTHS: dict[str, tuple[int, ...]] = {
    "poses/initial": (3,),
    "poses/refined": (3,),
    "alignment/covariance": (3, 3),
    "commands/velocity": (2,),
    "lines/segments": (4,),
}


class SequenceReader:
    """Read a sequence; cheap to open, safe to pickle, one handle per process.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    CorruptFileError
        If it is truncated, damaged, no sequence, or its arrays do not fit each other.
    UnsafeFileError
        If it holds anything that the format does not list.
    FormatVersionError
        If it was written in a newer major format.
    """

    def __init__(self, path: Path) -> None:
        self._container = ContainerReader(path, SEQUENCE)
        self.path = self._container.path
        self.names = self._container.names
        self.header = self._read_header()
        self._length = self._check_shapes()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return self._length

    def __contains__(self, name: str) -> bool:
        return name in self.names

    @property
    def lidar(self) -> LidarSpec:
        """The sensor."""
        return self.header.lidar

    def close(self) -> None:
        """Close this process's handle; the next read opens it again."""
        self._container.close()

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array."""
        return self._container.shape(name)

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Read rows start to stop of an array.

        Raises
        ------
        InvalidInputError
            If the sequence has no such array.
        CorruptFileError
            If a checksum does not fit.
        """
        return self._container.read(name, start, stop)

    def copy_to(self, writer: ContainerWriter, name: str) -> None:
        """Copy a whole array into a file that is being written."""
        writer.copy(self._container, name)

    def batch(self, start: int = 0, stop: int | None = None) -> ScanBatch:
        """Read scans start to stop with what else describes them.

        Poses are the refined ones, the initial ones where there are no others, else NaN.
        """
        stamps = self.read("scans/stamps_ns", start, stop)
        return ScanBatch(
            self.lidar,
            self.read("scans/ranges", start, stop),
            self._read_or_none("scans/intensities", start, stop),
            self._read_or_none("scans/labels", start, stop),
            self.read_poses(start, stop),
            stamps,
        )

    def read_poses(self, start: int = 0, stop: int | None = None) -> NDArray[np.float64]:
        """Read the best poses there are, (n, 3) f8 x y yaw, NaN where unknown."""
        for name in ("poses/refined", "poses/initial"):
            if name in self:
                return self.read(name, start, stop)
        return np.full((len(range(*slice(start, stop).indices(len(self)))), 3), np.nan)

    def read_map(self) -> SemanticMap | None:
        """Read the map, or None where the sequence has none."""
        if "map/occupancy" not in self or "map/labels" not in self:
            return None
        said = self._container.attributes("map")
        try:
            return SemanticMap(
                self.read("map/occupancy"),
                self.read("map/labels"),
                float(said["resolution"]),
                Pose2(*said["origin"]),
            )
        except (KeyError, TypeError, InvalidInputError) as err:
            raise CorruptFileError(f"{self.path}: the map is not valid: {err}") from err

    def describe_stream(self, name: str) -> dict[str, Any]:
        """Return what is known of ``streams/<name>``: its topic, type, stamps and columns.

        Raises
        ------
        InvalidInputError
            If the sequence has no such stream.
        """
        return dict(self._container.read_json(f"streams/{name}/about"))

    def content_digest(self) -> str:
        """Return the SHA-256 over arrays and what describes them, not dates or generators.

        Two sequences with the same digest hold the same data, however they were made.
        """
        digest = hashlib.sha256()
        for owner in ("", "lidar", "map", "taxonomy", "scans/stamps_ns"):
            if not owner or self._container.has_group(owner):
                said = self._container.attributes(owner)
                kept = {key: said[key] for key in sorted(said) if key not in _NOT_IN_DIGEST}
                digest.update(json.dumps([owner, kept], sort_keys=True).encode())
        for name in self.names:
            if name == "provenance":
                continue
            dtype = self._container.dtype(name).str
            digest.update(json.dumps([name, dtype, self.shape(name)]).encode())
            for block in self._container.blocks(name):
                digest.update(block.tobytes())
        return digest.hexdigest()

    def check_values(self) -> None:
        """Read every chunk, and check what the values must keep to.

        Raises
        ------
        CorruptFileError
            If a checksum does not fit, stamps go backward, a label is no class, or offsets of
            lines do not divide their segments.
        """
        self._container.read_everything()
        if _goes_backward(self.read("scans/stamps_ns")):
            raise CorruptFileError(f"{self.path}: scans/stamps_ns go backward")
        for block in self._container.blocks("scans/labels") if "scans/labels" in self else ():
            strange = (block >= len(self.header.taxonomy)) & (block != UNLABELLED)
            if strange.any():
                raise CorruptFileError(
                    f"{self.path}: scans/labels: expected 0 to {len(self.header.taxonomy) - 1} "
                    f"or {UNLABELLED}, found {block[strange][0]}"
                )
        if "lines/offsets" in self and "lines/segments" in self:
            offsets, segments = self.read("lines/offsets"), self.shape("lines/segments")[0]
            if offsets[0] != 0 or offsets[-1] != segments or (np.diff(offsets) < 0).any():
                raise CorruptFileError(
                    f"{self.path}: lines/offsets do not divide the {segments} segments"
                )

    def _read_or_none(self, name: str, start: int, stop: int | None) -> Any:
        return self.read(name, start, stop) if name in self else None

    def _read_header(self) -> SequenceHeader:
        root, lidar = self._container.attributes(), self._container.attributes("lidar")
        try:
            stamps = self._container.attributes("scans/stamps_ns")
            header = SequenceHeader(
                environment=root["environment"],
                recording=root["recording"],
                lidar=LidarSpec(**lidar | {"base_T_lidar": tuple(lidar["base_T_lidar"])}),
                license=root.get("license", "unknown"),
                stamps_source=stamps.get("stamps_source", "header"),
                provenance=self._container.read_json("provenance")
                if "provenance" in self.names
                else {},
                taxonomy=self._read_taxonomy(),
            )
        except (KeyError, TypeError, ValueError) as err:
            raise CorruptFileError(f"{self.path}: its description is not valid: {err}") from err
        if root.get("sequence_id") != header.sequence_id:
            raise CorruptFileError(
                f"{self.path}: expected the sequence id {header.sequence_id}, "
                f"found {root.get('sequence_id')}"
            )
        return header

    def _read_taxonomy(self) -> Taxonomy:
        said = self._container.attributes("taxonomy")
        colours = tuple((int(r), int(g), int(b)) for r, g, b in said["colours"])
        return Taxonomy(tuple(said["names"]), colours, int(said["background_id"]))

    def _check_shapes(self) -> int:
        shapes = {name: self.shape(name) for name in self.names}
        for name, shape in shapes.items():
            width = (self.lidar.beams,) if name in _PER_BEAM else _WIDTHS.get(name)
            if width is not None and shape[1:] != width:
                raise CorruptFileError(
                    f"{self.path}: {name}: expected rows of {width}, found {shape}"
                )
        try:
            _check_lengths(self.path, {name: shape[0] for name, shape in shapes.items()})
        except InvalidInputError as err:
            raise CorruptFileError(str(err)) from err
        return shapes["scans/stamps_ns"][0]


def _goes_backward(stamps_ns: NDArray[np.int64]) -> bool:
    """Compare, not subtract: differences of stamps may be beyond int64."""
    return bool((stamps_ns[1:] < stamps_ns[:-1]).any())


def _check_lengths(path: Path, rows: Mapping[str, int]) -> None:
    scans = rows["scans/stamps_ns"]
    for name, found in rows.items():
        spec = SEQUENCE.array(name)
        expected = scans + 1 if name == "lines/offsets" else scans
        if spec is not None and (spec.per_scan or name == "lines/offsets") and found != expected:
            raise InvalidInputError(f"{path}: {name}: expected {expected} rows, found {found}")


def _attributes_of(header: SequenceHeader) -> dict[str, dict[str, Any]]:
    return {
        "": root_attributes(
            SEQUENCE,
            sequence_id=header.sequence_id,
            environment=header.environment,
            recording=header.recording,
            license=header.license,
        ),
        "lidar": asdict(header.lidar) | {"base_T_lidar": list(header.lidar.base_T_lidar)},
        "taxonomy": header.taxonomy.as_dict() | {"ignore_id": UNLABELLED},
    }
