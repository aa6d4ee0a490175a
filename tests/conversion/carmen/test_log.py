import gzip
import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conversion.carmen.log import CarmenLog, is_carmen
from conversion.messages.source import MessageSource
from conversion.options import Options
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.scene.geometry import to_points, transform

NEFF = "NEFF 0.5\n"


def words(*values):
    return " ".join(map(str, values)) + "\n"


def flaser(index, ranges, *, pose=None, stamp=None, logged=None, odometry=None, kind="FLASER"):
    pose = (index * 0.1, 0.0, 0.01 * index) if pose is None else pose
    stamp = 100 + 0.1 * index if stamp is None else stamp
    logged = stamp if logged is None else logged
    return words(kind, len(ranges), *ranges, *pose, *(odometry or pose), stamp, "nohost", logged)


def robotlaser(index, ranges, remissions=(), *, laser, robot, kind="ROBOTLASER1"):
    described = (0, -1.570796, 3.141593, 0.017453, 50.0, 0.1, 0)
    stamp = 976_053_557.5 + index
    return words(
        kind, *described, len(ranges), *ranges, len(remissions), *remissions, *laser, *robot,
        *(0, 0, 0, 0, 0), stamp, "x", 700 + index,
    )  # fmt: skip


@pytest.fixture
def log(tmp_path):
    def write(*lines, packed=False):
        text = "".join(lines).encode()
        path = tmp_path / ("x.log.gz" if packed else "x.log")
        path.write_bytes(gzip.compress(text) if packed else text)
        return path

    return write


def convert(path, **options):
    """All arrays of each sequence that a log becomes."""
    with MessageSource(CarmenLog(path)) as source:
        plans = source.plans(Options(**options))
        blocks = [list(plan.blocks()) for plan in plans]
    arrays = [{n: np.concatenate([b[n] for b in some]) for n in some[0]} for some in blocks]
    return list(zip(plans, arrays, strict=True))


@pytest.mark.parametrize("packed", [False, True])
def test_scans_and_poses_come_out_as_the_lines_say(log, packed):
    ranges = [[1.0 + i + 0.01 * b for b in range(180)] for i in range(5)]
    path = log("# c\n", "PARAM x on 1 h 1\n", *(flaser(i, r) + NEFF for i, r in enumerate(ranges)),
               packed=packed)  # fmt: skip
    ((plan, arrays),) = convert(path)
    np.testing.assert_array_equal(arrays["scans/ranges"], np.float32(ranges))
    expected = [(0.1 * i, 0.0, 0.01 * i) for i in range(5)]
    np.testing.assert_allclose(arrays["poses/initial"], expected, atol=1e-12)
    stamps = [round((100 + 0.1 * i) * 1e6) * 1000 for i in range(5)]
    np.testing.assert_array_equal(arrays["scans/stamps_ns"], stamps)
    lidar = plan.header.lidar
    assert (lidar.beams, lidar.angle_min, lidar.range_max) == (180, -math.pi / 2, 80.0)
    assert lidar.base_T_lidar == (0.0,) * 6
    assert (plan.pose_source, plan.scans_with_pose) == ("FLASER pose", 5)


def test_a_range_for_no_return_becomes_infinite_and_is_told(log):
    rng = np.random.default_rng(1)
    ranges = np.round(rng.uniform(1, 20, (40, 180)), 2)
    missed = rng.random(ranges.shape) < 0.05
    ranges[missed] = 81.83
    path = log(*(flaser(i, r) for i, r in enumerate(ranges.tolist())))
    ((plan, arrays),) = convert(path)
    np.testing.assert_array_equal(arrays["scans/ranges"] == np.inf, missed)
    np.testing.assert_array_equal(arrays["scans/ranges"][~missed], np.float32(ranges[~missed]))
    assert any("81.83 m" in notice for notice in plan.notices)


def test_a_cut_off_below_the_lidars_reach_is_its_reach(log):
    rng = np.random.default_rng(1)
    ranges = np.where(rng.random((40, 180)) < 0.1, 32.77, np.round(rng.uniform(1, 20, 180), 2))
    ((plan, _),) = convert(log(*(flaser(i, r) for i, r in enumerate(ranges.tolist()))))
    assert plan.header.lidar.range_max == pytest.approx(32.77)


