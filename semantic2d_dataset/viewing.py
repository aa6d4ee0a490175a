"""Open a sequence in the Rerun viewer: map, way, and labelled scans over time."""

from __future__ import annotations

import os
import shutil
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset import plotting
from semantic2d_dataset.errors import InvalidInputError, Semantic2DError, WriteError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.writing import partial_name, remove_stale_partials
from semantic2d_dataset.scene.geometry import to_base, to_points
from semantic2d_dataset.scene.maps import SemanticMap
from semantic2d_dataset.scene.scans import ScanBatch
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

_BLOCK = 8 * CHUNK_ROWS  # scans
_TIMELINE = "stamp"
_POINT_PIXELS, _ROBOT_M = 4.0, 0.5
_WAYS = {"poses/initial": (122, 127, 135), "poses/refined": (20, 87, 200)}
_ROBOT_RGB = (214, 0, 127)  # no class is pink
_ABOVE_MAP_M = 0.02
_FREE_BYTES_KEPT = 1 << 27  # more than a block of scans takes


def view_sequence(path: Path, *, every: int = 1, save: Path | None = None) -> int:
    """Show a sequence in the Rerun viewer, or write what it would show.

    Scans lie where their poses say, in the colours of their classes; where some scans have a
    pose and others not, the others are left out. Scans are sent in blocks, so that memory here
    does not grow with the recording.

    Parameters
    ----------
    path
        The sequence; labels, poses and a map are shown where it has them.
    every
        Show one scan of so many.
    save
        A Rerun recording (``.rrd``) to write, in place of opening the viewer.

    Returns
    -------
    How many scans are shown.

    Raises
    ------
    FileNotFoundError, CorruptFileError
        If the sequence is missing or damaged.
    InvalidInputError
        If `every` is below 1, the extra ``view`` is not installed, or the viewer does not open.
    WriteError
        If the recording cannot be written.
    """
    if every < 1:
        raise InvalidInputError(f"every: expected at least 1, found {every}")
    with SequenceReader(path) as reader:
        _require_rerun()
        import rerun

        stream = rerun.RecordingStream("semantic2d")
        if save is None:
            _open_viewer(stream, _from_above(reader))
            shown = _send(reader, stream, every)
            stream.flush()
            return shown
        return _save(reader, stream, every, Path(save))


def _require_rerun() -> None:
    try:
        import rerun.blueprint  # noqa: F401 - another package has the name rerun, too
    except ImportError as err:
        raise InvalidInputError(
            "viewing needs Rerun: pip install 'semantic2d-dataset[view]'"
        ) from err


def _open_viewer(stream: Any, blueprint: Any) -> None:
    path = os.environ.get("PATH", "")
    # pip puts the viewer beside Python, in a folder that an environment not activated lacks
    os.environ["PATH"] = os.pathsep.join((sysconfig.get_path("scripts"), path))
    try:
        stream.spawn(default_blueprint=blueprint)
    except RuntimeError as err:
        reason = next(iter(str(err).strip().splitlines()), "no reason given")
        raise InvalidInputError(
            f"the Rerun viewer does not open ({reason}); --save writes what it would show"
        ) from err
    finally:
        os.environ["PATH"] = path


def _save(reader: SequenceReader, stream: Any, every: int, target: Path) -> int:
    """Write a recording under a temporary name, and give it its own when it is whole."""
    if not target.parent.is_dir():
        raise WriteError(f"{target}: the folder {target.parent} does not exist")
    remove_stale_partials(target)
    partial = partial_name(target)
    try:
        partial.touch(exist_ok=False)
        _check_space(target)
        stream.save(partial, default_blueprint=_from_above(reader))
        shown = _send(reader, stream, every, after=lambda: _check_space(target))
        stream.disconnect()
        partial.replace(target)
    except (OSError, RuntimeError) as err:
        if isinstance(err, Semantic2DError):
            raise
        raise WriteError(f"{target}: could not be written: {err}") from err
    finally:
        partial.unlink(missing_ok=True)
    return shown


def _check_space(target: Path) -> None:
    """Stop before the disk is full: Rerun does not tell, and waits for ever."""
    free = shutil.disk_usage(target.parent).free
    if free < _FREE_BYTES_KEPT:
        raise WriteError(
            f"{target}: the disk is full: {free} bytes are free; --every shows fewer scans"
        )


def _from_above(reader: SequenceReader) -> Any:
    """Look down on the map, or on the robot where there is none."""
    import rerun.blueprint as rrb

    scene = reader.read_map()
    centre, size = np.zeros(2), 30.0
    if scene is not None:
        rows, columns = scene.occupancy.shape
        centre = scene.centres_of((rows / 2, columns / 2))
        size = scene.resolution * max(rows, columns)
    x, y = centre.tolist()
    eye = rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(x, y, size),
        look_target=(x, y, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )
    view = rrb.Spatial3DView(name=reader.header.sequence_id, eye_controls=eye, line_grid=False)
    return rrb.Blueprint(view, rrb.TimePanel(timeline=_TIMELINE), collapse_panels=True)


