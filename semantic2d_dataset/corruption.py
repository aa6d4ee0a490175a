"""Test sets as a worse sensor, or worse weather, would have recorded them.

Kinds, each in five severities, in the manner of ImageNet-C (Hendrycks and Dietterich, ICLR 2019):

- ``range-noise``: Gaussian noise on ranges;
- ``dropout``: beams chosen at random have no return;
- ``dimming``: intensities multiplied by a factor below 1, as by a dirty window; ranges stay;
- ``coarse``: a beam takes all that its nearest of every k-th beam measured, label too;
- ``short-range``: what is farther than a limit gives no return;
- ``rain``: beams chosen at random end at a drop, between the lidar and what they hit, at most
  10 m away. A drop is none of the classes: its label is the background, and to call it a chair
  is an error.

A beam without a return keeps its label and is not scored. Each set is a data set of its own, in
the format of any other: the scans of one split, with labels, poses and map. Its name says from
which data set, kind and severity, its version that of this generator.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.access.scan_source import Fields
from semantic2d_dataset.access.transforms import BeamDropout, RangeNoise, Transform
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.format.splits import SplitScheme, split_id
from semantic2d_dataset.format.writing import make_folder, stale_partials
from semantic2d_dataset.scene.lidars import LidarSpec

GENERATOR_VERSION = "1.0.0"
"""Changes whenever the same seed could give other scans."""

SEVERITIES = (1, 2, 3, 4, 5)

_BLOCK = 1024  # scans drawn at a time: another number gives other scans
_DROPS_WITHIN_M = 10.0
_DROP_SHINES = 0.3  # of the intensity that the beam would have had
_COPIED = ("poses/initial", "poses/refined", "scans/stamps_ns")


@dataclass(frozen=True)
class Dimming:
    """Multiply intensities by a factor; nothing where there are none."""

    factor: float

    def __call__(self, fields: Fields, lidar: LidarSpec, rng: np.random.Generator) -> Fields:  # noqa: ARG002
        """Return scans that shine less."""
        if "intensities" not in fields:
            return fields
        return dict(fields) | {"intensities": fields["intensities"] * np.float32(self.factor)}


@dataclass(frozen=True)
class Coarse:
    """Keep one beam of so many, and let it stand for its neighbours."""

    step: int

    def __call__(self, fields: Fields, lidar: LidarSpec, rng: np.random.Generator) -> Fields:  # noqa: ARG002
        """Return scans of which several beams in a row are alike."""
        kept = (np.arange(lidar.beams) + self.step // 2) // self.step * self.step
        kept = np.minimum(kept, (lidar.beams - 1) // self.step * self.step)
        per_beam = ("ranges", "intensities", "labels")
        return dict(fields) | {
            name: np.ascontiguousarray(fields[name][:, kept]) for name in per_beam if name in fields
        }


@dataclass(frozen=True)
class ShortRange:
    """Take the return from all that is at least so far away."""

    limit_m: float

    def __call__(self, fields: Fields, lidar: LidarSpec, rng: np.random.Generator) -> Fields:  # noqa: ARG002
        """Return scans that see less far."""
        ranges = fields["ranges"]
        far = ranges >= np.float32(self.limit_m)
        return dict(fields) | {"ranges": np.where(far, np.float32(np.inf), ranges)}


@dataclass(frozen=True)
class Rain:
    """Let a share of the beams end early, at something of the background class."""

    share: float
    background: int

    def __call__(self, fields: Fields, lidar: LidarSpec, rng: np.random.Generator) -> Fields:
        """Return scans with drops in them."""
        ranges = fields["ranges"]
        hit = rng.random(ranges.shape, np.float32) < np.float32(self.share)
        there = lidar.has_return(ranges)
        hit &= there | np.isposinf(ranges)
        low = np.float32(max(lidar.range_min, 0.05))
        reach = min(lidar.range_max, _DROPS_WITHIN_M)
        end = np.where(there, np.minimum(ranges, np.float32(reach)), np.float32(reach))
        drop = low + rng.random(ranges.shape, np.float32) * np.maximum(end - low, np.float32(0))
        changed = {"ranges": np.where(hit, drop, ranges)}
        changed["labels"] = np.where(hit, np.uint8(self.background), fields["labels"])
        if "intensities" in fields:
            values = fields["intensities"]
            changed["intensities"] = np.where(hit, values * np.float32(_DROP_SHINES), values)
        return dict(fields) | changed


_Levels = tuple[float, ...]

KINDS: Mapping[str, tuple[_Levels, Callable[[float, int], Transform]]] = MappingProxyType(
    {
        "range-noise": ((0.02, 0.05, 0.1, 0.2, 0.4), lambda std_m, _: RangeNoise(std_m)),
        "dropout": ((0.05, 0.1, 0.2, 0.35, 0.5), lambda share, _: BeamDropout(share)),
        "dimming": ((0.8, 0.6, 0.4, 0.2, 0.1), lambda factor, _: Dimming(factor)),
        "coarse": ((2, 3, 4, 6, 8), lambda step, _: Coarse(int(step))),
        "short-range": ((12.0, 9.0, 6.0, 4.0, 3.0), lambda limit_m, _: ShortRange(limit_m)),
        "rain": ((0.02, 0.05, 0.1, 0.15, 0.25), Rain),
    }
)
"""By kind: its parameter by severity, and what makes the change from it and the background id."""


def corruption(kind: str, severity: int, background: int = 0) -> Transform:
    """Return a corruption as a change of scans.

    Parameters
    ----------
    kind
        One of `KINDS`.
    severity
        1 to 5.
    background
        Id of the class of what is none of the others.

    Raises
    ------
    InvalidInputError
        If there is no such kind or severity.
    """
    if kind not in KINDS:
        raise InvalidInputError(f"unknown corruption {kind!r}; known are {', '.join(KINDS)}")
    if severity not in SEVERITIES:
        raise InvalidInputError(f"severity: expected 1 to {SEVERITIES[-1]}, found {severity}")
    levels, make = KINDS[kind]
    return make(levels[severity - 1], background)


def corrupt_dataset(
    data: OpenDataset,
    folder: Path,
    kind: str,
    severity: int,
    *,
    seed: int = 0,
    scheme: str = "block",
    split: str = "test",
) -> str:
    """Write the scans of a split as a corrupted data set.

    Parameters
    ----------
    data
        A labelled data set.
    folder
        The folder to make.
    kind, severity
        As for `corruption`.
    seed
        The same one gives the same scans.
    scheme, split
        Which scans.

    Returns
    -------
    str
        The name of the data set.

    Raises
    ------
    InvalidInputError
        If there is no such kind, severity, scheme or split, a sequence has no labels, or the
        folder exists.
    DatasetNotFoundError
        If the split is empty.
    WriteError
        If a file cannot be written.
    """
    corruption(kind, severity)
    if seed < 0:
        raise InvalidInputError(f"seed: expected 0 or more, found {seed}")
    if folder.exists():
        raise InvalidInputError(f"{folder}: exists already; choose a new folder")
    scans, manifest = _scans_of(data, scheme, split), data.manifest
    name = f"{manifest.name}-{manifest.version}-{set_name(kind, severity, seed)}"
    made = SplitScheme(
        scheme, _members(scans, split), f"{split} of {manifest.name} {manifest.version}, {kind}"
    )

    def make(target: Path) -> None:
        (target / "sequences").mkdir()
        for sequence_id, indices in scans.items():
            with data.reader(sequence_id) as reader:
                _write(target / "sequences", reader, indices, kind, severity, seed)
        license_ = manifest.license
        publish(target, name=name, version=GENERATOR_VERSION, license=license_, schemes=[made])

    make_folder(folder.resolve(), make, lambda: False)
    return name


def corrupt_into(
    data: OpenDataset,
    out: Path,
    item: tuple[str, int],
    *,
    seed: int = 0,
    scheme: str = "block",
    split: str = "test",
) -> Path:
    """Write the corrupted data set of a kind and severity below `out`, as `set_name` calls it.

    One that is there already is kept; one of other scans is refused. Other parameters and errors
    are those of `corrupt_dataset`.
    """
    kind, severity = item
    folder = out / set_name(kind, severity, seed)
    if not folder.exists():
        corrupt_dataset(data, folder, kind, severity, seed=seed, scheme=scheme, split=split)
        return folder
    base, members = data.manifest, _members(_scans_of(data, scheme, split), split)
    wanted = f"{base.name}-{base.version}-{folder.name}"
    if not _holds(folder, wanted, scheme, members):
        raise InvalidInputError(
            f"{folder}: exists already, and is not {wanted} {GENERATOR_VERSION} with {split} of "
            f"{scheme}; choose another folder"
        )
    return folder


def remove_partials(out: Path, items: Iterable[tuple[str, int]], seed: int = 0) -> None:
    """Remove what processes left half written below `out` that are gone."""
    for kind, severity in items:
        for stale in stale_partials(out.resolve() / set_name(kind, severity, seed)):
            shutil.rmtree(stale, ignore_errors=True)


def set_name(kind: str, severity: int, seed: int = 0) -> str:
    """Return the end of a corrupted data set's name."""
    return f"{kind}-{severity}" + (f"-seed{seed}" if seed else "")