def test_the_users_no_return_joins_what_was_found(log):
    ranges = [[7.25 if b == 3 else 2.0 + 0.01 * b for b in range(180)] for _ in range(3)]
    path = log(*(flaser(i, r) for i, r in enumerate(ranges)))
    ((_, arrays),) = convert(path, no_return=(7.25,))
    assert (arrays["scans/ranges"][:, 3] == np.inf).all()
    assert np.isfinite(np.delete(arrays["scans/ranges"], 3, axis=1)).all()


def test_the_mount_is_the_offset_between_the_two_poses(log):
    def line(i):
        robot = (i * 0.2, 1.0, 0.3 * i)
        c, s = math.cos(robot[2]), math.sin(robot[2])
        laser = (robot[0] + 0.25 * c, robot[1] + 0.25 * s, robot[2])
        return robotlaser(i, [2.0] * 180, laser=laser, robot=robot)

    ((plan, arrays),) = convert(log(*map(line, range(6))))
    assert plan.header.lidar.base_T_lidar == pytest.approx((0.25, 0, 0, 0, 0, 0), abs=1e-9)
    np.testing.assert_allclose(arrays["poses/initial"][:, 0], 0.2 * np.arange(6), atol=1e-12)


def test_a_corrected_laser_pose_beside_odometry_is_taken_as_it_is(log):
    lines = [flaser(i, [2.0] * 180, pose=(i, 0, 0), odometry=(1.2 * i, 0.1, 0)) for i in range(4)]
    recording = CarmenLog(log(*lines))
    assert [topic.name for topic in recording.pose_topics] == ["FLASER pose", "FLASER odometry"]
    ((plan, arrays),) = convert(recording.path)
    assert plan.pose_source == "FLASER pose"
    np.testing.assert_allclose(arrays["poses/initial"][:, 0], np.arange(4.0))
    ((plan, arrays),) = convert(recording.path, poses="FLASER odometry")
    np.testing.assert_allclose(arrays["poses/initial"][:, 0], 1.2 * np.arange(4.0))
    assert any("'odom'" in notice for notice in plan.notices)


def test_remissions_become_intensities(log):
    lines = [
        robotlaser(i, [1.0, 2, 3], [10 * i, 20, 30], laser=(0, 0, 0), robot=(0, 0, 0))
        for i in range(3)
    ]
    ((_, arrays),) = convert(log(*lines))
    np.testing.assert_array_equal(arrays["scans/intensities"][:, 0], [0, 10, 20])


def test_raw_scans_are_left_out_where_the_robots_hold_them_too(log):
    described = (0, -1.5, 3.0, 0.0175, 50.0, 0.1, 0)
    raw = words("RAWLASER1", *described, 2, 1.0, 2.0, 0, 5.0, "x", 5.0)
    robot = robotlaser(1, [1.0, 2.0], laser=(0, 0, 0), robot=(0, 0, 0))
    both = CarmenLog(log(raw, robot))
    assert [topic.name for topic in both.scan_topics] == ["ROBOTLASER1"]
    assert "RAWLASER1 left out" in both.notices[0]
    alone = CarmenLog(log(raw, raw))
    assert [topic.name for topic in alone.scan_topics] == ["RAWLASER1"]
    assert alone.pose_topics == alone.transform_topics == ()


def test_front_and_rear_lasers_become_two_sequences(log):
    pair = [flaser(i, [1.0] * 180) + flaser(i, [2.0] * 181, kind="RLASER") for i in range(4)]
    found = {plan.topic: arrays for plan, arrays in convert(log(*pair))}
    assert found["FLASER"]["scans/ranges"].shape == (4, 180)
    assert found["RLASER"]["scans/ranges"].shape == (4, 181)


def test_record_times_increase_whatever_the_logger_wrote(log):
    logged = [10.0, 11.0, 10.5, 10.5, 0.0, 12.0]
    path = log(*(flaser(i, [1.0, 2], stamp=5.0, logged=t) for i, t in enumerate(logged)))
    recording = CarmenLog(path)
    times = [m.record_ns for m in recording.messages(recording.scan_topics)]
    assert (np.diff(times) > 0).all()
    assert times[0] == 10 * 10**9
    assert times[-1] == 12 * 10**9
    assert any("backward 2 times" in notice for notice in recording.notices)


