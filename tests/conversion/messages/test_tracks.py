from __future__ import annotations

import math
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from conversion.messages.tracks import Track, TrackLog, default_gap_s, planar, values_of

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
        log.add(second * SECOND + 5, second * 10, values(x))
    found = log.track("header")
    assert found.stamps_ns.tolist() == [SECOND + 5, 2 * SECOND + 5, 3 * SECOND + 5]
    assert found.poses[:, 0].tolist() == [9.0, 2.0, 3.0]
    assert log.track("record").stamps_ns.tolist() == [10, 20, 30]


def test_an_empty_log_has_an_empty_track():
    log = TrackLog()
    assert len(log) == log.lead_ns == 0
    assert log.track("header").stamps_ns.size == 0
    assert np.isnan(log.track("record").sample(at(1), 1.0)).all()


def plain_log(stamps, x) -> tuple[TrackLog, Track]:
    """The same samples, of a log that keeps them aside in blocks, and as arrays."""
    log = TrackLog()
    for stamp, value in zip(stamps.tolist(), x.tolist(), strict=True):
        log.add(stamp, stamp + 7, (value, 0.0, 0.0, 0.0, 0.0, math.sin(value), math.cos(value)))
    yaw = (2 * x + math.pi) % (2 * math.pi) - math.pi
    return log, Track(stamps, np.column_stack((x, 0 * x, yaw)))


@pytest.mark.parametrize("shuffled", [0, 40, 5000])
def test_a_long_log_samples_as_its_whole_arrays_do(shuffled):
    random = np.random.default_rng(4)
    stamps = BASE + np.sort(random.integers(0, 300, 5000)) * SECOND // 10
    stamps += np.where(np.arange(5000) > 2500, 30 * SECOND, 0)  # a gap
    if shuffled:  # stamps out of order, within forty or anywhere
        stamps = stamps[np.argsort(np.arange(5000) + random.uniform(0, shuffled, 5000))]
    log, whole = plain_log(stamps, random.uniform(-1, 1, 5000))
    track = log.track("header")
    for lowest, highest in ((-5, 70), (3, 4), (20, 45), (29.95, 29.99), (70, 80), (-9, -8)):
        wanted = BASE + (random.uniform(lowest, highest, 400) * SECOND).astype(np.int64)
        for held in (False, True):
            found = track.sample(wanted, 2.0, held=held)
            expected = whole.sample(wanted, 2.0, held=held)
            np.testing.assert_allclose(found, expected, atol=1e-7)
    shifted = track.shifted(SECOND).shifted(-3 * SECOND)
    expected = whole.sample(wanted + 2 * SECOND, 2.0)
    np.testing.assert_allclose(shifted.sample(wanted, 2.0), expected, atol=1e-7)
    np.testing.assert_array_equal(track.stamps_ns, whole.stamps_ns)
    np.testing.assert_allclose(track.poses, whole.poses, atol=1e-12)
    assert track.period_s == whole.period_s


def test_a_log_remembers_what_its_samples_span():
    log = TrackLog()
    for n in range(3000):
        sign = -1.0 if n % 2 else 1.0
        log.add(BASE + n, BASE, (0.001 * n, 2.0, 0.0, 0.0, 0.0, 0.6 * sign, 0.8 * sign))
    log.add(BASE + 3000, BASE, (0.0, 2.0, 0.0, 0.6, 0.0, 0.0, 0.8))
    assert len(log) == 3001
    np.testing.assert_allclose(log.first, [0, 2, 0, 0, 0, 0.6, 0.8])
    np.testing.assert_allclose(log.last, [0, 2, 0, 0.6, 0, 0, 0.8])
    np.testing.assert_allclose(log.extent, [2.999, 0, 0, 0.6, 0, 0.6, 0], atol=1e-12)
    assert log.upright == pytest.approx(0.8**2 - 0.6**2)
    assert log.lead_ns == 1500


def test_period_and_lead_of_a_very_long_log_are_those_of_all_of_it():
    log = TrackLog()
    pose = values(1.0)
    for n in range(200_000):
        log.add(BASE + n * 10_000_000 + 25, BASE + n * 10_000_000, pose)
    assert log.track("header").period_s == 0.01
    assert log.lead_ns == 25


def test_a_long_log_takes_no_memory_and_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr("conversion.messages.spill.temporary_folder", lambda: str(tmp_path))
    monkeypatch.setattr("conversion.messages.spill._IN_MEMORY", 10_000)
    log, pose = TrackLog(), values(1.0)
    tracemalloc.start()
    for n in range(30_000):
        log.add(BASE + n, BASE + n, pose)
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 150_000  # of the 2.2 MB that the samples have
    assert log.track("header").sample(at(0), 1.0)[0, 0] == 1.0
    assert list(tmp_path.iterdir()) == []


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
