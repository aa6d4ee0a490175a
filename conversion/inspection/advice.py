"""What to do with a recording: options to pass, things to look at, the command to go on with."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from conversion.inspection.findings import PoseReport, ScanReport, Suggestion
from conversion.inspection.holdings import Holdings
from conversion.messages.poses import AUTO
from conversion.options import Options
from conversion.plan import SequencePlan

_FEW = 0.5  # of the scans with a pose: below that other sources are proposed
_PARTS = 2  # of a topic: more are rather a logger's fault than a clock that was set
_LEAD_S = 1.0
_MISSING = 0.05
_DEAD = 0.1
_YEAR_S, _DAY_S, _HOUR_S = 365.25 * 86400, 86400.0, 3600.0

# Options that the command takes, by the field that they set; tuples repeat their option.
_FLAGS = {
    "scan_topics": "--scan-topic",
    "poses": "--poses",
    "poses_of": "--poses-of",
    "clock_offset_s": "--clock-offset",
    "map_frame": "--map-frame",
    "base_frame": "--base-frame",
    "max_gap_s": "--max-gap",
    "mount": "--mount",
    "stamps": "--stamps",
    "lidar": "--lidar",
    "velocity": "--velocity",
    "streams": "--stream",
    "no_return": "--no-return",
    "reverse_intensities": "--reverse-intensities",
    "drop_without_pose": "--drop-without-pose",
    "preset": "--preset",
    "distro": "--distro",
    "environment": "--environment",
    "recording": "--recording-name",
    "license": "--license",
}


def advise(
    held: Holdings, plans: Sequence[SequencePlan], options: Options, way_out: str | None
) -> tuple[tuple[Suggestion, ...], tuple[str, ...]]:
    """Return options to pass, and what needs a person's eye.

    Parameters
    ----------
    held
        What the recording holds.
    plans
        What a conversion with these options would do; empty where it fails.
    options
        As given.
    way_out
        An option with which it would not fail.
    """
    suggestions = [*_stamps(held, plans, options, way_out), *_poses(held, plans, options)]
    suggestions += [*_no_return(held, options), *_intensities(held, options)]
    unreadable = (f"{name} ({kind}): {why}" for (name, kind), why in held.unreadable.items())
    remarks = [*unreadable, *_mixed_intensities(held, options)]
    remarks += chain.from_iterable(_remarks(scans) for scans in held.scans)
    return tuple(suggestions), tuple(remarks)


def command_line(
    path: Path, files: Sequence[Path], options: Options, suggestions: Sequence[Suggestion]
) -> str:
    """Return the command that converts a recording with the options given and suggested."""
    several = len(files) > 1 and all(file.suffix == path.suffix for file in files)
    words = ["semantic2d", "convert", *(map(str, files) if several else (str(path),))]
    words += ["--merge"] if several else []
    given = _arguments(options)
    proposed = [shlex.split(suggestion.option) for suggestion in suggestions]
    replaced = {name for option in proposed for name in option[::2]} - {"--no-return"}
    for option in (*(g for g in given if g[0] not in replaced), *proposed):
        words += option
    return shlex.join((*words, "--out", "sequences"))


def _arguments(options: Options) -> Iterator[list[str]]:
    default = Options()
    for name, flag in _FLAGS.items():
        value = getattr(options, name)
        if value == getattr(default, name):
            continue
        if value is True:
            yield [flag]
        elif name == "mount":
            yield [flag, ",".join(f"{part:.9g}" for part in value)]
        elif isinstance(value, tuple):
            yield from ([flag, str(each)] for each in value)
        else:
            yield [flag, str(value)]


def _stamps(
    held: Holdings, plans: Sequence[SequencePlan], options: Options, way_out: str | None
) -> Iterator[Suggestion]:
    backward = {scans.topic for scans in held.scans if scans.stamps and scans.stamps.backward}
    parts = [
        plan for plan in plans if plan.topic in backward and plan.header.stamps_source == "header"
    ]
    if way_out is not None:
        yield Suggestion(way_out, "nothing stands against a conversion then")
    elif options.stamps == AUTO and len(parts) > _PARTS * len(backward):
        why = f"header stamps go backward, which makes {len(parts)} sequences"
        yield Suggestion("--stamps record", f"{', '.join(sorted(backward))}: {why}")


def _poses(held: Holdings, plans: Sequence[SequencePlan], options: Options) -> Iterator[Suggestion]:
    """Propose another source where the one chosen covers few scans or none."""
    scans = sum(plan.scans_in for plan in plans)
    covered = sum(plan.scans_with_pose for plan in plans) / max(1, scans)
    others = [each for each in held.poses if each.option and not each.automatic and each.length_m]
    best = max(others, key=_usefulness, default=None)
    if not plans or options.poses != AUTO or best is None:
        return
    if covered < _FEW and best.covers > covered:
        why = f"covers {best.covers:.0%} of the scans, {_what(plans)} {covered:.0%}"
        if not _is_truth(best) and best.frame == "odom":
            why += "; odometry drifts, so that its map is only good near by"
        yield Suggestion(best.option, why)


def _usefulness(source: PoseReport) -> tuple[bool, float, bool]:
    return (_is_truth(source) and source.covers >= _FEW, source.covers, source.kind == "tf")


def _is_truth(source: PoseReport) -> bool:
    return "truth" in source.name.lower()


def _what(plans: Sequence[SequencePlan]) -> str:
    sources = {plan.pose_source for plan in plans} - {"none"}
    return ", ".join(sorted(sources)) or "what is taken now"


def _no_return(held: Holdings, options: Options) -> Iterator[Suggestion]:
    shares: dict[float, list[str]] = {}
    for scans in held.scans:
        for value in scans.recurring:
            if value.no_return and value.value_m not in options.no_return:
                what = f"{value.share:.1%} of the ranges of {scans.topic} are exactly that"
                what += ", and would count as returns" if value.counts_as_return else ""
                shares.setdefault(value.value_m, []).append(what)
    for value_m, why in shares.items():
        yield Suggestion(f"--no-return {value_m:g}", "; ".join(why))


def _intensities(held: Holdings, options: Options) -> Iterator[Suggestion]:
    backward = _backward(held)
    if backward and len(backward) == len(_measured(held)) and not options.reverse_intensities:
        why = "zero intensity meets no return only when intensities are reversed"
        yield Suggestion("--reverse-intensities", f"{', '.join(backward)}: {why}")


def _mixed_intensities(held: Holdings, options: Options) -> Iterator[str]:
    backward, measured = _backward(held), _measured(held)
    if backward and len(backward) < len(measured):
        yield (
            f"intensities run against the ranges in {', '.join(backward)} only: convert these "
            "topics on their own, with --scan-topic and --reverse-intensities"
        )
    if options.reverse_intensities and measured and not backward:
        yield "--reverse-intensities was given, but nothing shows that intensities run backward"


def _measured(held: Holdings) -> list[str]:
    return [scans.topic for scans in held.scans if scans.intensities.kind == "measured"]


def _backward(held: Holdings) -> list[str]:
    return [scans.topic for scans in held.scans if scans.intensities_run_backward]


def _remarks(scans: ScanReport) -> Iterator[str]:
    """Say what is unusual about scans, whether or not something can be done."""
    name, stamps = scans.topic, scans.stamps
    if stamps is not None:
        if abs(stamps.lead_s) > _LEAD_S:
            side = "ahead of" if stamps.lead_s > 0 else "behind"
            apart = in_words(abs(stamps.lead_s))
            yield f"{name}: header stamps are {apart} {side} the times of recording"
        if stamps.backward:
            back = in_words(stamps.furthest_back_s)
            yield f"{name}: header stamps go backward {stamps.backward} times, at most by {back}"
        if stamps.zero:
            yield f"{name}: {stamps.zero} header stamps are 0"
        if stamps.missing > _MISSING * scans.scans:
            yield f"{name}: about {stamps.missing} scans are missing in gaps"
    if scans.dead_beams > _DEAD * scans.beams:
        yield f"{name}: {scans.dead_beams} of {scans.beams} beams never hold a return"
    if scans.kinds["returns"] == 0 and scans.scans:
        yield (
            f"{name}: no beam holds a return within {scans.range_min_m:g} to "
            f"{scans.range_max_m:g} m"
        )
    if scans.intensities.kind == "denormal":
        yield (
            f"{name}: intensities are denormal numbers, which no sensor gives: integers "
            "stored as floats, perhaps"
        )
    for oddity in scans.oddities:
        yield f"{name}: {oddity}"


def in_words(seconds: float) -> str:
    """Write a time in the unit that suits it."""
    for unit, size in (("years", _YEAR_S), ("days", _DAY_S), ("h", _HOUR_S)):
        if seconds >= size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s" if seconds >= 1 else f"{1000 * seconds:.3g} ms"