def test_every_scan_keeps_its_own_pose_where_stamps_go_backward(log):
    logged = [10.0, 11.0, 10.5, 10.5, 9.0, 12.0]
    path = log(*(flaser(i, [1.0, 2], stamp=t) for i, t in enumerate(logged)))
    ((_, arrays),) = convert(path, stamps="record")
    np.testing.assert_allclose(arrays["poses/initial"][:, 0], 0.1 * np.arange(6), atol=1e-12)


def test_a_sequence_ends_where_header_stamps_go_backward(log):
    path = log(*(flaser(i, [1.0, 2], stamp=t) for i, t in enumerate([1.0, 2.0, 1.5, 3.0])))
    parts = convert(path, stamps="header")
    assert [plan.scans_out for plan, _ in parts] == [2, 2]


def test_the_loggers_clock_is_lined_up_with_that_of_the_messages(log):
    lines = [robotlaser(i, [1.0, 2], laser=(0, 0, 0), robot=(0, 0, 0)) for i in range(2)]
    recording = CarmenLog(log(*lines))
    (first, second) = recording.messages(recording.scan_topics)
    assert first.record_ns == recording.scan(first).stamp_ns == 976_053_557_500_000_000
    assert second.record_ns - first.record_ns == 10**9


def test_messages_of_a_time_are_the_same_whatever_topics_are_asked_for(log):
    path = log(*(flaser(i, [1.0, 2]) + flaser(i, [3.0, 4], kind="RLASER") for i in range(5)))
    recording = CarmenLog(path)
    every = [
        (m.topic, m.record_ns) for m in recording.messages(recording.topics) if m.topic == "RLASER"
    ]
    (rear,) = (topic for topic in recording.scan_topics if topic.name == "RLASER")
    assert [(m.topic, m.record_ns) for m in recording.messages([rear])] == every
    late = [m.record_ns for m in recording.messages([rear], every[2][1])]
    assert late == [time for _, time in every[2:]]


def test_poses_that_are_not_finite_are_unknown(log):
    lines = [flaser(i, [1.0, 2], pose=(math.nan if i == 1 else i, 0, 0)) for i in range(3)]
    ((plan, arrays),) = convert(log(*lines), max_gap_s=0.0)
    assert plan.scans_with_pose == 2
    assert np.isnan(arrays["poses/initial"][1]).all()


def test_a_trajectory_of_ones_own_replaces_the_poses_of_the_log(log, tmp_path):
    path = log(*(flaser(i, [1.0, 2], stamp=10.0 + i) for i in range(4)))
    (tmp_path / "slam.txt").write_text("10 5 0 0 0 0 0 1\n12 7 0 0 0 0 0 1\n")
    ((plan, arrays),) = convert(path, poses=str(tmp_path / "slam.txt"), max_gap_s=2.0)
    np.testing.assert_allclose(arrays["poses/initial"][:3, 0], [5, 6, 7])
    assert np.isnan(arrays["poses/initial"][3]).all()
    assert plan.pose_source == "TUM trajectory slam.txt"


def test_a_log_has_no_streams_and_says_so(log):
    recording = CarmenLog(log(flaser(0, [1.0, 2])))
    assert list(recording.streams((), 0, 10**18)) == []
    with pytest.raises(RecordingError, match="expected no streams"):
        recording.streams(("all",), 0, 10**18)
    with pytest.raises(RecordingError, match="FLASER: a CARMEN log holds no commands"):
        recording.velocity(next(recording.messages(recording.scan_topics)))


@pytest.mark.parametrize(
    ("lines", "problem"),
    [
        ([], "found no lines at all"),
        (["PARAM a 1 1 h 1\n", "ODOM 0 0 0 0 0 0 1 h 1\n"], r"found PARAM \(1\), ODOM \(1\)"),
        ([flaser(0, [1.0, 2]), "FLASER 3 1 2\n", NEFF], r"line 2 \(FLASER 3 1 2 \.\.\.\) is dam"),
        ([flaser(0, [1.0, 2]), "FLASER 3 1 2"], "cut off within line 2"),
        ([flaser(0, [1.0, "x"]), NEFF], "line 1 .*could not convert"),
        ([flaser(0, [1.0, 2], logged="nan"), NEFF], "line 1 .* no time"),
    ],
)
def test_a_log_that_cannot_be_read_is_refused_with_the_reason(log, lines, problem):
    with pytest.raises(RecordingError, match=problem):
        CarmenLog(log(*lines))


