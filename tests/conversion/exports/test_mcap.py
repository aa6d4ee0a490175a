"""Exports as ROS, RViz and Foxglove read them; read back here by plain rosbags."""

import math
import re
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from conversion.exports import mcap as mcap_export
from conversion.exports.mcap import export_mcap
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, WriteError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import rotation_matrix, to_points
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from tests.conftest import PROJECT
from tests.conversion.exports.sequences import (
    COLOURED,
    LIDAR,
    any_bits,
    full_arrays,
    random_map,
    write_sequence,
)

SCANS = 8
POINT = np.dtype(
    {
        "names": ["x", "y", "z", "rgb", "intensity", "label", "confidence"],
        "formats": ["<f4", "<f4", "<f4", "<u4", "<f4", "u1", "u1"],
        "offsets": [0, 4, 8, 12, 16, 20, 21],
        "itemsize": 24,
    }
)


def usual_arrays(scans=SCANS):
    """What a labelled sequence usually holds, its refined poses known in part."""
    rng = np.random.default_rng(8)
    arrays = full_arrays(rng, scans)
    poses = rng.normal(0, 2, (scans, 3))
    poses[2] = np.nan
    names = ("scans/", "commands/", "poses/initial")
    kept = {name: rows for name, rows in arrays.items() if name.startswith(names)}
    return kept | {"poses/refined": poses}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """The folder of an export `a.mcap` of a sequence `a.h5`, its arrays and its map."""
    folder = tmp_path_factory.mktemp("export")
    arrays, scene = usual_arrays(), random_map(np.random.default_rng(3))
    write_sequence(folder / "a.h5", arrays, scene=scene)
    export_mcap(folder / "a.h5", folder / "a.mcap")
    return folder, arrays, scene


def messages_of(path, topic):
    """Messages of a topic as plain rosbags reads them, by the definitions in the file."""
    with AnyReader([path]) as reader:
        chosen = [c for c in reader.connections if c.topic == topic]
        return [
            (stamp, reader.deserialize(raw, connection.msgtype))
            for connection, stamp, raw in (reader.messages(chosen) if chosen else ())
        ]


def stamp_of(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def rotation(q):
    return np.array(
        (
            (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y - q.w * q.z), 2 * (q.x * q.z + q.w * q.y)),
            (2 * (q.x * q.y + q.w * q.z), 1 - 2 * (q.x**2 + q.z**2), 2 * (q.y * q.z - q.w * q.x)),
            (2 * (q.x * q.z - q.w * q.y), 2 * (q.y * q.z + q.w * q.x), 1 - 2 * (q.x**2 + q.y**2)),
        )
    )


def test_scans_are_laser_scans_in_the_frame_of_the_lidar(exported):
    folder, arrays, _ = exported
    scans = [scan for _, scan in messages_of(folder / "a.mcap", "/scan")]
    assert [stamp_of(s.header) for s in scans] == arrays["scans/stamps_ns"].tolist()
    assert {s.header.frame_id for s in scans} == {"lidar"}
    for name, field in (("scans/ranges", "ranges"), ("scans/intensities", "intensities")):
        found = np.stack([getattr(scan, field) for scan in scans])
        assert found.tobytes() == arrays[name].tobytes()
    scan = scans[0]
    assert scan.angle_min == pytest.approx(LIDAR.angle_min)
    assert scan.angle_max == pytest.approx(LIDAR.bearings[-1])
    assert scan.angle_increment == pytest.approx(LIDAR.angle_increment)
    assert (scan.range_min, scan.range_max) == pytest.approx((0.1, 12.0))


def clouds_of(path):
    clouds = [cloud for _, cloud in messages_of(path, "/scan/labels")]
    return clouds, [np.frombuffer(cloud.data.tobytes(), POINT) for cloud in clouds]


