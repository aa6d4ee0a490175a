"""Which lidar measured a scan topic: one of the release, one of a file, or a new one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from conversion.messages.recordings import Topic
from conversion.messages.scans import Beams
from conversion.messages.transforms import Mount
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import slug
from semantic2d_dataset.scene.lidars import LIDARS, LidarSpec, find_lidar, read_lidar

_NO_MOUNT = (0.0,) * 6
_YAML = (".yaml", ".yml")


def choose_lidar(
    path: Path, topic: Topic, beams: Beams, named: str | None
) -> tuple[LidarSpec, str]:
    """Return the lidar of a topic, and how it was found.

    Parameters
    ----------
    path
        The recording, for messages.
    topic, beams
        The scan topic, and what its messages say.
    named
        A lidar of the release or a YAML file; None recognises the release's lidars by their
        beams and angles, and describes any other by its messages.

    Raises
    ------
    RecordingError
        If the messages are not of the named lidar, or describe none that can be.
    InvalidInputError
        If nothing has that name.
    """
    if named is not None:
        spec = read_lidar(Path(named)) if named.lower().endswith(_YAML) else find_lidar(named)
        if not _fits(spec, beams):
            raise RecordingError(
                path,
                f"{topic.name}: expected the {spec.beams} beams of {spec.name} from "
                f"{spec.angle_min:.4f} rad in steps of {spec.angle_increment:.6f}, found "
                f"{beams.count} from {beams.angle_min:.4f} in steps of {beams.angle_increment:.6f}",
            )
        return spec, "as named"
    for spec in LIDARS.values():
        if _fits(spec, beams):
            return spec, "recognised by its beams and angles; --lidar names another"
    return _describe(path, topic, beams), "described by its messages; --lidar names it"


def place_lidar(spec: LidarSpec, given: Mount | None, in_tf: Mount | None) -> tuple[LidarSpec, str]:
    """Set the mount: as given, else as recorded in tf, else as the lidar's own description says.

    Returns
    -------
    spec, how
        The lidar with its mount, and where that comes from.
    """
    if given is not None:
        return replace(spec, base_T_lidar=given), "as given"
    if in_tf is not None:
        return replace(spec, base_T_lidar=in_tf), "from tf"
    if spec.base_T_lidar != _NO_MOUNT:
        return spec, f"from the description of {spec.name}"
    return spec, "not found: taken as identity; --mount x,y,z,roll,pitch,yaw sets it"


def _fits(spec: LidarSpec, beams: Beams) -> bool:
    """Compare the counts, and both ends to half a beam."""
    if spec.beams != beams.count:
        return False
    first = beams.angle_min - spec.angle_min
    last = first + (beams.angle_increment - spec.angle_increment) * (beams.count - 1)
    return max(abs(first), abs(last)) <= spec.angle_increment / 2


def _describe(path: Path, topic: Topic, beams: Beams) -> LidarSpec:
    try:
        return LidarSpec(
            name=f"{slug(topic.name)}-{beams.count}",
            model=f"lidar of {topic.name} ({beams.frame or 'no frame'})",
            beams=beams.count,
            angle_min=beams.angle_min,
            angle_increment=beams.angle_increment,
            range_min=beams.range_min,
            range_max=beams.range_max,
        )
    except InvalidInputError as err:
        raise RecordingError(
            path, f"{topic.name}: its messages describe no lidar: {err}; pass --lidar LIDAR.yaml"
        ) from err
