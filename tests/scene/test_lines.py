from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from semantic2d_dataset.scene.lines import FAST, PUBLISHED, LineParameters, extract_lines
from semantic2d_dataset.simulation.raycast import lidar_frames
from semantic2d_dataset.simulation.recording import simulate_recording
from semantic2d_dataset.simulation.worlds import draw_world

BEARINGS = np.linspace(-2.3, 2.3, 1081)
LIMITS = {"range_min": 0.1, "range_max": 60.0}
REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "data" / "line_reference.npz"


@pytest.fixture(params=[PUBLISHED, FAST], ids=["classic", "joint"])
def parameters(request):
    return request.param


def rectangle(turn=0.0, left=-3.0, right=4.0, bottom=-2.0, top=2.5, bearings=BEARINGS):
    """Exact ranges from the origin to the walls of a room that is turned by `turn`."""
    c, s = np.cos(bearings - turn), np.sin(bearings - turn)
    with np.errstate(divide="ignore"):
        x = np.where(c > 0, right, left) / c
        y = np.where(s > 0, top, bottom) / s
    return np.minimum(np.abs(x), np.abs(y))[None]


def angle_of(segments):
    return np.arctan2(segments[:, 3] - segments[:, 1], segments[:, 2] - segments[:, 0]) % np.pi


def test_the_walls_of_a_room_are_found_where_they_are(parameters):
    segments, offsets = extract_lines(rectangle(), BEARINGS, parameters, **LIMITS)
    assert segments.dtype == np.float32
    assert offsets.tolist() == [0, len(segments)]
    bottom, right, top = segments[1:4] if len(segments) == 5 else segments[:3]
    np.testing.assert_allclose(bottom[[1, 3]], -2.0, atol=1e-3)
    np.testing.assert_allclose(right[[0, 2]], 4.0, atol=1e-3)
    np.testing.assert_allclose(top[[1, 3]], 2.5, atol=1e-3)
    assert right[1] == pytest.approx(-2.0, abs=0.1)
    assert right[3] == pytest.approx(2.5, abs=0.1)


def test_noise_of_the_sensor_moves_a_wall_by_less_than_a_centimetre(parameters):
    noise = np.random.default_rng(0).normal(0, 0.01, (20, 1081))
    segments, offsets = extract_lines(rectangle() + noise, BEARINGS, parameters, **LIMITS)
    along_right = np.abs(segments[:, [0, 2]] - 4.0).max(axis=1) < 0.1
    assert along_right.sum() >= 20
    middle = segments[along_right][:, [0, 2]].mean(axis=1)
    assert np.abs(middle - 4.0).max() < 0.01
    assert (np.diff(offsets) >= 3).all()


def test_a_turned_room_gives_turned_segments(parameters):
    here, _ = extract_lines(rectangle(0.0), BEARINGS, parameters, **LIMITS)
    there, _ = extract_lines(rectangle(0.3), BEARINGS, parameters, **LIMITS)
    long_here = here[np.hypot(*(here[:, :2] - here[:, 2:]).T) > 3]
    long_there = there[np.hypot(*(there[:, :2] - there[:, 2:]).T) > 3]
    turned = (angle_of(long_here) + 0.3) % np.pi
    for angle in angle_of(long_there):
        assert np.abs((turned - angle + np.pi / 2) % np.pi - np.pi / 2).min() < 1e-3


def test_scans_do_not_depend_on_those_beside_them(parameters):
    scans = np.concatenate([rectangle(turn) for turn in (0.0, 0.2, 0.4)])
    together, offsets = extract_lines(scans, BEARINGS, parameters, **LIMITS)
    for n in range(3):
        alone, _ = extract_lines(scans[n : n + 1], BEARINGS, parameters, **LIMITS)
        np.testing.assert_array_equal(together[offsets[n] : offsets[n + 1]], alone)


@pytest.mark.parametrize("value", [0.0, np.inf, -np.inf, np.nan, 61.0])
def test_a_scan_without_usable_returns_has_no_segments(value, parameters):
    scans = np.concatenate((np.full((1, 1081), value), rectangle()))
    segments, offsets = extract_lines(scans, BEARINGS, parameters, **LIMITS)
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


