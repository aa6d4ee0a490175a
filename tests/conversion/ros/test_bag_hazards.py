"""Of a damaged bag come the right arrays or a RecordingError; odd bags are read as they are."""

from __future__ import annotations

import multiprocessing
import random
import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import (
    KINDS,
    LASER,
    START_NS,
    STRING,
    TF,
    Recording,
    add_checksums,
    storage_of,
    straight_drive,
)

TENTH = 100_000_000
YEAR = 31_557_600 * 10**9

Content = dict[tuple[str, str], list[tuple]]


def content_of(path: Path) -> tuple[set, Content]:
    """The topics of a bag, and what its scans and transforms hold."""
    with RosRecording(Bag(path)) as recording:
        found: Content = {}
        for message in recording.messages((*recording.scan_topics, *recording.transform_topics)):
            if message.type == LASER:
                *about, ranges, intensities = recording.scan(message)
                values = (*about, ranges.tobytes(), intensities.tobytes())
            else:
                values = tuple(recording.transforms(message))
            found.setdefault(message[:2], []).append((message.record_ns, values))
        return {topic[:2] for topic in recording.topics}, found


def write_fragile(kind: str, folder: Path, scans: int = 30) -> Path:
    """A bag of several chunks or pages, an MCAP with the checksums that ROS 2 gives it."""
    file = storage_of(straight_drive(kind, scans).write(folder, chunk=1500))
    if kind == "mcap":
        add_checksums(file)
    return file


def borders(kind: str, data: bytes) -> Iterator[int]:
    """Where records begin: of ROS 1 and MCAP also those in a chunk, of SQLite its pages."""
    if kind == "db3":
        yield from range(0, len(data), 4096)
        return
    at = {"ros1": 13, "mcap": 8}[kind]
    while at < len(data) - 8:
        yield at
        if kind == "mcap":
            chunk = data[at] == 0x06
            at += 9 + (40 if chunk else int.from_bytes(data[at + 1 : at + 9], "little"))
        else:
            head = int.from_bytes(data[at : at + 4], "little")
            chunk = b"op=\x05" in data[at : at + 4 + head]
            size = int.from_bytes(data[at + 4 + head : at + 8 + head], "little")
            at += 8 + head + (0 if chunk else size)


def frame_of(kind: str, data: bytes, file: Path) -> list[int]:
    """Bytes that are no payload of messages: those no checksum guards in ROS 1 and SQLite."""
    if kind == "mcap":
        return list(range(len(data)))
    framing = np.ones(len(data), np.bool_)
    with Bag(file) as bag:
        for message in bag.messages(bag.topics):
            at = data.find(message.raw)
            framing[at : at + len(message.raw)] = at < 0
    return np.flatnonzero(framing).tolist()


def check(file: Path, data: bytes, topics: set, truth: Content) -> bool:
    """Tell whether a damaged bag is refused; fail where it gives anything but the truth."""
    file.write_bytes(data)
    try:
        found_topics, found = content_of(file)
    except RecordingError as err:
        return err.path == file
    for topic in topics & found_topics:  # a topic whose name is damaged is another topic
        assert found.get(topic) == truth.get(topic), topic
    return False


def flip(kind: str, folder: Path, seed: int, count: int, most: int = 1) -> int:
    """Flip bits; return how many bags were refused."""
    file = write_fragile(kind, folder)
    data, (topics, truth) = file.read_bytes(), content_of(file)
    frame, choose, refused = frame_of(kind, data, file), random.Random(seed), 0
    for _ in range(count):
        damaged = bytearray(data)
        for _ in range(choose.randint(1, most)):
            damaged[choose.choice(frame)] ^= 1 << choose.randrange(8)
        refused += check(file, bytes(damaged), topics, truth)
    return refused


