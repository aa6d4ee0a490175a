from __future__ import annotations

import hashlib
import random
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from conversion.bags import Bag
from conversion.blocks import read_blocks
from conversion.plan import Options, make_plan
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import CUSTOM, KINDS, LASER, START_NS, Recording, straight_drive


def storage_of(path: Path) -> Path:
    """The file that holds the messages of a bag."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


def ranges_of(path: Path) -> np.ndarray:
    with Bag(path) as bag:
        plan = make_plan(bag, Options())
        return np.concatenate([block["scans/ranges"] for block in read_blocks(bag, plan)])


@pytest.mark.parametrize("kind", KINDS)
def test_topics_and_their_counts_are_listed(kind, tmp_path):
    path = straight_drive(kind, scans=5).write(tmp_path)
    with Bag(path) as bag:
        found = {
            topic.name: (topic.type.rsplit("/", 1)[-1], topic.messages) for topic in bag.topics
        }
    assert found == {
        "/scan": ("LaserScan", 5), "/tf": ("TFMessage", 5), "/tf_static": ("TFMessage", 2),
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_bare_storage_file_reads_like_its_folder(kind, tmp_path):
    folder = straight_drive(kind).write(tmp_path)
    bare = shutil.copy(storage_of(folder), tmp_path)
    np.testing.assert_array_equal(ranges_of(Path(bare)), ranges_of(folder))


def test_a_bag_of_ros1_needs_no_suffix(tmp_path):
    path = straight_drive("ros1").write(tmp_path)
    renamed = path.rename(tmp_path / "drive.bag.active")
    assert len(ranges_of(renamed)) == 12


@pytest.mark.parametrize("kind", KINDS)
def test_messages_come_in_the_order_of_recording(kind, tmp_path):
    drive = Recording(kind)
    for n in (2, 0, 1):
        drive.add_scan(START_NS, [1.0] * 8, record_ns=START_NS + n)
    with Bag(drive.write(tmp_path)) as bag:
        times = [message.record_ns - START_NS for message in bag.messages(bag.topics)]
    assert times == [0, 1, 2]


@pytest.mark.parametrize("kind", KINDS)
def test_no_topics_give_no_messages(kind, tmp_path):
    with Bag(straight_drive(kind).write(tmp_path)) as bag:
        assert list(bag.messages(())) == []


@pytest.mark.parametrize("kind", KINDS)
def test_custom_types_are_read_by_the_definitions_of_the_bag(kind, tmp_path):
    drive = straight_drive(kind)
    force = np.array([0.5, 2.0], np.float32)
    drive.add(
        "/bumper", drive.new(CUSTOM, header=drive.header(START_NS, "b"), force=force), START_NS
    )
    with Bag(drive.write(tmp_path)) as bag:
        (message,) = bag.messages(bag.of_type((CUSTOM,)))
        np.testing.assert_array_equal(bag.read(message, lambda m: m.force), force)


def test_a_custom_type_with_a_broken_definition_spoils_nothing_else(tmp_path):
    drive = straight_drive("db3")
    drive.add("/bumper", drive.new(CUSTOM, header=drive.header(0, "b"), force=np.zeros(1, "f4")), 5)
    file = storage_of(drive.write(tmp_path))
    data = file.read_bytes()
    assert b"float32[] force" in data
    file.write_bytes(data.replace(b"float32[] force", b"float32[[ f?rce"))
    with Bag(file) as bag:
        (message,) = bag.messages(bag.of_type((CUSTOM,)))
        with pytest.raises(
            RecordingError, match=r"/bumper: the message at 0\.000 s is no readable"
        ):
            bag.read(message, str)
    assert len(ranges_of(file)) == 12


def test_sources_carry_the_digest_of_every_file(tmp_path):
    folder = straight_drive("db3").write(tmp_path)
    with Bag(folder) as bag:
        found = {source["name"]: source for source in bag.sources()}
    assert set(found) == {"drive.db3", "metadata.yaml"}
    data = (folder / "drive.db3").read_bytes()
    assert found["drive.db3"]["sha256"] == hashlib.sha256(data).hexdigest()
    assert found["drive.db3"]["bytes"] == len(data)


def test_a_missing_recording_is_file_not_found(tmp_path):
    with pytest.raises(FileNotFoundError):
        Bag(tmp_path / "none.bag")


REFUSED = {
    "empty.bag": (b"", "the file is empty"),
    "text.bag": (b"hello, this is no bag at all", "not a ROS bag: expected a ROS 1 .bag"),
    "short.bag": (b"#ROS", "not a ROS bag"),
    "old.bag": (b"#ROSRECORD V1.2\n0000", r"found '#ROSRECORD V1.2': convert it with ROS 1"),
    "older.bag": (b"#ROSBAG V1.1\n0000", r"version 2.0, found '#ROSBAG V1.1'"),
    "magic.bag": (b"#ROSBAG V2.0\n", "cannot be opened as a bag: ReaderError"),
    "gzip.bag": (b"\x1f\x8b\x08\x00", "gzip data: decompress it"),
    "bag.db3": (b"\x89MCAP0\r\n" + bytes(40), "name must end with .mcap: rename it"),
    "bag.mcap": (b"\x89MCAP0\r\n" + bytes(40), "cannot be opened as a bag"),
    "sql.db3": (b"SQLite format 3\x00" + bytes(99), "cannot be opened as a bag"),
    "drive.db3.zstd": (b"\x28\xb5\x2f\xfd1234", "zstd data: give the folder"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_bag_is_refused_with_a_way_on(name, tmp_path):
    data, message = REFUSED[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(RecordingError, match=message) as caught:
        Bag(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name))


def test_a_zipped_bag_is_refused_with_a_hint(tmp_path):
    bag = straight_drive("ros1").write(tmp_path)
    with zipfile.ZipFile(tmp_path / "drive.bag.zip", "w") as archive:
        archive.write(bag, bag.name)
    with pytest.raises(RecordingError, match="a zip archive: unpack it"):
        Bag(tmp_path / "drive.bag.zip")


def test_a_folder_without_metadata_is_refused_and_names_its_bags(tmp_path):
    with pytest.raises(RecordingError, match="it holds no bag"):
        Bag(tmp_path)
    straight_drive("ros1").write(tmp_path)
    with pytest.raises(RecordingError, match=r"give one of its bags: drive\.bag"):
        Bag(tmp_path)


BAD_METADATA = ["", "[", "7", "rosbag2_bagfile_information: 3", "a: &b [*b]", "\x00"]


@pytest.mark.parametrize("text", BAD_METADATA)
def test_metadata_that_is_none_is_refused(text, tmp_path):
    folder = straight_drive("db3").write(tmp_path)
    (folder / "metadata.yaml").write_text(text)
    with pytest.raises(RecordingError, match="cannot be opened as a bag"):
        Bag(folder)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bare", [False, True])
def test_a_bag_truncated_anywhere_is_refused_or_read_right(kind, bare, tmp_path):
    path = straight_drive(kind).write(tmp_path)
    truth = ranges_of(path)
    file = storage_of(path)
    data = file.read_bytes()
    target = file if bare else path
    for length in np.linspace(0, len(data) - 1, 60).astype(int):
        file.write_bytes(data[:length])
        try:
            found = ranges_of(target)
        except RecordingError:
            continue
        np.testing.assert_array_equal(found, truth)


@pytest.mark.parametrize("kind", KINDS)
def test_flipped_bytes_raise_nothing_but_recording_errors(kind, tmp_path):
    path = straight_drive(kind, scans=3).write(tmp_path)
    file = storage_of(path)
    data = file.read_bytes()
    choose = random.Random(5)
    refused = 0
    for _ in range(60):
        damaged = bytearray(data)
        for _ in range(3):
            damaged[choose.randrange(len(data))] ^= 1 << choose.randrange(8)
        file.write_bytes(damaged)
        try:
            ranges_of(file)
        except RecordingError:
            refused += 1
    assert refused > 5


@pytest.mark.parametrize("kind", KINDS)
def test_a_message_cut_short_is_named_with_topic_and_time(kind, tmp_path):
    drive = straight_drive(kind, scans=2, with_tf=False)
    serialise = drive.store.serialize_ros1 if kind == "ros1" else drive.store.serialize_cdr
    scan = drive.messages[1][3]
    whole = bytes(serialise(scan, LASER))
    drive.store.serialize_ros1 = drive.store.serialize_cdr = lambda message, type_: (
        whole[:-9] if message is scan else serialise(message, type_)
    )
    path = drive.write(tmp_path)
    with pytest.raises(RecordingError, match=r"/scan: the message at 1700000000\.150 s is no read"):
        ranges_of(path)
