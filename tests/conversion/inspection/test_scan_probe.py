"""The scans of one topic under inspection."""

import math

import numpy as np
import pytest

from conversion.inspection.scan_probe import SAMPLES, ScanProbe
from conversion.messages.lidars import choose_lidar
from conversion.messages.recordings import Topic
from conversion.messages.scans import Scan
from conversion.plan import BLOCK

NOTHING = np.zeros(0, np.float32)


def probe(scans, *, lidar=None):
    topic = Topic("/scan", "scan", len(scans))
    found = ScanProbe(topic, lambda beams: choose_lidar("bag", topic, beams, lidar))
    for n, each in enumerate(scans):
        found.add(each, 10**18 + n * 10**8)
    found.flush()
    return found


def scan(ranges, intensities=NOTHING, *, first=-1.0, step=0.25, limits=(0.1, 30.0), at=10**18):
    values = np.asarray(ranges, np.float32), np.asarray(intensities, np.float32)
    return Scan(at, "laser", first, step, *limits, *values)


def report(found, mount=None):
    return found.report(found.log.runs[0].beams, (mount, "as given"))


def test_scans_are_counted_across_blocks():
    found = report(probe([scan([1.0, 2.0, np.inf, 0.0])] * (2 * BLOCK + 3)))
    assert found.scans == 2 * BLOCK + 3
    assert found.kinds["returns"] == 0.5
    assert (found.beams, found.field_of_view_deg) == (4, pytest.approx(math.degrees(0.75)))
    assert found.direction == "counter-clockwise"


def test_a_clockwise_scan_is_reported_as_recorded_and_counted_counter_clockwise():
    found = probe([scan([1.0, np.inf, np.inf, 5.0], first=1.0, step=-0.25)] * 3)
    said = report(found)
    assert (said.direction, said.angle_increment_rad) == ("clockwise", -0.25)
    assert (said.angle_min_rad, said.angle_max_rad) == (1.0, 0.25)
    bearings, shares = found.by_beam
    np.testing.assert_allclose(bearings, [0.25, 0.5, 0.75, 1.0])
    np.testing.assert_array_equal(shares[:, 0], [1, 0, 0, 1])
    np.testing.assert_array_equal(found.samples[0].ranges, [5.0, np.inf, np.inf, 1.0])


def test_changes_of_beams_are_said_with_their_scan_and_not_without_end():
    eight, nine = [scan(np.ones(8))] * 2, [scan(np.ones(9))] * 2
    found = report(probe((eight + nine) * 10))
    assert found.changes[0] == "before scan 2: 9 beams after 8"
    assert found.changes[-1] == "and 11 more times"
    assert found.scans == 40
    assert found.kinds["returns"] == 1


def test_changing_limits_and_lacking_intensities_are_odd():
    found = report(
        probe([scan(np.ones(3), np.ones(3)), scan(np.ones(3)), scan(np.ones(3), limits=(0.1, 9.0))])
    )
    assert found.oddities == (
        "the range limits change: 0.1 to 30 m, 0.1 to 9 m",
        "2 of 3 scans lack one intensity per beam",
    )
    assert found.intensity_scans == 1


@pytest.mark.parametrize("nothing", [np.inf, np.nan, 0.0, 30.0])
def test_intensities_that_run_against_the_ranges_are_noticed(nothing):
    random = np.random.default_rng(1)
    missing = random.random((50, 40)) < 0.4
    ranges = np.where(missing, nothing, random.uniform(1, 5, (50, 40)))
    intensities = np.where(missing, 0.0, 10.0)
    forward = [scan(r, i, step=0.1) for r, i in zip(ranges, intensities, strict=True)]
    backward = [scan(r, i[::-1], step=0.1) for r, i in zip(ranges, intensities, strict=True)]
    assert not report(probe(forward)).intensities_run_backward
    assert report(probe(backward)).intensities_run_backward


def test_messages_without_beams_are_counted_apart():
    found = probe([scan([]), scan(np.ones(4)), scan([])])
    assert (report(found).scans, report(found).empty) == (1, 2)
    assert probe([scan([])]).beams is None


def test_a_few_samples_are_spread_over_the_recording():
    found = probe([scan(np.full(4, n + 1.0)) for n in range(30)])
    assert [s.ranges[0] for s in found.samples] == [6, 16, 26]
    assert len(probe([scan(np.ones(4))]).samples) <= SAMPLES


def test_a_lidar_that_cannot_be_is_said_and_the_scans_are_counted_all_the_same():
    found = report(probe([scan(np.ones(4), limits=(5.0, 1.0))] * 2))
    assert found.lidar is None
    assert "describe no lidar" in found.lidar_found
    assert found.scans == 2


def test_the_limits_of_a_named_lidar_count():
    ranges = np.linspace(0.05, 70, 1081)
    width = 2 * 2.356194496154785 / 1080
    scans = [scan(ranges, first=-2.356194496154785, step=width, limits=(0.0, 1000.0))]
    assert report(probe(scans, lidar="hokuyo")).kinds["range_max and more"] > 0.1


@pytest.mark.parametrize(
    ("mount", "upside_down"),
    [
        (None, False),
        ((0.0,) * 6, False),
        ((0.0, 0, 0, math.pi, 0, 0), True),
        ((0.0, 0, 0, 0, math.pi, 0), True),
        ((0.0, 0, 0, math.pi, math.pi, 0), False),
        ((0.0, 0, 0, 0, 0, math.pi), False),
    ],
)
def test_upside_down_is_a_lidar_whose_z_points_downward(mount, upside_down):
    assert report(probe([scan(np.ones(4))]), mount).upside_down == upside_down


def test_labels_are_counted():
    found = probe([scan(np.ones(4))])
    assert report(found).labelled is None
    found.add_labels(np.array([[0, 4, 255, 255]], np.uint8))
    assert report(found).labelled == 0.5
