from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from baselines.line_detector import ON_LINE_M, RANGE_MIN_M, label_walls
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import to_points
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from semantic2d_dataset.scene.lines import FAST, PUBLISHED, extract_lines
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.simulation.raycast import Hits, cast

LIDAR = replace(HOKUYO_UTM_30LX_EW, base_T_lidar=(0.0,) * 6)
WALL = 9
ROOM = np.array([(-4, -3, 5, -3), (5, -3, 5, 4), (5, 4, -4, 4), (-4, 4, -4, -3)], float)
ROUND = np.array([(2.0, 0.5, 0.1), (-1.0, 1.5, 0.2), (1.0, -2.0, 0.07)])


def look(poses: int = 1) -> tuple[np.ndarray, Hits]:
    """Ranges (N, B) and hits in a room with round things, from places in its middle."""
    places = np.random.default_rng(1).uniform((-0.5, -0.5, -3), (0.5, 0.5, 3), (poses, 3))
    hits = cast(ROOM, ROUND, np.zeros((poses, 0, 3)), places, LIDAR)
    noise = np.random.default_rng(2).normal(scale=0.01, size=hits.distances.shape)
    return (hits.distances + noise).astype(np.float32), hits


@pytest.mark.parametrize("parameters", [PUBLISHED, FAST])
def test_walls_are_found_and_round_things_are_not(parameters):
    ranges, hits = look(20)
    labels = label_walls(ranges, LIDAR, parameters)
    on_wall = hits.primitives < len(ROOM)
    assert set(np.unique(labels)) == {0, WALL}
    assert (labels[on_wall] == WALL).mean() > 0.98
    assert (labels[~on_wall] == WALL).mean() < 0.02


def test_exactly_the_beams_near_a_segment_are_walls():
    ranges, _ = look(5)
    limits = {"range_min": RANGE_MIN_M, "range_max": LIDAR.range_max}
    segments, offsets = extract_lines(ranges, LIDAR.bearings, **limits)
    points = to_points(ranges, LIDAR.bearings)
    labels = label_walls(ranges, LIDAR)
    for n in range(5):
        near = np.zeros(LIDAR.beams, bool)
        for x1, y1, x2, y2 in segments[offsets[n] : offsets[n + 1]].astype(float):
            way = np.array((x2 - x1, y2 - y1)) / np.hypot(x2 - x1, y2 - y1)
            along = (points[n] - (x1, y1)) @ way
            across = np.abs((points[n] - (x1, y1)) @ (-way[1], way[0]))
            past = np.hypot(x2 - x1, y2 - y1) + ON_LINE_M
            near |= (across <= ON_LINE_M) & (along >= -ON_LINE_M) & (along <= past)
        assert np.array_equal(labels[n] == WALL, near)


def test_a_larger_distance_never_labels_less():
    ranges, _ = look(5)
    counts = [(label_walls(ranges, LIDAR, on_line_m=d) == WALL).sum() for d in (0.01, 0.03, 0.2)]
    assert counts == sorted(counts)
    assert counts[0] < counts[2]


def test_a_wall_nearer_than_the_limit_makes_no_line_but_its_beams_may_lie_on_one():
    near = np.array([(0.3, -3.0, 0.3, 3.0)])
    hits = cast(near, np.zeros((0, 3)), np.zeros((1, 0, 3)), np.zeros((1, 3)), LIDAR)
    close = hits.distances < RANGE_MIN_M
    assert (label_walls(hits.distances, LIDAR)[close] == WALL).all()
    assert not label_walls(np.where(close, hits.distances, 0.0), LIDAR).any()


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf, -np.inf, 100.0, 0.01])
def test_a_beam_without_a_return_is_background(nothing):
    ranges, _ = look()
    ranges[0, ::7] = nothing
    labels = label_walls(ranges, LIDAR)
    assert (labels == WALL).any()
    assert not labels[0, ::7].any()
    assert not label_walls(np.full((3, LIDAR.beams), nothing), LIDAR).any()


def test_no_scans_give_no_labels():
    assert label_walls(np.zeros((0, LIDAR.beams)), LIDAR).shape == (0, LIDAR.beams)


def test_a_scan_gives_the_same_alone_and_among_others_in_any_order():
    ranges, _ = look(8)
    order = np.random.default_rng(0).permutation(8)
    together = label_walls(ranges, LIDAR)
    assert np.array_equal(label_walls(ranges[order], LIDAR), together[order])
    assert np.array_equal(label_walls(ranges[3:4], LIDAR), together[3:4])


def test_ids_are_those_of_the_taxonomy():
    ranges, _ = look()
    own = Taxonomy(("wall", "rest"), ((1, 2, 3), (4, 5, 6)), background_id=1)
    assert np.array_equal(
        label_walls(ranges, LIDAR, taxonomy=own) == 0, label_walls(ranges, LIDAR) == WALL
    )
    without = Taxonomy(("rest", "Person"), ((1, 2, 3), (4, 5, 6)))
    with pytest.raises(InvalidInputError, match="unknown class 'Wall'"):
        label_walls(ranges, LIDAR, taxonomy=without)


def test_what_does_not_fit_is_refused():
    with pytest.raises(InvalidInputError, match=r"expected ranges \(N, 1081\), found \(2, 5\)"):
        label_walls(np.ones((2, 5)), LIDAR)
    for distance in (0.0, -1.0, float("nan")):
        with pytest.raises(InvalidInputError, match="distance above 0"):
            label_walls(np.ones((2, 1081)), LIDAR, on_line_m=distance)
