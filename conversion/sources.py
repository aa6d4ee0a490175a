"""What a path is: the source that reads it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from conversion.carmen.log import CarmenLog, is_carmen
from conversion.exports.exported import ExportedSource, is_exported
from conversion.layouts.ogm import OgmSource, is_ogm
from conversion.layouts.release import ReleaseSource
from conversion.layouts.sessions import is_release
from conversion.layouts.trees import is_archive, open_tree
from conversion.messages.source import MessageSource
from conversion.options import Options
from conversion.plan import Source
from conversion.presets import OGM
from conversion.ros.bags import Bag, bags_in
from conversion.ros.recording import RosRecording
from conversion.tables.table import TableSource, is_table
from semantic2d_dataset.errors import RecordingError

_YAML = (".yaml", ".yml")
_BAG_METADATA = "metadata.yaml"
_BAGS = (".bag", ".db3", ".mcap")


def find_recordings(paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """Return the recordings that paths name, each by its file or folder, or by its several files.

    A folder that holds bags stands for all of them; files that continue one another
    (``drive_0.mcap``, ``drive_1.mcap``) are one recording.

    Raises
    ------
    FileNotFoundError
        If a path does not exist.
    """
    found: list[tuple[Path, ...]] = []
    for path in paths:
        if path.is_dir() and not (path / _BAG_METADATA).is_file():
            found += [tuple(files) for files in bags_in(path)] or [(path,)]
        else:
            found.append((path,))
    return found


def holds_layout(archive: Path) -> bool:
    """Tell whether a file is an archive that holds recordings of a layout that is known.

    Raises
    ------
    RecordingError
        If it cannot be read.
    """
    if not is_archive(archive):
        return False
    with open_tree(archive) as tree:
        return is_release(tree.names) or is_ogm(tree.names)


def open_source(paths: Sequence[Path], options: Options) -> Source:
    """Open a recording of any kind.

    Parameters
    ----------
    paths
        A ROS 1 or ROS 2 bag (or the several files of one), a CARMEN log, a folder or archive in
        the layout of the published release or of OGM-Turtlebot2, or the YAML that describes
        other arrays.
    options
        `distro` and `preset` count here.

    Raises
    ------
    FileNotFoundError
        If a path does not exist.
    RecordingError
        If nothing here reads it.
    """
    path = paths[0].parent if paths[0].name == _BAG_METADATA else paths[0]
    if len(paths) > 1 or (path / _BAG_METADATA).is_file():
        return _open_bag([path, *paths[1:]], options)
    if is_table(path) or path.suffix.lower() in _YAML:
        return TableSource(path)
    if path.is_dir() or is_archive(path):
        return _open_layout(path, options)
    if is_carmen(path):
        return MessageSource(CarmenLog(path))
    return _open_bag(paths, options)


def _open_bag(paths: Sequence[Path], options: Options) -> Source:
    recording = RosRecording(Bag(paths, distro=options.distro))
    return ExportedSource(recording) if is_exported(recording) else MessageSource(recording)


def _open_layout(path: Path, options: Options) -> Source:
    if options.preset == OGM:
        return OgmSource(path)
    tree = open_tree(path)
    if is_release(tree.names):
        return ReleaseSource(path, tree)
    with tree:
        names = tree.names
        if is_ogm(names):
            return OgmSource(path)
        bags = [name for name in names if name.endswith(_BAGS)]
    if bags and path.is_file():
        raise RecordingError(
            path, f"holds bags ({', '.join(bags[:3])}): unpack it, and give what was in it"
        )
    raise RecordingError(
        path,
        "holds no recording that is known: expected bags (.bag, .db3, .mcap, or a folder with "
        "metadata.yaml), folders with scans_lidar/ (the published layout), or train/, val/ and "
        f"test/ with scans/ (OGM-Turtlebot2); found {', '.join(names[:5]) or 'nothing'}",
    )
