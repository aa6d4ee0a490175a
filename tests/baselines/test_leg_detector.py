from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from baselines.leg_detector import PATTERNS, LegParameters, detect_legs, label_people
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LIDARS, LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy
from semantic2d_dataset.simulation.raycast import cast
from tests.baselines.annotated_people import AnnotatedPeople, find_matches, read_people
from tests.baselines.plain_legs import people_of

MID = [replace(spec, base_T_lidar=(0.0,) * 6) for spec in LIDARS.values()]
HOKUYO = MID[0]
ROOM = np.array([(-9, -7, 9, -7), (9, -7, 9, 7), (9, 7, -9, 7), (-9, 7, -9, -7)], float)
APART, STRADDLE, SINGLE = range(3)
LEG = 0.065  # radius, m


def scan(circles, lidar: LidarSpec = HOKUYO, walls=ROOM, noise_m: float = 0.01) -> np.ndarray:
    """Ranges (1, B) f4 seen from the middle of a room with round things in it."""
    things = np.reshape(np.array(circles, float), (-1, 3))
    hits = cast(walls, things, np.zeros((1, 0, 3)), np.zeros((1, 3)), lidar)
    noise = np.random.default_rng(0).normal(scale=noise_m, size=hits.distances.shape)
    return (hits.distances + noise).astype(np.float32)


def at(distance: float, bearing: float, radius: float = LEG) -> tuple[float, float, float]:
    return (distance * np.cos(bearing), distance * np.sin(bearing), radius)


def pair(distance: float, bearing: float, apart: float = 0.25) -> list:
    """Two legs side by side as the lidar sees them."""
    half = apart / 2 / distance
    return [at(distance, bearing - half), at(distance, bearing + half)]


def detect(ranges, lidar: LidarSpec = HOKUYO, parameters=None):
    limits = {"range_min": lidar.range_min, "range_max": lidar.range_max}
    return detect_legs(ranges, lidar.bearings, parameters, **limits)


def far_off(found, places) -> float:
    """How far the people found are from where they are at worst, m."""
    apart = np.linalg.norm(found.positions[:, None] - np.array(places)[:, :2], axis=-1)
    return float(apart.min(axis=1).max())


@pytest.mark.parametrize("lidar", MID, ids=lambda lidar: lidar.name)
@pytest.mark.parametrize("distance", [0.8, 1.5, 3.0, 5.0])
def test_legs_apart_are_one_person_half_way_between_them(lidar, distance):
    for bearing in (-2.0, -0.4, 0.0, 1.3):
        found = detect(scan(pair(distance, bearing), lidar), lidar)
        assert found.patterns.tolist() == [APART]
        assert far_off(found, [at(distance, bearing)]) < 0.1


@pytest.mark.parametrize("lidar", MID, ids=lambda lidar: lidar.name)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_leg_half_behind_the_other_is_a_straddle(lidar, side):
    legs = [at(2.0, 0.5), at(2.3, 0.5 + side * 0.055)]
    found = detect(scan(legs, lidar), lidar)
    assert found.patterns.tolist() == [STRADDLE]
    assert far_off(found, [at(2.15, 0.5)]) < 0.12


@pytest.mark.parametrize("legs", [[at(2.5, 0.3)], [at(2.5, 0.3 - 0.02), at(2.5, 0.3 + 0.02)]])
def test_a_single_leg_and_legs_together_are_one_person(legs):
    found = detect(scan(legs))
    assert [PATTERNS[i] for i in found.patterns] == ["single leg or legs together"]
    assert far_off(found, [at(2.5, 0.3)]) < 0.1


def test_everybody_of_a_group_is_found_once():
    bearings = (-1.8, -0.9, 0.0, 0.9, 1.8)
    found = detect(scan([leg for b in bearings for leg in pair(2.0, b)]))
    assert found.patterns.tolist() == [APART] * 5
    assert far_off(found, [at(2.0, b) for b in bearings]) < 0.1


