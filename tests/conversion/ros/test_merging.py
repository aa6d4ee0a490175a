from __future__ import annotations

from collections.abc import Iterator

from hypothesis import given
from hypothesis import strategies as st

from conversion.messages.recordings import Message
from conversion.ros.merging import Stream, merge

times = st.lists(st.integers(0, 20), max_size=8).map(sorted)


def message(number: int, record_ns: int, index: int) -> Message:
    return Message(f"/{number}", "t", record_ns, index)


@given(st.lists(st.tuples(times, st.integers(0, 3)), max_size=6))
def test_messages_come_by_time_and_of_one_time_by_stream(parts):
    streams, expected = [], []
    for number, (record_ns, early) in enumerate(parts):
        found = [message(number, ns, index) for index, ns in enumerate(record_ns)]
        start = found[0].record_ns - early if found else 0
        streams.append(Stream(start, lambda found=found: iter(found)))
        expected += found
    expected.sort(key=lambda m: (m.record_ns, int(m.topic[1:]), m.raw))
    assert list(merge(streams)) == expected


def test_streams_are_opened_when_their_time_has_come_and_dropped_at_their_end():
    open_now: set[int] = set()
    most = 0

    def stream(number: int) -> Iterator[Message]:
        nonlocal most
        open_now.add(number)
        most = max(most, len(open_now))
        yield from (message(number, 10 * number + k, k) for k in range(13))
        open_now.remove(number)

    found = merge(Stream(10 * n, lambda n=n: stream(n)) for n in range(50))
    next(found)
    assert open_now == {0}
    assert sum(1 for _ in found) == 50 * 13 - 1
    assert most == 2
    assert not open_now


def test_no_streams_have_no_messages():
    assert list(merge([])) == []
