"""Which lidar measured a session of the published layout."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from conversion.layouts.fields import SCANS
from conversion.layouts.sessions import Session
from conversion.messages.lidars import place_lidar
from conversion.options import Options
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.scene.lidars import LIDARS, LidarSpec, find_lidar, read_lidar

_ANGLES = "angles_lidar"


def choose_lidar(session: Session, options: Options) -> tuple[LidarSpec, tuple[str, ...]]:
    """Recognise the lidar of a session by its beams, unless it is named, and place it.

    Returns
    -------
    spec, notices
        The lidar, how it was found, and what does not fit it.

    Raises
    ------
    RecordingError
        If its scans have other beams than the lidar, or than any that is known.
    InvalidInputError
        If nothing has the name that is given.
    """
    path, where = session.tree.path, session.name(SCANS)
    beams, others = _count_beams(session)
    named = options.lidar
    spec: LidarSpec | None
    if named is not None:
        is_file = named.lower().endswith((".yaml", ".yml"))
        spec = read_lidar(Path(named)) if is_file else find_lidar(named)
        how = "as named"
    else:
        spec = next((each for each in LIDARS.values() if each.beams == beams), None)
        how = f"recognised by its {beams} beams; --lidar names another"
    if spec is None or spec.beams != beams:
        known = ", ".join(f"{each.name} {each.beams}" for each in LIDARS.values())
        expected = f"the {spec.beams} beams of {spec.name}" if spec else f"one of {known}"
        raise RecordingError(
            path,
            f"{where}: expected {expected}, found {beams} beams{_describe_angles(session)}; "
            "describe the lidar in a YAML file with name, model, beams, angle_min, "
            "angle_increment (rad), range_min and range_max (m), and pass --lidar FILE.yaml",
        )
    spec, mount = place_lidar(spec, options.mount, None)
    notices = [f"lidar {how}", f"mount {mount}", "stamps synthetic: the layout has none; 20 Hz"]
    if others:
        what = f"{len(others)} scan files do not hold {beams} values (first: {others[0]})"
        notices.append(f"{what}: their ranges are NaN")
    return spec, (*notices, *_compare_angles(session, spec))


def _count_beams(session: Session) -> tuple[int, list[str]]:
    """Return how many values most scan files hold, and which hold another number."""
    tree, scans = session.tree, session.scans
    sizes = [tree.size(session.name(SCANS, file)) for file in scans]
    usual = Counter(sizes).most_common(1)[0][0]
    first = scans[sizes.index(usual)]
    beams = tree.read_array(session.name(SCANS, first)).size
    odd = [file for file, size in zip(scans, sizes, strict=True) if size != usual]
    return beams, [file for file in odd if tree.read_array(session.name(SCANS, file)).size != beams]


def _describe_angles(session: Session) -> str:
    """Say what the session itself tells of its angles, if anything."""
    angles = _first_angles(session)
    if angles is None:
        return ""
    step = (angles[-1] - angles[0]) / (len(angles) - 1)
    return f" (by {_ANGLES}: angle_min {angles[0]:.6f}, angle_increment {step:.6g})"


def _compare_angles(session: Session, spec: LidarSpec) -> tuple[str, ...]:
    angles = _first_angles(session)
    if angles is None:
        return ()
    if len(angles) == spec.beams:
        apart = float(np.abs(angles - spec.bearings).max())
        if apart <= spec.angle_increment / 2:
            return ()
    begins = f"{spec.angle_min:.4f} rad in steps of {spec.angle_increment:.6f}"
    found = f"{_ANGLES} does not fit {spec.name}, which begins at {begins}"
    return (f"{found}{_describe_angles(session)}; --lidar names another",)


def _first_angles(session: Session) -> NDArray[np.float64] | None:
    files = session.files.get(_ANGLES)
    if not files:
        return None
    angles = session.tree.read_array(session.name(_ANGLES, files[0])).reshape(-1)
    usable = angles.dtype.kind in "fiu" and len(angles) > 1
    return angles.astype(np.float64) if usable else None
