"""``semantic2d inspect``: what a recording holds, how it would be converted, what blocks that."""

from __future__ import annotations

import shlex
from dataclasses import replace

from conversion.inspection.advice import advise, command_line
from conversion.inspection.findings import Inspection, PlanReport
from conversion.inspection.holdings import Holdings, of_arrays, of_messages
from conversion.inspection.scan_timing import iso
from conversion.messages.source import MessageSource
from conversion.options import Options
from conversion.plan import SequencePlan, Source
from semantic2d_dataset.errors import InvalidInputError, RecordingError

_OTHER_STAMPS = {"auto": "record", "header": "record", "record": "header"}


def inspect_source(source: Source, options: Options) -> Inspection:
    """Look at everything in a recording, and plan its conversion without writing anything.

    Memory is bounded as that of a conversion is.

    Parameters
    ----------
    source
        Open for reading.
    options
        As for a conversion.

    Returns
    -------
    Inspection
        What was found; that the recording is damaged, or cannot be converted in this way, is one
        of its problems, and no error.
    """
    if isinstance(source, MessageSource):
        held = of_messages(source.recording, options)
        plans, problem = _plan(source, options)
    else:
        plans, problem = _plan(source, options)
        held = of_arrays(plans)
    problems = tuple(held.problems) or ((problem,) if problem else ())
    way_out = _way_out(source, options, held) if problem and not held.problems else None
    suggestions, remarks = advise(held, plans, options, way_out)
    files = source.files()
    first, last = held.first_ns, held.last_ns
    return Inspection(
        path=str(source.path),
        kind=source.kind,
        files=len(files),
        bytes=sum(file.stat().st_size for file in files),
        versions=dict(source.versions),
        notices=held.notices,
        start=None if first is None else iso(first),
        duration_s=None if first is None else (last - first) / 1e9,
        topics=tuple(held.topics),
        scans=tuple(held.scans),
        transforms=tuple(held.transforms),
        poses=tuple(held.poses),
        plans=tuple(_report(plan) for plan in plans),
        problems=problems,
        suggestions=suggestions,
        remarks=remarks,
        command=command_line(source.path, files, options, suggestions),
        pictures=held.pictures,
    )


def _plan(source: Source, options: Options) -> tuple[tuple[SequencePlan, ...], str | None]:
    """Return the plans, or why there are none."""
    try:
        return source.plans(options), None
    except RecordingError as err:
        return (), err.message
    except InvalidInputError as err:
        return (), str(err)


def _way_out(source: Source, options: Options, held: Holdings) -> str | None:
    """Try what might help where a conversion fails: other stamps, only the lidars that can be."""
    usable = tuple(scans.topic for scans in held.scans if scans.lidar is not None)
    if not usable:
        return None
    stamps = _OTHER_STAMPS[options.stamps]
    ways = {f"--stamps {stamps}": replace(options, stamps=stamps)}
    if len(usable) < len(held.scans) and not options.scan_topics:
        words = [word for topic in usable for word in ("--scan-topic", topic)]
        ways[shlex.join(words)] = replace(options, scan_topics=usable)
    return next((option for option, other in ways.items() if _plan(source, other)[0]), None)


def _report(plan: SequencePlan) -> PlanReport:
    header = plan.header
    return PlanReport(
        sequence_id=header.sequence_id,
        topic=plan.topic,
        scans_in=plan.scans_in,
        scans_out=plan.scans_out,
        scans_with_pose=plan.scans_with_pose,
        duration_s=plan.duration_s,
        lidar=header.lidar.name,
        mount=header.lidar.base_T_lidar,
        stamps=header.stamps_source,
        pose_source=plan.pose_source,
        pose_max_gap_s=plan.pose_max_gap_s,
        lists=tuple(plan.lists),
        notices=plan.notices,
    )