def cut(kind: str, folder: Path, lengths: list[int]) -> None:
    file = write_fragile(kind, folder)
    data, (topics, truth) = file.read_bytes(), content_of(file)
    for length in lengths:
        assert check(file, data[:length], topics, truth)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_cut_at_a_record_border_is_refused(kind, tmp_path):
    (tmp_path / "0").mkdir()
    places = list(borders(kind, write_fragile(kind, tmp_path / "0").read_bytes()))
    assert len(places) > 5
    cut(kind, tmp_path, places[:: max(1, len(places) // 20)])


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_cut_anywhere_is_refused(kind, tmp_path):
    (tmp_path / "0").mkdir()
    size = write_fragile(kind, tmp_path / "0").stat().st_size
    choose = random.Random(2)
    cut(kind, tmp_path, [0, 1, size - 1, *(choose.randrange(size) for _ in range(15))])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(2))
def test_a_flipped_bit_gives_the_right_arrays_or_is_refused(kind, seed, tmp_path):
    assert flip(kind, tmp_path, seed, 20) > 0


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_flipped_anywhere_raise_nothing_but_recording_errors(kind, tmp_path):
    file = storage_of(straight_drive(kind, scans=3).write(tmp_path))
    data, choose, refused = file.read_bytes(), random.Random(5), 0
    for _ in range(25):
        damaged = bytearray(data)
        for _ in range(3):
            damaged[choose.randrange(len(data))] ^= 1 << choose.randrange(8)
        file.write_bytes(damaged)
        try:
            content_of(file)
        except RecordingError:
            refused += 1
    assert refused > 1


def fuzz(kind: str, folder: Path, seed: int) -> None:
    """Try thousands of damages in little memory, none for longer than seconds."""
    resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(900)
    folders = [folder / name for name in ("first", "one", "more", "cuts", "borders")]
    for each in folders:
        each.mkdir()
    file = write_fragile(kind, folders[0])
    data = file.read_bytes()
    places = list(borders(kind, data))
    flip(kind, folders[1], seed, 2500)
    flip(kind, folders[2], seed, 800, most=8 if kind == "mcap" else 1)
    choose = random.Random(seed)
    cut(kind, folders[3], [choose.randrange(len(data)) for _ in range(400)])
    cut(kind, folders[4], places + [place + 1 for place in places])


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [11, 12])
def test_thousands_of_damages_give_the_right_arrays_or_are_refused(kind, seed, tmp_path):
    child = multiprocessing.get_context("spawn").Process(target=fuzz, args=(kind, tmp_path, seed))
    child.start()
    child.join()
    assert child.exitcode == 0


DENORMAL = np.array([1, 0x007FFFFF, 0x80000001, 0x00400000, 0, 0x80000000], np.uint32)


@pytest.mark.parametrize("kind", KINDS)
def test_denormal_intensities_keep_their_bits(kind, tmp_path):
    drive = Recording(kind)
    values = DENORMAL.view(np.float32)
    drive.add_scan(START_NS, values, intensities=values[::-1])
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        (message,) = recording.messages(recording.scan_topics)
        for scan in (recording.scan(message), recording.parse_scan(message)):
            assert scan.ranges.view(np.uint32).tolist() == DENORMAL.tolist()
            assert scan.intensities.view(np.uint32).tolist() == DENORMAL[::-1].tolist()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lead", [-YEAR, YEAR])
def test_header_stamps_a_year_from_record_times_are_both_kept(kind, lead, tmp_path):
    drive = Recording(kind)
    for n in range(5):
        record_ns = START_NS + n * TENTH
        drive.add_scan(record_ns + lead, [1.0] * 8, record_ns=record_ns)
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        messages = list(recording.messages(recording.scan_topics))
        stamps = [recording.scan(message).stamp_ns for message in messages]
    assert [message.record_ns for message in messages] == [START_NS + n * TENTH for n in range(5)]
    assert stamps == [START_NS + n * TENTH + lead for n in range(5)]


@pytest.mark.parametrize("kind", KINDS)
def test_three_lidars_are_three_topics(kind, tmp_path):
    drive = Recording(kind)
    for n in range(30):
        drive.add_scan(START_NS + n, [1.0 * n] * (n % 3 + 5), topic=f"/lidar{n % 3}/scan")
    with RosRecording(Bag(drive.write(tmp_path))) as recording:
        assert [topic.messages for topic in recording.scan_topics] == [10, 10, 10]
        for number, topic in enumerate(recording.scan_topics):
            scans = [recording.scan(message) for message in recording.messages([topic])]
            assert {len(scan.ranges) for scan in scans} == {number + 5}
            assert [scan.ranges[0] for scan in scans] == list(range(number, 30, 3))


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_without_tf_has_its_scans(kind, tmp_path):
    path = straight_drive(kind, with_tf=False).write(tmp_path)
    topics, found = content_of(path)
    assert topics == {("/scan", LASER)}
    assert len(found["/scan", LASER]) == 12


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_without_scans_has_its_other_topics(kind, tmp_path):
    drive = Recording(kind)
    drive.add_tf(START_NS, "map", "odom", (0.0, 0.0, 0.0))
    drive.add("/talk", drive.new(STRING, data="hello"), START_NS)
    topics, found = content_of(drive.write(tmp_path))
    assert topics == {("/talk", STRING), ("/tf", TF)}
    assert list(found) == [("/tf", TF)]


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_bag_is_empty(kind, tmp_path):
    assert content_of(Recording(kind).write(tmp_path)) == (set(), {})