def _scans_of(data: OpenDataset, scheme: str, split: str) -> dict[str, NDArray[np.int64]]:
    chosen = data.scheme(scheme)
    found = {
        entry.id: chosen.scans_of(entry.id, split)
        for entry in data.manifest.sequences
        if entry.id in chosen.membership
    }
    scans = {name: indices for name, indices in found.items() if indices.size}
    if not scans:
        raise DatasetNotFoundError(f"{data.manifest.name}: no scan in split {split!r} of {scheme}")
    return scans


def _members(scans: Mapping[str, NDArray[np.int64]], split: str) -> dict[str, NDArray[np.uint8]]:
    return {name: np.full(len(rows), split_id(split), np.uint8) for name, rows in scans.items()}


def _holds(folder: Path, name: str, scheme: str, members: Mapping[str, NDArray[np.uint8]]) -> bool:
    """Tell whether a folder is a set that was made before, of the same scans."""
    try:
        found = open_dataset(folder)
    except DatasetNotFoundError:
        return False
    said = found.manifest
    if (said.name, said.version, {*said.splits}) != (name, GENERATOR_VERSION, {scheme}):
        return False
    there = found.scheme(scheme).membership
    return there.keys() == members.keys() and all(
        np.array_equal(there[each], members[each]) for each in members
    )


