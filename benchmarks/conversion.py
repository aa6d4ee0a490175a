"""Time ``semantic2d convert`` beside the compressor alone, and look at its memory.

Run with ``python benchmarks/conversion.py``; ``--large`` takes bags of 2 GB as well. Bags of ROS 1
and ROS 2 hold the Hokuyo's scans of semantic2d-mini (1081 beams, intensities) over and over, and
tf. The ways run in turn, each in a process of its own:

- convert: the whole command, from the start of Python to the complete sequence on disk;
- compressor: shuffle and zlib at the same level, of the same arrays in memory, on all cores given;
- packing: the same as the compressor, by the package's own chunks, which deflate planes apart;
- h5py: the same arrays from memory through HDF5's own filters, which take one thread.

A bag of a few scans shows how much of the command is its start; "no start" leaves that out.
Memory is the peak that the kernel counted for the command, and for the process that writes for it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import platform
import resource
import statistics
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semantic2d_dataset import load_dataset
from semantic2d_dataset.format.chunks import pack_in_order

KINDS = ("ROS 1", "ROS 2")
WAYS = ("convert", "compressor", "packing", "h5py")
ARRAYS = ("scans/ranges", "scans/intensities", "scans/stamps_ns", "poses/initial")
FEW_MB, SMALL_MB, LARGE_MB = 0.2, 20, 2000
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 50_000_000
CHUNK_ROWS, LEVEL, BLOCK = 64, 4, 4096
CORES = len(os.sched_getaffinity(0))
LASER, TF = "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage"


def write_bag(path: Path, kind: str, megabytes: float) -> None:
    """Write scans at 20 Hz and a pose for each; fast, by changing the bytes of two messages."""
    source = load_dataset("semantic2d-mini", lidar="hokuyo", features="RI", in_memory=True)
    fields, rows = source.source.fetch(np.arange(len(source)))
    scans = [(fields["ranges"][i].tobytes(), fields["intensities"][i].tobytes()) for i in rows]
    size = len(scans[0][0])
    store = typestore(kind)
    scan, tf = scan_message(kind, store, source.lidar), tf_message(kind, store, "odom", "base_link")
    with new_writer(kind, path) as writer:
        topics = {
            topic: writer.add_connection(topic, type_, typestore=store)
            for topic, type_ in {"/scan": LASER, "/tf": TF, "/tf_static": TF}.items()
        }
        for parent, child in (("map", "odom"), ("base_link", "laser")):
            writer.write(topics["/tf_static"], START_NS, tf_message(kind, store, parent, child))
        for i in range(round(megabytes * 1e6 / (2 * size))):
            ns = START_NS + i * PERIOD_NS
            stamp = divmod(ns, 10**9)
            struct.pack_into("<2I", tf, 8, *stamp)
            struct.pack_into("<d", tf, len(tf) - 56, 5 * math.sin(i / 200))
            writer.write(topics["/tf"], ns, tf)
            struct.pack_into("<2I", scan, 4, *stamp)
            scan[-2 * size - 4 : -size - 4], scan[-size:] = scans[i % len(scans)]
            writer.write(topics["/scan"], ns, scan)


def new_writer(kind: str, path: Path) -> Any:
    if kind == "ROS 1":
        return Writer1(path)
    return Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)


def typestore(kind: str) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if kind == "ROS 1" else Stores.ROS2_HUMBLE)
    if kind == "ROS 1":
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    return store


def serialise(kind: str, store: Any, message: Any, type_: str) -> bytearray:
    write = store.serialize_ros1 if kind == "ROS 1" else store.serialize_cdr
    return bytearray(write(message, type_))


def header(kind: str, store: Any, frame: str) -> Any:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    seq = {"seq": 0} if kind == "ROS 1" else {}
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **seq)


def scan_message(kind: str, store: Any, lidar: Any) -> bytearray:
    nothing = np.zeros(lidar.beams, np.float32)
    message = store.types[LASER](
        header=header(kind, store, "laser"),
        angle_min=lidar.angle_min,
        angle_max=lidar.angle_min + lidar.angle_increment * (lidar.beams - 1),
        angle_increment=lidar.angle_increment,
        time_increment=0.0,
        scan_time=PERIOD_NS / 1e9,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        ranges=nothing,
        intensities=nothing,
    )
    return serialise(kind, store, message, LASER)


def tf_message(kind: str, store: Any, parent: str, child: str) -> bytearray:
    types = store.types
    transform = types["geometry_msgs/msg/Transform"](
        translation=types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0),
        rotation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    stamped = types["geometry_msgs/msg/TransformStamped"](
        header=header(kind, store, parent), child_frame_id=child, transform=transform
    )
    return serialise(kind, store, types[TF](transforms=[stamped]), TF)


class Cost(NamedTuple):
    """Wall and processor time, s; the second says more where the machine is shared."""

    wall: float
    cpu: float


def convert(bag: Path, out: Path) -> Cost:
    """Run the command, and return what it and its writing process took."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(convert_command(bag, out), check=True, stdout=subprocess.DEVNULL)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(wall, cpu)


def convert_command(bag: Path, out: Path) -> list[str]:
    command = [sys.executable, "-m", "semantic2d_dataset.cli", "convert", str(bag)]
    return [*command, "--out", str(out), "--force"]