def test_the_classic_fit_joins_the_pieces_of_a_wall_over_any_gap():
    scan = rectangle()
    scan[0, np.abs(BEARINGS) < 0.15] = np.inf  # 1.2 m, more than a line may miss
    segments, _ = extract_lines(scan, BEARINGS, **LIMITS)
    on_right = segments[np.abs(segments[:, [0, 2]] - 4.0).max(axis=1) < 0.01]
    assert len(on_right) == 1
    assert abs(on_right[0, 3] - on_right[0, 1]) > 4.0


@pytest.mark.parametrize(("half_rad", "segments"), [(0.1, 1), (0.15, 2)])  # 0.8 m, 1.2 m
def test_the_joint_fit_joins_the_pieces_of_a_wall_over_gaps_of_the_allowed_width(
    half_rad, segments
):
    scan = rectangle()
    scan[0, np.abs(BEARINGS) < half_rad] = np.inf
    scan[0, np.abs(BEARINGS) < 0.01] = 2.0  # someone's leg
    found, _ = extract_lines(scan, BEARINGS, FAST, **LIMITS)
    on_right = np.abs(found[:, [0, 2]] - 4.0).max(axis=1) < 0.01
    assert on_right.sum() == segments


def test_the_joint_fit_joins_pieces_whose_angles_differ_by_a_turn():
    bearings = np.linspace(-np.pi, np.pi, 1440, endpoint=False)
    walls = np.repeat(rectangle(bearings=bearings), 20, axis=0)
    walls += np.random.default_rng(0).normal(0, 0.008, walls.shape)
    walls[:, (bearings > -2.84) & (bearings < -2.80)] = 1.0  # a leg in front of the wall behind
    found, _ = extract_lines(walls, bearings, FAST, **LIMITS)
    on_left = (np.abs(found[:, [0, 2]] + 3.0).max(axis=1) < 0.05) & (found[:, 3] < 0.0)
    assert on_left.sum() == 20


def test_bad_shapes_and_parameters_are_refused():
    with pytest.raises(InvalidInputError, match="ranges"):
        extract_lines(np.zeros((2, 10)), BEARINGS, **LIMITS)
    with pytest.raises(InvalidInputError, match="line parameters"):
        LineParameters(max_line_gap=-1.0)
    with pytest.raises(InvalidInputError, match="found 'best'"):
        LineParameters(fit="best")


def test_segments_are_those_of_the_classic_ros_node():
    if not REFERENCE.is_file():
        pytest.skip("line_reference.npz is not present")
    with np.load(REFERENCE) as data:
        bearings = data["angle_min"] + data["angle_increment"] * np.arange(1081)
        segments, offsets = extract_lines(data["ranges"], bearings, range_min=0.6, range_max=60.0)
        np.testing.assert_array_equal(offsets, data["offsets"])
        np.testing.assert_allclose(segments, data["segments"], atol=1e-4)


def points_on(segments, step=0.02):
    """Points on every segment, `step` apart, (P, 2), and the segment of each (P,)."""
    lengths = np.hypot(*(segments[:, 2:] - segments[:, :2]).T.astype(float))
    counts = (lengths / step).astype(int) + 2
    of = np.repeat(np.arange(len(segments)), counts)
    at = np.concatenate([np.linspace(0, 1, count) for count in counts])[:, None]
    return segments[of, :2] + at * (segments[of, 2:] - segments[of, :2]), of


def distances(points, segments):
    """Distance of points (P, 2) from the nearest segment, (P,)."""
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    there = points[:, None] - start
    at = np.clip((there * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12), 0, 1)
    return np.hypot(*np.moveaxis(there - at[..., None] * along, -1, 0)).min(axis=1)


def test_the_joint_fit_finds_the_lines_of_the_classic_ros_node():
    if not REFERENCE.is_file():
        pytest.skip("line_reference.npz is not present")
    with np.load(REFERENCE) as data:
        bearings = data["angle_min"] + data["angle_increment"] * np.arange(1081)
        found, of = extract_lines(data["ranges"], bearings, FAST, range_min=0.6, range_max=60.0)
        classic, of_classic = data["segments"].astype(float), data["offsets"]
    off = [
        distances(
            points_on(classic[of_classic[n] : of_classic[n + 1]])[0], found[of[n] : of[n + 1]]
        )
        for n in range(len(of) - 1)
    ]
    off = np.concatenate(off)
    assert (off < 0.01).mean() > 0.99  # of the length
    assert off.max() < 0.05


