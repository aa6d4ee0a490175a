"""Label a whole sequence: the three steps of SALSA over blocks of scans, in bounded memory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import scipy
from numpy.typing import NDArray
from tqdm import tqdm

import semantic2d_dataset
from salsa.alignment import TRUSTED, Acceptance, Alignment, align, check_inside, corrections, fit
from salsa.annotation import annotate_map
from salsa.fields import MapField, map_field
from salsa.labelling import DEFAULT_TRANSFER, Transfer, transfer_labels
from salsa.persistence import HitCounter, Persistence
from semantic2d_dataset.errors import AlignmentError, InvalidInputError, WriteError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.scene.lines import PUBLISHED, LineParameters, extract_lines
from semantic2d_dataset.scene.maps import map_image
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

BLOCK_SCANS = 8 * CHUNK_ROWS
"""Scans in memory at a time; neighbours help each other within a block, and forward beyond it."""

MIN_ACCEPTED_SHARE = 1 / 3
"""Of the scans with a pose: below it the map is not that of the recording."""

_OURS = ("scans/labels", "scans/confidence", "poses/refined", "provenance")
_OUR_GROUPS = ("alignment/", "lines/", "map/")
_PER_SCAN_GROUPS = ("scans/", "poses/", "commands/")


@dataclass(frozen=True)
class Settings:
    """Parameters of all steps; `persistence` None leaves unmapped static things as Person."""

    lines: LineParameters = PUBLISHED
    acceptance: Acceptance = TRUSTED
    transfer: Transfer = DEFAULT_TRANSFER
    persistence: Persistence | None = None


@dataclass(frozen=True)
class Summary:
    """What came of labelling a sequence.

    Parameters
    ----------
    scans, scans_with_pose, scans_accepted
        Counts.
    median_residual_m
        Median over the accepted scans of the rms distance of their inliers, m.
    near_before, near_after
        Median over the scans with a pose: share of points near (Acceptance.inlier_m) a mapped
        object, at the rough and at the refined poses.
    static_cells
        Map cells that hold something unmapped which stays.
    points
        Labelled beams by class name; beams of scans not accepted under ``unlabelled``.
    """

    scans: int
    scans_with_pose: int
    scans_accepted: int
    median_residual_m: float
    near_before: float
    near_after: float
    static_cells: int
    points: dict[str, int]


def label_sequence(
    source: Path,
    map_yaml: Path,
    annotation: Path,
    out: Path,
    *,
    settings: Settings | None = None,
    force: bool = False,
) -> Summary:
    """Write a labelled copy of a sequence.

    The copy has lines, alignment, refined poses, labels, confidence, the annotated map and the
    provenance of them all beside what the source had.

    Parameters
    ----------
    source
        A sequence with poses.
    map_yaml, annotation
        The map and its annotation, see `salsa.annotation.annotate_map`.
    out
        The file to write.
    settings
        Parameters of all steps.
    force
        Replace `out` where it exists.

    Raises
    ------
    FileNotFoundError, CorruptFileError, InvalidInputError
        If an input is missing or not what it should be, or `out` exists or is an input.
    AlignmentError
        If the scans have no poses, or do not fit the map: nothing is written then.
    WriteError
        If `out` cannot be written.
    """
    source, out, settings = Path(source), Path(out), settings or Settings()
    inputs = input_files(source, map_yaml, annotation)
    check_target(out, inputs.values(), force=force)
    with SequenceReader(source) as reader:
        taxonomy = reader.header.taxonomy
        scene = annotate_map(map_yaml, annotation, taxonomy)
        field = map_field(scene, taxonomy)
        check_inside(_rough_poses(reader, 0, len(reader)), field)
        said = _provenance(inputs, settings)
        header = replace(reader.header, provenance=dict(reader.header.provenance) | {"salsa": said})
        with tqdm(total=2 * len(reader), desc=source.name, unit="scan", disable=None) as bar:
            found = _align_all(reader, field, settings, bar)
            _check_fit(source, found)
            with SequenceWriter(out, header) as writer:
                counts = _write_all(reader, writer, found, settings, bar)
                _copy_other_arrays(reader, writer)
                writer.set_map(scene)
    return _summarise(found, counts, taxonomy)


def input_files(source: Path, map_yaml: Path, annotation: Path) -> dict[str, Path]:
    """Return every file that labelling reads, by its role.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        If the map's YAML file is missing, or names no image.
    """
    return {
        "sequence": Path(source),
        "map": Path(map_yaml),
        "map_image": map_image(map_yaml),
        "annotation": Path(annotation),
    }


def check_target(target: Path, inputs: Iterable[Path], *, force: bool) -> None:
    """Check that a file can be written, and takes the place of nothing that is still needed.

    Raises
    ------
    InvalidInputError
        If it is one of the inputs or a folder, or exists and `force` is not given.
    WriteError
        If its folder does not exist.
    """
    if any(_same(target, path) for path in inputs):
        raise InvalidInputError(f"{target}: is an input itself; choose another name")
    if target.is_dir():
        raise InvalidInputError(f"{target}: is a folder; give the name of a file in it")
    if target.exists() and not force:
        raise InvalidInputError(f"{target}: exists already; choose another name or use --force")
    if not target.parent.is_dir():
        raise WriteError(f"{target}: the folder {target.parent} does not exist")


def _same(one: Path, other: Path) -> bool:
    if one.exists() and other.exists():
        return one.samefile(other)
    return one.resolve() == other.resolve()


@dataclass(frozen=True)
class _Found:
    """What the first pass learns: a few numbers per scan, and where unmapped things stay."""

    alignment: Alignment
    correction_m: NDArray[np.float64]
    near_before: NDArray[np.float32]
    field: MapField
    static_cells: int

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which scans have a pose, (N,) bool."""
        return np.asarray(np.isfinite(self.alignment.poses).all(axis=-1))