def _send(
    reader: SequenceReader, stream: Any, every: int, *, after: Callable[[], object] = lambda: None
) -> int:
    """Send all there is to see; `after` is called when a block of scans is sent."""
    scene = reader.read_map()
    _send_classes(stream, reader.header.taxonomy)
    if scene is not None:
        _send_map(stream, scene, reader.header.taxonomy)
    for name, colour in _WAYS.items():
        if name in reader:
            _send_way(stream, name, reader.read(name)[::every], colour)
    _send_robot(stream)
    posed = bool(np.isfinite(reader.read_poses()).all(axis=-1).any())
    shown = 0
    with tqdm(total=len(reader), desc=reader.path.name, unit="scan", disable=None) as bar:
        for start in range(0, len(reader), _BLOCK):
            stop = min(start + _BLOCK, len(reader))
            kept = np.arange(-start % every, stop - start, every)
            if kept.size:
                shown += _send_scans(stream, reader.batch(start, stop), kept, posed=posed)
            bar.update(stop - start)
            after()
    after()
    return shown


def _send_classes(stream: Any, taxonomy: Taxonomy) -> None:
    import rerun

    colours = taxonomy.palette
    names = {**dict(enumerate(taxonomy.names)), UNLABELLED: "not labelled"}
    infos = [rerun.AnnotationInfo(i, name, colours[i].tolist()) for i, name in names.items()]
    stream.log("/", rerun.AnnotationContext(infos), static=True)


def _send_map(stream: Any, scene: SemanticMap, taxonomy: Taxonomy) -> None:
    """Lay the map as a picture on the floor; its first row is the smallest y."""
    import rerun

    rows, columns = scene.occupancy.shape
    corners = np.array(((0, 0), (0, columns), (rows, columns), (rows, 0))) - 0.5
    floor = np.column_stack((scene.centres_of(corners), np.zeros(4)))
    mesh = rerun.Mesh3D(
        vertex_positions=floor,
        triangle_indices=((0, 1, 2), (0, 2, 3)),
        vertex_texcoords=((0, 0), (1, 0), (1, 1), (0, 1)),
        albedo_texture=plotting.cell_colours(scene, taxonomy),
    )
    stream.log("map", mesh, static=True)


def _send_way(
    stream: Any, name: str, poses: NDArray[np.float64], colour: tuple[int, int, int]
) -> None:
    """Draw the way (N, 3) as lines that break where poses are unknown."""
    import rerun

    places = np.column_stack((poses[:, :2], np.full(len(poses), _ABOVE_MAP_M)))
    known = np.isfinite(places).all(axis=-1)
    runs = np.split(places, np.flatnonzero(np.diff(known)) + 1)
    strips = [run for run in runs if len(run) > 1 and np.isfinite(run[0]).all()]
    radius = rerun.Radius.ui_points(1.0)
    stream.log(name, rerun.LineStrips3D(strips, colors=colour, radii=radius), static=True)


def _send_robot(stream: Any) -> None:
    import rerun

    arrow = rerun.Arrows3D(
        vectors=(_ROBOT_M, 0.0, 0.0), origins=(0.0, 0.0, 2 * _ABOVE_MAP_M), colors=_ROBOT_RGB
    )
    size = rerun.Radius.ui_points(_POINT_PIXELS / 2)
    stream.log("robot", arrow, static=True)
    stream.log("robot/scan", rerun.Points3D.from_fields(radii=size), static=True)


def _send_scans(stream: Any, batch: ScanBatch, kept: NDArray[np.int64], *, posed: bool) -> int:
    """Send rows of a block: the poses of the robot, and the points in its frame."""
    import rerun

    poses = batch.poses[kept]
    known = np.isfinite(poses).all(axis=-1)
    if posed:
        kept, poses = kept[known], poses[known]
    else:
        poses = np.zeros((len(kept), 3))
    if not kept.size:
        return 0
    stamps = batch.stamps_ns[kept].astype("datetime64[ns]")
    times = [rerun.TimeColumn(_TIMELINE, timestamp=stamps)]
    level = np.zeros(len(kept))
    half = poses[:, 2] / 2
    moves = rerun.Transform3D.columns(
        translation=np.column_stack((poses[:, :2], level)),
        quaternion=np.column_stack((level, level, np.sin(half), np.cos(half))),
    )
    stream.send_columns("robot", times, moves)
    valid = batch.valid[kept]
    points = to_base(to_points(batch.ranges[kept], batch.lidar.bearings), batch.lidar.base_T_lidar)
    flat = points[valid].astype(np.float32)
    flat = np.column_stack((flat, np.full(len(flat), _ABOVE_MAP_M, np.float32)))
    labels = np.full(valid.shape, UNLABELLED, np.uint8)
    if batch.labels is not None:
        labels = batch.labels[kept]
    columns = rerun.Points3D.columns(positions=flat, class_ids=labels[valid].astype(np.uint16))
    stream.send_columns("robot/scan", times, columns.partition(valid.sum(axis=-1)))
    return len(kept)
