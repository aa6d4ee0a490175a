"""Label a whole sequence: the three steps of SALSA over blocks of scans, in bounded memory."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numba
import numpy as np
import scipy
from numpy.typing import NDArray
from tqdm import tqdm

import semantic2d_dataset
from salsa.alignment import Alignment, check_inside, corrections
from salsa.blocks import (
    BLOCK_SCANS,
    Block,
    Job,
    align_block,
    blocks_of,
    gather_block,
    joined,
    judge_block,
    label_block,
    prepare,
    rough_poses,
    rows_of,
)
from salsa.detections import STREAM
from salsa.evidence import Ledger, coarse, look_length
from salsa.settings import Settings
from salsa.sightings import Seen, Sightings, sighting_files
from salsa.smoothing import read_odometry, smooth
from salsa.things import NO_THINGS, Things, find_things, movable_ids
from semantic2d_dataset.errors import AlignmentError
from semantic2d_dataset.executors import Executor, Serial
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from semantic2d_dataset.format.writing import check_target
from semantic2d_dataset.scene.maps import map_image
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

MIN_ACCEPTED_SHARE = 1 / 3
"""Of the scans with a pose: below it the map is not that of the recording."""

Facts = dict[str, Any]

_OURS = (
    "scans/labels",
    "scans/confidence",
    "poses/refined",
    "provenance",
    "alignment/",
    "lines/",
    "map/",
)


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
    things, things_moved, standing
        Unmapped things that stay, how many of them are mapped objects that were moved, and how
        many outlines were taken for people who stand.
    scans_with_image
        Scans that a camera's image is near to; None where there was no camera.
    points
        Points (beams with a return) by class name; those of scans not accepted under
        ``unlabelled``.
    """

    scans: int
    scans_with_pose: int
    scans_accepted: int
    median_residual_m: float
    near_before: float
    near_after: float
    things: int
    things_moved: int
    standing: int
    scans_with_image: int | None
    points: dict[str, int]