def peak_memory(bag: Path, out: Path) -> list[float]:
    """Run the command; return the peak MB of its process and of that which writes for it."""
    peaks: dict[int, float] = {}
    with subprocess.Popen(convert_command(bag, out), stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            for pid, status in statuses():
                if process.pid in (pid, int(status["PPid"])) and "VmHWM" in status:
                    peaks[pid] = int(status["VmHWM"].split()[0]) / 1024  # it only grows
            time.sleep(0.02)
    if process.returncode:
        sys.exit(f"{bag} was not converted")
    return list(peaks.values())


def statuses() -> Iterator[tuple[int, dict[str, str]]]:
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):  # it has just ended
                lines = (folder / "status").read_text().splitlines()
                yield (
                    int(folder.name),
                    dict(line.split(":\t", 1) for line in lines if ":\t" in line),
                )


def measure(way: str, file: Path) -> None:
    """Print what a way costs for the arrays of a sequence, from memory."""
    wall = cpu = 0.0
    with ThreadPoolExecutor(CORES) as pool, tempfile.TemporaryDirectory() as folder:
        plain = h5py.File(Path(folder) / "plain.h5", "w")
        for name, block in chain(blocks(file), [("", np.empty(0))]):
            began, used = time.perf_counter(), time.process_time()
            if not name:
                plain.close()
            elif way == "compressor":
                sum(pool.map(compress, (chunk for _, chunk in whole_chunks(block))))
            elif way == "packing":
                sum(len(packed) for _, packed in pack_in_order(whole_chunks(block)))
            else:
                append(plain, name, block)
            wall += time.perf_counter() - began
            cpu += time.process_time() - used
    print(json.dumps(Cost(wall, cpu)))


def blocks(file: Path) -> Iterator[tuple[str, np.ndarray]]:
    with h5py.File(file) as sequence:
        for name in ARRAYS:
            for start in range(0, len(sequence[name]), BLOCK):
                yield name, sequence[name][start : start + BLOCK]


def whole_chunks(block: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    for start in range(0, len(block), CHUNK_ROWS):
        yield start, block[start : start + CHUNK_ROWS]


def compress(chunk: np.ndarray) -> int:
    shuffled = np.ascontiguousarray(chunk.reshape(-1).view(np.uint8).reshape(-1, chunk.itemsize).T)
    return len(zlib.compress(shuffled.data, LEVEL))


def append(file: h5py.File, name: str, block: np.ndarray) -> None:
    if name not in file:
        file.create_dataset(
            name,
            data=block,
            maxshape=(None, *block.shape[1:]),
            chunks=(CHUNK_ROWS, *block.shape[1:]),
            compression=LEVEL,
            shuffle=True,
            fletcher32=True,
        )
        return
    file[name].resize(len(file[name]) + len(block), axis=0)
    file[name][-len(block) :] = block


def compare(kind: str, megabytes: float, rounds: int, start: Cost | None = None) -> Cost:
    """Convert a bag in turn with the other ways, print what was seen, and return the median.

    With the cost of a start, the command is shown without it too.
    """
    with tempfile.TemporaryDirectory() as name:
        bag, out = Path(name) / ("bag.bag" if kind == "ROS 1" else "bag"), Path(name) / "out.h5"
        write_bag(bag, kind, megabytes)
        peaks = peak_memory(bag, out)  # its sequence is what the other ways compress
        costs: dict[str, list[Cost]] = {way: [] for way in WAYS}
        for _ in range(rounds):
            costs["convert"].append(convert(bag, out))
            for way in WAYS[1:]:
                command = [sys.executable, __file__, "--way", way, "--file", str(out)]
                done = subprocess.run(command, check=True, capture_output=True, text=True)
                costs[way].append(Cost(*json.loads(done.stdout)))
    print(f"{kind}, {megabytes:g} MB; peak memory, MB: {' + '.join(f'{mb:.0f}' for mb in peaks)}")
    middle = {way: median(found) for way, found in costs.items()}
    if start:
        middle["no start"] = Cost(*(np.array(middle["convert"]) - start))
    for way, cost in middle.items():
        ratio = np.array(cost) / middle["compressor"]
        spread = " ".join(f"{one.wall:.2f}" for one in costs.get(way, ()))
        print(
            f"  {way:10} {cost.wall:8.2f} s, {ratio[0]:6.2f}x of the compressor; processors "
            f"{cost.cpu:8.2f} s, {ratio[1]:6.2f}x   ({spread})"
        )
    return middle["convert"]


def median(costs: list[Cost]) -> Cost:
    return Cost(*(statistics.median(values) for values in zip(*costs, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--large", action="store_true", help="bags of 2 GB as well")
    parser.add_argument("--way", choices=WAYS[1:], help=argparse.SUPPRESS)
    parser.add_argument("--file", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.way:
        measure(options.way, options.file)
        return
    print(f"{platform.machine()}, {CORES} cores, Python {platform.python_version()}")
    for kind in KINDS:
        start = compare(kind, FEW_MB, options.rounds)
        for megabytes in (SMALL_MB, LARGE_MB) if options.large else (SMALL_MB,):
            compare(kind, megabytes, options.rounds, start)


if __name__ == "__main__":
    main()
