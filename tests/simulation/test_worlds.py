"""Floor plans, their maps, and worlds that differ from their maps."""

import numpy as np
import pytest
from scipy import ndimage

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.lidars import LIDARS
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, UNKNOWN, SemanticMap
from semantic2d_dataset.simulation.furniture import CHAIR, OTHER, PERSON, SOFA, TABLE, WALL
from semantic2d_dataset.simulation.plans import PLANS
from semantic2d_dataset.simulation.recording import simulate_recording
from semantic2d_dataset.simulation.worlds import (
    draw_world,
    perturb,
    sample_outlines,
    world_from_map,
)

HOKUYO = LIDARS["hokuyo-utm-30lx-ew"]
SEEDS = (0, 1, 2024)
each_plan = pytest.mark.parametrize("name", PLANS)


def cell_values(grid, scene, points):
    cells = scene.cells_of(points)
    return grid[cells[:, 0], cells[:, 1]]


def middle_of(primitives, mine):
    """Mean of an object's corners and centres."""
    split = len(primitives.segments)
    ends = primitives.segments[mine[:split]].reshape(-1, 2)
    return np.concatenate((ends, primitives.circles[mine[split:], :2])).mean(axis=0)


@each_plan
@pytest.mark.parametrize("seed", SEEDS)
def test_every_plan_holds_clutter_and_all_classes_but_people(name, seed):
    assert set(draw_world(name, seed).primitives.labels) == set(range(10)) - {PERSON}


@each_plan
def test_outlines_are_occupied_in_the_map_and_carry_their_class(name):
    world = draw_world(name, 1, clutter=False)
    points, which = sample_outlines(world.primitives, 0.02)
    # an outline on the border of two cells belongs to one of them
    near = ndimage.binary_dilation(world.scene_map.occupancy == OCCUPIED, np.ones((3, 3)))
    assert cell_values(near, world.scene_map, points).all()
    labels = cell_values(world.scene_map.labels, world.scene_map, points)
    assert (labels == world.primitives.labels[which])[labels != 255].mean() > 0.97
    assert ((world.scene_map.labels != 255) == (world.scene_map.occupancy == OCCUPIED)).all()


@each_plan
def test_map_knows_no_clutter(name):
    world = draw_world(name, 1)
    assert OTHER not in world.scene_map.labels
    points, which = sample_outlines(world.primitives, 0.05)
    clutter = points[world.primitives.labels[which] == OTHER]
    assert (cell_values(world.scene_map.occupancy, world.scene_map, clutter) != OCCUPIED).any()


@each_plan
def test_free_space_does_not_leak_out_of_the_building(name):
    occupancy = draw_world(name, 2).scene_map.occupancy
    border = np.concatenate((occupancy[0], occupancy[-1], occupancy[:, 0], occupancy[:, -1]))
    assert (border == UNKNOWN).all()
    assert (occupancy == FREE).mean() > 0.25


@each_plan
@pytest.mark.parametrize("seed", SEEDS)
def test_no_two_surfaces_coincide(name, seed):
    # the nearer of two equal distances would depend on how a machine rounds
    segments = draw_world(name, seed).primitives.segments
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    lengths = np.hypot(*along.T)
    unit = along / lengths[:, None]
    ends = segments.reshape(-1, 2, 2) - start[:, None, None]  # (S, S, 2, 2)
    aside = np.abs(unit[:, None, None, 0] * ends[..., 1] - unit[:, None, None, 1] * ends[..., 0])
    place = unit[:, None, None, 0] * ends[..., 0] + unit[:, None, None, 1] * ends[..., 1]
    overlap = np.minimum(place.max(-1), lengths[:, None]) - np.maximum(place.min(-1), 0)
    coincide = (aside.max(-1) < 1e-3) & (overlap > 1e-3) & ~np.eye(len(segments), dtype=bool)
    assert lengths.min() > 1e-3
    assert not coincide.any()


def test_seed_decides_the_world():
    first, again, other = (draw_world("lounge", s).primitives for s in (4, 4, 5))
    np.testing.assert_array_equal(first.segments, again.segments)
    assert not np.array_equal(first.circles, other.circles)


def test_unknown_plan_is_refused_with_the_known_ones():
    with pytest.raises(InvalidInputError, match="'attic'; known are lobby, corridor"):
        draw_world("attic", 1)


def test_perturbing_moves_the_stated_share_of_chairs_and_tables_by_up_to_a_metre():
    world = draw_world("cafeteria", 1, clutter=False)
    changed = perturb(world, 3, moved_share=1.0, clutter_per_m2=0.0, warp_m=0.0)
    movable = np.isin(world.primitives.labels, (CHAIR, TABLE))
    for number in np.unique(world.primitives.objects):
        mine = world.primitives.objects == number
        before, after = (middle_of(w.primitives, mine) for w in (world, changed))
        moved = np.hypot(*(after - before))
        assert 0.29 < moved < 1.01 if movable[mine].all() else moved < 1e-4