def _write(
    folder: Path,
    reader: SequenceReader,
    indices: NDArray[np.int64],
    kind: str,
    severity: int,
    seed: int,
) -> None:
    header = reader.header
    if "scans/labels" not in reader:
        raise InvalidInputError(f"{header.sequence_id}: has no labels to score against")
    said = {
        "corruption": {
            "kind": kind,
            "severity": severity,
            "seed": seed,
            "generator_version": GENERATOR_VERSION,
            "source": {
                "sequence": header.sequence_id,
                "content_digest": reader.content_digest(),
            },
        }
    }
    change = corruption(kind, severity, header.taxonomy.background_id)
    rng = _random(kind, severity, seed, header.sequence_id)
    path = folder / f"{header.sequence_id}.h5"
    with SequenceWriter(path, replace(header, provenance=said)) as writer:
        scene = reader.read_map()
        if scene is not None:
            writer.set_map(scene)
        for start in range(0, len(indices), _BLOCK):
            block = indices[start : start + _BLOCK]
            fields = change(_read_fields(reader, block), reader.lidar, rng)
            arrays: dict[str, Any] = {f"scans/{name}": values for name, values in fields.items()}
            copied = {n: _pick(reader, n, block) for n in _COPIED if n in reader}
            writer.append(arrays | copied)


def _random(kind: str, severity: int, seed: int, sequence_id: str) -> np.random.Generator:
    """Numbers of each sequence's own, whatever others there are."""
    text = f"{kind}/{severity}/{seed}/{sequence_id}"
    return np.random.default_rng(np.frombuffer(hashlib.sha256(text.encode()).digest(), "<u4"))


def _read_fields(reader: SequenceReader, rows: NDArray[np.int64]) -> Fields:
    names = ("ranges", "intensities", "labels")
    return {n: _pick(reader, f"scans/{n}", rows) for n in names if f"scans/{n}" in reader}


def _pick(reader: SequenceReader, name: str, rows: NDArray[np.int64]) -> NDArray[Any]:
    low = int(rows[0])
    return reader.read(name, low, int(rows[-1]) + 1)[rows - low]