def test_the_labelled_cloud_holds_the_points_of_the_beams(exported):
    folder, arrays, _ = exported
    clouds, points = clouds_of(folder / "a.mcap")
    returns = LIDAR.has_return(arrays["scans/ranges"])
    expected = to_points(np.where(returns, arrays["scans/ranges"], np.nan), LIDAR.bearings)
    assert returns.any()
    assert not returns.all()
    for i, (cloud, found) in enumerate(zip(clouds, points, strict=True)):
        assert (cloud.height, cloud.width, cloud.row_step) == (1, LIDAR.beams, 24 * LIDAR.beams)
        assert not cloud.is_dense
        assert not cloud.is_bigendian
        assert cloud.header.frame_id == "lidar"
        assert stamp_of(cloud.header) == arrays["scans/stamps_ns"][i]
        np.testing.assert_array_equal(found["x"], expected[i, :, 0].astype(np.float32))
        np.testing.assert_array_equal(found["y"], expected[i, :, 1].astype(np.float32))
        np.testing.assert_array_equal(found["z"], np.where(returns[i], 0, np.nan))
        np.testing.assert_array_equal(found["intensity"], arrays["scans/intensities"][i])
        np.testing.assert_array_equal(found["confidence"], arrays["scans/confidence"][i])
    with SequenceReader(folder / "a.h5") as reader:
        taken = reader.batch().valid
    np.testing.assert_array_equal(np.isfinite(np.stack([p["x"] for p in points])), taken)


def test_the_fields_of_the_cloud_are_what_rviz_and_foxglove_look_for(exported):
    clouds, _ = clouds_of(exported[0] / "a.mcap")
    found = [(f.name, f.offset, f.datatype, f.count) for f in clouds[0].fields]
    float32, uint8 = 7, 2  # constants of sensor_msgs/PointField
    assert found == [
        ("x", 0, float32, 1),
        ("y", 4, float32, 1),
        ("z", 8, float32, 1),
        ("rgb", 12, float32, 1),
        ("intensity", 16, float32, 1),
        ("label", 20, uint8, 1),
        ("confidence", 21, uint8, 1),
    ]


def test_points_have_the_colours_of_their_classes(exported):
    folder, arrays, _ = exported
    _, points = clouds_of(folder / "a.mcap")
    for found, labels in zip(points, arrays["scans/labels"], strict=True):
        np.testing.assert_array_equal(found["label"], labels)
        for label, packed in zip(labels.tolist(), found["rgb"].tolist(), strict=True):
            rgb = (packed >> 16 & 255, packed >> 8 & 255, packed & 255)
            assert rgb == ((235,) * 3 if label == 255 else SEMANTIC2D.colours[label])


def test_another_taxonomy_brings_its_own_colours(tmp_path):
    labels = np.array([[0, 1, 2] + [255] * 20], np.uint8)
    ranges = np.ones((1, 23), np.float32)
    arrays = {"scans/ranges": ranges, "scans/labels": labels, "scans/stamps_ns": np.zeros(1, "i8")}
    write_sequence(tmp_path / "a.h5", arrays, taxonomy=COLOURED)
    export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    clouds, (points,) = clouds_of(tmp_path / "a.mcap")
    assert [hex(value) for value in points["rgb"][:4]] == [
        "0x90807",
        "0xff8001",
        "0xff",
        "0xebebeb",
    ]
    assert [field.name for field in clouds[0].fields] == ["x", "y", "z", "rgb", "label"]
    assert not messages_of(tmp_path / "a.mcap", "/tf")
    assert not messages_of(tmp_path / "a.mcap", "/map")


def test_tf_carries_the_refined_poses_that_are_known(exported):
    folder, arrays, _ = exported
    found = [message.transforms[0] for _, message in messages_of(folder / "a.mcap", "/tf")]
    known = np.isfinite(arrays["poses/refined"]).all(axis=1)
    assert known.sum() == SCANS - 1
    assert [stamp_of(t.header) for t in found] == arrays["scans/stamps_ns"][known].tolist()
    for transform, (x, y, yaw) in zip(found, arrays["poses/refined"][known], strict=True):
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "base_link")
        move = transform.transform
        assert (move.translation.x, move.translation.y, move.translation.z) == (x, y, 0)
        np.testing.assert_allclose(rotation(move.rotation), rotation_matrix(0, 0, yaw), atol=1e-12)


def test_without_refined_poses_tf_carries_the_initial_ones(tmp_path):
    arrays = usual_arrays(3)
    del arrays["poses/refined"]
    arrays["poses/initial"] = np.arange(9.0).reshape(3, 3)
    write_sequence(tmp_path / "a.h5", arrays)
    export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    found = [message.transforms[0] for _, message in messages_of(tmp_path / "a.mcap", "/tf")]
    assert [t.transform.translation.x for t in found] == [0, 3, 6]


