import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conversion.messages.pose_files import nanoseconds, poses_at_scans, read_pose_file
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.scene.geometry import compose, to_base, transform

IDENTITY = (0.0,) * 6
TUM = """# stamp tx ty tz qx qy qz qw
1305031102.175304 1.0 2.0 0.1 0 0 0 1

1305031102.275304 1.5 2.5 0.1 0 0 0.7071068 0.7071068
"""
STATA = "1305031102175304,1.0,2.0,0.25\n1305031102275304,1.5,2.5,-3.0\n"


@pytest.fixture
def file(tmp_path):
    def write(text, name="poses.txt"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def tum(stamps, poses):
    lines = (
        f"{t!r} {x!r} {y!r} 0 0 0 {math.sin(yaw / 2)!r} {math.cos(yaw / 2)!r}"
        for t, (x, y, yaw) in zip(stamps, poses, strict=True)
    )
    return "\n".join(lines) + "\n"


def test_a_tum_trajectory_is_read_to_the_nanosecond(file):
    found = read_pose_file(file(TUM))
    assert (found.kind, found.of, found.notices) == ("TUM trajectory", "base", ())
    assert found.track.stamps_ns.tolist() == [1305031102175304000, 1305031102275304000]
    expected = [(1.0, 2.0, 0.0), (1.5, 2.5, math.pi / 2)]
    np.testing.assert_allclose(found.track.poses, expected, atol=1e-6)


def test_the_ground_truth_of_stata_is_of_the_laser_and_in_microseconds(file):
    found = read_pose_file(file(STATA, "2012-01-18-09-09-07.gt.laser.poses"))
    assert (found.kind, found.of) == ("MIT Stata ground truth", "lidar")
    assert found.track.stamps_ns.tolist() == [1305031102175304000, 1305031102275304000]
    np.testing.assert_allclose(found.track.poses, [(1.0, 2.0, 0.25), (1.5, 2.5, -3.0)])


def test_the_kind_is_told_by_content_whatever_the_name(file):
    assert read_pose_file(file(TUM, "x.gt.laser.poses")).of == "base"
    assert read_pose_file(file(STATA, "tum.txt")).of == "lidar"
    assert read_pose_file(file(STATA.replace(",", ", "))).of == "lidar"


def test_column_names_and_comments_are_skipped(file):
    plain = read_pose_file(file(STATA))
    named = read_pose_file(file("% made by\n\nt_us,x,y,yaw\n# begin\n" + STATA))
    np.testing.assert_array_equal(named.track.poses, plain.track.poses)


def test_backward_and_repeated_stamps_are_sorted_and_told(file):
    stamps = [3.0, 1.0, 2.0, 2.0, 4.0]
    poses = [(float(i), 0.0, 0.0) for i in range(5)]
    found = read_pose_file(file(tum(stamps, poses)))
    np.testing.assert_array_equal(found.track.stamps_ns, np.array([1, 2, 3, 4]) * 10**9)
    np.testing.assert_array_equal(found.track.poses[:, 0], [1, 3, 0, 4])  # the last of stamp 2
    assert len(found.notices) == 2
    assert "go backward 1 times" in found.notices[0]
    assert "1 stamps of the pose file are repeated" in found.notices[1]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "expected poses, found none"),
        ("# nothing\n", "expected poses, found none"),
        ("hello\n", "expected poses, found none"),
        ("hello\nworld\n", r"line 2 \(world\) is no pose; lines are either"),
        ("1.0 2.0 3.0\n", "line 1: expected 8 or 4 numbers, found 3"),
        (TUM + "1305031102.3 nan 0 0 0 0 0 1\n", "line 5 .*not finite"),
        (TUM + "1305031102.3 1 0 inf 0 0 0 1\n", "line 5 .*not finite"),
        (TUM + "1305031102.3 1 0 0 0 0 0\n", "line 5 .*expected 8 numbers, found 7"),
        (TUM + "1305031102.3 1 0 0 0 0 0 0\n", "line 5 .*no unit quaternion"),
        (TUM + "1305031102.3 1 0 0 1 0 0 0\n", "line 5 .*leaves the plane"),
        (TUM + "1305031102.3 1e12 0 0 0 0 0 1\n", "line 5 .*no place on this planet"),
        (TUM + "1305031102.3 x 0 0 0 0 0 1\n", "line 5 .*could not convert"),
        (STATA + "1e400,0,0,0\n", "line 3 .*is no time"),
        (STATA + "nan,0,0,0\n", "line 3 .*is no time"),
        ("1305031102175304000 0 0 0 0 0 0 1\n", "line 1 .*beyond the year 2116"),
        ("1 2" * 5000, "line 1 .*is no pose"),
    ],
)
def test_what_is_no_trajectory_is_refused_with_its_line(file, text, problem):
    with pytest.raises(RecordingError, match=problem):
        read_pose_file(file(text))


