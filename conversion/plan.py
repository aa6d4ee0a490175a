"""What a conversion will do: the user's options, and the choices that a survey allows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from conversion.bags import Bag, Topic
from conversion.lidars import choose_lidar, place_lidar
from conversion.poses import FoundPoses, PoseRequest, find_poses, pose_topics
from conversion.scans import ScanDecoder
from conversion.survey import Survey, choose_scan_topic, make_survey
from conversion.transforms import Mount
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.scene.lidars import LidarSpec


@dataclass(frozen=True)
class Options:
    """What a user may decide; None and the defaults are found from the recording.

    Parameters
    ----------
    scan_topic
        The topic of the scans; None takes the only one.
    poses, map_frame, max_gap_s
        Where poses come from, as `conversion.poses.PoseRequest`.
    base_frame
        The robot's frame; None takes base_link or base_footprint.
    mount
        x y z (m) roll pitch yaw (rad) of the lidar on its base; None takes it from tf.
    stamps
        ``header``, or ``record`` where header stamps cannot be used.
    lidar
        A lidar of the release or a YAML file; None recognises or describes it.
    reverse_intensities
        Whether the driver stores intensities in the opposite order of the ranges.
    drop_without_pose
        Whether scans without a pose are left out; else their pose is NaN.
    environment, recording
        Parts of the sequence id; None takes them from the path.
    license
        Licence of the data.
    """

    scan_topic: str | None = None
    poses: str = "auto"
    map_frame: str = "map"
    max_gap_s: float | None = None
    base_frame: str | None = None
    mount: Mount | None = None
    stamps: str = "header"
    lidar: str | None = None
    reverse_intensities: bool = False
    drop_without_pose: bool = False
    environment: str | None = None
    recording: str | None = None
    license: str = "unknown"

    def __post_init__(self) -> None:
        if self.stamps not in ("header", "record"):
            raise InvalidInputError(f"stamps: expected header or record, found {self.stamps!r}")
        if self.max_gap_s is not None and not 0 <= self.max_gap_s < math.inf:
            raise InvalidInputError(
                f"max_gap_s: expected a number of seconds, 0 or more, found {self.max_gap_s}"
            )


@dataclass(frozen=True)
class Plan:
    """Everything that is decided before the first range is written.

    Parameters
    ----------
    topic, decode
        The scan topic, and the decoder of its messages.
    found
        The survey of the recording.
    lidar
        The sensor with its mount.
    base
        The robot's frame; None where tf has none.
    poses
        A pose for each scan of the survey.
    keep
        (N,) bool, the scans that are written.
    reverse_intensities
        Whether intensities run against the ranges.
    notices
        What was guessed, for the user.
    """

    topic: Topic
    decode: ScanDecoder
    found: Survey
    lidar: LidarSpec
    base: str | None
    poses: FoundPoses
    keep: NDArray[np.bool_]
    reverse_intensities: bool
    notices: tuple[str, ...]


def make_plan(bag: Bag, options: Options) -> Plan:
    """Read a recording once, and decide how to convert it.

    Raises
    ------
    RecordingError
        If it cannot be converted, or not in this way.
    InvalidInputError
        If an option names nothing known.
    """
    topic, decode = choose_scan_topic(bag, options.scan_topic), ScanDecoder(bag)
    pose_sources = pose_topics(bag, options.poses)
    found = make_survey(bag, topic, decode, stamps=options.stamps, poses=pose_sources)
    lidar, lidar_how = choose_lidar(bag.path, topic, found.beams, options.lidar)
    base = _base_frame(bag.path, found, options.base_frame)
    in_tf = None if base is None else found.transforms.mount(base, found.beams.frame)
    lidar, mount_how = place_lidar(lidar, options.mount, in_tf)
    poses = _poses(bag.path, found, options, base, lidar)
    keep = poses.known if options.drop_without_pose else np.full(len(poses.poses), True)  # noqa: FBT003
    if not keep.any():
        why = "; ".join(poses.notices) or f"{poses.source} covers none"
        raise RecordingError(bag.path, f"no scan has a pose to be kept for: {why}")
    notices = (f"lidar {lidar_how}", f"mount {mount_how}", *poses.notices, *_oddities(found))
    return Plan(
        topic, decode, found, lidar, base, poses, keep, options.reverse_intensities, notices
    )


def _base_frame(path: Path, found: Survey, named: str | None) -> str | None:
    if named is None:
        return found.transforms.base_of(found.beams.frame)
    base = named.strip("/")
    if base not in found.transforms.frames:
        frames = ", ".join(found.transforms.frames) or "none"
        raise RecordingError(path, f"no frame {named!r} in tf; its frames: {frames}")
    return base


def _poses(
    path: Path, found: Survey, options: Options, base: str | None, lidar: LidarSpec
) -> FoundPoses:
    map_frame = options.map_frame.strip("/")
    request = PoseRequest(options.poses, map_frame, options.max_gap_s, options.stamps)
    # without a base in tf the chain ends at the lidar, and its mount leads back to the base
    target = (found.beams.frame, lidar.base_T_lidar) if base is None else (base, None)
    return find_poses(path, request, found.stamps_ns, found.transforms, found.poses, target)


def _oddities(found: Survey) -> tuple[str, ...]:
    notices = []
    repeated = int((np.diff(found.stamps_ns) == 0).sum())
    if repeated:
        notices.append(f"{repeated} scans repeat the stamp before them: kept")
    usual = {0, found.beams.count} if not found.has_intensities else {found.beams.count}
    odd = sum(n for count, n in found.intensity_counts.items() if count not in usual)
    if odd:
        notices.append(f"{odd} scans lack one intensity for each beam: NaN, or left out if all do")
    return tuple(notices)
