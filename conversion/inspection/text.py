"""An inspection as text for people: aligned tables, one section after the other."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence

from conversion.inspection.advice import in_words
from conversion.inspection.findings import (
    Inspection,
    PlanReport,
    PoseReport,
    ScanReport,
    StampReport,
)
from conversion.inspection.scan_statistics import Intensities, Recurring

_WIDTH = 110
_LABEL = 11
_FRAMES = 12  # transforms listed one by one
_PARTS = 4  # sequences of a topic, likewise

Row = Sequence[str]


def write_report(found: Inspection) -> str:
    """Write everything but what only programs want."""
    sections = {
        "Topics": _table(_topics(found), "<<>>>>"),
        **{f"Scans of {scans.topic}": _labelled(_scans(scans)) for scans in found.scans},
        "Transforms": _table(_transforms(found), "<>>>"),
        "Poses": _table(_poses(found), "<<>>>><"),
        "Conversion": _labelled(_plans(found.plans)),
        "Problems": _labelled(("-", text) for text in found.problems),
        "Suggested": _labelled((each.option, each.why) for each in found.suggestions),
        "Look at": _labelled(("-", text) for text in found.remarks),
        _what_next(found): [f"  {found.command}"],
    }
    texts = [
        "\n".join((name, *lines)) for name, section in sections.items() if (lines := [*section])
    ]
    return "\n\n".join((_head(found), *texts))


def _what_next(found: Inspection) -> str:
    blocked = found.problems and not found.suggestions
    return "To convert, once that is solved" if blocked else "To convert"


def _head(found: Inspection) -> str:
    files = "1 file" if found.files == 1 else f"{found.files} files"
    said = [found.kind, files, _bytes(found.bytes)]
    if found.duration_s is not None:
        said += [f"{found.duration_s:.1f} s", f"from {found.start}"]
    lines = [f"{found.path}: {', '.join(said)}"]
    return "\n".join((*lines, *(f"  {text}" for text in found.notices)))


def _topics(found: Inspection) -> Iterator[Row]:
    if not found.topics:
        return
    yield "name", "type", "messages", "rate", "regular", "longest gap"
    for topic in found.topics:
        regular = gap = ""
        if topic.rate_hz is not None:
            regular = f"{topic.regularity:.0%}"
            gap = f"{_seconds(topic.longest_gap_s)} at {topic.longest_gap_at_s:.1f} s"
        yield (
            topic.name,
            topic.type.replace("/msg/", "/"),
            str(topic.messages),
            _rate(topic.rate_hz),
            regular,
            gap,
        )


def _scans(scans: ScanReport) -> Iterator[Row]:
    frame = f", frame {scans.frame}" if scans.frame else ""
    yield "scans", f"{scans.scans}, each of {scans.beams} beams{frame}"
    if scans.empty:
        yield "", f"and {scans.empty} messages without beams"
    for change in scans.changes:
        yield "changes", change
    name = "not to be told" if scans.lidar is None else scans.lidar
    yield "lidar", f"{name} ({scans.lidar_found})" if scans.lidar_found else name
    yield "mount", _mount(scans)
    yield "angles", _angles(scans)
    apart = math.degrees(abs(scans.angle_increment_rad))
    field = f"field of view {scans.field_of_view_deg:.1f} deg"
    yield "", f"{scans.direction}, {apart:.4f} deg apart, {field}"
    yield "limits", f"{scans.range_min_m:g} to {scans.range_max_m:g} m"
    yield "beams", ", ".join(f"{n}: {_share(share)}" for n, share in scans.kinds.items() if share)
    if scans.dead_beams:
        yield "", f"{scans.dead_beams} of {scans.beams} never hold a return"
    if scans.median_m is not None:
        ends = f"1 % nearer than {scans.nearest_m:.2f}, 1 % farther than {scans.farthest_m:.2f}"
        yield "returns", f"median {scans.median_m:.2f} m, {ends} m"
    for value in scans.recurring:
        yield "recurring", _recurring(value)
    yield "intensity", _intensities(scans.intensities, runs_backward=scans.intensities_run_backward)
    if scans.labelled is not None:
        yield "labels", f"{_share(scans.labelled)} of the beams"
    if scans.stamps is not None:
        yield from (("stamps", text) for text in _stamps(scans.stamps))


def _angles(scans: ScanReport) -> str:
    first, last = scans.angle_min_rad, scans.angle_max_rad
    in_degrees = f"{math.degrees(first):.2f} to {math.degrees(last):.2f} deg"
    return f"{in_degrees} ({first:.6f} to {last:.6f} rad)"


def _mount(scans: ScanReport) -> str:
    if scans.mount is None:
        return scans.mount_found
    x, y, z, *angles = scans.mount
    turned = " ".join(f"{round(math.degrees(angle), 3):g}" for angle in angles)
    side = ", upside down" if scans.upside_down else ""
    where = f"x y z {x:.4g} {y:.4g} {z:.4g} m, roll pitch yaw {turned} deg{side}"
    return f"{where} ({scans.mount_found})"


def _recurring(value: Recurring) -> str:
    meaning = "looks like no return" if value.no_return else "a code of the driver, perhaps"
    counts = "would count as a return" if value.counts_as_return else "outside the limits"
    return f"{value.value_m:g} m in {_share(value.share)} of the beams: {meaning}; {counts}"


def _intensities(found: Intensities, *, runs_backward: bool) -> str:
    if found.low is None or found.high is None:
        return found.kind
    said = [found.kind, f"{found.low:.6g} to {found.high:.6g}"]
    shares = {
        "zero": found.zero,
        "denormal": found.denormal,
        "negative": found.negative,
        "not finite": found.invalid,
    }
    said += [f"{_share(share)} {name}" for name, share in shares.items() if share]
    return ", ".join(said) + ("; stored against the ranges" if runs_backward else "")


def _stamps(stamps: StampReport) -> Iterator[str]:
    if stamps.period_s is not None:
        missing = f", about {stamps.missing} missing" if stamps.missing else ""
        yield f"a scan every {_seconds(stamps.period_s)}{missing}, {stamps.first} to {stamps.last}"
    yield _lead(stamps)
    counts = {"zero": stamps.zero, "repeated": stamps.repeated, "backward": stamps.backward}
    odd = [f"{count} {name}" for name, count in counts.items() if count]
    if odd:
        back = f", at most by {in_words(stamps.furthest_back_s)}" if stamps.backward else ""
        yield ", ".join(odd) + back


def _lead(stamps: StampReport) -> str:
    if stamps.lead_low_s == stamps.lead_high_s == 0:
        return "the same as the times of recording"
    side = "ahead of" if stamps.lead_s > 0 else "behind"
    spread = f"{_seconds(stamps.lead_low_s)} to {_seconds(stamps.lead_high_s)}"
    lead = f"{in_words(abs(stamps.lead_s))} {side} the times of recording"
    return f"{lead} (5 to 95 %: {spread})"


def _transforms(found: Inspection) -> Iterator[Row]:
    if not found.transforms:
        return
    yield "from -> to", "samples", "rate", "longest gap"
    parents = {each.child: each.parent for each in found.transforms}
    wanted = {frame for scans in found.scans for frame in _line_of(scans.frame, parents)}
    listed = [each for each in found.transforms if each.child in wanted] or found.transforms
    for each in listed[:_FRAMES]:
        rate = "static" if each.static else _rate(each.rate_hz)
        gap = "" if each.longest_gap_s is None or each.static else _seconds(each.longest_gap_s)
        yield f"{each.parent} -> {each.child}", str(each.samples), rate, gap
    more = len(found.transforms) - min(len(listed), _FRAMES)
    if more:
        yield f"and {more} more", "", "", ""


def _line_of(frame: str, parents: dict[str, str]) -> set[str]:
    """Return a frame and all frames above it."""
    line: set[str] = set()
    while frame not in line:
        line.add(frame)
        frame = parents.get(frame, frame)
    return line


def _poses(found: Inspection) -> Iterator[Row]:
    if not found.poses:
        return
    yield "source", "frame", "samples", "rate", "longest gap", "scans covered", "way"
    for pose in found.poses:
        yield (
            pose.name,
            pose.frame,
            str(pose.samples),
            _rate(pose.rate_hz),
            "" if pose.longest_gap_s is None else _seconds(pose.longest_gap_s),
            _coverage(pose),
            f"{pose.length_m:.1f} m in {pose.width_m:.1f} x {pose.height_m:.1f} m",
        )


def _coverage(pose: PoseReport) -> str:
    shares = sorted(set(pose.coverage.values()))
    if not shares:
        return ""
    ends = _share(shares[0]) if len(shares) == 1 else f"{_share(shares[0])} to {_share(shares[-1])}"
    return f"{ends}, gaps up to {_seconds(pose.max_gap_s)}" if pose.max_gap_s else ends


def _plans(plans: Sequence[PlanReport]) -> Iterator[Row]:
    """Write some of the sequences of each topic, and what is said of them all once."""
    shared = [text for text in plans[0].notices if _all_say(plans, text)] if plans else []
    for topic in dict.fromkeys(plan.topic for plan in plans):
        parts = [plan for plan in plans if plan.topic == topic]
        shown = parts if len(parts) <= _PARTS else parts[: _PARTS - 1]
        for plan in shown:
            yield from _plan(plan)
            yield from (("", f"- {text}") for text in plan.notices if text not in shared)
        if len(parts) > len(shown):
            counts = [plan.scans_out for plan in parts[len(shown) :]]
            yield (
                "...",
                f"and {len(counts)} more of {topic}, of {min(counts)} to {max(counts)} scans",
            )
    yield from (("notes", f"- {text}") for text in shared)


def _all_say(plans: Sequence[PlanReport], text: str) -> bool:
    return all(text in plan.notices for plan in plans)


def _plan(plan: PlanReport) -> Iterator[Row]:
    share = plan.scans_with_pose / max(1, plan.scans_in)
    scans = f"{plan.scans_out} of {plan.scans_in} scans of {plan.topic}, {plan.duration_s:.1f} s"
    yield "sequence", plan.sequence_id
    yield "", f"{scans}, {plan.stamps} stamps"
    posed = f"{plan.scans_with_pose} with a pose ({share:.1%}) from {plan.pose_source}"
    yield "", posed if plan.scans_with_pose else "no poses"
    if plan.lists:
        yield "", f"split lists {', '.join(plan.lists)} kept"


def _table(rows: Iterable[Row], sides: str) -> Iterator[str]:
    """Align columns, `<` to the left and `>` to the right; nothing of no rows."""
    table = list(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        cells = (f"{cell:{s}{w}}" for cell, s, w in zip(row, sides, widths, strict=True))
        yield f"  {'  '.join(cells)}".rstrip()


def _labelled(rows: Iterable[Row]) -> Iterator[str]:
    """Write labels in a column, and their texts wrapped beside it; no label twice in a row."""
    last = ""
    for label, text in rows:
        shown = "" if label == last and label != "-" else label
        last = label
        width = 2 if label == "-" else _LABEL
        if len(shown) >= width:
            yield f"  {shown}"
            shown = ""
        indent = " " * (2 + width)
        yield from textwrap.wrap(
            text,
            _WIDTH,
            initial_indent=f"  {shown:<{width}}",
            subsequent_indent=indent,
            break_long_words=False,
            break_on_hyphens=False,
        )


def _rate(rate_hz: float | None) -> str:
    return "" if rate_hz is None else f"{rate_hz:.3g} Hz"


def _seconds(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return f"{seconds:.3g} s" if abs(seconds) >= 1 else f"{1000 * seconds:.3g} ms"


def _share(share: float) -> str:
    if 0 < share < 0.001:
        return "< 0.1 %"
    if 0.999 < share < 1:
        return "> 99.9 %"
    return f"{100 * share:.3g} %"


def _bytes(count: int) -> str:
    size, units = float(count), ["B", "kB", "MB", "GB", "TB"]
    while size >= 1000 and len(units) > 1:
        size, units = size / 1000, units[1:]
    return f"{size:.3g} {units[0]}"