@given(st.binary(max_size=200))
def test_any_bytes_give_a_trajectory_or_our_own_error(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("any") / "x"
    path.write_bytes(content)
    with suppress(RecordingError):
        assert len(read_pose_file(path).track.stamps_ns)


@given(st.integers(-(10**18), 4 * 10**18))
def test_a_time_survives_its_decimal_form(stamp_ns):
    sign, size = "-" if stamp_ns < 0 else "", abs(stamp_ns)
    text = f"{sign}{size // 10**9}.{size % 10**9:09d}"
    assert nanoseconds(text, 1) == stamp_ns
    assert nanoseconds(str(stamp_ns), 10**9) == stamp_ns


def test_poses_of_the_base_are_interpolated_at_the_scans(file):
    found = poses_at_scans(
        read_pose_file(file(tum([10.0, 10.4], [(0.0, 0.0, 3.0), (4.0, 0.0, -3.0)]))),
        np.array([9.9, 10.1, 10.2, 10.5]) * 10**9,
        (5.0, 5.0, 0.0, 0.0, 0.0, 1.0),
    )
    np.testing.assert_array_equal(found.known, [False, True, True, False])
    np.testing.assert_allclose(found.poses[1:3, 0], [1.0, 2.0])
    assert abs(found.poses[2, 2]) == pytest.approx(math.pi)  # the short way around
    assert found.source == "TUM trajectory poses.txt"
    assert "covers 2 of 4 scans, from 10.000 s to 10.400 s" in found.notices[0]


@pytest.mark.parametrize(
    "mount", [(0.3, 0.1, 0.2, 0.0, 0.0, 0.7), (0.3, -0.1, 0.0, math.pi, 0.0, 0.5)]
)
def test_poses_of_the_lidar_are_moved_to_the_base(file, mount):
    base = np.array([(1.0, 2.0, 0.3), (3.0, 2.5, -1.2)])
    heading = to_base([(1.0, 0.0)], mount) - to_base([(0.0, 0.0)], mount)
    lidar = compose(base, (*mount[:2], math.atan2(heading[0, 1], heading[0, 0])))
    lines = [f"{i}000000,{x},{y},{yaw}\n" for i, (x, y, yaw) in enumerate(lidar.tolist(), 1)]
    trajectory = read_pose_file(file("".join(lines)))
    at_ns = np.array([1, 2]) * 10**9
    found = poses_at_scans(trajectory, at_ns, mount, max_gap_s=2.0).poses
    np.testing.assert_allclose(found, base, atol=1e-9)
    # the point of view: where the lidar is follows from the base by its mount
    seen = transform(found, to_base([(0.0, 0.0)], mount)[None])[:, 0]
    np.testing.assert_allclose(seen, lidar[:, :2], atol=1e-9)
    as_base = poses_at_scans(trajectory, at_ns, mount, of="base", max_gap_s=2.0).poses
    np.testing.assert_allclose(as_base, lidar, atol=1e-9)


def test_a_clock_offset_is_added_to_the_stamps_of_the_file(file):
    trajectory = read_pose_file(file(tum([0.0, 1.0], [(0.0, 0, 0), (1.0, 0, 0)])))
    at_ns = np.array([100.25, 100.5]) * 10**9
    found = poses_at_scans(trajectory, at_ns, IDENTITY, clock_offset_s=100.0, max_gap_s=1.0)
    np.testing.assert_allclose(found.poses[:, 0], [0.25, 0.5])
    assert "with +100.000 s covers 2 of 2" in found.notices[0]
    with pytest.raises(InvalidInputError, match="clock offset"):
        poses_at_scans(trajectory, at_ns, IDENTITY, clock_offset_s=1e300)


def test_clocks_that_never_meet_are_refused_with_the_offset_that_would_help(file):
    trajectory = read_pose_file(file(tum([5.0, 6.0], [(0.0, 0, 0)] * 2)))
    at_ns = np.array([105.0, 105.5]) * 10**9
    with pytest.raises(
        RecordingError,
        match=r"from 5.000 s to 6.000 s, but the scans are from 105.000 s to 105.500 s.*"
        r"--clock-offset 100.000",
    ):
        poses_at_scans(trajectory, at_ns.astype(np.int64), IDENTITY)
    with pytest.raises(RecordingError, match=r"--clock-offset 100.000"):
        poses_at_scans(trajectory, at_ns.astype(np.int64), IDENTITY, clock_offset_s=-7.0)


def test_gaps_longer_than_allowed_leave_scans_without_pose(file):
    stamps = [0.0, 0.1, 0.2, 3.0, 3.1]
    trajectory = read_pose_file(file(tum(stamps, [(t, 0.0, 0.0) for t in stamps])))
    at_ns = (np.array([0.15, 1.0, 3.05]) * 1e9).astype(np.int64)
    assert poses_at_scans(trajectory, at_ns, IDENTITY).known.tolist() == [True, False, True]
    wide = poses_at_scans(trajectory, at_ns, IDENTITY, max_gap_s=5.0)
    assert wide.known.all()
    assert wide.max_gap_s == 5.0
