"""What a user may decide about a conversion."""

from __future__ import annotations

import math
from dataclasses import dataclass

from conversion.messages.transforms import Mount
from semantic2d_dataset.errors import InvalidInputError

STAMPS = ("auto", "header", "record")


@dataclass(frozen=True)
class Options:
    """What a user may decide; None and the defaults are found from the recording.

    Parameters
    ----------
    scan_topics
        Topics of the scans; none means all, each a sequence of its own.
    poses
        ``auto``, ``tf``, ``none``, the name of a topic, or a pose file (TUM, or the ground truth
        of MIT Stata Center).
    poses_of
        Whether a pose file gives poses of the ``base`` or of the ``lidar``; None takes what its
        kind usually gives.
    clock_offset_s
        Added to the stamps of a pose file, s.
    map_frame, max_gap_s
        Where poses come from, as `conversion.messages.poses.PoseRequest`.
    base_frame
        The robot's frame; None takes base_link or base_footprint.
    mount
        x y z (m) roll pitch yaw (rad) of the lidar on its base; None takes it from tf.
    stamps
        ``header``, ``record``, or ``auto``: header stamps where they can be used.
    lidar
        A lidar of the release or a YAML file; None recognises or describes it.
    velocity
        Topic of the velocity commands; ``auto`` or ``none``.
    streams
        Topics (or ``all``) that are kept in ``/streams``.
    no_return
        Ranges that the driver writes where there is no return, m; they become +inf.
    reverse_intensities
        Whether the driver stores intensities in the opposite order of the ranges.
    drop_without_pose
        Whether scans without a pose are left out; else their pose is NaN.
    preset
        A public data set whose ways are known, as `conversion.presets` lists them.
    distro
        The ROS release whose message definitions are used where a bag has none.
    environment, recording
        Parts of the sequence id; None takes them from the path.
    license
        Licence of the data.
    """

    scan_topics: tuple[str, ...] = ()
    poses: str = "auto"
    poses_of: str | None = None
    clock_offset_s: float = 0.0
    map_frame: str = "map"
    max_gap_s: float | None = None
    base_frame: str | None = None
    mount: Mount | None = None
    stamps: str = "auto"
    lidar: str | None = None
    velocity: str = "auto"
    streams: tuple[str, ...] = ()
    no_return: tuple[float, ...] = ()
    reverse_intensities: bool = False
    drop_without_pose: bool = False
    preset: str | None = None
    distro: str | None = None
    environment: str | None = None
    recording: str | None = None
    license: str = "unknown"

    def __post_init__(self) -> None:
        if self.stamps not in STAMPS:
            raise InvalidInputError(
                f"stamps: expected one of {', '.join(STAMPS)}, found {self.stamps!r}"
            )
        if self.poses_of not in (None, "base", "lidar"):
            raise InvalidInputError(f"poses_of: expected base or lidar, found {self.poses_of!r}")
        if self.max_gap_s is not None and not 0 <= self.max_gap_s < math.inf:
            raise InvalidInputError(
                f"max_gap_s: expected a number of seconds, 0 or more, found {self.max_gap_s}"
            )
        if not math.isfinite(self.clock_offset_s):
            raise InvalidInputError(
                f"clock_offset_s: expected a number of seconds, found {self.clock_offset_s}"
            )
