"""One recording to one sequence: a survey, the choices it allows, then the scans by blocks."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import semantic2d_dataset
from conversion.bags import ROSBAGS_VERSION, Bag
from conversion.blocks import read_blocks
from conversion.plan import Options, Plan, make_plan
from conversion.summary import Summary, Tally
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter, slug


def convert_recording(recording: Path, out: Path, options: Options | None = None) -> Summary:
    """Convert the scans of one topic of a ROS 1 or ROS 2 recording into a sequence.

    Memory is bounded by a block of scans, and by the transforms and poses at 72 bytes each.

    Parameters
    ----------
    recording
        A bag, as `conversion.bags.Bag` takes it.
    out
        The sequence file; one that exists is replaced when the new one is complete.
    options
        What is not to be found from the recording.

    Returns
    -------
    Summary
        What was found, guessed and written.

    Raises
    ------
    FileNotFoundError
        If there is no such recording.
    RecordingError
        If it cannot be converted; nothing is written then.
    InvalidInputError
        If an option names nothing known, or `out` is a file of the recording.
    WriteError
        If the sequence cannot be written.
    """
    options = options or Options()
    with Bag(recording) as bag:
        _check_apart(bag.path, Path(out))
        plan = make_plan(bag, options)
        header, tally = _header(bag, plan, options), Tally(plan.lidar)
        with SequenceWriter(Path(out), header) as writer:
            for arrays in read_blocks(bag, plan):
                writer.append(arrays)
                tally.add(arrays)
    return Summary.of(str(out), header.sequence_id, plan, tally)


def _check_apart(recording: Path, out: Path) -> None:
    """Refuse to replace what is being read, whatever name or link it goes by."""
    files = recording.rglob("*") if recording.is_dir() else ()
    if out.exists() and any(out.samefile(path) for path in (recording, *files) if path.exists()):
        raise InvalidInputError(f"{out}: belongs to the recording {recording}; choose another name")


def _header(bag: Bag, plan: Plan, options: Options) -> SequenceHeader:
    where = bag.path.resolve()
    versions = {"semantic2d-dataset": semantic2d_dataset.__version__, "rosbags": ROSBAGS_VERSION}
    return SequenceHeader(
        environment=_given(options.environment, slug(where.parent.name)),
        recording=_given(options.recording, slug(where.name if where.is_dir() else where.stem)),
        lidar=plan.lidar,
        license=options.license,
        stamps_source=options.stamps,
        provenance={
            "tool": "semantic2d convert",
            "versions": versions,
            "sources": bag.sources(),
            "topic": plan.topic.name,
            "frame": plan.found.beams.frame,
            "base_frame": plan.base,
            "poses": plan.poses.source,
            "notices": list(plan.notices),
            "options": asdict(options),
        },
    )


def _given(value: str | None, default: str) -> str:
    """Return what was given, even if it is empty: the header refuses that."""
    return default if value is None else value