def test_the_mount_is_a_static_transform(exported):
    ((_, message),) = messages_of(exported[0] / "a.mcap", "/tf_static")
    (transform,) = message.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "lidar")
    place, expected = transform.transform.translation, LIDAR.base_T_lidar
    assert (place.x, place.y, place.z) == expected[:3]
    np.testing.assert_allclose(
        rotation(transform.transform.rotation), rotation_matrix(*expected[3:]), atol=1e-12
    )


def test_the_map_is_an_occupancy_grid(exported):
    folder, _, scene = exported
    ((_, grid),) = messages_of(folder / "a.mcap", "/map")
    assert (grid.info.width, grid.info.height) == (14, 9)
    cells = np.where(scene.occupancy == 255, -1, scene.occupancy.astype(int))
    np.testing.assert_array_equal(grid.data.reshape(9, 14), cells)
    assert grid.info.resolution == pytest.approx(scene.resolution)
    origin = grid.info.origin
    assert (origin.position.x, origin.position.y) == (scene.origin.x, scene.origin.y)
    assert origin.orientation.z == pytest.approx(math.sin(scene.origin.yaw / 2))
    assert grid.header.frame_id == "map"


def test_who_comes_late_still_gets_the_map_the_mount_and_the_head(exported):
    with Reader(exported[0] / "a.mcap") as reader:
        durability = {
            c.topic: [qos.durability for qos in c.ext.offered_qos_profiles]
            for c in reader.connections
        }
    latched = {"/map", "/tf_static", "/semantic2d/sequence"}
    for topic, found in durability.items():
        wanted = QosDurability.TRANSIENT_LOCAL if topic in latched else QosDurability.VOLATILE
        assert found == [wanted], topic
    assert latched < set(durability)


def test_quality_of_service_is_written_as_humble_reads_it(exported):
    """From rosbag2's version 9 on these are words, which Humble cannot read."""
    raw = (exported[0] / "a.mcap").read_bytes()
    assert b"durability: 1" in raw
    assert b"durability: transient_local" not in raw
    assert b"\nversion: 8" in raw


def test_every_topic_is_one_that_ros_2_allows(tmp_path):
    names = ("a b", "a-b", "9", "__", "über", "-")
    arrays = {f"original/{name}": np.zeros(2) for name in names}
    arrays |= {"scans/ranges": np.ones((2, 23), np.float32), "scans/stamps_ns": np.arange(2)}
    write_sequence(tmp_path / "a.h5", arrays | {"streams/2nd-odom/data": np.zeros((2, 3))})
    export = export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    with Reader(tmp_path / "a.mcap") as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert len(counts) == len(reader.connections) == 4 + len(names) + 1
    token = "[A-Za-z](_?[A-Za-z0-9])*"
    assert not [topic for topic in counts if not re.fullmatch(f"(/{token})+", topic)]
    assert dict(export.messages) == counts


def test_a_folder_is_written_with_its_metadata_where_the_name_is_no_file(exported, tmp_path):
    folder, _, _ = exported
    export = export_mcap(folder / "a.h5", tmp_path / "recording")
    assert export.path == tmp_path / "recording"
    assert {p.name for p in export.path.iterdir()} == {"recording.mcap", "metadata.yaml"}
    assert len(messages_of(tmp_path / "recording", "/scan")) == export.scans == SCANS
    metadata = (export.path / "metadata.yaml").read_text(encoding="utf-8")
    assert "- recording.mcap" in metadata
    assert "storage_identifier: mcap" in metadata
    assert list(tmp_path.iterdir()) == [export.path]
    assert (folder / "a.mcap").is_file()


def test_times_of_recording_always_increase(tmp_path):
    stamps = np.full(5, 1_700_000_000_000_000_000)
    arrays = {"scans/ranges": np.ones((5, 23), np.float32), "scans/stamps_ns": stamps}
    arrays["original/x"] = np.zeros((9000, 40))
    write_sequence(tmp_path / "a.h5", arrays)
    export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    for topic, count in (("/scan", 5), ("/semantic2d/original/x", 3)):
        logged = [stamp for stamp, _ in messages_of(tmp_path / "a.mcap", topic)]
        assert len(logged) == count
        assert (np.diff(logged) > 0).all()
    scans = [scan for _, scan in messages_of(tmp_path / "a.mcap", "/scan")]
    assert {stamp_of(scan.header) for scan in scans} == {int(stamps[0])}


