"""What an inspection finds in a recording, as plain values that a program can read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conversion.inspection.scan_statistics import Intensities, Recurring


@dataclass(frozen=True)
class TopicReport:
    """A topic of one type: how much of it there is, and how steadily it came.

    Parameters
    ----------
    name, type, role
        `role` is what the topic is good for here: scans, poses, transforms, velocity or other.
    messages
        How many were read.
    rate_hz, period_s
        Mean rate over the whole time, and the median gap; None of fewer than two messages.
    regularity
        Share of gaps within a fifth of the median gap.
    longest_gap_s, longest_gap_at_s
        The longest gap, and when it began, from the first message of the recording.
    start_s, stop_s
        First and last message, from the first message of the recording.
    """

    name: str
    type: str
    role: str
    messages: int
    rate_hz: float | None
    period_s: float | None
    regularity: float | None
    longest_gap_s: float | None
    longest_gap_at_s: float | None
    start_s: float | None
    stop_s: float | None


@dataclass(frozen=True)
class StampReport:
    """The stamps of the headers of a scan topic, alone and against the times of recording.

    Parameters
    ----------
    first, last
        Stamps of the first and of the last header, ISO 8601 in UTC.
    period_s, missing
        Median time between scans, and about how many scans are missing in longer gaps.
    zero, repeated, backward, furthest_back_s
        How many stamps are 0, equal the one before, or are earlier, and by how much at most.
    lead_s, lead_low_s, lead_high_s
        How far headers lie ahead of the times of recording: median, 5 % and 95 %.
    """

    first: str
    last: str
    period_s: float | None
    missing: int
    zero: int
    repeated: int
    backward: int
    furthest_back_s: float
    lead_s: float
    lead_low_s: float
    lead_high_s: float


@dataclass(frozen=True)
class ScanReport:
    """A topic of scans, or the scans of a sequence of arrays.

    Parameters
    ----------
    topic, frame, scans, empty
        `empty` counts messages without beams.
    beams, angle_min_rad, angle_max_rad, angle_increment_rad, direction, field_of_view_deg
        Of the first scan, as recorded; `direction` is counter-clockwise or clockwise.
    range_min_m, range_max_m
        Limits as the first message states them.
    lidar, lidar_found
        The lidar that a conversion takes it for, and how it was found; None for none.
    mount, mount_found, upside_down
        x y z (m) roll pitch yaw (rad) on the base, where that comes from, and whether the lidar's
        z axis points downward.
    changes
        How the beams change on the way: what changes, and before which scan.
    kinds
        Share of beams by kind, as `conversion.inspection.scan_statistics.KINDS`.
    dead_beams
        Beams that never hold a return.
    nearest_m, median_m, farthest_m
        Of the returns: 1 %, 50 % and 99 %.
    recurring
        Values that the driver writes instead of ranges.
    intensities, intensity_scans, intensities_run_backward
        What they are, how many scans carry one for each beam, and whether zero intensity meets no
        return only when they are reversed.
    stamps
        None for layouts without headers.
    labelled
        Share of beams with a label; None where the layout has none.
    oddities
        What else is strange about it.
    """

    topic: str
    frame: str
    scans: int
    empty: int
    beams: int
    angle_min_rad: float
    angle_max_rad: float
    angle_increment_rad: float
    direction: str
    field_of_view_deg: float
    range_min_m: float
    range_max_m: float
    lidar: str | None
    lidar_found: str
    mount: tuple[float, ...] | None
    mount_found: str
    upside_down: bool
    changes: tuple[str, ...]
    kinds: Mapping[str, float]
    dead_beams: int
    nearest_m: float | None
    median_m: float | None
    farthest_m: float | None
    recurring: tuple[Recurring, ...]
    intensities: Intensities
    intensity_scans: int
    intensities_run_backward: bool
    stamps: StampReport | None
    labelled: float | None
    oddities: tuple[str, ...]


@dataclass(frozen=True)
class TransformReport:
    """A transform of tf: how often it was sent."""

    parent: str
    child: str
    static: bool
    samples: int
    rate_hz: float | None
    longest_gap_s: float | None


@dataclass(frozen=True)
class PoseReport:
    """A source of poses.

    Parameters
    ----------
    name, kind, frame
        ``tf map -> base_link`` or a topic; what it is; the frame that its poses are in.
    samples, rate_hz, longest_gap_s
        Of a chain of tf those of its sparsest moving transform, and the longest gap of any.
    start_s, stop_s
        First and last sample, from the first message of the recording.
    max_gap_s
        Over what time poses would be interpolated.
    coverage
        Share of the scans of each topic that would have a pose.
    length_m, width_m, height_m
        Way travelled, and the box around it.
    automatic
        Whether a conversion considers it unless told otherwise.
    option
        What chooses it.
    notes
        What else is to be known.
    """

    name: str
    kind: str
    frame: str
    samples: int
    rate_hz: float | None
    longest_gap_s: float | None
    start_s: float | None
    stop_s: float | None
    max_gap_s: float | None
    coverage: Mapping[str, float]
    length_m: float
    width_m: float
    height_m: float
    automatic: bool
    option: str
    notes: tuple[str, ...] = ()

    @property
    def covers(self) -> float:
        """The largest share of scans of a topic that would have a pose."""
        return max(self.coverage.values(), default=0.0)


@dataclass(frozen=True)
class PlanReport:
    """A sequence that a conversion would write."""

    sequence_id: str
    topic: str
    scans_in: int
    scans_out: int
    scans_with_pose: int
    duration_s: float
    lidar: str
    mount: tuple[float, ...]
    stamps: str
    pose_source: str
    pose_max_gap_s: float | None
    lists: tuple[str, ...]
    notices: tuple[str, ...]


@dataclass(frozen=True)
class Suggestion:
    """An option of `semantic2d convert` to pass, and why."""

    option: str
    why: str


@dataclass(frozen=True)
class SampleScan:
    """A scan to look at: when, s from the first message; ranges (B,) f4, m; bearings (B,) rad."""

    at_s: float
    ranges: NDArray[np.float32]
    bearings: NDArray[np.float64]
    range_min: float
    range_max: float


@dataclass(frozen=True)
class Pictures:
    """What is only good for drawing.

    Parameters
    ----------
    rates
        By topic: times (K + 1,) s from the first message, and the rates (K,) Hz between them.
    trajectories
        By source of poses: (M, 3) x y yaw, NaN where unknown.
    by_beam
        By scan topic: bearings (B,) rad, and shares (B, kinds).
    ranges
        By scan topic: counts of ranges in cells of `conversion.inspection.scan_statistics.CELL_M`.
    samples
        By scan topic: a few scans.
    """

    rates: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(
        default_factory=dict
    )
    trajectories: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    by_beam: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(
        default_factory=dict
    )
    ranges: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    samples: Mapping[str, tuple[SampleScan, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class Inspection:
    """What a recording holds, how it would be converted, and what stands against it.

    Parameters
    ----------
    path, kind, files, bytes, versions, notices
        The recording; `notices` are about opening it.
    start, duration_s
        First message, ISO 8601 in UTC, and the time to the last; None where there are no times.
    topics, scans, transforms, poses
        What it holds.
    plans
        The sequences that a conversion would write.
    problems
        What stands against a conversion.
    suggestions, remarks
        Options to pass, and what needs no option but a person's eye.
    command
        The command line to go on with.
    pictures
        For `conversion.inspection.plot.draw_inspection`; no part of `as_dict`.
    """

    path: str
    kind: str
    files: int
    bytes: int
    versions: Mapping[str, str]
    notices: tuple[str, ...]
    start: str | None
    duration_s: float | None
    topics: tuple[TopicReport, ...]
    scans: tuple[ScanReport, ...]
    transforms: tuple[TransformReport, ...]
    poses: tuple[PoseReport, ...]
    plans: tuple[PlanReport, ...]
    problems: tuple[str, ...]
    suggestions: tuple[Suggestion, ...]
    remarks: tuple[str, ...]
    command: str
    pictures: Pictures = field(default_factory=Pictures, repr=False, compare=False)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; what is not finite is None."""
        named = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "pictures"}
        return {name: _plain(value) for name, value in named.items()}

    def __str__(self) -> str:
        from conversion.inspection.text import write_report

        return write_report(self)


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(each) for each in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
