"""Velocity commands of a recording, and the one in force at each scan."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from conversion.messages.recordings import Recording, Topic
from semantic2d_dataset.errors import RecordingError

AUTO, NONE = "auto", "none"

# A base stops where no command comes for so long (0.5 to 1 s in common drivers).
_HOLDS_NS = 1_000_000_000


class VelocityLog:
    """Collect the commands of one topic: time of recording, forward m/s, turning rad/s."""

    def __init__(self, topic: Topic | None) -> None:
        self.topic = topic
        self._record_ns = array("q")
        self._values = array("d")

    def add(self, record_ns: int, forward: float, turning: float) -> None:
        """Add a command."""
        self._record_ns.append(record_ns)
        self._values.extend((forward, turning))

    def at(self, record_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the last command at each time of recording.

        Parameters
        ----------
        record_ns
            (N,) i8.

        Returns
        -------
        (N, 2) f8 m/s and rad/s; NaN where none came within a second before.
        """
        known = np.array(self._record_ns, np.int64)
        values = np.vstack((np.array(self._values).reshape(-1, 2), [[np.nan, np.nan]]))
        last = np.searchsorted(known, record_ns, side="right") - 1
        if known.size:
            stale = record_ns - known[np.maximum(last, 0)] > _HOLDS_NS
            last = np.where(stale, -1, last)
        found: NDArray[np.float64] = values[last]  # -1 is the row of NaN
        return found


def choose_velocity_topic(recording: Recording, named: str) -> Topic | None:
    """Return the topic named, the most used ``cmd_vel`` for ``auto``, or None.

    Raises
    ------
    RecordingError
        If there is no such topic.
    """
    topics = recording.velocity_topics
    if named == NONE:
        return None
    if named == AUTO:
        commands = [topic for topic in topics if "cmd_vel" in topic.name and topic.messages]
        return max(commands, key=lambda topic: topic.messages, default=None)
    found = [topic for topic in topics if topic.name.strip("/") == named.strip("/")]
    if not found:
        known = ", ".join(topic.name for topic in topics) or "none"
        raise RecordingError(
            recording.path, f"no topic {named!r} with velocity commands; there are: {known}"
        )
    return found[0]
