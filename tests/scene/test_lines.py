from pathlib import Path

import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lines import LineParameters, extract_lines

BEARINGS = np.linspace(-2.3, 2.3, 1081)
LIMITS = {"range_min": 0.1, "range_max": 60.0}
REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "data" / "line_reference.npz"


def rectangle(turn=0.0, left=-3.0, right=4.0, bottom=-2.0, top=2.5):
    """Exact ranges from the origin to the walls of a room that is turned by `turn`."""
    c, s = np.cos(BEARINGS - turn), np.sin(BEARINGS - turn)
    with np.errstate(divide="ignore"):
        x = np.where(c > 0, right, left) / c
        y = np.where(s > 0, top, bottom) / s
    return np.minimum(np.abs(x), np.abs(y))[None]


def angle_of(segments):
    return np.arctan2(segments[:, 3] - segments[:, 1], segments[:, 2] - segments[:, 0]) % np.pi


def test_the_walls_of_a_room_are_found_where_they_are():
    segments, offsets = extract_lines(rectangle(), BEARINGS, **LIMITS)
    assert segments.dtype == np.float32
    assert offsets.tolist() == [0, len(segments)]
    bottom, right, top = segments[1:4] if len(segments) == 5 else segments[:3]
    np.testing.assert_allclose(bottom[[1, 3]], -2.0, atol=1e-3)
    np.testing.assert_allclose(right[[0, 2]], 4.0, atol=1e-3)
    np.testing.assert_allclose(top[[1, 3]], 2.5, atol=1e-3)
    assert right[1] == pytest.approx(-2.0, abs=0.1)
    assert right[3] == pytest.approx(2.5, abs=0.1)


def test_noise_of_the_sensor_moves_a_wall_by_less_than_a_centimetre():
    noise = np.random.default_rng(0).normal(0, 0.01, (20, 1081))
    segments, offsets = extract_lines(rectangle() + noise, BEARINGS, **LIMITS)
    along_right = np.abs(segments[:, [0, 2]] - 4.0).max(axis=1) < 0.1
    assert along_right.sum() >= 20
    middle = segments[along_right][:, [0, 2]].mean(axis=1)
    assert np.abs(middle - 4.0).max() < 0.01
    assert (np.diff(offsets) >= 3).all()


def test_a_turned_room_gives_turned_segments():
    here, _ = extract_lines(rectangle(0.0), BEARINGS, **LIMITS)
    there, _ = extract_lines(rectangle(0.3), BEARINGS, **LIMITS)
    long_here = here[np.hypot(*(here[:, :2] - here[:, 2:]).T) > 3]
    long_there = there[np.hypot(*(there[:, :2] - there[:, 2:]).T) > 3]
    turned = (angle_of(long_here) + 0.3) % np.pi
    for angle in angle_of(long_there):
        assert np.abs((turned - angle + np.pi / 2) % np.pi - np.pi / 2).min() < 1e-3


def test_scans_do_not_depend_on_those_beside_them():
    scans = np.concatenate([rectangle(turn) for turn in (0.0, 0.2, 0.4)])
    together, offsets = extract_lines(scans, BEARINGS, **LIMITS)
    for n in range(3):
        alone, _ = extract_lines(scans[n : n + 1], BEARINGS, **LIMITS)
        np.testing.assert_array_equal(together[offsets[n] : offsets[n + 1]], alone)


@pytest.mark.parametrize("value", [0.0, np.inf, -np.inf, np.nan, 61.0])
def test_a_scan_without_usable_returns_has_no_segments(value):
    scans = np.concatenate((np.full((1, 1081), value), rectangle()))
    segments, offsets = extract_lines(scans, BEARINGS, **LIMITS)
    assert offsets[1] == 0
    assert len(segments) == offsets[2] > 0


def test_a_niche_parts_a_wall_and_short_pieces_are_dropped():
    scan = rectangle()
    niche = np.abs(4.0 * np.tan(BEARINGS) - 0.2) < 0.6
    scan[0, niche & (np.abs(BEARINGS) < 1)] += 0.3
    segments, _ = extract_lines(scan, BEARINGS, **LIMITS)
    on_right = np.abs(segments[:, [0, 2]] - 4.0).max(axis=1) < 0.01
    behind = np.abs(segments[:, [0, 2]] - 4.3).max(axis=1) < 0.05
    assert on_right.sum() == 2
    assert behind.sum() == 1
    longer, _ = extract_lines(scan, BEARINGS, LineParameters(min_line_length=3.0), **LIMITS)
    assert 0 < len(longer) < len(segments)


def test_pieces_of_one_wall_become_one_segment_again():
    scan = rectangle()
    scan[0, np.abs(BEARINGS) < 0.15] = np.inf  # 1.2 m, more than a line may miss
    segments, _ = extract_lines(scan, BEARINGS, **LIMITS)
    on_right = segments[np.abs(segments[:, [0, 2]] - 4.0).max(axis=1) < 0.01]
    assert len(on_right) == 1
    assert abs(on_right[0, 3] - on_right[0, 1]) > 4.0


def test_bad_shapes_and_parameters_are_refused():
    with pytest.raises(InvalidInputError, match="ranges"):
        extract_lines(np.zeros((2, 10)), BEARINGS, **LIMITS)
    with pytest.raises(InvalidInputError, match="line parameters"):
        LineParameters(max_line_gap=-1.0)


def test_segments_are_those_of_the_classic_ros_node():
    if not REFERENCE.is_file():
        pytest.skip("line_reference.npz is not present")
    with np.load(REFERENCE) as data:
        bearings = data["angle_min"] + data["angle_increment"] * np.arange(1081)
        segments, offsets = extract_lines(data["ranges"], bearings, range_min=0.6, range_max=60.0)
        np.testing.assert_array_equal(offsets, data["offsets"])
        np.testing.assert_allclose(segments, data["segments"], atol=1e-4)


@pytest.mark.parametrize("value", [0.0, 1e-3, 1e-30])
def test_ranges_of_about_nothing_never_raise_and_give_no_bad_segment(value):
    scans = np.concatenate((np.full((2, 1081), value), rectangle()))
    scans[1, 40:43], scans[1, 43:] = 0.5, np.inf  # with those before it a chord of 0.5 m
    scans[2, 100:400] = value
    segments, offsets = extract_lines(scans, BEARINGS, range_min=0.0, range_max=60.0)
    assert offsets[1] == 0
    assert offsets[3] - offsets[2] >= 2
    assert np.isfinite(segments).all()
    assert (np.hypot(*(segments[:, 2:] - segments[:, :2]).T) > 0.1).all()


def test_points_without_any_spread_give_finite_segments_or_none():
    loose = LineParameters(min_line_length=1e-9, min_line_points=2, max_line_gap=10.0)
    for increment in (0.0, 1e-12, np.pi):
        bearings = np.arange(40) * increment
        for value in (1e-20, 1e-3, 1.0):
            ranges = np.where(np.arange(40) % 3, value, 2 * value)[None]
            segments, _ = extract_lines(ranges, bearings, loose, range_min=0.0, range_max=9.0)
            assert np.isfinite(segments).all()
