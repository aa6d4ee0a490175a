from __future__ import annotations

import os
import shutil
import sqlite3
import zipfile
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from conversion.messages.recordings import Message
from conversion.ros.bags import Bag, bags_in
from conversion.ros.recording import RosRecording
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from tests.conversion.recordings import (
    CUSTOM,
    KINDS,
    LASER,
    OLD_TF,
    START_NS,
    TF,
    Recording,
    add_checksums,
    storage_of,
    straight_drive,
)

TENTH = 100_000_000


def messages_of(paths, **options) -> list[Message]:
    with Bag(paths, **options) as bag:
        return list(bag.messages(bag.topics))


def ranges_of(paths) -> np.ndarray:
    with RosRecording(Bag(paths)) as recording:
        messages = recording.messages(recording.scan_topics)
        return np.stack([recording.scan(message).ranges for message in messages])


def refusal(paths, **options) -> str:
    with pytest.raises(RecordingError) as caught:
        messages_of(paths, **options)
    return str(caught.value)


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


WAYS_TO_WRITE = [
    ("ros1", None), ("ros1", "lz4"), ("ros1", "bz2"),
    ("db3", None), ("db3", "file"), ("db3", "message"),
    ("mcap", None), ("mcap", "file"), ("mcap", "message"), ("mcap", "storage"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "compression"), WAYS_TO_WRITE)
def test_every_message_is_the_one_that_rosbags_reads(kind, compression, tmp_path):
    drive = straight_drive(kind, scans=200)
    path = drive.write(tmp_path, compression=compression, chunk=5000)
    with AnyReader([path]) as reader:
        expected = [(c.topic, c.msgtype, ns, bytes(raw)) for c, ns, raw in reader.messages()]
    found = messages_of(path)
    assert len(found) == 402
    assert sorted(map(tuple, found)) == sorted(expected)
    assert [message.record_ns for message in found] == [ns for _, _, ns, _ in expected]


@pytest.mark.parametrize(("kind", "compression"), [w for w in WAYS_TO_WRITE if w[0] != "ros1"])
def test_a_bare_storage_file_reads_like_its_folder(kind, compression, tmp_path):
    folder = straight_drive(kind).write(tmp_path, compression=compression)
    bare = shutil.copy(storage_of(folder), tmp_path)
    np.testing.assert_array_equal(ranges_of(bare), ranges_of(folder))
    np.testing.assert_array_equal(ranges_of(storage_of(folder)), ranges_of(folder))
    (folder / "metadata.yaml").unlink()
    np.testing.assert_array_equal(ranges_of(folder), ranges_of(bare))


def test_the_metadata_of_a_folder_can_be_given_in_its_place(tmp_path):
    folder = straight_drive("mcap").write(tmp_path)
    assert messages_of(folder / "metadata.yaml") == messages_of(folder)


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
@pytest.mark.parametrize("name", ["drive.bag.active", "a b?c#d%41.x", "ü", "-.db3", "x.mcap"])
def test_the_name_of_a_file_does_not_matter(kind, name, tmp_path):
    file = storage_of(straight_drive(kind).write(tmp_path))
    folder = tmp_path / "50 % of #1?"
    folder.mkdir()
    renamed = file.rename(folder / name)
    assert len(messages_of(renamed)) == 26


def test_a_folder_with_signs_of_a_uri_is_read(tmp_path):
    folder = straight_drive("db3").write(tmp_path)
    renamed = folder.rename(tmp_path / "drive?mode=memory#1 %20")
    assert len(messages_of(renamed)) == 26