@pytest.fixture(scope="module", params=["lobby", "office", "pillar-hall"])
def drive(request):
    """Ranges, walls in the map, and the lidar's frames, of a simulated drive without people."""
    world = draw_world(request.param, 1)
    batch = simulate_recording(world, HOKUYO_UTM_30LX_EW, seed=1, scans=160, people=0).batch
    rows = slice(None, None, 8)
    frames = lidar_frames(batch.poses[rows], HOKUYO_UTM_30LX_EW.base_T_lidar)
    return batch.ranges[rows], world.primitives, frames


def errors_and_lengths(drive, parameters):
    """Distances of the segments' points from the true surfaces, and the segments' lengths, m."""
    ranges, solid, (axes, origins) = drive
    bearings = HOKUYO_UTM_30LX_EW.bearings
    found, offsets = extract_lines(ranges, bearings, parameters, range_min=0.6, range_max=60.0)
    points, of = points_on(found)
    scan = np.searchsorted(offsets, of, side="right") - 1
    points = np.einsum("nij,nj->ni", axes[scan], points) + origins[scan]
    off_round = np.hypot(*np.moveaxis(points[:, None] - solid.circles[:, :2], -1, 0))
    off_round = np.abs(off_round - solid.circles[:, 2]).min(axis=1)
    off = np.minimum(distances(points, solid.segments), off_round)
    return off, np.hypot(*(found[:, 2:] - found[:, :2]).T.astype(float))


def test_the_joint_fit_is_nearer_to_the_walls_and_finds_as_much_of_them(drive):
    classic, classic_lengths = errors_and_lengths(drive, PUBLISHED)
    joint, lengths = errors_and_lengths(drive, FAST)
    assert np.median(joint) < np.median(classic) < 0.002
    assert joint.mean() < classic.mean()
    assert np.percentile(joint, 95) < np.percentile(classic, 95)
    right = lengths.sum() * (joint < 0.02).mean()
    assert right > 0.99 * classic_lengths.sum() * (classic < 0.02).mean()
    assert len(lengths) < 1.02 * len(classic_lengths)


@pytest.mark.parametrize("value", [0.0, 1e-3, 1e-30])
def test_ranges_of_about_nothing_never_raise_and_give_no_bad_segment(value, parameters):
    scans = np.concatenate((np.full((2, 1081), value), rectangle()))
    scans[1, 40:43], scans[1, 43:] = 0.5, np.inf  # with those before it a chord of 0.5 m
    scans[2, 100:400] = value
    segments, offsets = extract_lines(scans, BEARINGS, parameters, range_min=0.0, range_max=60.0)
    assert offsets[1] == 0
    assert offsets[3] - offsets[2] >= 2
    assert np.isfinite(segments).all()
    assert (np.hypot(*(segments[:, 2:] - segments[:, :2]).T) > 0.1).all()


def test_points_without_any_spread_give_finite_segments_or_none(parameters):
    loose = replace(parameters, min_line_length=1e-9, min_line_points=2, max_line_gap=10.0)
    for increment in (0.0, 1e-12, np.pi):
        bearings = np.arange(40) * increment
        for value in (1e-20, 1e-3, 1.0):
            ranges = np.where(np.arange(40) % 3, value, 2 * value)[None]
            segments, _ = extract_lines(ranges, bearings, loose, range_min=0.0, range_max=9.0)
            assert np.isfinite(segments).all()


def test_no_scans_have_no_segments(parameters):
    segments, offsets = extract_lines(np.zeros((0, 1081)), BEARINGS, parameters, **LIMITS)
    assert segments.shape == (0, 4)
    assert offsets.tolist() == [0]
    segments, offsets = extract_lines(np.zeros((3, 0)), np.zeros(0), parameters, **LIMITS)
    assert segments.shape == (0, 4)
    assert offsets.tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, -np.pi / 2, 0.7])