def _align_all(
    reader: SequenceReader, field: MapField, settings: Settings, bar: tqdm[Any]
) -> _Found:
    """First pass: align block after block, and count what stays in free space."""
    counter = HitCounter(field, settings.transfer.object_m) if settings.persistence else None
    parts: list[Alignment] = []
    near_before: list[NDArray[np.float32]] = []
    moved: list[NDArray[np.float64]] = []
    before: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    for start, stop in _blocks(len(reader)):
        batch = _rough_batch(reader, start, stop)
        part = align(batch, field, acceptance=settings.acceptance, before=before)
        if counter is not None:
            counter.add(batch, part.poses, part.accepted)
        if part.accepted.any():
            last = int(np.flatnonzero(part.accepted)[-1])
            before = part.poses[last], batch.poses[last]
        parts.append(part)
        near_before.append(fit(batch, batch.poses, field, settings.acceptance.inlier_m)[1])
        moved.append(corrections(batch.poses, part.poses))
        bar.update(stop - start)
    static = (field, 0)
    if counter is not None and settings.persistence is not None:
        static = counter.without_static(settings.persistence)
    return _Found(_joined(parts), np.concatenate(moved), np.concatenate(near_before), *static)


def _write_all(
    reader: SequenceReader,
    writer: SequenceWriter,
    found: _Found,
    settings: Settings,
    bar: tqdm[Any],
) -> NDArray[np.int64]:
    """Second pass: lines, labels and what the source had; returns beams per label (256,)."""
    counts = np.zeros(256, np.int64)
    lines_before = 0
    for start, stop in _blocks(len(reader)):
        batch = _rough_batch(reader, start, stop)
        part = _rows(found.alignment, slice(start, stop))
        labels, confidence = transfer_labels(
            batch,
            part.poses,
            found.field,
            part.accepted,
            quality=part.inlier_ratio,
            transfer=settings.transfer,
            taxonomy=reader.header.taxonomy,
        )
        segments, offsets = _lines_of(batch, settings.lines)
        copied = {name: reader.read(name, start, stop) for name in reader.names if _is_kept(name)}
        writer.append(
            copied
            | {
                "scans/labels": labels,
                "scans/confidence": confidence,
                "poses/refined": part.poses,
                "alignment/residual_m": part.residual_m,
                "alignment/inlier_ratio": part.inlier_ratio,
                "alignment/accepted": part.accepted.astype(np.uint8),
                "alignment/covariance": part.covariance,
                "lines/segments": segments,
                "lines/offsets": (offsets if start == 0 else offsets[1:]) + lines_before,
            }
        )
        lines_before += len(segments)
        counts += np.bincount(labels[batch.valid | (labels == UNLABELLED)], minlength=256)
        bar.update(stop - start)
    return counts