def test_a_relative_path_is_read(tmp_path, monkeypatch):
    straight_drive("db3").write(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert len(messages_of("drive")) == 26
    monkeypatch.chdir(tmp_path / "drive")
    assert len(messages_of(Path("drive.db3"))) == 26


def write_parts(kind: str, folder: Path, name="drive_{}") -> list[Path]:
    """Three files of one recording: the second begins before the first ends."""
    paths = []
    for part, times in enumerate(((0, 1, 2, 4), (3, 5, 6), (7, 8, 9))):
        drive = Recording(kind)
        for n in times:
            drive.add_scan(START_NS + n, [1.0 * n] * 8)
        paths.append(storage_of(drive.write(folder, name.format(part))))
    return paths


@pytest.mark.parametrize("kind", KINDS)
def test_several_files_of_one_recording_are_one(kind, tmp_path):
    parts = write_parts(kind, tmp_path)
    found = messages_of(parts[::-1])
    assert [message.record_ns - START_NS for message in found] == list(range(10))
    with Bag(parts) as bag:
        assert [topic.messages for topic in bag.topics] == [10]
        assert bag.files() == parts
        assert bag.path == parts[0]
        late = [m.record_ns - START_NS for m in bag.messages(bag.topics, START_NS + 4)]
    assert late == [4, 5, 6, 7, 8, 9]


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_folder_without_metadata_whose_files_go_on_is_one_recording(kind, tmp_path):
    folder = tmp_path / "rec"
    folder.mkdir()
    for part, path in enumerate(write_parts(kind, tmp_path)):
        path.rename(folder / f"rec_{part + 8}.{kind}")  # 8, 9, 10: sorted as numbers
    with Bag(folder) as bag:
        assert [path.name for path in bag.files()] == [f"rec_{n}.{kind}" for n in (8, 9, 10)]
        assert len(list(bag.messages(bag.topics))) == 10
        (notice,) = bag.notices
    assert notice.startswith(f"3 files taken as one recording: rec_8.{kind}, rec_9.{kind}, rec_10")


def test_a_folder_with_metadata_of_several_files_is_read_by_time(tmp_path):
    parts = write_parts("db3", tmp_path)
    folder = parts[0].parent
    for path in parts[1:]:
        path.rename(folder / path.name)
    described = (folder / "metadata.yaml").read_text()
    listed = "\n  - ".join(["relative_file_paths:", *(path.name for path in parts)])
    described = described.replace("relative_file_paths:\n  - drive_0.db3", listed)
    (folder / "metadata.yaml").write_text(described)
    found = messages_of(folder)
    assert [message.record_ns - START_NS for message in found] == list(range(10))
    with Bag(folder) as bag:
        assert bag.files() == [*(folder / path.name for path in parts), folder / "metadata.yaml"]
        assert bag.notices == ()
    (folder / "drive_1.db3").unlink()
    assert "names files that are not there: drive_1.db3" in refusal(folder)


def test_of_several_files_the_damaged_one_is_named(tmp_path):
    parts = write_parts("ros1", tmp_path)
    data = bytearray(parts[1].read_bytes())
    data[data.index(b"op=\x02") + 3] = 9
    parts[1].write_bytes(data)
    assert f"{parts[1]}: is damaged after 3 messages, the last of /scan at 17" in refusal(parts)


def test_one_file_cannot_be_given_twice(tmp_path):
    path = straight_drive("ros1").write(tmp_path)
    link = tmp_path / "link.bag"
    link.symlink_to(path)
    assert f"{link}: is given twice" in refusal([path, link])


def test_bags_of_both_ros_are_no_recording(tmp_path):
    paths = [straight_drive(kind).write(tmp_path, kind) for kind in ("ros1", "db3")]
    assert "is a bag of another ROS than ros1.bag" in refusal(paths)


def test_the_recordings_of_a_folder_are_listed(tmp_path):
    for name in ("a.bag", "b_0.db3", "b_2.db3", "b_10.db3", "c_0.mcap", "c_0.db3.zstd", "d.txt"):
        (tmp_path / name).touch()
    for name in ("one", "two", ".hidden", "one/deeper"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "z.mcap").touch()
    (tmp_path / "two" / "metadata.yaml").touch()
    (tmp_path / "e.bag").mkdir()
    found = [[str(p.relative_to(tmp_path)) for p in bag] for bag in bags_in(tmp_path)]
    assert found == [
        ["a.bag"], ["b_0.db3", "b_2.db3", "b_10.db3"], ["c_0.db3.zstd"], ["c_0.mcap"],
        ["one/z.mcap"], ["two"],
    ]  # fmt: skip
    assert bags_in(tmp_path / "two") == [[tmp_path / "two"]]
    assert bags_in(tmp_path / "e.bag") == []


def test_a_folder_of_several_recordings_is_refused_and_names_them(tmp_path):
    assert "it holds no bag" in refusal(tmp_path)
    straight_drive("ros1").write(tmp_path)
    assert len(messages_of(tmp_path)) == 26  # the only one
    straight_drive("ros1").write(tmp_path, "other")
    assert "give one of its bags: drive.bag, other.bag" in refusal(tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_come_in_the_order_of_recording(kind, tmp_path):
    drive = Recording(kind)
    for n in (2, 0, 1):
        drive.add_scan(START_NS, [1.0] * 8, record_ns=START_NS + n)
    times = [m.record_ns - START_NS for m in messages_of(drive.write(tmp_path))]
    assert times == [0, 1, 2]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_reading_goes_on_in_the_middle_as_it_went_before(kind, seed, tmp_path):
    """Chunks overlap, and many messages have one time."""
    random = np.random.default_rng(seed)
    drive = Recording(kind)
    for n in range(300):
        late = int(random.integers(0, 40))
        drive.add_scan(n, [1.0], record_ns=START_NS + n // 10 + late, topic=f"/{n % 3}")
    with Bag(drive.write(tmp_path, chunk=700)) as bag:
        whole = list(bag.messages(bag.topics))
        times = [message.record_ns for message in whole]
        assert times == sorted(times)
        for start in (1, START_NS, *random.choice(times, 8).tolist(), times[-1] + 1):
            expected = [message for message in whole if message.record_ns >= start]
            assert list(bag.messages(bag.topics, start)) == expected
            one = [t for t in bag.topics if t.name == "/1"]
            assert list(bag.messages(one, start)) == [m for m in expected if m.topic == "/1"]


@pytest.mark.parametrize("kind", KINDS)
def test_two_passes_at_once_do_not_disturb_each_other(kind, tmp_path):
    with Bag(straight_drive(kind, scans=100).write(tmp_path, chunk=3000)) as bag:
        alone = list(bag.messages(bag.topics))
        both = list(zip(bag.messages(bag.topics), bag.messages(bag.topics), strict=True))
    assert both == [(message, message) for message in alone]


@pytest.mark.parametrize("kind", KINDS)
def test_no_topics_give_no_messages(kind, tmp_path):
    with Bag(straight_drive(kind).write(tmp_path)) as bag:
        assert list(bag.messages(())) == []


@pytest.mark.parametrize("kind", KINDS)
def test_an_empty_bag_has_no_topics(kind, tmp_path):
    with Bag(Recording(kind).write(tmp_path)) as bag:
        assert bag.topics == ()
        assert list(bag.messages(bag.topics)) == []


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
        assert "std_msgs/msg/Header" in bag.fields_of(CUSTOM)


@pytest.mark.parametrize(
    ("garbled", "why"),
    [
        (b"float32[[ f?rce", "TypesysError: Could not parse"),
        (b"Nothing[] force", "lacks that of my_robot/msg/Nothing"),
        (b"Bumper[9]  force", "RecursionError"),
    ],
)
def test_a_broken_definition_is_named_and_spoils_nothing_else(garbled, why, tmp_path):
    drive = straight_drive("db3")
    drive.add("/bumper", drive.new(CUSTOM, header=drive.header(0, "b"), force=np.zeros(1, "f4")), 5)
    file = storage_of(drive.write(tmp_path))
    data = file.read_bytes()
    assert b"float32[] force" in data
    file.write_bytes(data.replace(b"float32[] force", garbled[:15].ljust(15)))
    with Bag(file) as bag:
        (message,) = bag.messages(bag.of_type((CUSTOM,)))
        with pytest.raises(RecordingError) as caught:
            bag.read(message, str)
    text = str(caught.value)
    assert "/bumper: the message at 0.000 s is no readable my_robot/msg/Bumper" in text
    assert why in text
    assert len(ranges_of(file)) == 12


def test_the_old_type_of_tf_is_read_as_the_new_one(tmp_path):
    found = []
    for type_ in (TF, OLD_TF):
        drive = Recording("ros1")
        drive.add_tf(START_NS, "map", "base", (1.0, 2.0, 0.0), (0.0, 0.0, 0.3), type_=type_)
        path = drive.write(tmp_path, type_.replace("/", "-"))
        with RosRecording(Bag(path)) as recording:
            assert recording.bag.is_standard(type_)
            (message,) = recording.messages(recording.transform_topics)
            found.append(recording.transforms(message))
            assert recording.parse_transforms(message) == found[-1]
    assert found[0] == found[1]


def without_definitions(folder: Path, drive: Recording, distro: str | None = None) -> Path:
    """A bag as Humble and its elders write it: sqlite3 without definitions."""
    path = drive.write(folder)
    with sqlite3.connect(storage_of(path)) as database:
        database.execute("UPDATE schema SET schema_version = 3")
        database.execute("DROP TABLE message_definitions")
    database.close()
    if distro is not None:
        text = (path / "metadata.yaml").read_text()
        assert "ros_distro: rosbags" in text
        (path / "metadata.yaml").write_text(text.replace("distro: rosbags", f"distro: {distro}"))
    return path


def test_a_bag_without_definitions_is_read_by_those_of_humble(tmp_path):
    path = without_definitions(tmp_path, straight_drive("db3"))
    assert len(ranges_of(path)) == 12
    with Bag(path) as bag:
        (notice,) = bag.notices
        assert bag.is_standard(LASER)
    assert "2 of its types nowhere: those of ROS humble are used; --distro names" in notice


@pytest.mark.parametrize(("told", "given", "used"), [
    ("jazzy", None, "jazzy"), ("jazzy", "foxy", "foxy"), ("rolling", None, "humble"),
    (None, "Galactic", "galactic"),
])  # fmt: skip
def test_the_release_is_told_or_given(told, given, used, tmp_path):
    drive = straight_drive("db3")
    drive.add("/bumper", drive.new(CUSTOM, header=drive.header(0, "b"), force=np.zeros(1, "f4")), 5)
    path = without_definitions(tmp_path, drive, told)
    with Bag(path, distro=given) as bag:
        (message,) = bag.messages(bag.of_type((CUSTOM,)))
        with pytest.raises(RecordingError, match=f"neither the bag nor ROS {used} defines my_rob"):
            bag.read(message, str)


@pytest.mark.parametrize("kind", KINDS)
def test_an_unknown_release_is_refused_with_those_known(kind, tmp_path):
    path = straight_drive(kind).write(tmp_path)
    known = "noetic for a bag of ROS 1" if kind == "ros1" else "dashing, .*, humble, .*jazzy.*ROS 2"
    with pytest.raises(InvalidInputError, match=f"expected one of {known}, found 'melodious'"):
        Bag(path, distro="melodious")


def test_a_missing_recording_is_file_not_found(tmp_path):
    with pytest.raises(FileNotFoundError):
        Bag(tmp_path / "none.bag")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_bag_without_permission_is_a_permission_error(tmp_path):
    path = straight_drive("ros1").write(tmp_path)
    path.chmod(0)
    with pytest.raises(PermissionError):
        Bag(path)


REFUSED = {
    "empty.bag": (b"", "the file is empty"),
    "text.bag": (
        b"hello, this is no bag at all",
        "not a ROS bag, nor any other recording: expected a ROS 1 .bag",
    ),
    "short.bag": (b"#ROS", "not a ROS bag"),
    "old.bag": (b"#ROSRECORD V1.2\n0000", r"found '#ROSRECORD V1.2': convert it with ROS 1"),
    "older.bag": (b"#ROSBAG V1.1\n0000", r"version 2.0, found '#ROSBAG V1.1'"),
    "magic.bag": (b"#ROSBAG V2.0\n", "cannot be opened as a bag: the file ends within a record"),
    "gzip.bag": (b"\x1f\x8b\x08\x00", "gzip data: decompress it"),
    "bag.db3": (b"\x89MCAP0\r\n" + bytes(40), "cannot be opened as a bag"),
    "bag.mcap": (b"\x89MCAP0\r\n" + bytes(40), "cannot be opened as a bag"),
    "sql.db3": (b"SQLite format 3\x00" + bytes(99), "cannot be opened as a bag"),
    "drive.db3.zstd": (b"\x28\xb5\x2f\xfd1234", "cannot be opened as a bag: ZstdError"),
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
    assert "a zip archive: unpack it" in refusal(tmp_path / "drive.bag.zip")


def test_a_bag_whose_recorder_was_killed_names_what_it_holds(tmp_path):
    path = straight_drive("ros1", scans=40).write(tmp_path, chunk=3000)
    data = path.read_bytes()
    at = data.index(b"index_pos=") + 10
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    text = refusal(path)
    assert "the bag has no index" in text
    assert "82 messages can be read, the last of /scan at 1700000003.950 s" in text
    assert "rosbag reindex drive.bag" in text


CUT = {"ros1": "rosbag reindex", "db3": r"sqlite3 .* \.recover", "mcap": "mcap recover"}


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_cut_short_names_what_it_holds_and_what_repairs_it(kind, tmp_path):
    drive = Recording(kind)
    for n in range(400):
        drive.add_scan(START_NS + n * TENTH, np.arange(1000.0))
    file = storage_of(drive.write(tmp_path))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 9 // 10])
    with pytest.raises(RecordingError, match=CUT[kind]) as caught:
        Bag(file)
    words = str(caught.value).split(" messages can be read, the last of /scan at ")
    count = int(words[0].split()[-1])
    assert 200 < count < 400
    assert words[1].startswith(f"{1_700_000_000 + (count - 1) / 10:.3f} s")


@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
def test_a_database_with_messages_in_its_journal_is_refused(suffix, tmp_path):
    file = storage_of(straight_drive("db3").write(tmp_path))
    file.with_name(file.name + suffix).write_bytes(b"messages")
    assert "holds messages; put them into it with: sqlite3 drive.db3" in refusal(file)


def test_the_checksum_of_an_mcap_summary_counts(tmp_path):
    file = storage_of(straight_drive("mcap").write(tmp_path))
    add_checksums(file)
    assert len(messages_of(file)) == 26
    data = file.read_bytes()
    at = data.rindex(b"offered_qos_profiles")
    file.write_bytes(data[:at] + b"O" + data[at + 1 :])
    assert "its summary does not fit its checksum" in refusal(file)


BAD_METADATA = ["", "[", "7", "rosbag2_bagfile_information: 3", "a: &b [*b]", "\x00", "!!python/x"]


@pytest.mark.parametrize("text", BAD_METADATA)
def test_metadata_that_is_none_is_refused(text, tmp_path):
    folder = straight_drive("db3").write(tmp_path)
    (folder / "metadata.yaml").write_text(text)
    assert "metadata.yaml: cannot be read as the metadata of a bag" in refusal(folder)
    assert "ros2 bag reindex" in refusal(folder)


def test_metadata_cannot_lead_out_of_its_folder(tmp_path):
    inner, outer = (straight_drive("db3").write(tmp_path, name) for name in ("inner", "outer"))
    text = (inner / "metadata.yaml").read_text()
    text = text.replace("- inner.db3", "- ../outer/outer.db3")
    (inner / "metadata.yaml").write_text(text)
    assert "names files that are not there: outer.db3" in refusal(inner)
    assert outer.exists()


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


def test_a_bag_that_lacks_messages_that_it_counted_is_refused(tmp_path):
    drive = Recording("mcap")
    for n in range(400):
        drive.add_scan(START_NS + n, np.arange(1000.0))
    file = storage_of(drive.write(tmp_path))
    data = bytearray(file.read_bytes())
    at = int.from_bytes(data[-28:-20], "little")  # the summary
    while data[at] != 0x08:  # to the index of a chunk
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    data[at] = 0x7F
    file.write_bytes(data)
    assert "expected 400 messages of the chosen topics" in refusal(file)
