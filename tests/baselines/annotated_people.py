"""People annotated in a real recording, and how many of them a detector finds.

The recording is of a moving wheelchair in a public place, with a lidar at the height of ankles.
Annotations are in the frame of the lidar (the markers published with them say so), and belong to
the scan recorded nearest to them: each then lies within 0.3 m of a return of that scan, which is
true of far fewer in the scan before or after. Not everybody in sight is annotated.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.optimize import linear_sum_assignment

from baselines.leg_detector import LegDetections

ARCHIVE = Path("leg_tracker_benchmarks") / "general_tracking_moving_1.bag.zip"
SCANS, PEOPLE = "/scan", "/ground_truth_people_tracks"
FOUND_M = 0.5


@dataclass(frozen=True)
class AnnotatedPeople:
    """Scans (N, B) in m, K people in them: number of the scan (K,) and position (K, 2) in m."""

    ranges: np.ndarray
    bearings: np.ndarray
    range_min: float
    range_max: float
    scan: np.ndarray
    positions: np.ndarray

    @property
    def distances(self) -> np.ndarray:
        """Distances (K,) from the lidar, m."""
        return np.hypot(*self.positions.T)

    def nearest_return(self, later: int = 0) -> np.ndarray:
        """Distances (K,) of people from the nearest return of their scan, or of a later one."""
        usable = (self.ranges >= self.range_min) & (self.ranges < self.range_max)
        seen = np.where(usable, self.ranges, np.nan)[self.scan + later]
        ends = seen[..., None] * np.stack((np.cos(self.bearings), np.sin(self.bearings)), axis=-1)
        apart = np.linalg.norm(ends - self.positions[:, None], axis=-1)
        return np.nanmin(apart, axis=1)


def read_people(data: Path, scratch: Path) -> AnnotatedPeople:
    """Read the recording below the folder of real data; `scratch` takes the bag, 31 MB."""
    with zipfile.ZipFile(data / ARCHIVE) as archive:
        (name,) = archive.namelist()
        path = scratch / "people.bag"
        path.write_bytes(archive.read(name))
    store = get_typestore(Stores.ROS1_NOETIC)
    times: dict[str, list[int]] = {SCANS: [], PEOPLE: []}
    messages: dict[str, list] = {SCANS: [], PEOPLE: []}
    with Reader(path) as bag:
        wanted = [c for c in bag.connections if c.topic in times]
        for c in wanted:
            store.register(get_types_from_msg(c.msgdef.data, c.msgtype))
        for c, time, raw in bag.messages(wanted):
            times[c.topic].append(time)
            messages[c.topic].append(store.deserialize_ros1(raw, c.msgtype))
    apart = np.abs(np.subtract.outer(times[PEOPLE], times[SCANS]))
    ranges = np.stack([scan.ranges for scan in messages[SCANS]])
    first = messages[SCANS][0]
    places = (person.pose.position for person in messages[PEOPLE])
    return AnnotatedPeople(
        ranges,
        first.angle_min + first.angle_increment * np.arange(ranges.shape[1]),
        first.range_min,
        first.range_max,
        apart.argmin(axis=1),
        np.array([(place.x, place.y) for place in places]),
    )


def find_matches(found: LegDetections, people: AnnotatedPeople) -> tuple[np.ndarray, int]:
    """Tell which people (K,) are found, and how many detections the annotated scans have.

    One to one, within `FOUND_M`, as many as can be.
    """
    matched = np.zeros(len(people.scan), bool)
    annotated = np.unique(people.scan)
    for n in annotated:
        there = np.flatnonzero(people.scan == n)
        said = np.arange(found.offsets[n], found.offsets[n + 1])
        apart = np.linalg.norm(found.positions[said][:, None] - people.positions[there], axis=-1)
        rows, columns = linear_sum_assignment(np.where(apart <= FOUND_M, apart, 1e3))
        matched[there[columns[apart[rows, columns] <= FOUND_M]]] = True
    return matched, int(np.diff(found.offsets)[annotated].sum())