def _blocks(scans: int) -> list[tuple[int, int]]:
    return [(start, min(start + BLOCK_SCANS, scans)) for start in range(0, scans, BLOCK_SCANS)]


def _rough_batch(reader: SequenceReader, start: int, stop: int) -> ScanBatch:
    """Read scans with the poses that they had before any alignment."""
    return replace(reader.batch(start, stop), poses=_rough_poses(reader, start, stop))


def _rough_poses(reader: SequenceReader, start: int, stop: int) -> NDArray[np.float64]:
    if "poses/initial" in reader:
        return reader.read("poses/initial", start, stop)
    return reader.read_poses(start, stop)


def _lines_of(
    batch: ScanBatch, parameters: LineParameters
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    lidar = batch.lidar
    return extract_lines(
        batch.ranges,
        lidar.bearings,
        parameters,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
    )


def _is_kept(name: str) -> bool:
    """Tell whether an array has one row a scan and stays as it is."""
    return name.startswith(_PER_SCAN_GROUPS) and name not in _OURS


def _copy_other_arrays(reader: SequenceReader, writer: SequenceWriter) -> None:
    """Copy what has rows of its own: streams, and fields of a published layout."""
    for name in reader.names:
        if name in _OURS or name.startswith(_OUR_GROUPS + _PER_SCAN_GROUPS):
            continue
        rows = reader.shape(name)[0]
        for start in range(0, max(rows, 1), BLOCK_SCANS):
            writer.append({name: reader.read(name, start, min(start + BLOCK_SCANS, rows))})


def _joined(parts: list[Alignment]) -> Alignment:
    return Alignment(
        *(
            np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(Alignment)
        )
    )


def _rows(alignment: Alignment, rows: slice) -> Alignment:
    return Alignment(*(getattr(alignment, each.name)[rows] for each in fields(Alignment)))


def _check_fit(source: Path, found: _Found) -> None:
    """Refuse to call a recording from elsewhere a crowd."""
    known, accepted = found.known, found.alignment.accepted
    if not known.any():
        raise AlignmentError(
            f"{source}: no scan has a pose, so alignment has nowhere to start; convert the "
            f"recording with its amcl pose or tf"
        )
    if accepted.sum() < MIN_ACCEPTED_SHARE * known.sum():
        near = np.median(found.alignment.inlier_ratio[known])
        moved = np.median(found.correction_m[known])
        raise AlignmentError(
            f"{source}: the scans do not fit the map: {accepted.sum()} of {known.sum()} scans "
            f"accepted; the median scan fits best {moved:.1f} m from its rough pose, with "
            f"{100 * near:.0f} % of its points near a mapped object; check that map, scan topic "
            f"and mount belong together"
        )


def _provenance(inputs: dict[str, Path], settings: Settings) -> dict[str, Any]:
    return {
        "inputs": {
            role: {"name": path.name, "sha256": _sha256(path)} for role, path in inputs.items()
        },
        "parameters": asdict(settings) | {"block_scans": BLOCK_SCANS},
        "versions": {
            "semantic2d-dataset": semantic2d_dataset.__version__,
            "numpy": np.__version__,
            "numba": numba.__version__,
            "scipy": scipy.__version__,
        },
    }


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _summarise(found: _Found, counts: NDArray[np.int64], taxonomy: Taxonomy) -> Summary:
    alignment, known = found.alignment, found.known
    names = {**dict(enumerate(taxonomy.names)), UNLABELLED: "unlabelled"}
    return Summary(
        scans=len(alignment),
        scans_with_pose=int(known.sum()),
        scans_accepted=int(alignment.accepted.sum()),
        median_residual_m=float(np.median(alignment.residual_m[alignment.accepted])),
        near_before=float(np.median(found.near_before[known])),
        near_after=float(np.median(alignment.inlier_ratio[known])),
        static_cells=found.static_cells,
        points={name: int(counts[label]) for label, name in names.items()},
    )
