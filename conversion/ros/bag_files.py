"""Which files are one recording of ROS, and of what kind a file is."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import yaml

from conversion.wording import one_line
from semantic2d_dataset.errors import RecordingError

ROS1, SQLITE, MCAP, ZSTD = "ROS 1", "sqlite3", "MCAP", "zstd"
METADATA = "metadata.yaml"

_MAGIC = {
    b"#ROSBAG V2.0\n": ROS1,
    b"SQLite format 3\x00": SQLITE,
    b"\x89MCAP0\r\n": MCAP,
    b"\x28\xb5\x2f\xfd": ZSTD,
}
_OLD_MAGIC = (b"#ROSBAG", b"#ROSRECORD", b"#ROSLOG")
# First bytes of what people pass, and how to go on from there.
_PACKED = {
    b"PK\x03\x04": "a zip archive: unpack it, and give what was in it",
    b"\x1f\x8b": "gzip data: decompress it (gunzip), and give what was in it",
    b"BZh": "bzip2 data: decompress it (bunzip2), and give what was in it",
    b"\xfd7zXZ": "xz data: decompress it (unxz), and give what was in it",
}
_BAG_NAME = re.compile(r".*\.(bag|(db3|mcap)(\.zstd)?)", re.DOTALL)
_SPLIT_NAME = re.compile(
    r"(?P<stem>.*)_(?P<number>\d+)\.(?P<suffix>(db3|mcap)(\.zstd)?)", re.DOTALL
)
_MAX_METADATA = 1 << 24  # bytes; a recording of a day has some kilobytes
_LISTED = 8


class BagFiles(NamedTuple):
    """The files of one recording.

    Parameters
    ----------
    files
        Those that hold messages.
    metadata
        Those that only describe them.
    distro
        The release of ROS that recorded them, where it is told.
    """

    files: tuple[Path, ...]
    metadata: tuple[Path, ...] = ()
    distro: str | None = None


def bags_in(folder: Path) -> list[list[Path]]:
    """Return the recordings of a folder and of the folders directly in it.

    Returns
    -------
    Each recording as the paths that `conversion.ros.bags.Bag` takes: a ROS 2 folder with its
    metadata.yaml, one file, or the files that a ROS 2 recorder named one after the other
    (``drive_0.mcap``, ``drive_1.mcap``).
    """
    inner = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    if (folder / METADATA).is_file():
        return [[folder]]
    found = _bags_of(folder)
    for path in inner:
        found += [[path]] if (path / METADATA).is_file() else _bags_of(path)
    return found


def find_files(paths: Sequence[Path]) -> BagFiles:
    """Return the files of the recording that some paths name.

    Raises
    ------
    FileNotFoundError
        If there is no such file or folder.
    RecordingError
        If a folder is no recording, or a file is given twice.
    """
    found = [_find(path) for path in paths]
    files = tuple(file for one in found for file in one.files)
    seen: set[tuple[int, int]] = set()
    for file in files:
        about = file.stat()
        if (about.st_dev, about.st_ino) in seen:
            raise RecordingError(file, "is given twice: give every file of a recording once")
        seen.add((about.st_dev, about.st_ino))
    metadata = tuple(file for one in found for file in one.metadata)
    return BagFiles(files, metadata, next((one.distro for one in found if one.distro), None))


def kind_of(path: Path) -> str:
    """Tell by its first bytes what a file is: `ROS1`, `SQLITE`, `MCAP` or `ZSTD`.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    RecordingError
        If it is something else.
    """
    with path.open("rb") as file:  # FileNotFoundError and PermissionError pass as they are
        head = file.read(64)
    if not head:
        raise RecordingError(path, "the file is empty")
    for magic, kind in _MAGIC.items():
        if head.startswith(magic):
            return kind
    if head.startswith(_OLD_MAGIC):
        line = head.splitlines()[0].decode("ascii", "replace")
        raise RecordingError(
            path,
            f"expected a bag of version 2.0, found {line!r}: convert it with ROS 1 "
            "(rosbag fix OLD.bag NEW.bag)",
        )
    for magic, advice in _PACKED.items():
        if head.startswith(magic):
            raise RecordingError(path, f"expected a bag, found {advice}")
    raise RecordingError(
        path,
        "not a ROS bag, nor any other recording: expected a ROS 1 .bag, a ROS 2 .db3, .mcap or "
        "folder, a CARMEN log, a published layout (folder, zip, tar), or a .yaml that describes "
        f"arrays; found a file that starts with {head[:16]!r}",
    )


def _find(path: Path) -> BagFiles:
    if path.name == METADATA and path.is_file():
        path = path.parent
    if not path.is_dir():
        return BagFiles((path,))
    if (path / METADATA).is_file():
        return _described(path)
    bags = _bags_of(path)
    if len(bags) == 1:
        return BagFiles(tuple(bags[0]))
    names = ", ".join(bag[0].name for bag in bags[:_LISTED])
    advice = f"give one of its bags: {names}" if bags else "it holds no bag"
    raise RecordingError(path, f"a folder without {METADATA} is no ROS 2 recording; {advice}")


def _bags_of(folder: Path) -> list[list[Path]]:
    """Bag files directly in a folder, those of one recording together."""
    bags: dict[tuple[str, ...], list[tuple[int, Path]]] = {}
    for path in sorted(p for p in folder.iterdir() if _BAG_NAME.fullmatch(p.name) and p.is_file()):
        match = _SPLIT_NAME.fullmatch(path.name)
        key = (match["stem"], match["suffix"]) if match else (path.name,)
        bags.setdefault(key, []).append((int(match["number"]) if match else 0, path))
    return [[path for _, path in sorted(bag)] for bag in bags.values()]


def _described(folder: Path) -> BagFiles:
    """Return the files that a metadata.yaml names."""
    described = folder / METADATA
    try:
        about = _read_metadata(described)["rosbag2_bagfile_information"]
        names = [PurePath(name).name for name in about["relative_file_paths"]]
        distro = about.get("ros_distro")
    except PermissionError:
        raise
    except Exception as err:  # YAML can hold anything, and its parser fail in many ways
        raise RecordingError(
            described,
            f"cannot be read as the metadata of a bag ({one_line(err)}): ros2 bag reindex writes "
            f"them anew; or give the files of messages themselves",
        ) from err
    missing = [name for name in names if not (folder / name).is_file()]
    if missing or not names:
        raise RecordingError(
            described,
            f"names files that are not there: {', '.join(missing[:_LISTED])}; copy them here, or "
            "give those that are there"
            if missing
            else "names no files: ros2 bag reindex",
        )
    files = tuple(folder / name for name in names)
    return BagFiles(files, (described,), _text_or_none(distro))


def _read_metadata(path: Path) -> Any:
    size = path.stat().st_size
    if size > _MAX_METADATA:
        raise ValueError(f"it has {size} bytes")
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _text_or_none(value: Any) -> str | None:
    return value if isinstance(value, str) else None
