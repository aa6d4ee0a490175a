from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from conversion.tracks import Track, TrackLog, default_gap_s, planar, values_of

SECOND = 10**9
BASE = 1_700_000_000 * SECOND


def track(*seconds: float, yaw: float = 0.0) -> Track:
    t = np.array(seconds)
    poses = np.column_stack((2 * t, -t, np.full(t.size, yaw)))
    return Track(BASE + (t * SECOND).astype(np.int64), poses)


def at(*seconds: float) -> np.ndarray:
    return BASE + (np.array(seconds) * SECOND).astype(np.int64)


def test_poses_between_samples_are_interpolated():
    found = track(0, 1).sample(at(0, 0.25, 1), 1.0)
    np.testing.assert_allclose(found, [[0, 0, 0], [0.5, -0.25, 0], [2, -1, 0]], atol=1e-12)


def test_yaw_takes_the_shorter_way():
    source = Track(at(0, 1), np.array([[0, 0, math.pi - 0.1], [0, 0, -math.pi + 0.1]]))
    found = source.sample(at(0.25), 1.0)[0, 2]
    assert found == pytest.approx(math.pi - 0.05)


def test_no_pose_is_made_up_in_a_gap_that_is_too_long():
    found = track(0, 1, 5, 6).sample(at(0.5, 1, 1.5, 4.9, 5, 5.5), 1.0)
    assert np.isfinite(found).all(axis=1).tolist() == [True, True, False, False, True, True]


def test_ends_hold_only_where_asked_and_only_for_the_gap():
    stamps = at(-1.5, -0.5, 0, 1, 1.5, 2.5)
    free, held = (track(0, 1).sample(stamps, 1.0, held=held) for held in (False, True))
    assert np.isfinite(free).all(axis=1).tolist() == [False, False, True, True, False, False]
    assert np.isfinite(held).all(axis=1).tolist() == [False, True, True, True, True, False]
    np.testing.assert_array_equal(held[1], [0, 0, 0])
    np.testing.assert_array_equal(held[4], [2, -1, 0])


def test_an_empty_track_knows_nothing():
    empty = Track(np.empty(0, np.int64), np.empty((0, 3)))
    assert np.isnan(empty.sample(at(0, 1), 1.0)).all()
    assert empty.period_s == 0


def test_default_gap_is_twice_the_slowest_median_period_and_at_least_half_a_second():
    assert default_gap_s() == 0.5
    assert default_gap_s(track(0, 0.1, 0.2)) == 0.5
    assert default_gap_s(track(0, 0.1, 0.2), track(0, 1.1, 2.2, 9)) == pytest.approx(2.2)


def values(x: float, w: float = 1.0):
    return values_of(SimpleNamespace(x=x, y=0.0, z=0.0), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=w))


def test_samples_are_sorted_and_the_last_of_equal_stamps_counts():
    log = TrackLog()
    for second, x in ((3, 3.0), (1, 1.0), (2, 2.0), (1, 9.0)):
        log.add(SimpleNamespace(sec=second, nanosec=5), second * 10, values(x))
    found = log.track("header")
    assert found.stamps_ns.tolist() == [SECOND + 5, 2 * SECOND + 5, 3 * SECOND + 5]
    assert found.poses[:, 0].tolist() == [9.0, 2.0, 3.0]
    assert log.track("record").stamps_ns.tolist() == [10, 20, 30]


def test_values_that_are_no_pose_are_none():
    assert values(math.nan) is None
    assert values(1.0, math.inf) is None
    assert values(1e300) is None
    assert values(1.0, 0.0) is None
    assert values(1.0) == (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.0, 0.5, 3.1])
@pytest.mark.parametrize("scale", [1.0, -1.0, 1.001])
def test_yaw_of_a_quaternion_of_either_sign(yaw, scale):
    turned = np.array([[1, 2, 3, 0, 0, scale * math.sin(yaw / 2), scale * math.cos(yaw / 2)]])
    np.testing.assert_allclose(planar(turned), [[1, 2, yaw]], atol=1e-12)
