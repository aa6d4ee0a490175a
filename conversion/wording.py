"""How times and failures are written in messages to people."""

from __future__ import annotations

_LONGEST = 300


def seconds(stamp_ns: int) -> str:
    """Write a stamp as seconds, to the millisecond."""
    return f"{stamp_ns // 10**9}.{stamp_ns // 10**6 % 1000:03d} s"


def one_line(err: BaseException) -> str:
    """Name a failure of a library, in one line; of our own checks only the words."""
    text = " ".join(str(err).split())[:_LONGEST]
    if type(err) is ValueError and text:
        return text
    return f"{type(err).__name__}{': ' + text if text else ''}"