@pytest.mark.parametrize("radius", [2.0, 0.02])  # the second is seen along itself
def test_a_wall_is_found_whatever_its_direction(angle, radius, parameters):
    bearings = angle + np.linspace(-1.2, 1.2, 400)
    if radius < 1:
        bearings = angle + np.linspace(1.5, 1.565, 400)
    ranges = radius / np.cos(bearings - angle)
    loose = replace(parameters, outlier_dist=1.0)
    segments, _ = extract_lines(ranges[None], bearings, loose, range_min=0.0, range_max=60.0)
    assert len(segments) > 0
    off = segments.reshape(-1, 2, 2) @ (np.cos(angle), np.sin(angle)) - radius
    assert np.abs(off).max() < 1e-3


def test_points_on_one_ray_are_a_segment_on_that_ray(parameters):
    ranges = np.linspace(1.0, 3.0, 60)[None]
    segments, _ = extract_lines(ranges, np.full(60, 0.4), parameters, **LIMITS)
    assert len(segments) == 1
    np.testing.assert_allclose(np.arctan2(segments[0, 1::2], segments[0, ::2]), 0.4, atol=1e-6)
    np.testing.assert_allclose(np.hypot(segments[0, ::2], segments[0, 1::2]), [1, 3], atol=1e-3)


def test_two_points_are_the_segment_between_them(parameters):
    bearings = np.arange(8) * 0.3
    ranges = np.array([1.0, 1.0, 9.0, 9.0, 9.0, 9.0, 1.0, 1.0])[None]
    pair = replace(parameters, min_line_points=2, min_line_length=0.1, min_split_dist=1e-3)
    segments, _ = extract_lines(ranges, bearings, pair, **LIMITS)
    ends = np.stack((np.cos(bearings[:2]), np.sin(bearings[:2])), axis=-1).ravel()
    assert len(segments) == 1
    np.testing.assert_allclose(segments[0], ends, atol=1e-5)


def runs(draw, beams):
    """Draw a scan of walls at any angle, wavy runs and no returns, with noise of any size."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bearings = np.linspace(-2.356, 2.356, beams)
    cuts = np.sort(rng.integers(0, beams, draw(st.integers(0, 12))))
    ranges = np.empty(beams)
    for run in np.split(np.arange(beams), cuts):
        kind = rng.integers(4)
        radius = 10.0 ** rng.uniform(-3, 1.5)
        if kind == 0:
            ranges[run] = rng.choice([0.0, np.nan, np.inf, -np.inf, 100.0])
        elif kind == 1:
            ranges[run] = radius + np.cumsum(rng.normal(0, 0.02, len(run)))
        else:
            normal = rng.uniform(-np.pi, np.pi)
            ranges[run] = radius / np.maximum(np.abs(np.cos(bearings[run] - normal)), 1e-6)
    noise = draw(st.sampled_from([0.0, 0.001, 0.03, 0.3, 30.0]))
    return ranges + rng.normal(0, 1, beams) * noise, bearings


@given(
    data=st.data(),
    beams=st.sampled_from([1, 2, 15, 40, 200, 1081]),
    fit=st.sampled_from(["classic", "joint"]),
)
@settings(max_examples=300, deadline=None)
def test_segments_are_finite_have_a_length_and_lie_within_the_scan(data, beams, fit):
    ranges, bearings = runs(data.draw, beams)
    parameters = LineParameters(fit=fit)
    if fit == "joint":  # the classic node also joins pieces of a few points that are no line
        points = data.draw(st.sampled_from([2, 3, 15]))
        parameters = replace(parameters, min_line_points=points, min_line_length=1e-3)
    segments, offsets = extract_lines(
        ranges[None], bearings, parameters, range_min=0.0, range_max=60.0
    )
    assert offsets.tolist() == [0, len(segments)]
    assert np.isfinite(segments).all()
    assert (np.hypot(*(segments[:, 2:] - segments[:, :2]).T) > 0).all()
    if len(segments):
        used = (ranges.astype(np.float32) > 0) & (ranges < 60)
        points = ranges[used] * (np.cos(bearings[used]), np.sin(bearings[used]))
        ends = segments.reshape(-1, 2)
        assert (ends > points.min(axis=1) - 0.1).all()
        assert (ends < points.max(axis=1) + 0.1).all()
