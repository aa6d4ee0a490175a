"""When scans were taken, by their headers and by the times of recording."""

import numpy as np
import pytest

from conversion.inspection.scan_timing import Timing, iso, report_stamps, timing_oddities
from conversion.messages.recordings import Topic
from conversion.messages.scans import Beams, Scan
from conversion.messages.survey import ScanLog

SECOND = 10**9
START = 1_700_000_000 * SECOND
BEAMS = Beams("laser", 101, -1.0, 0.02, 0.1, 30.0, reversed=False)


def log(header_ns, record_ns=None):
    found = ScanLog(Topic("/scan", "scan", len(header_ns)))
    nothing = np.zeros(0, np.float32)
    for header, record in zip(header_ns, record_ns or header_ns, strict=True):
        scan = Scan(int(header), "laser", 0.0, 0.1, 0.1, 9.0, np.ones(4, np.float32), nothing)
        found.add(scan, int(record))
    return found


def every_100_ms(count=20):
    return [START + n * SECOND // 10 for n in range(count)]


def test_good_stamps_have_their_period_and_nothing_odd():
    found = report_stamps(log(every_100_ms()))
    assert found.period_s == pytest.approx(0.1)
    assert (found.missing, found.zero, found.repeated, found.backward) == (0, 0, 0, 0)
    assert found.first == "2023-11-14T22:13:20.000Z"
    assert found.last == "2023-11-14T22:13:21.900Z"


def test_scans_that_are_missing_in_a_steady_stream_are_counted():
    stamps = every_100_ms()
    assert report_stamps(log(stamps[:8] + stamps[11:])).missing == 3


def test_an_unsteady_stream_lacks_nothing():
    gaps = np.random.default_rng(1).exponential(0.3, 50)
    stamps = START + (np.cumsum(gaps) * 1e9).astype(np.int64)
    assert report_stamps(log(stamps.tolist())).missing == 0


def test_zero_repeated_and_backward_stamps_are_counted():
    stamps = every_100_ms(6)
    found = report_stamps(log([0, stamps[3], stamps[3], stamps[1], stamps[4]]))
    assert (found.zero, found.repeated, found.backward) == (1, 1, 1)
    assert found.furthest_back_s == pytest.approx(0.2)


def test_the_lead_over_the_times_of_recording_is_a_median_with_its_spread():
    record = every_100_ms(101)
    found = report_stamps(log([r + 7_000_000 + n * 10_000 for n, r in enumerate(record)], record))
    assert found.lead_s == pytest.approx(0.0075)
    assert found.lead_low_s == pytest.approx(0.00705)
    assert found.lead_high_s == pytest.approx(0.00795)


def test_no_scans_have_no_stamps():
    assert report_stamps(log([])) is None


def test_stamps_before_the_epoch_can_be_written():
    assert iso(-500_000_000) == "1969-12-31T23:59:59.500Z"


def oddities(*timings, period_s=0.1, beams=BEAMS):
    return timing_oddities([Timing(*timing) for timing in timings], beams, period_s)


def test_times_that_fit_are_not_mentioned():
    assert oddities((1.0, 0.0009, 0.1), (1.0, 0.0009, 0.1)) == ()
    assert oddities((1.0, 0.0, 0.0)) == ()
    assert oddities() == ()


@pytest.mark.parametrize(
    ("timing", "said"),
    [
        ((1.05, 0.0, 0.0), "angle_max is 2.5 beams off"),
        ((1.0, -1.0, 0.0), "time_increment is -1"),
        ((1.0, float("nan"), 0.0), "time_increment is nan"),
        ((1.0, 0.003, 0.1), "time_increment makes a scan 0.3 s, one comes every 0.1 s"),
        ((1.0, 0.0, 0.025), "scan_time is 0.025 s, a scan comes every 0.1 s"),
    ],
)
def test_what_does_not_fit_is_said(timing, said):
    (found,) = oddities(timing)
    assert said in found


def test_times_that_change_from_message_to_message_are_said():
    found = oddities((1.0, 0.0003, 0.12), (1.0, 0.0007, 0.1))
    assert "time_increment changes from message to message, 0.0003 to 0.0007 s" in found


@pytest.mark.parametrize("step", [0.0, float("nan"), float("inf")])
def test_angles_that_cannot_be_are_said(step):
    beams = Beams("laser", 8, -1.0, step, 0.1, 30.0, reversed=False)
    assert oddities((1.0, 0.0, 0.0), beams=beams) == (f"angle_increment is {step:g}",)


def test_a_clockwise_lidar_ends_at_its_smallest_angle():
    clockwise = Beams("laser", 101, -1.0, 0.02, 0.1, 30.0, reversed=True)
    assert oddities((-1.0, 0.0, 0.0), beams=clockwise) == ()
    assert oddities((1.0, 0.0, 0.0), beams=clockwise) != ()
