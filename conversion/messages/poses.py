"""Where the robot was at each scan: the sources of a recording, and the choice among them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from conversion.messages.recordings import PoseSample, Recording, Topic
from conversion.messages.tracks import TrackLog, default_gap_s
from conversion.messages.transforms import Mount, Transforms
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.scene.geometry import compose, invert, mount_in_plane

# Poses of where a robot should be, or was said to be by hand; odometry is in no map.
_NOT_MEASURED = ("goal", "initialpose", "initial_pose", "target", "waypoint", "clicked")

AUTO, TF, NONE = "auto", "tf", "none"


@dataclass(frozen=True)
class PoseRequest:
    """Which poses are wanted.

    Parameters
    ----------
    source
        ``auto``, ``tf``, ``none``, or the name of a topic.
    map_frame
        The frame that poses are given in.
    max_gap_s
        Longest time to interpolate over, s; None takes twice the source's median period, at
        least 0.5 s.
    stamps
        Whether ``header`` or ``record`` stamps are compared.
    """

    source: str = AUTO
    map_frame: str = "map"
    max_gap_s: float | None = None
    stamps: str = "header"


@dataclass(frozen=True)
class FoundPoses:
    """Poses at the scans, (N, 3) f8 with NaN where unknown, and what they come from."""

    source: str
    poses: NDArray[np.float64]
    max_gap_s: float | None = None
    notices: tuple[str, ...] = ()

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which scans have a pose, (N,) bool."""
        found: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(self.poses), axis=1)
        return found


class PoseLog:
    """Collect the poses of topics, and the frame that each is given in."""

    def __init__(self) -> None:
        self.tracks: dict[str, TrackLog] = {}
        self.frames: dict[str, str] = {}

    def add(self, topic: str, sample: PoseSample, record_ns: int) -> None:
        """Add a pose of a topic that was recorded at a time."""
        self.frames[topic] = sample.frame
        if sample.values is not None:
            log = self.tracks.setdefault(topic, TrackLog())
            log.add(sample.stamp_ns, record_ns, sample.values)


def pose_topics(recording: Recording, source: str) -> tuple[Topic, ...]:
    """Return the topics to collect poses from.

    Raises
    ------
    RecordingError
        If `source` names a topic that holds no poses.
    """
    topics = recording.pose_topics
    if source in (TF, NONE):
        return ()
    if source == AUTO:
        return tuple(topic for topic in topics if _is_measured(topic))
    named = tuple(topic for topic in topics if topic.name.strip("/") == source.strip("/"))
    if not named:
        known = ", ".join(topic.name for topic in topics) or "none"
        raise RecordingError(
            recording.path,
            f"no topic {source!r} with poses; topics with poses: {known}; or pass --poses tf, "
            "auto or none",
        )
    return named


def find_poses(
    path: Path,
    request: PoseRequest,
    at_ns: NDArray[np.int64],
    transforms: Transforms,
    log: PoseLog,
    target: tuple[str, Mount | None],
) -> FoundPoses:
    """Choose the source that covers the most scans, tf where several do, or take the one named.

    Parameters
    ----------
    path
        The recording, for messages.
    request
        What is wanted.
    at_ns
        (N,) i8 stamps of the scans.
    transforms, log
        What was recorded.
    target
        The frame that tf gives poses of: the base with None, else the lidar with its mount.

    Raises
    ------
    RecordingError
        If the named source is not there.
    """
    if request.source == NONE:
        return FoundPoses(NONE, _unknown(at_ns))
    from_tf = _poses_of_tf(request, at_ns, transforms, target)
    if request.source == TF:
        if isinstance(from_tf, str):
            raise RecordingError(path, f"{from_tf}; pass --map-frame, --base-frame or --poses")
        return from_tf
    candidates = [] if isinstance(from_tf, str) or request.source != AUTO else [from_tf]
    candidates += [_poses_of_topic(request, at_ns, log, name) for name in log.tracks]
    if request.source == AUTO:
        candidates = [found for found in candidates if found.known.any()]
    if not candidates:
        return FoundPoses(NONE, _unknown(at_ns), None, (_why_none(from_tf, log.frames, request),))
    return max(candidates, key=lambda found: int(found.known.sum()))


def _poses_of_tf(
    request: PoseRequest,
    at_ns: NDArray[np.int64],
    transforms: Transforms,
    target: tuple[str, Mount | None],
) -> FoundPoses | str:
    """Poses along the chain from the map to the target, or why there are none."""
    frame, mount = target
    chain = transforms.chain(request.map_frame, frame)
    if chain is None:
        frames = ", ".join(transforms.frames[:20]) or "none"
        return f"tf has no chain from {request.map_frame!r} to {frame!r} (frames: {frames})"
    if not transforms.is_level(chain):
        return f"the tf chain {' -> '.join(chain)} leaves the plane"
    poses, gap, postdated = transforms.poses(chain, at_ns, request.stamps, request.max_gap_s)
    if mount is not None:
        rotation, (x, y) = mount_in_plane(mount)
        poses = compose(poses, invert((x, y, np.arctan2(rotation[1, 0], rotation[0, 0]))))
    notice = f"tf corrections were post-dated by {postdated:.2f} s: undone"
    return FoundPoses(f"tf {' -> '.join(chain)}", poses, gap, (notice,) if postdated else ())


def _poses_of_topic(
    request: PoseRequest, at_ns: NDArray[np.int64], log: PoseLog, name: str
) -> FoundPoses:
    frame = log.frames[name]
    elsewhere = frame not in ("", request.map_frame)
    if elsewhere and request.source == AUTO:
        return FoundPoses(name, _unknown(at_ns))
    notice = f"the poses of {name} are in the frame {frame!r}, not {request.map_frame!r}"
    track = log.tracks[name].track(request.stamps)
    gap = default_gap_s(track) if request.max_gap_s is None else request.max_gap_s
    return FoundPoses(name, track.sample(at_ns, gap), gap, (notice,) if elsewhere else ())


def _why_none(from_tf: FoundPoses | str, frames: Mapping[str, str], request: PoseRequest) -> str:
    tf = from_tf if isinstance(from_tf, str) else f"{from_tf.source} covers no scan"
    topics = ", ".join(f"{name} (in {frame!r})" for name, frame in frames.items()) or "none"
    return (
        f"no poses in {request.map_frame!r}: {tf}; pose topics: {topics}; pass --map-frame or "
        "--poses to choose"
    )


def _is_measured(topic: Topic) -> bool:
    name = topic.name.lower()
    return "Odometry" not in topic.type and not any(word in name for word in _NOT_MEASURED)


def _unknown(at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.full((at_ns.size, 3), np.nan)
