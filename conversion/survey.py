"""The first pass over a recording: stamps, beams, transforms and poses; no ranges are kept."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from conversion.bags import Bag, Message, Topic, seconds
from conversion.poses import PoseLog
from conversion.scans import LASER_SCAN, Beams, ScanDecoder
from conversion.transforms import TF_MESSAGES, Transforms
from semantic2d_dataset.errors import RecordingError


@dataclass(frozen=True)
class Survey:
    """What a recording holds besides its ranges.

    Parameters
    ----------
    beams
        What all scans share.
    stamps_ns
        (N,) i8, non-decreasing.
    intensity_counts
        How many scans carry so many intensities.
    transforms, poses
        Everything that could say where the robot was.
    """

    beams: Beams
    stamps_ns: NDArray[np.int64]
    intensity_counts: dict[int, int]
    transforms: Transforms
    poses: PoseLog

    @property
    def has_intensities(self) -> bool:
        """Whether any scan carries one intensity for each beam."""
        return self.beams.count in self.intensity_counts


def choose_scan_topic(bag: Bag, named: str | None) -> Topic:
    """Return the only scan topic, or the one named.

    Raises
    ------
    RecordingError
        If there is no such topic, none at all, none that holds messages, or several to choose
        from.
    """
    scans = bag.of_type((LASER_SCAN,))
    if named is not None:
        scans = tuple(topic for topic in scans if topic.name.strip("/") == named.strip("/"))
        if not scans:
            raise RecordingError(
                bag.path, f"no scan topic {named!r}; topics: {_listing(bag.topics)}"
            )
    if not scans:
        raise RecordingError(
            bag.path, f"expected a topic of {LASER_SCAN}, found {_listing(bag.topics)}"
        )
    filled = tuple(topic for topic in scans if topic.messages) or scans
    if len(filled) > 1:
        raise RecordingError(
            bag.path,
            f"several scan topics: {_listing(filled)}; choose one with --scan-topic NAME",
        )
    return filled[0]


def make_survey(
    bag: Bag, topic: Topic, decode: ScanDecoder, *, stamps: str, poses: Collection[Topic]
) -> Survey:
    """Read everything once.

    Parameters
    ----------
    bag
        The recording.
    topic
        Its scan topic.
    decode
        The decoder of its messages.
    stamps
        ``header`` or ``record``: which stamps the scans get.
    poses
        Topics to collect poses from.

    Raises
    ------
    RecordingError
        If the recording is damaged, the beams change, or stamps go backward.
    """
    transforms, pose_log = Transforms(), PoseLog()
    beams: Beams | None = None
    found, counts = array("q"), dict[int, int]()
    pose_names = {pose.name for pose in poses}
    for message in with_progress(bag, (topic, *bag.of_type(TF_MESSAGES), *poses), "survey"):
        if message.topic == topic.name:
            scan = decode(message)
            changed = None if beams is None else beams.difference(scan)
            beams = beams or Beams.of(scan)
            if changed is not None:
                raise RecordingError(
                    bag.path,
                    f"{topic.name}: scan {len(found)} at {seconds(scan.stamp_ns)} has {changed}; "
                    "a topic whose beams change cannot be converted",
                )
            found.append(scan.stamp_ns if stamps == "header" else message.record_ns)
            counts[len(scan.intensities)] = counts.get(len(scan.intensities), 0) + 1
        elif message.topic in pose_names:
            bag.read(message, partial(pose_log.add, message))
        else:
            bag.read(message, partial(transforms.add, message))
    if beams is None or len(found) < topic.messages:
        raise RecordingError(
            bag.path, f"{topic.name}: expected {topic.messages or 'some'} scans, found {len(found)}"
        )
    stamps_ns = np.array(found, np.int64)
    _check_stamps(bag.path, topic, stamps_ns, stamps)
    return Survey(beams, stamps_ns, counts, transforms, pose_log)


def with_progress(bag: Bag, topics: Collection[Topic], what: str) -> Iterator[Message]:
    """Yield the messages of some topics beside a bar that counts them."""
    total = sum(topic.messages for topic in topics)
    yield from tqdm(
        bag.messages(topics), total=total, desc=what, unit=" msg", disable=None, leave=False
    )


def _check_stamps(path: Path, topic: Topic, stamps_ns: NDArray[np.int64], stamps: str) -> None:
    advice = "pass --stamps record to use the times of recording"
    if stamps == "record":
        advice = "its times of recording are damaged"
    steps = np.diff(stamps_ns)
    if len(steps) and not steps.any():
        raise RecordingError(
            path,
            f"{topic.name}: all {len(stamps_ns)} scans have the stamp {seconds(stamps_ns[0])}; "
            f"{advice}",
        )
    backward = np.flatnonzero(steps < 0)
    if backward.size:
        at = int(backward[0])
        raise RecordingError(
            path,
            f"{topic.name}: stamps go backward {backward.size} time(s), first at scan {at + 1}, "
            f"from {seconds(stamps_ns[at])} to {seconds(stamps_ns[at + 1])}; {advice}",
        )


def _listing(topics: Collection[Topic]) -> str:
    return (
        ", ".join(f"{t.name} ({t.type}, {t.messages} messages)" for t in topics)
        or "no topics at all"
    )