@given(st.floats(0, 1))
def test_a_log_cut_anywhere_is_refused_or_loses_only_its_end(tmp_path_factory, share):
    text = "".join(flaser(i, [1.25, 2.5, 3.75]) for i in range(4)).encode()
    cut = text[: round(share * len(text))]
    path = tmp_path_factory.mktemp("cut") / "x.log"
    path.write_bytes(cut)
    whole = cut.count(b"\n")
    with suppress(RecordingError):
        recording = CarmenLog(path)
        scans = [recording.scan(m).ranges for m in recording.messages(recording.scan_topics)]
        assert len(scans) in (whole, whole + 1)  # only the end of the last stamp can be missed
        np.testing.assert_array_equal(scans, [[1.25, 2.5, 3.75]] * len(scans))


@given(st.integers(0, 400), st.integers(0, 255))
def test_a_changed_byte_gives_scans_or_our_own_error(tmp_path_factory, at, byte):
    text = bytearray("".join(flaser(i, [1.25, 2.5]) for i in range(8)).encode())
    text[at % len(text)] = byte
    path = tmp_path_factory.mktemp("byte") / "x.log"
    path.write_bytes(bytes(text))
    with suppress(RecordingError):
        for _, arrays in convert(path, stamps="record"):
            assert arrays["scans/ranges"].dtype == np.float32


def test_carmen_is_told_by_its_content(log, tmp_path):
    assert is_carmen(log(NEFF, flaser(0, [1.0, 2])))
    assert is_carmen(log("# x\n", "PARAM a 1 1 h 1\n", packed=True))
    (tmp_path / "cut.gz").write_bytes(gzip.compress(flaser(0, [1.0] * 181).encode() * 9)[:-20])
    assert is_carmen(tmp_path / "cut.gz")
    for name, content in {
        "empty": b"",
        "bag": b"#ROSBAG V2.0\n" + bytes(100),
        "text": b"hello world\n" * 9,
        "binary": b"FLASER 1\n" + bytes(range(256)),
        "gzip": gzip.compress(b"t,x\n1,2\n"),
        "tum": b"# stamp x y\n1.0 0 0 0 0 0 0 1\n",
    }.items():
        (tmp_path / name).write_bytes(content)
        assert not is_carmen(tmp_path / name), name
    assert not is_carmen(tmp_path)
    assert not is_carmen(tmp_path / "absent")


REAL = {
    "intel-corrected.log.gz": (910, 180, 81.83, 4172),
    "freiburg-079-corrected.log.gz": (4791, 360, 81.91, 36004),
    "intel-lab-robotlaser1.log.gz": (2672, 180, 81.83, 10677),
}


@pytest.mark.parametrize("name", REAL)
def test_real_logs_convert(shared_data, name):
    scans, beams, far, missed = REAL[name]
    ((plan, arrays),) = convert(shared_data / "carmen" / name, stamps="record")
    ranges = arrays["scans/ranges"]
    assert ranges.shape == (scans, beams)
    assert int((ranges == np.inf).sum()) == missed
    assert ranges[np.isfinite(ranges)].max() < 40
    assert plan.scans_with_pose == scans
    assert any(f"{far} m" in notice for notice in plan.notices)


def spread(ranges, poses, bearings):
    """Entropy of the hits of all scans over cells of 5 cm: the sharper the map the smaller."""
    points = transform(poses, to_points(np.where(ranges < 20, ranges, np.nan), bearings))
    cells = np.floor(points[np.isfinite(points[..., 0])] / 0.05).astype(np.int64)
    _, counts = np.unique(cells @ [100_003, 1], return_counts=True)
    shares = counts / counts.sum()
    return -(shares * np.log(shares)).sum()


def test_the_map_of_a_real_log_is_sharpest_where_its_beams_begin_at_90_degrees(shared_data):
    path = shared_data / "carmen" / "intel-corrected.log.gz"
    ((plan, arrays),) = convert(path, stamps="record")
    ranges, poses, bearings = (
        arrays["scans/ranges"], arrays["poses/initial"], plan.header.lidar.bearings
    )  # fmt: skip
    assert math.degrees(bearings[0]) == pytest.approx(-90)
    sharpness = {
        shift: spread(ranges, poses, bearings + math.radians(shift)) for shift in (-0.5, 0, 0.5)
    }
    assert min(sharpness, key=sharpness.get) == 0
