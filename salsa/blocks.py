"""The work on one block of scans: pure functions that run here, in processes or on a cluster.

Each takes a `Job` that names the files, so that little travels; whoever runs it reads them once.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from salsa.alignment import Alignment, align, fit, judge
from salsa.annotation import annotate_map
from salsa.evidence import Evidence, gather
from salsa.fields import MapField, map_field
from salsa.labelling import transfer_labels
from salsa.projection import apply_detections
from salsa.settings import Settings
from salsa.sightings import Seen, Sightings, read_sightings
from salsa.things import Things
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.lines import extract_lines
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import Taxonomy

BLOCK_SCANS = 8 * CHUNK_ROWS
"""Scans in memory at a time; neighbours help each other within a block."""

Float = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]
Counts = NDArray[np.int64]


@dataclass(frozen=True)
class Job:
    """One sequence to label: its files, its classes and the parameters of all steps.

    `digest` is that of what the files hold, so that a changed file is another job.
    """

    source: Path
    map_yaml: Path
    annotation: Path
    sightings: Sightings | None
    taxonomy: Taxonomy
    settings: Settings
    digest: str


@dataclass(frozen=True)
class Prepared:
    """What the files of a job hold."""

    reader: SequenceReader
    scene: SemanticMap
    field: MapField
    seen: Seen | None


@dataclass(frozen=True)
class Block:
    """Scans `start` to `stop`, and what is known of them so far.

    Parameters
    ----------
    before
        Refined and rough pose (2, 3) of a trusted scan before them.
    found
        Their alignment.
    """

    start: int
    stop: int
    before: Float | None = None
    found: Alignment | None = None


@lru_cache(maxsize=1)
def prepare(job: Job) -> Prepared:
    """Open the sequence of a job and measure its map; kept for the next block of the same job."""
    reader = SequenceReader(job.source)
    scene = annotate_map(job.map_yaml, job.annotation, job.taxonomy)
    seen = read_sightings(job.sightings, reader, job.taxonomy)
    return Prepared(reader, scene, map_field(scene, job.taxonomy), seen)


def blocks_of(scans: int) -> list[Block]:
    """Divide a sequence; the division is the same wherever the work is done."""
    starts = range(0, scans, BLOCK_SCANS)
    return [Block(start, min(start + BLOCK_SCANS, scans)) for start in starts]


def align_block(job: Job, block: Block) -> tuple[Alignment, NDArray[np.float32]]:
    """Align scans; also return the share of their points near the map at the rough poses (n,)."""
    prepared, acceptance = prepare(job), job.settings.acceptance
    batch = rough_batch(prepared.reader, block)
    found = align(batch, prepared.field, acceptance=acceptance, before=block.before)
    return found, fit(batch, batch.poses, prepared.field, acceptance.inlier_m)[1]


def judge_block(job: Job, block: Block) -> Alignment:
    """Say how scans fit at the poses that they have been given."""
    prepared = prepare(job)
    batch = rough_batch(prepared.reader, block)
    poses, acceptance = aligned(block).poses, job.settings.acceptance
    return judge(batch, poses, prepared.field, acceptance=acceptance)


def gather_block(job: Job, look_s: float, block: Block) -> Evidence:
    """Count what stays in free space and what does not."""
    prepared, found = prepare(job), aligned(block)
    batch = rough_batch(prepared.reader, block)
    return gather(batch, found.poses, found.accepted, prepared.field, look_s=look_s)


def label_block(job: Job, things: Things, block: Block) -> tuple[Arrays, Counts]:
    """Label scans, and extract their lines.

    Returns
    -------
    arrays, counts
        Arrays by their names in the sequence, and how many points have each label (256,).
    """
    prepared, found = prepare(job), aligned(block)
    batch = rough_batch(prepared.reader, block)
    labels, confidence = transfer_labels(
        batch,
        found.poses,
        prepared.field,
        found.accepted,
        quality=found.inlier_ratio,
        things=things.layer(prepared.field.free.shape),
        transfer=job.settings.transfer,
        taxonomy=job.taxonomy,
    )
    if prepared.seen is not None:
        camera, detections, matching, _ = prepared.seen
        labels, confidence = apply_detections(
            batch,
            found.poses,
            labels,
            confidence,
            camera,
            detections,
            matching=matching,
            taxonomy=job.taxonomy,
        )
    segments, offsets = extract_lines(
        batch.ranges,
        batch.lidar.bearings,
        job.settings.lines,
        range_min=batch.lidar.range_min,
        range_max=batch.lidar.range_max,
    )
    arrays: Arrays = {
        "scans/labels": labels,
        "scans/confidence": confidence,
        "lines/segments": segments,
        "lines/offsets": offsets,
    }
    return arrays, np.bincount(labels[batch.valid], minlength=256)


def aligned(block: Block) -> Alignment:
    """Return the alignment of a block that has one."""
    if block.found is None:
        raise ValueError(f"scans {block.start} to {block.stop} are not aligned yet")
    return block.found


def rough_batch(reader: SequenceReader, block: Block) -> ScanBatch:
    """Read the ranges of scans, with the poses that they had before any alignment."""
    rows = block.start, block.stop
    return ScanBatch(
        reader.lidar,
        reader.read("scans/ranges", *rows),
        intensities=None,
        labels=None,
        poses=rough_poses(reader, *rows),
        stamps_ns=reader.read("scans/stamps_ns", *rows),
    )


def rough_poses(reader: SequenceReader, start: int, stop: int) -> Float:
    """Read the poses (n, 3) that scans had before any alignment, NaN where unknown."""
    if "poses/initial" in reader:
        return reader.read("poses/initial", start, stop)
    return reader.read_poses(start, stop)


def joined(parts: list[Alignment]) -> Alignment:
    """Join the alignments of blocks."""
    names = [each.name for each in fields(Alignment)]
    return Alignment(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def rows_of(alignment: Alignment, block: Block) -> Alignment:
    """Return the alignment of the scans of a block."""
    rows = slice(block.start, block.stop)
    return Alignment(*(getattr(alignment, each.name)[rows] for each in fields(Alignment)))