def test_walls_corners_and_what_is_too_thick_or_thin_are_nobody():
    walls = np.array([(2, -2, 2, 1), (2, 1, 3, 1), (-2, -1, -1, 3)], float)
    assert not detect(scan([])).patterns.size
    assert not detect(scan([], walls=np.concatenate((ROOM, walls)))).patterns.size
    assert not detect(scan([at(3.0, 0.0, 0.4), at(3.0, 1.5, 0.02)])).patterns.size


def test_legs_beyond_the_largest_distance_are_left_alone():
    legs = scan(pair(5.0, 0.0))
    assert detect(legs).patterns.size == 1
    assert detect(legs, parameters=LegParameters(max_distance_m=4.0)).patterns.size == 0


def test_legs_too_far_apart_are_two_people():
    found = detect(scan(pair(2.0, 0.0, 0.6)))
    assert found.patterns.tolist() == [SINGLE, SINGLE]


@pytest.mark.parametrize("nothing", [0.0, np.inf, np.nan, -np.inf, 60.0, 0.05])
def test_no_return_is_far_away_whatever_stands_for_it(nothing):
    ranges = scan(pair(2.0, 0.0), walls=np.zeros((0, 4)))
    ranges[~HOKUYO.has_return(ranges)] = nothing
    found = detect(ranges)
    assert found.patterns.tolist() == [APART]
    labels = label_people(ranges, HOKUYO)
    assert np.array_equal(labels == 4, HOKUYO.has_return(ranges))


@pytest.mark.parametrize("hole", [np.nan, 0.0, 8.0])
def test_a_beam_that_the_cloth_swallows_does_not_split_a_leg_and_is_no_leg(hole):
    ranges = scan([at(1.5, 0.0)])
    ranges[0, 540] = hole
    assert detect(ranges).patterns.tolist() == [SINGLE]
    labels = label_people(ranges, HOKUYO)[0]
    assert labels[538:543].tolist() == [4, 4, 0, 4, 4]


def test_exactly_the_beams_on_legs_are_labelled():
    legs = [*pair(2.0, 0.4), *pair(3.0, -1.0)]
    clean = cast(ROOM, np.array(legs), np.zeros((1, 0, 3)), np.zeros((1, 3)), HOKUYO)
    labels = label_people(clean.distances.astype(np.float32), HOKUYO)
    assert np.array_equal(labels == 4, clean.primitives >= len(ROOM))


def test_ids_are_those_of_the_taxonomy():
    own = Taxonomy(("people", "rest"), ((1, 2, 3), (4, 5, 6)), background_id=1)
    labels = label_people(scan(pair(2.0, 0.0)), HOKUYO, taxonomy=own)
    assert labels.dtype == np.uint8
    assert set(np.unique(labels)) == {0, 1}
    assert (labels == 0).sum() < 100
    without = Taxonomy(("rest", "Wall"), ((1, 2, 3), (4, 5, 6)))
    with pytest.raises(InvalidInputError, match="unknown class 'Person'"):
        label_people(scan([]), HOKUYO, taxonomy=without)


@pytest.mark.parametrize("shape", [(0, 1081), (3, 1081), (0, 1), (4, 1), (4, 2), (2, 0)])
def test_scans_without_anything_have_nobody(shape):
    found = detect_legs(
        np.full(shape, np.nan), np.arange(shape[1]) * 0.01, range_min=0.1, range_max=10.0
    )
    assert found.offsets.tolist() == [0] * (shape[0] + 1)
    assert found.positions.shape == (0, 2)
    assert found.spans.shape == (0, 2, 2)


def test_wrong_shapes_and_settings_are_refused():
    with pytest.raises(InvalidInputError, match=r"found \(2, 3\) and \(4,\)"):
        detect_legs(np.ones((2, 3)), np.arange(4), range_min=0.1, range_max=10)
    with pytest.raises(InvalidInputError, match="above 0"):
        LegParameters(min_leg_m=float("nan"))
    with pytest.raises(InvalidInputError, match="odd"):
        LegParameters(window_beams=4)


