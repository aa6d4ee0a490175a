"""Recordings in memory."""

import numpy as np
import pytest
from scipy import ndimage

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import to_base, to_points, transform
from semantic2d_dataset.scene.lidars import LIDARS
from semantic2d_dataset.simulation.recording import (
    record,
    record_blocks,
    simulate_recording,
    stage,
)
from semantic2d_dataset.simulation.worlds import draw_world

HOKUYO = LIDARS["hokuyo-utm-30lx-ew"]


@pytest.mark.parametrize("lidar", LIDARS.values(), ids=LIDARS)
def test_nearest_mapped_cell_names_nearly_every_beam_where_world_is_map(lidar):
    world = draw_world("pillar-hall", 5, clutter=False)
    batch = simulate_recording(world, lidar, seed=7, scans=60, people=0).batch
    points = to_base(to_points(batch.ranges, lidar.bearings), lidar.base_T_lidar)
    cells = world.scene_map.cells_of(transform(batch.poses, points)[batch.valid])
    free = world.scene_map.occupancy != 100
    distance, (row, column) = ndimage.distance_transform_edt(free, return_indices=True)
    at = tuple(cells.T)
    assert (distance[at] <= 2).mean() > 0.995
    named = world.scene_map.labels[row[at], column[at]]
    assert (named == batch.labels[batch.valid]).mean() > 0.99


def test_lidars_of_one_recording_share_poses_and_stamps():
    scene = stage(draw_world("lounge", 1), seed=2, scans=10)
    first, second = (record(scene, LIDARS[name], seed=2) for name in ("wlr-716", "rplidar-s2"))
    np.testing.assert_array_equal(first.batch.poses, second.batch.poses)
    np.testing.assert_array_equal(first.batch.stamps_ns, second.batch.stamps_ns)
    assert (np.diff(first.batch.stamps_ns) == 50_000_000).all()


@pytest.mark.parametrize("name", LIDARS)
def test_recording_is_the_same_in_blocks_of_64_and_of_1000_scans(name):
    scene = stage(draw_world("lounge", 1), seed=2, scans=130)
    small, big = (
        list(record_blocks(scene, LIDARS[name], seed=3, block=block)) for block in (64, 1000)
    )
    assert [len(batch) for batch in small] == [64, 64, 2]
    assert len(big) == 1
    for field in ("ranges", "intensities", "labels", "poses", "stamps_ns"):
        joined = np.concatenate([getattr(batch, field) for batch in small])
        np.testing.assert_array_equal(joined, getattr(big[0], field))
    assert (big[0].ranges[:64] != big[0].ranges[64:128]).any()


def test_people_are_labelled_person_and_there_are_none_without_them():
    world = draw_world("lobby", 1)
    crowded = simulate_recording(world, HOKUYO, seed=2, scans=5, people=30).batch
    lonely = simulate_recording(world, HOKUYO, seed=2, scans=5, people=0).batch
    assert (crowded.labels == 4).mean() > 0.03
    assert not (lonely.labels == 4).any()


def test_recording_without_scans_is_refused():
    with pytest.raises(InvalidInputError, match="at least 1 scan"):
        stage(draw_world("lobby", 1), seed=2, scans=0)
