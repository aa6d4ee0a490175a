"""Bring streams of messages into one order of time, opening each no sooner than it is needed."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from conversion.messages.recordings import Message

_NEVER_NS = 2**64


class Stream(NamedTuple):
    """Messages in the order of time, to be opened when their time has come.

    Parameters
    ----------
    start_ns
        No message of it was recorded before.
    open
        Begins to read it.
    """

    start_ns: int
    open: Callable[[], Iterator[Message]]


def merge(streams: Iterable[Stream]) -> Iterator[Message]:
    """Yield the messages of all streams by time; of those at one time, in the order of streams.

    Only streams that overlap in time are open at once: what they hold is what lies in memory.
    """
    streams = tuple(streams)
    if len(streams) == 1:
        yield from streams[0].open()
        return
    waiting = sorted(enumerate(streams), key=lambda item: -item[1].start_ns)
    heads: list[tuple[int, int, Message, Iterator[Message]]] = []
    while waiting or heads:
        while waiting and (not heads or waiting[-1][1].start_ns <= heads[0][0]):
            number, stream = waiting.pop()
            rest = stream.open()
            for message in rest:
                heapq.heappush(heads, (message.record_ns, number, message, rest))
                break
        if not heads:
            continue
        _, number, message, rest = heapq.heappop(heads)
        yield message
        until_ns = heads[0][0] if heads else _NEVER_NS
        if waiting:
            until_ns = min(until_ns, waiting[-1][1].start_ns)
        for message in rest:  # mostly one stream goes on for long
            if message.record_ns >= until_ns:
                heapq.heappush(heads, (message.record_ns, number, message, rest))
                break
            yield message
