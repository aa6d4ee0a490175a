"""What a user may decide about a conversion."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

from conversion.messages.transforms import Mount
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.documents import hint

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
    only_lidars
        Sequences of other lidars are left out; none means all lidars.
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
    only_lidars: tuple[str, ...] = ()
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


def options_from(said: Mapping[str, Any]) -> Options:
    """Return the options that plain values (of YAML or JSON) say, by their names.

    Raises
    ------
    InvalidInputError
        If there is no option of a name, or a value is not of its kind.
    """
    kinds = {field.name: str(field.type) for field in fields(Options)}
    values = {}
    for name, value in said.items():
        if name not in kinds:
            raise InvalidInputError(f"unknown option {name!r}{hint(name, kinds)}")
        values[name] = _plain(name, kinds[name], value)
    return Options(**values)


def _plain(name: str, kind: str, value: Any) -> Any:
    """Check a value by the annotation of its option, and make tuples of lists."""
    if value is None and kind.endswith("| None"):
        return None
    expected, is_right, make = _KINDS[kind.removesuffix(" | None")]
    if not is_right(value):
        raise InvalidInputError(f"{name}: expected {expected}, found {value!r}")
    return make(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _are_numbers(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(map(_is_number, value))


def _are_texts(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(each, str) for each in value)


def _floats(value: Sequence[float]) -> tuple[float, ...]:
    return tuple(map(float, value))


_MOUNT = ("x", "y", "z", "roll", "pitch", "yaw")
_KINDS: Mapping[str, tuple[str, Callable[[Any], bool], Callable[[Any], Any]]] = {
    "bool": ("true or false", lambda value: isinstance(value, bool), bool),
    "str": ("text", lambda value: isinstance(value, str), str),
    "float": ("a number", _is_number, float),
    "tuple[str, ...]": ("a list of texts", _are_texts, tuple),
    "tuple[float, ...]": ("a list of numbers", _are_numbers, _floats),
    "Mount": (
        f"six numbers [{', '.join(_MOUNT)}]",
        lambda value: _are_numbers(value) and len(value) == len(_MOUNT),
        _floats,
    ),
}
