"""Time our reading of scan messages beside rosbags' own deserialisation of the same topic.

Run with ``python benchmarks/bags.py``. The two run in turn, each in a process of its own, on
bags that it writes: 1081 beams with intensities, and a transform and an odometry message for
each scan, which neither reads. Both make the same arrays, which is checked. ``--messages``
times transforms and poses in their place.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT))

from conversion.ros.bags import Bag  # noqa: E402
from conversion.ros.recording import RosRecording  # noqa: E402
from tests.conversion.recordings import KINDS, ODOMETRY, START_NS, TF, Recording  # noqa: E402

BEAMS = 1081
SCANS = 4000
BUDGET_S = 3.0
NAMES = {"ros1": "ROS 1", "db3": "sqlite3", "mcap": "MCAP"}
TOPICS = ("/scan", "/tf", "/odom")


def write_bag(kind: str, folder: Path) -> Path:
    """Write a drive at 40 Hz."""
    drive = Recording(kind)
    random = np.random.default_rng(0)
    ranges = random.uniform(0.1, 30, (64, BEAMS)).astype(np.float32)
    for n in range(SCANS):
        ns = START_NS + n * 25_000_000
        drive.add_scan(ns, ranges[n % 64], intensities=ranges[-(n % 64)], increment=0.00436)
        drive.add_tf(ns, "odom", "base_link", (0.01 * n, 0.0, 0.0))
        drive.add_pose(ns, (0.01 * n, 0.0, 0.0), topic="/odom", type_=ODOMETRY, frame="odom")
    return drive.write(folder, f"bag-{kind}")


def ours(path: Path, topic: str) -> Iterator[tuple]:
    with RosRecording(Bag(path)) as recording:
        topics = [known for known in recording.topics if known.name == topic]
        decode = {"/scan": recording.scan, "/tf": recording.transforms, "/odom": recording.pose}
        for message in recording.messages(topics):
            yield shown(decode[topic](message), topic)


def theirs(path: Path, topic: str) -> Iterator[tuple]:
    with AnyReader([path]) as reader:
        chosen = [connection for connection in reader.connections if connection.topic == topic]
        for connection, _, raw in reader.messages(chosen):
            yield shown_of(reader.deserialize(raw, connection.msgtype), topic)


def shown(found: object, topic: str) -> tuple:
    if topic == "/scan":
        return found.ranges, found.intensities
    return found[0].values if topic == "/tf" else found.values


def shown_of(message: object, topic: str) -> tuple:
    """The same numbers of an object of rosbags."""
    if topic == "/scan":
        return message.ranges, message.intensities
    if topic == "/tf":
        move = message.transforms[0].transform
        place, turn = move.translation, move.rotation
    else:
        place, turn = message.pose.pose.position, message.pose.pose.orientation
    return place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w


WAYS: dict[str, Callable[[Path, str], Iterator[tuple]]] = {"ours": ours, "rosbags": theirs}


def measure(way: str, path: Path, topic: str) -> None:
    """Print messages/s over whole passes; the first warms the file cache and compiles."""
    seconds, messages = 0.0, 0
    for attempt in range(10_000):
        start = time.perf_counter()
        count = sum(1 for _ in WAYS[way](path, topic))
        if attempt:
            seconds, messages = seconds + time.perf_counter() - start, messages + count
        if seconds > BUDGET_S:
            break
    print(json.dumps(messages / seconds))


def check_same(path: Path, topic: str) -> None:
    for a, b in zip(ours(path, topic), theirs(path, topic), strict=True):
        if not all(np.array_equal(x, y) for x, y in zip(a, b, strict=True)):
            sys.exit(f"{path.name} {topic}: a message differs")


def compare(path: Path, topic: str, rounds: int) -> str:
    check_same(path, topic)
    rates: dict[str, list[float]] = {way: [] for way in WAYS}
    for _ in range(rounds):
        for way, found in rates.items():
            command = [sys.executable, __file__, "--way", way, "--bag", str(path)]
            command += ["--topic", topic]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            found.append(json.loads(done.stdout))
    middle = {way: statistics.median(found) for way, found in rates.items()}
    spread = " | ".join(" ".join(f"{one:,.0f}" for one in found) for found in rates.values())
    ratio = middle["ours"] / middle["rosbags"]
    return f"{middle['ours']:9,.0f} /s, {ratio:.2f}x of {middle['rosbags']:,.0f} /s ({spread})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--messages", action="store_true", help="time /tf and /odom too")
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)
    parser.add_argument("--bag", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--topic", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        measure(options.way, options.bag, options.topic)
        return
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    print(f"scans of {BEAMS} beams with intensities; {TF}, {ODOMETRY} beside them")
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as name:
            path = write_bag(kind, Path(name))
            for topic in TOPICS if options.messages else TOPICS[:1]:
                print(f"{NAMES[kind]:8} {topic:6} {compare(path, topic, options.rounds)}")


if __name__ == "__main__":
    main()