def test_stamps_that_ros_2_cannot_hold_are_refused(tmp_path):
    for stamps in ([-1, 5], [0, 2**31 * 10**9]):
        arrays = {"scans/ranges": np.ones((2, 23), np.float32), "scans/stamps_ns": np.array(stamps)}
        write_sequence(tmp_path / "a.h5", arrays)
        with pytest.raises(InvalidInputError, match="none that ROS 2 can hold"):
            export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    assert {p.name for p in tmp_path.iterdir()} == {"a.h5"}


def test_what_exists_is_never_replaced(exported, tmp_path):
    sequence = exported[0] / "a.h5"
    (tmp_path / "file.mcap").write_text("mine")
    (tmp_path / "folder").mkdir()
    for name in ("file.mcap", "folder"):
        with pytest.raises(InvalidInputError, match=f"{name}: exists; give another name"):
            export_mcap(sequence, tmp_path / name)
    assert (tmp_path / "file.mcap").read_text() == "mine"


def test_names_that_cannot_be_used_are_refused(exported, tmp_path):
    with pytest.raises(WriteError, match="no-folder does not exist"):
        export_mcap(exported[0] / "a.h5", tmp_path / "no-folder" / "a.mcap")
    with pytest.raises(FileNotFoundError):
        export_mcap(tmp_path / "none.h5", tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def test_a_damaged_sequence_leaves_nothing(tmp_path):
    arrays = usual_arrays(2000)
    arrays["scans/ranges"] = any_bits(np.random.default_rng(1), (2000, 23), "<f4")
    path = write_sequence(tmp_path / "a.h5", arrays)
    raw = bytearray(path.read_bytes())
    with SequenceReader(path) as reader:
        chunk = reader._container._array("scans/ranges").id.get_chunk_info(25)
    raw[chunk.byte_offset + chunk.size // 2] ^= 1
    path.write_bytes(raw)
    with pytest.raises(CorruptFileError):
        export_mcap(path, tmp_path / "a.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_an_interrupted_export_leaves_nothing(exported, tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(mcap_export._Exporter, "_send_whole", interrupt)
    with pytest.raises(KeyboardInterrupt):
        export_mcap(exported[0] / "a.h5", tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_an_error_that_leaves_nothing(tmp_path):
    arrays = {"original/x": any_bits(np.random.default_rng(1), (4000, 100), "<f8")}
    arrays["scans/ranges"] = np.ones((1, 23), np.float32)
    write_sequence(tmp_path / "a.h5", arrays | {"scans/stamps_ns": np.zeros(1, np.int64)})
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, hard))
        with pytest.raises(WriteError, match=r"a\.mcap: could not be written: .*File too large"):
            export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_a_killed_export_leaves_nothing_under_its_name_and_a_rerun_succeeds(tmp_path):
    arrays = usual_arrays(6000)
    path, out = write_sequence(tmp_path / "a.h5", arrays), tmp_path / "a.mcap"
    code = "import sys; from pathlib import Path; from conversion.exports.mcap import export_mcap"
    code += "; export_mcap(Path(sys.argv[1]), Path(sys.argv[2]))"
    child = subprocess.Popen([sys.executable, "-c", code, path, out], cwd=PROJECT)
    try:
        deadline = time.monotonic() + 60
        while not any(p.stat().st_size > 10_000 for p in tmp_path.rglob(".*/a/*.mcap")):
            assert child.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.002)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert child.returncode == -signal.SIGKILL
    left = {p.name for p in tmp_path.iterdir()}
    assert "a.mcap" not in left
    assert len(left) == 2
    short = write_sequence(tmp_path / "short.h5", usual_arrays(3))
    export_mcap(short, out)
    assert {p.name for p in tmp_path.iterdir()} == {"a.h5", "short.h5", "a.mcap"}


def test_a_progress_bar_is_not_shown_to_files(exported, tmp_path, capsys):
    export_mcap(exported[0] / "a.h5", tmp_path / "a.mcap")
    assert capsys.readouterr() == ("", "")


def test_message_definitions_are_those_of_ros(exported):
    standard = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(exported[0] / "a.mcap") as reader:
        for connection in reader.connections:
            text, _ = standard.generate_msgdef(connection.msgtype, ros_version=2)
            assert connection.msgdef.data == text
    assert Path(exported[0] / "a.mcap").read_bytes().startswith(b"\x89MCAP0\r\n")
