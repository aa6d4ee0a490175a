"""CARMEN logs, the text format of the classic 2D lidar data sets, as recordings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Self

import numpy as np
from tqdm import tqdm

from conversion.carmen.kinds import SAME_RANGE_M, LaserKind
from conversion.carmen.lines import (
    LAYOUTS,
    LaserLine,
    angles_of,
    damaged,
    first_word,
    nanoseconds,
    range_max_of,
    read_lines,
    read_parameter,
    split_line,
)
from conversion.messages.recordings import Message, PoseSample, Topic, TransformSample
from conversion.messages.scans import Scan
from conversion.messages.tracks import Values
from conversion.plan import Arrays
from semantic2d_dataset.errors import RecordingError

BASE, MAP, ODOMETRY = "base_link", "map", "odom"

_MOUNTS = Topic("mounts", "CARMEN mount", 1)
_POSE, _ODOMETRY = "CARMEN pose", "CARMEN Odometry"

# Words that only a log holds whose poses a SLAM has corrected: of particles, or of a pose graph.
_CORRECTED = frozenset((b"NEFF", b"VERTEX2", b"EDGE2"))
_OTHERS = _CORRECTED | {
    *(b"ODOM", b"PARAM", b"SYNC", b"TRUEPOS", b"POSITION", b"NMEAGGA", b"NMEARMC", b"SONAR"),
    *(b"BUMPER", b"IMU", b"GPS", b"COMPASS", b"ODO_UPDATE", b"SM_UPDATE", b"SCANMARK", b"MARKER"),
}
_LOOKED_AT = 200  # lines
_MOST_WORDS = 50
_EPOCH_NS = 10**17  # 1973; stamps below count from the start of the logger


class CarmenLog:
    """A CARMEN log, plain or gzip, as a `conversion.messages.recordings.Recording`.

    Each kind of laser line (FLASER, RLASER, RAWLASER1 to 4, ROBOTLASER1 and 2) is a topic of
    scans, and its poses are a topic named ``<kind> pose``, in the frame ``map``; all other lines
    are skipped. Where the laser does not move on the robot, the robot's pose is taken, and the
    offset is the mount. Where it does, the laser's pose was corrected and the robot's is odometry
    (``<kind> odometry``): the laser's counts, without a mount.

    The time of recording is the logger's stamp, made to increase with every line; the stamp of a
    scan is what its line says. Ranges that stand for no return become +inf: the error codes of
    SICK lasers, and the value that recurs beyond all others.

    Parameters
    ----------
    path
        The log; it is read once.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    RecordingError
        If it is damaged, or holds no scans.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.kind = "CARMEN log"
        self.versions: Mapping[str, str] = {}
        self._parameters: dict[str, float] = {}
        self._words: Counter[bytes] = Counter()
        self._first_ns = self._rebase_ns = self._stamps_back = 0
        every = self._survey()
        self._kinds = {name: kind for name, kind in every.items() if _twin(name) not in every}
        self._no_return = {name: [r.value_m for r in k.no_return] for name, k in every.items()}
        kinds = sorted(self._kinds.items())
        self.scan_topics = tuple(Topic(name, f"CARMEN {name}", k.lines) for name, k in kinds)
        self.pose_topics = tuple(self._pose_topics())
        self.transform_topics: tuple[Topic, ...] = (_MOUNTS,) if self.pose_topics else ()
        self.velocity_topics: tuple[Topic, ...] = ()
        self.topics = tuple(sorted((*self.scan_topics, *self.pose_topics, *self.transform_topics)))
        self.notices = tuple(self._notices(every.keys() - self._kinds.keys()))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Leave nothing open: every pass opens the file for itself."""

    def files(self) -> Sequence[Path]:
        """Return the log itself."""
        return (self.path,)

    def messages(self, topics: Collection[Topic], start_ns: int = 0) -> Iterator[Message]:
        """Read the file again, and yield the messages of some topics.

        Raises
        ------
        RecordingError
            If the file is damaged, or has changed.
        """
        by_kind: dict[str, list[Topic]] = {}
        for topic in topics:
            by_kind.setdefault(topic.name.split(" ")[0], []).append(topic)
        if _MOUNTS.name in by_kind and self._first_ns >= start_ns:
            yield Message(_MOUNTS.name, _MOUNTS.type, self._first_ns, None)
        record_ns = self._first_ns - 1
        for number, text in read_lines(self.path):
            word = first_word(text)
            if word not in LAYOUTS:
                continue
            # of every line, so that a message has one time whatever topics were asked for
            record_ns = max(record_ns + 1, self._logged_ns(number, text) + self._rebase_ns)
            wanted = by_kind.get(word.decode())
            if wanted and record_ns >= start_ns:
                line = split_line(self.path, number, text)
                for topic in wanted:
                    yield Message(topic.name, topic.type, record_ns, line)

    def scan(self, message: Message) -> Scan:
        """Decode a laser's line; ranges that stand for no return become +inf.

        Raises
        ------
        RecordingError
            If it holds something that is no number.
        """
        line: LaserLine = message.raw
        try:
            ranges, remissions = line.values(line.ranges), line.values(line.remissions)
            angles, limit = angles_of(line, self._parameters), range_max_of(line, self._parameters)
            stamp_ns = line.stamp_ns
        except ValueError as err:
            raise self._changed(err) from err
        no_return = self._no_return[line.kind]
        for value in no_return:
            ranges[np.abs(ranges - value) < SAME_RANGE_M] = np.inf
        limit = min((limit, *no_return))
        return Scan(stamp_ns, line.kind, angles.first, angles.step, 0.0, limit, ranges, remissions)

    def pose(self, message: Message) -> PoseSample:
        """Decode the pose in a laser's line: of the robot where the two are rigid.

        Raises
        ------
        RecordingError
            If it holds something that is no number.
        """
        line: LaserLine = message.raw
        try:
            (laser, robot), stamp_ns = line.poses(), line.stamp_ns
        except ValueError as err:
            raise self._changed(err) from err
        if message.type == _ODOMETRY:
            return PoseSample(stamp_ns, ODOMETRY, _values(*robot))
        taken = robot if self._kinds[line.kind].is_rigid else laser
        return PoseSample(stamp_ns, MAP, _values(*taken))

    def transforms(self, message: Message) -> Sequence[TransformSample]:
        """Return the mounts of the lasers on the robot."""
        found = ((name, _values(*kind.mount)) for name, kind in self._kinds.items() if kind.poses)
        return [
            TransformSample(message.record_ns, BASE, name, values, static=True)
            for name, values in found
            if values is not None
        ]

    def velocity(self, message: Message) -> tuple[float, float]:
        """Refuse: a log has no velocity topics."""
        raise RecordingError(self.path, f"{message.topic}: a CARMEN log holds no commands")

    def streams(self, names: Collection[str], start_ns: int, stop_ns: int) -> Iterator[Arrays]:  # noqa: ARG002
        """Yield nothing: a log holds no other topics.

        Raises
        ------
        RecordingError
            If any was asked for.
        """
        if names:
            raise RecordingError(
                self.path,
                f"expected no streams of a CARMEN log, found {', '.join(names)}: leave them out",
            )
        return iter(())

    def _survey(self) -> dict[str, LaserKind]:
        kinds: dict[str, LaserKind] = {}
        last_ns = None
        for number, text in self._with_progress():
            word = first_word(text)
            if word in self._words or len(self._words) < _MOST_WORDS:
                self._words[word] += 1
            if word == b"PARAM":
                self._parameters.update(filter(None, (read_parameter(text),)))
            if word not in LAYOUTS:
                continue
            line = split_line(self.path, number, text)
            logged_ns = self._logged_ns(number, text)
            try:
                if line.kind not in kinds:
                    kinds[line.kind] = LaserKind(line, self._parameters)
                kinds[line.kind].add(line, self._parameters)
                sent_ns = line.stamp_ns
            except ValueError as err:
                raise damaged(self.path, number, text, err) from err
            if last_ns is None:
                # the logger counts from its start: line its clock up with the messages'
                self._rebase_ns = sent_ns - logged_ns if sent_ns >= _EPOCH_NS > logged_ns else 0
                self._first_ns = logged_ns + self._rebase_ns
            self._stamps_back += last_ns is not None and logged_ns < last_ns
            last_ns = logged_ns
        if not kinds:
            raise RecordingError(self.path, _why_no_scans(self._words))
        return kinds

    def _with_progress(self) -> Iterator[tuple[int, bytes]]:
        what = f"read {self.path.name}, {self.path.stat().st_size / 1e6:.1f} MB"
        lines = read_lines(self.path)
        return iter(tqdm(lines, desc=what, unit=" lines", disable=None, leave=False))

    def _pose_topics(self) -> Iterator[Topic]:
        for name, kind in sorted(self._kinds.items()):
            if kind.poses:
                yield Topic(f"{name} pose", _POSE, kind.lines)
                if not kind.is_rigid:
                    yield Topic(f"{name} odometry", _ODOMETRY, kind.lines)

    def _logged_ns(self, number: int, text: bytes) -> int:
        try:
            return nanoseconds(text.rsplit(None, 1)[-1])
        except ValueError as err:
            raise damaged(self.path, number, text, err) from err

    def _changed(self, err: ValueError) -> RecordingError:
        return RecordingError(self.path, f"the log changed while it was read: {err}")

    def _notices(self, left_out: Collection[str]) -> Iterator[str]:
        for name in sorted(left_out):
            yield f"{name} left out: {_twin(name)} has the same scans, and poses"
        for kind in self._kinds.values():
            yield from kind.notices(corrected=not _CORRECTED.isdisjoint(self._words))
        if self._stamps_back:
            yield (
                f"the logger's stamps go backward {self._stamps_back} times: times of recording go "
                "on from the latest; --stamps record makes one sequence of the log"
            )


def is_carmen(path: Path) -> bool:
    """Tell by its first lines whether a file is a CARMEN log, plain or gzip."""
    lines: list[bytes] = []
    with suppress(RecordingError, OSError):  # judged by what can be read
        lines.extend(line for _, line in islice(read_lines(Path(path)), _LOOKED_AT))
    words = [word for word in map(first_word, lines) if word and not word.startswith(b"#")]
    known = [word for word in words if word in LAYOUTS or word in _OTHERS]
    return bool(known) and 2 * len(known) >= len(words) and not any(b"\0" in x for x in lines)


def _twin(name: str) -> str | None:
    """Return the kind of line that repeats the scans of a RAWLASER line beside a pose."""
    return name.replace("RAW", "ROBOT") if name.startswith("RAW") else None


def _values(x: float, y: float, theta: float) -> Values | None:
    usable = all(map(math.isfinite, (x, y, theta)))
    return (x, y, 0.0, 0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)) if usable else None


def _why_no_scans(words: Counter[bytes]) -> str:
    found = ", ".join(
        f"{word.decode(errors='replace')[:20]} ({count})"
        for word, count in words.most_common(8)
        if word
    )
    kinds = ", ".join(word.decode() for word in LAYOUTS)
    return f"expected lines of scans ({kinds}), found {found or 'no lines at all'}"