def label_sequence(
    source: Path,
    map_yaml: Path,
    annotation: Path,
    out: Path,
    *,
    settings: Settings | None = None,
    sightings: Sightings | None = None,
    taxonomy: Taxonomy | None = None,
    force: bool = False,
    executor: Executor | None = None,
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
    sightings
        What a camera saw of other things that move, see `docs/camera.md`.
    taxonomy
        Classes of the labels; those of the sequence unless given.
    force
        Replace `out` where it exists.
    executor
        Where blocks of scans are worked on; the result is the same. This process, with all its
        cores, unless given.

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
    inputs = input_files(source, map_yaml, annotation, sightings)
    check_target(out, inputs.values(), force=force)
    with SequenceReader(source) as reader:
        header = reader.header
    facts = salsa_facts(source, map_yaml, annotation, settings, sightings, taxonomy)
    taxonomy = taxonomy or header.taxonomy
    if settings.persistence is not None:
        movable_ids(settings.persistence, taxonomy)  # before hours of work
    files = [path.resolve() for path in (source, Path(map_yaml), Path(annotation))]
    seen = None if sightings is None else sightings.resolved()
    job = Job(files[0], files[1], files[2], seen, taxonomy, settings, _digest(facts))
    prepared, run = prepare(job), executor or Serial()
    reader = prepared.reader
    rough = rough_poses(reader, 0, len(reader))
    try:
        _check_poses(source, rough)
        check_inside(rough, prepared.field)
        provenance = dict(header.provenance) | {"salsa": facts}
        header = replace(header, taxonomy=taxonomy, provenance=provenance)
        with tqdm(total=2 * len(reader), desc=source.name, unit="scan", disable=None) as bar:
            found, near_before = _align_all(job, run, bar)
            found = _smoothed(job, found, run)
            _check_fit(source, found, corrections(rough, found.poses), header)
            things = _find_things(job, found, run)
            with SequenceWriter(out, header) as writer:
                writer.copy(reader, _kept(reader))
                counts = _write_all(job, writer, found, things, run, bar)
                writer.set_map(prepared.scene)
        return _summarise(found, near_before, things, prepared.seen, counts, taxonomy)
    finally:
        reader.close()


def input_files(
    source: Path, map_yaml: Path, annotation: Path, sightings: Sightings | None = None
) -> dict[str, Path]:
    """Return every file that labelling reads, by its role.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        If the map's YAML file is missing, or names no image; or that of a camera.
    """
    files = {
        "sequence": Path(source),
        "map": Path(map_yaml),
        "map_image": map_image(map_yaml),
        "annotation": Path(annotation),
    }
    return files | sighting_files(sightings)


def salsa_facts(
    source: Path,
    map_yaml: Path,
    annotation: Path,
    settings: Settings | None = None,
    sightings: Sightings | None = None,
    taxonomy: Taxonomy | None = None,
) -> Facts:
    """Return what a labelling depends on: inputs with SHA-256, parameters, versions.

    A labelled sequence has it in its provenance, under ``salsa``.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        As `input_files`, and if another file is missing.
    """
    inputs = input_files(source, map_yaml, annotation, sightings)
    parameters = asdict(settings or Settings()) | {"block_scans": BLOCK_SCANS}
    if sightings is not None:
        parameters["matching"] = asdict(sightings.matching)
        if sightings.detections.startswith(STREAM):
            parameters["detections"] = sightings.detections
    if taxonomy is not None:
        parameters["taxonomy"] = asdict(taxonomy)
    facts = {
        "inputs": {
            role: {"name": path.name, "sha256": sha256_of(path)} for role, path in inputs.items()
        },
        "parameters": parameters,
        "versions": {
            "semantic2d-dataset": semantic2d_dataset.__version__,
            "numpy": np.__version__,
            "numba": numba.__version__,
            "scipy": scipy.__version__,
        },
    }
    return dict(json.loads(json.dumps(facts)))  # as it is read back


def _align_all(job: Job, run: Executor, bar: tqdm[Any]) -> tuple[Alignment, NDArray[np.float32]]:
    """Align all blocks; also return the share of points near the map at the rough poses (N,)."""
    parts, near_before = [], []
    blocks = blocks_of(len(prepare(job).reader))
    for block, (found, near) in zip(
        blocks, run.map(partial(align_block, job), blocks), strict=True
    ):
        parts.append(found)
        near_before.append(near)
        bar.update(block.stop - block.start)
    return _help_on(job, blocks, parts, run), np.concatenate(near_before)


def _help_on(job: Job, blocks: list[Block], parts: list[Alignment], run: Executor) -> Alignment:
    """Align blocks of which little fits once more, from where the block before them ended."""
    reader = prepare(job).reader
    for number in range(1, len(blocks)):
        block, last = blocks[number], np.flatnonzero(parts[number - 1].accepted)
        known = np.isfinite(parts[number].poses).all(axis=-1)
        if not len(last) or 2 * parts[number].accepted.sum() >= known.sum():
            continue
        at = blocks[number - 1].start + int(last[-1])
        before = np.stack((parts[number - 1].poses[last[-1]], rough_poses(reader, at, at + 1)[0]))
        ((found, _),) = run.map(partial(align_block, job), [replace(block, before=before)])
        if found.accepted.sum() > parts[number].accepted.sum():
            parts[number] = found
    return joined(parts)


def _smoothed(job: Job, found: Alignment, run: Executor) -> Alignment:
    """Let the poses of the whole recording agree with each other, where that is asked for."""
    smoothing, reader = job.settings.smoothing, prepare(job).reader
    if smoothing is None:
        return found
    odometry = read_odometry(reader, smoothing.odometry) if smoothing.odometry else None
    rough, stamps_ns = rough_poses(reader, 0, len(reader)), reader.read("scans/stamps_ns")
    poses = smooth(found, rough, stamps_ns, smoothing, odometry=odometry)
    blocks = _with_alignment(job, replace(found, poses=poses))
    return joined(list(run.map(partial(judge_block, job), blocks)))


def _find_things(job: Job, found: Alignment, run: Executor) -> Things:
    """Find what stays in free space, from what all blocks saw."""
    persistence, field = job.settings.persistence, prepare(job).field
    if persistence is None:
        return NO_THINGS
    look_s = look_length(prepare(job).reader.read("scans/stamps_ns"))
    ledger = Ledger(coarse(field)[1], look_s)
    for evidence in run.map(partial(gather_block, job, look_s), _with_alignment(job, found)):
        ledger.add(evidence)
    object_m = job.settings.transfer.object_m
    return find_things(ledger, field, object_m, persistence, job.taxonomy)


def _with_alignment(job: Job, found: Alignment) -> Iterable[Block]:
    blocks = blocks_of(len(prepare(job).reader))
    return (replace(block, found=rows_of(found, block)) for block in blocks)


def _write_all(
    job: Job,
    writer: SequenceWriter,
    found: Alignment,
    things: Things,
    run: Executor,
    bar: tqdm[Any],
) -> NDArray[np.int64]:
    """Write labels, lines and alignment, block by block; return points per label (256,)."""
    counts = np.zeros(256, np.int64)
    lines = 0
    blocks = blocks_of(len(found))
    results = run.map(partial(label_block, job, things), _with_alignment(job, found))
    for block, (arrays, of_block) in zip(blocks, results, strict=True):
        offsets = arrays["lines/offsets"]
        arrays["lines/offsets"] = (offsets if block.start == 0 else offsets[1:]) + lines
        writer.append(arrays)
        lines += len(arrays["lines/segments"])
        counts += of_block
        bar.update(block.stop - block.start)
    writer.append(_alignment_arrays(found))
    return counts


def _alignment_arrays(found: Alignment) -> dict[str, NDArray[Any]]:
    return {
        "poses/refined": found.poses,
        "alignment/residual_m": found.residual_m,
        "alignment/inlier_ratio": found.inlier_ratio,
        "alignment/accepted": found.accepted.astype(np.uint8),
        "alignment/covariance": found.covariance,
    }


def _kept(reader: SequenceReader) -> list[str]:
    """Return what the source has beside that which labelling makes."""
    return [name for name in reader.names if not name.startswith(_OURS)]


def _check_poses(source: Path, rough: NDArray[np.float64]) -> None:
    if not np.isfinite(rough).all(axis=-1).any():
        raise AlignmentError(
            f"{source}: no scan has a pose, so alignment has nowhere to start; semantic2d inspect "
            f"says which poses the recording has, and convert --poses takes them"
        )


def _check_fit(
    source: Path, found: Alignment, moved_m: NDArray[np.float64], header: SequenceHeader
) -> None:
    """Refuse to call a recording from elsewhere a crowd."""
    known = np.isfinite(found.poses).all(axis=-1)
    if found.accepted.sum() < MIN_ACCEPTED_SHARE * known.sum():
        near, moved = np.median(found.inlier_ratio[known]), np.median(moved_m[known])
        raise AlignmentError(
            f"{source}: the scans do not fit the map: {found.accepted.sum()} of {known.sum()} "
            f"scans accepted; the median scan fits best {moved:.1f} m from its rough pose, with "
            f"{100 * near:.0f} % of its points near a mapped object; check that map, scan topic "
            f"and mount belong together, and that the poses are in the frame of this map (they "
            f"come from: {header.provenance.get('poses', 'the sequence')})"
        )


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest(facts: Facts) -> str:
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _summarise(
    found: Alignment,
    near_before: NDArray[np.float32],
    things: Things,
    seen: Seen | None,
    counts: NDArray[np.int64],
    taxonomy: Taxonomy,
) -> Summary:
    known = np.isfinite(found.poses).all(axis=-1)
    names = {**dict(enumerate(taxonomy.names)), UNLABELLED: "unlabelled"}
    return Summary(
        scans=len(found),
        scans_with_pose=int(known.sum()),
        scans_accepted=int(found.accepted.sum()),
        median_residual_m=float(np.median(found.residual_m[found.accepted])),
        near_before=float(np.median(near_before[known])),
        near_after=float(np.median(found.inlier_ratio[known])),
        things=things.things,
        things_moved=things.moved,
        standing=things.standing,
        scans_with_image=None if seen is None else seen.scans,
        points={name: int(counts[label]) for label, name in names.items()},
    )