def test_perturbing_warps_walls_by_three_to_five_centimetres_and_keeps_the_map():
    world = draw_world("corridor", 1, clutter=False)
    changed = perturb(world, 3, moved_share=0.0, clutter_per_m2=0.0)
    shift = changed.primitives.segments - world.primitives.segments
    size = np.hypot(shift[:, 0], shift[:, 1])
    labels = world.primitives.labels[: len(size)]
    assert (size[labels != WALL] == 0).all()
    moved = size[size > 0]
    assert moved.min() > 0.0298
    assert moved.max() < 0.0502
    assert changed.scene_map is world.scene_map


def test_perturbing_adds_the_stated_density_of_unmapped_objects():
    world = draw_world("pillar-hall", 1, clutter=False)
    changed = perturb(world, 3, moved_share=0.0, warp_m=0.0, clutter_per_m2=0.1)
    clutter = changed.primitives.labels == OTHER
    area = (world.scene_map.occupancy == FREE).sum() * world.scene_map.resolution**2
    assert len(np.unique(changed.primitives.objects[clutter])) == round(0.1 * area)


def test_world_made_from_a_map_is_seen_where_the_map_says():
    occupancy = np.full((120, 160), FREE, np.uint8)
    occupancy[[0, -1]] = occupancy[:, [0, -1]] = OCCUPIED
    occupancy[50:60, 100:120] = OCCUPIED
    labels = np.full(occupancy.shape, 255, np.uint8)
    labels[50:60, 100:120] = SOFA
    scene = SemanticMap(occupancy, labels, 0.05, Pose2(-1.0, 2.0, 0.0))
    world = world_from_map("room", scene, np.array(((0.5, 3.0), (3.0, 7.0), (6.0, 4.0))))
    found = simulate_recording(world, HOKUYO, seed=1, scans=20, people=0)
    assert set(np.unique(found.batch.labels[found.batch.valid])) == {SOFA, OTHER}
    assert found.batch.ranges[found.batch.valid].max() < 10.0
    assert found.scene_map is scene


def map_with_a_bench():
    occupancy = np.full((120, 160), FREE, np.uint8)
    occupancy[[0, -1]] = occupancy[:, [0, -1]] = OCCUPIED
    occupancy[50:52, 100:110] = OCCUPIED
    labels = np.where(occupancy == OCCUPIED, WALL, 255).astype(np.uint8)
    labels[50:52, 100:110] = TABLE
    return SemanticMap(occupancy, labels, 0.05, Pose2(-1.0, 2.0, 0.0))


TOUR = np.array(((0.5, 3.0), (3.0, 7.0), (6.0, 4.0)))


def test_what_touches_in_a_map_is_one_object_that_moves_as_a_whole():
    world = world_from_map("room", map_with_a_bench(), TOUR)
    table = world.primitives.labels == TABLE
    assert len(np.unique(world.primitives.objects[table])) == 1
    changed = perturb(world, 3, moved_share=1.0, clutter_per_m2=0.0, warp_m=0.0)
    before, after = (w.primitives.segments[table].reshape(-1, 2) for w in (world, changed))
    assert 0.3 <= np.hypot(*(after.mean(axis=0) - before.mean(axis=0))) <= 1.01
    apart = [np.hypot(*(ends[:, None] - ends).T) for ends in (before, after)]
    np.testing.assert_allclose(*apart, atol=1e-3)


def test_walls_of_a_map_bend_by_three_to_five_centimetres():
    world = world_from_map("room", map_with_a_bench(), TOUR)
    changed = perturb(world, 3, moved_share=0.0, clutter_per_m2=0.0)
    shift = changed.primitives.segments - world.primitives.segments
    walls = world.primitives.labels[: len(shift)] == WALL
    size = np.hypot(shift[:, 0], shift[:, 1])
    assert size[walls].min() > 0.0298
    assert size[walls].max() < 0.0502
    assert size[~walls].max() < 1e-9
    assert np.hypot(*(shift[:, 2:] - shift[:, :2]).T).max() < 0.005  # neighbours go together


def test_a_map_without_classes_becomes_walls():
    scene = map_with_a_bench()
    plain = SemanticMap(
        scene.occupancy, np.full_like(scene.labels, 255), scene.resolution, scene.origin
    )
    assert (world_from_map("room", plain, TOUR).primitives.labels == WALL).all()