@st.composite
def scans(draw) -> tuple[np.ndarray, np.ndarray, LegParameters]:
    """Steps at heights that legs have, of widths that legs have, with holes."""
    seed, beams = draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([1, 2, 5, 90, 400]))
    rng = np.random.default_rng(seed)
    step = 3.0 / beams
    pieces = (rng.random((6, beams)) < draw(st.floats(0.02, 0.6))).cumsum(axis=1)
    heights = rng.choice([1.0, 1.15, 1.4, 2.0, 3.0, 9.5], (6, beams + 1))
    ranges = np.take_along_axis(heights, pieces, axis=1) + rng.normal(scale=0.02, size=(6, beams))
    ranges[rng.random(ranges.shape) < draw(st.floats(0, 0.2))] = np.nan
    wide = LegParameters(min_leg_m=0.03, min_together_m=0.03, max_together_m=0.5)
    parameters = draw(st.sampled_from([LegParameters(), wide, LegParameters(window_beams=1)]))
    return ranges.astype(np.float32), -1.5 + step * np.arange(beams), parameters


@given(scans())
@settings(max_examples=60)
def test_any_scan_gives_what_the_plain_way_gives(given_scans):
    ranges, bearings, parameters = given_scans
    found = detect_legs(ranges, bearings, parameters, range_min=0.1, range_max=9.0)
    for n, (first, past) in enumerate(itertools.pairwise(found.offsets)):
        plain = people_of(ranges[n], bearings, parameters, 0.1, 9.0)
        assert found.patterns[first:past].tolist() == [person.pattern for person in plain]
        assert found.spans[first:past].tolist() == [np.array(p.legs).tolist() for p in plain]


@given(scans())
@settings(max_examples=30)
def test_no_beam_belongs_to_two_people(given_scans):
    ranges, bearings, parameters = given_scans
    found = detect_legs(ranges, bearings, parameters, range_min=0.1, range_max=9.0)
    for first, past in itertools.pairwise(found.offsets):
        legs = {tuple(leg) for i in range(first, past) for leg in found.spans[i].tolist()}
        beams = [k for leg in legs for k in range(leg[0], leg[1] + 1)]
        assert len(beams) == len(set(beams))


def test_a_scan_gives_the_same_alone_and_among_others_in_any_order():
    rng = np.random.default_rng(3)
    many = np.concatenate(
        [
            scan([leg for _ in range(3) for leg in pair(*rng.uniform((1, -2), (4, 2)))])
            for _ in range(9)
        ]
    )
    order = rng.permutation(len(many))
    together, shuffled = detect(many), detect(many[order])
    for n, source in enumerate(order):
        a, b = (slice(*f.offsets[i : i + 2]) for f, i in ((shuffled, n), (together, source)))
        alone = detect(many[source : source + 1])
        assert np.array_equal(shuffled.positions[a], together.positions[b])
        assert np.array_equal(alone.positions, together.positions[b])
    assert np.array_equal(label_people(many[order], HOKUYO), label_people(many, HOKUYO)[order])


@pytest.fixture(scope="module")
def people(shared_data: Path, tmp_path_factory) -> AnnotatedPeople:
    return read_people(shared_data, tmp_path_factory.mktemp("people"))


def test_annotations_lie_where_the_lidar_sees_something(people: AnnotatedPeople):
    assert people.nearest_return().max() < 0.3
    assert (people.nearest_return(later=1) < 0.3).mean() < 0.8
    assert (people.nearest_return(later=-1) < 0.3).mean() < 0.8


# A lidar at the height of ankles: those are thinner than the legs of the paper.
@pytest.mark.parametrize(
    ("parameters", "recall"),
    [(LegParameters(), 0.55), (LegParameters(min_leg_m=0.05, min_together_m=0.05), 0.9)],
)
def test_real_people_are_found(people: AnnotatedPeople, parameters, recall):
    found = detect_legs(
        people.ranges,
        people.bearings,
        parameters,
        range_min=people.range_min,
        range_max=people.range_max,
    )
    matched, _ = find_matches(found, people)
    assert matched.mean() > recall
