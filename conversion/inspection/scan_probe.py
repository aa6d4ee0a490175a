"""The scans of one topic or sequence under inspection."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conversion.inspection.findings import SampleScan, ScanReport, StampReport
from conversion.inspection.scan_statistics import ScanStatistics
from conversion.inspection.scan_timing import Timing, report_stamps, timing_oddities
from conversion.messages.recordings import Message, Recording, Topic
from conversion.messages.scans import Beams, Scan
from conversion.messages.survey import ScanLog, is_scan
from conversion.plan import BLOCK
from conversion.ros.recording import RosRecording
from conversion.summary import Tally
from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import UNLABELLED

SAMPLES = 3
"""Scans kept to be drawn."""

_TIMED_EVERY = 16
_MOST_LIMITS = 8
_MOST_CHANGES = 8

Ranges = NDArray[np.float32]


class ScanProbe:
    """Collect what there is to say about scans that share a topic, in bounded memory.

    They are counted counter-clockwise, a block at a time.

    Parameters
    ----------
    topic
        The topic, and how many scans it is said to hold.
    choose
        Finds the lidar with given beams, and says how.
    """

    def __init__(self, topic: Topic, choose: Callable[[Beams], tuple[LidarSpec, str]]) -> None:
        self.topic = topic
        self.log = ScanLog(topic)
        self.beams: Beams | None = None
        self.lidar: LidarSpec | None = None
        self.lidar_found = ""
        self.statistics = ScanStatistics(0.0, math.inf)
        self.samples: list[SampleScan] = []
        self._choose = choose
        self._tally: Tally | None = None
        self._limits: dict[tuple[float, float], None] = {}
        self._timings: list[Timing] = []
        self._block = (np.empty((0, 0), np.float32), np.empty((0, 0), np.float32))
        self._filled = 0
        self._has_intensities = False
        self._intensity_scans = 0
        self._labels = np.zeros(2, np.int64)

    def add(self, scan: Scan, record_ns: int) -> None:
        """Add a scan that was recorded at a time."""
        self.log.add(scan, record_ns)
        if not is_scan(scan):
            return
        if self.beams is None:
            self.begin(Beams.of(scan))
        if self.wants_sample(len(self.log) - 1):
            self.keep_sample(record_ns, Beams.of(scan), scan.ranges)
        if len(self._limits) < _MOST_LIMITS:
            self._limits[scan.range_min, scan.range_max] = None
        self._put(scan)

    def begin(self, beams: Beams) -> None:
        """Take the first beams, and the limits of the lidar that they are of."""
        self.beams = beams
        self.statistics = ScanStatistics(beams.range_min, beams.range_max)
        try:
            self.lidar, self.lidar_found = self._choose(beams)
        except Semantic2DError as err:  # plans fail for it too, and that is reported
            self.lidar_found = str(getattr(err, "message", err))
        else:
            self.statistics = ScanStatistics(self.lidar.range_min, self.lidar.range_max)
            self._tally = Tally(self.lidar)

    def add_arrays(self, ranges: Ranges, intensities: Ranges | None) -> None:
        """Count a block of scans (N, B) f4."""
        self.statistics.add(ranges, intensities)
        if intensities is None:
            return
        self._intensity_scans += len(ranges)
        if self._tally is not None and self.lidar is not None:
            # a driver that writes 0 or range_max for no return is seen through, too
            known = np.where(self.lidar.has_return(ranges), ranges, np.float32(np.inf))
            self._tally.add({"scans/ranges": known, "scans/intensities": intensities})

    def add_labels(self, labels: NDArray[np.uint8]) -> None:
        """Count which beams (N, B) u1 are labelled."""
        self._labels += ((labels != UNLABELLED).sum(), labels.size)

    def flush(self) -> None:
        """Count the scans that are held."""
        if self._filled:
            ranges, intensities = (block[: self._filled] for block in self._block)
            self._filled = 0
            self.add_arrays(ranges, intensities if self._has_intensities else None)

    def time(self, recording: Recording, message: Message) -> None:
        """Look now and then at what a message says about time, which ROS's do."""
        if isinstance(recording, RosRecording) and len(self.log) % _TIMED_EVERY == 1:
            self._timings.append(recording.bag.read(message, Timing.of))

    def wants_sample(self, index: int) -> bool:
        """Tell whether a scan is one of the few, spread over the recording, to be drawn."""
        expected = max(self.topic.messages, 1)
        due = (2 * len(self.samples) + 1) * expected // (2 * SAMPLES)
        return len(self.samples) < SAMPLES and index >= due

    def keep_sample(self, at_ns: int, beams: Beams, ranges: Ranges) -> None:
        """Keep a scan to be drawn."""
        kept = np.array(ranges[:: -1 if beams.reversed else 1], np.float32)
        limits = (beams.range_min, beams.range_max)
        self.samples.append(SampleScan(at_ns / 1e9, kept, bearings_of(beams), *limits))

    @property
    def by_beam(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Bearings (B,) rad, increasing, and the shares (B, K) of the kinds, of the usual beams."""
        shares = self.statistics.shares_by_beam
        known = [run.beams for run in self.log.runs] or ([self.beams] if self.beams else [])
        usual = [bearings_of(beams) for beams in known if beams.count == len(shares)]
        drawable = usual and np.isfinite(usual[0]).all() and (np.diff(usual[0]) > 0).all()
        return (usual[0], shares) if drawable else None

    def report(self, beams: Beams, mount: tuple[tuple[float, ...] | None, str]) -> ScanReport:
        """Say what was found, of scans with these beams first, and with this mount."""
        stamps = report_stamps(self.log)
        statistics = self.statistics
        nearest, median, farthest = statistics.quantiles(0.01, 0.5, 0.99) or (None, None, None)
        ends = (beams.angle_min, beams.angle_min + beams.angle_increment * (beams.count - 1))
        first, last = reversed(ends) if beams.reversed else ends
        return ScanReport(
            topic=self.topic.name,
            frame=beams.frame,
            scans=statistics.scans,
            empty=self.log.empty,
            beams=beams.count,
            angle_min_rad=first,
            angle_max_rad=last,
            angle_increment_rad=-beams.angle_increment if beams.reversed else beams.angle_increment,
            direction="clockwise" if beams.reversed else "counter-clockwise",
            field_of_view_deg=math.degrees(ends[1] - ends[0]),
            range_min_m=beams.range_min,
            range_max_m=beams.range_max,
            lidar=None if self.lidar is None else self.lidar.name,
            lidar_found=self.lidar_found,
            mount=mount[0],
            mount_found=mount[1],
            upside_down=mount[0] is not None and _is_upside_down(mount[0]),
            changes=self._changes(),
            kinds=statistics.shares,
            dead_beams=statistics.dead_beams,
            nearest_m=nearest,
            median_m=median,
            farthest_m=farthest,
            recurring=statistics.recurring,
            intensities=statistics.intensities,
            intensity_scans=self._intensity_scans,
            intensities_run_backward=self._tally is not None
            and self._tally.intensities_run_backward,
            stamps=stamps,
            labelled=float(self._labels[0] / self._labels[1]) if self._labels[1] else None,
            oddities=self._oddities(stamps, beams),
        )

    def _put(self, scan: Scan) -> None:
        """Copy a scan into the block, which holds scans of one beam count."""
        count = len(scan.ranges)
        whole = len(scan.intensities) == count
        if self._block[0].shape[1] != count or whole != self._has_intensities:
            self.flush()
            shape = (BLOCK, count)
            self._block = (np.empty(shape, np.float32), np.empty(shape, np.float32))
            self._has_intensities = whole
        step = -1 if scan.angle_increment < 0 else 1
        self._block[0][self._filled] = scan.ranges[::step]
        if whole:
            self._block[1][self._filled] = scan.intensities[::step]
        self._filled += 1
        if self._filled == BLOCK:
            self.flush()

    def _changes(self) -> tuple[str, ...]:
        runs = self.log.runs[1:]
        said = [f"before scan {run.first}: {run.change}" for run in runs[:_MOST_CHANGES]]
        more = len(runs) - len(said)
        return (*said, *((f"and {more} more times",) if more > 0 else ()))

    def _oddities(self, stamps: StampReport | None, beams: Beams) -> tuple[str, ...]:
        said = []
        if len(self._limits) > 1:
            limits = ", ".join(f"{low:g} to {high:g} m" for low, high in self._limits)
            said.append(f"the range limits change: {limits}")
        lacking = self.statistics.scans - self._intensity_scans
        if 0 < lacking < self.statistics.scans:
            said.append(f"{lacking} of {self.statistics.scans} scans lack one intensity per beam")
        period = None if stamps is None else stamps.period_s
        return (*said, *timing_oddities(self._timings, beams, period))


def bearings_of(beams: Beams) -> NDArray[Any]:
    """Return the bearing of each beam, counter-clockwise, (B,) f8 rad."""
    return beams.angle_min + beams.angle_increment * np.arange(beams.count)


def _is_upside_down(mount: tuple[float, ...]) -> bool:
    _, _, _, roll, pitch, _ = mount
    return math.cos(roll) * math.cos(pitch) < 0
