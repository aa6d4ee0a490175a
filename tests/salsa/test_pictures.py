from dataclasses import replace

import numpy as np
import pytest

from salsa.pictures import SLATE, Sheet
from semantic2d_dataset.scene.geometry import Pose2, compose
from semantic2d_dataset.scene.maps import FREE, OCCUPIED
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from tests.salsa import rooms

WALL = SEMANTIC2D.id_of("Wall")


def labelled_batch(poses):
    batch = rooms.batch_at(poses, poses, noise=0.0)
    return replace(batch, labels=np.full(batch.ranges.shape, WALL, np.uint8))


@pytest.mark.parametrize("origin", [Pose2(0, 0, 0), Pose2(-3.0, 2.0, 0.7)])
def test_points_are_painted_on_the_cells_that_they_met(origin):
    scene, poses = rooms.room_map(origin), rooms.true_poses(3)
    sheet = Sheet.over(scene, whole=True)
    canvas = sheet.background(scene)
    sheet.paint(canvas, labelled_batch(poses), rooms.room_map(), SEMANTIC2D)
    expected = canvas.copy()
    canvas = sheet.background(scene)
    batch = labelled_batch(poses)
    turned = replace(batch, poses=compose(origin.as_array(), poses))
    sheet.paint(canvas, turned, scene, SEMANTIC2D)
    np.testing.assert_array_equal(canvas, expected)
    painted = (canvas == SEMANTIC2D.colours[WALL]).all(axis=-1)
    assert painted.sum() > 200
    assert (scene.occupancy[painted] == OCCUPIED).mean() > 0.9


def test_a_sheet_shows_what_is_occupied_with_a_margin():
    scene = rooms.room_map()
    sheet = Sheet.over(scene)
    rows, columns = np.nonzero(scene.occupancy == OCCUPIED)
    assert sheet.left == max(columns.min() - 20, 0)
    assert sheet.bottom + sheet.rows == min(rows.max() + 21, rooms.SHAPE[0])
    canvas = sheet.background(scene)
    assert canvas.shape == (*sheet.shape, 3)
    row, column = rows[0] - sheet.bottom, columns[0] - sheet.left
    assert canvas[row, column].tolist() == list(SLATE)


@pytest.mark.parametrize("most", [7, 40, 100, 180, 400, 2000])
def test_a_sheet_keeps_to_its_size_and_a_thin_wall_stays(most):
    scene = rooms.room_map()
    scene.occupancy[:] = FREE
    scene.occupancy[3, 170] = OCCUPIED
    scene.occupancy[130, 5] = OCCUPIED
    sheet = Sheet.over(scene, whole=True, pixels=3, max_pixels=most)
    canvas = sheet.background(scene)
    assert max(canvas.shape) <= min(most, 3 * max(rooms.SHAPE))
    slate = (canvas == SLATE).all(axis=-1)
    row, column = np.floor(np.array((3.5, 170.5)) * 0.05 * sheet.pixels_per_m).astype(int)
    assert slate[row, column]
    assert slate.sum() == 2 * sheet.pixels**2


def test_points_outside_and_scans_without_a_pose_are_left_out():
    scene, poses = rooms.room_map(), rooms.true_poses(2)
    poses[0] = np.nan
    poses[1] += (500, 0, 0)
    sheet = Sheet.over(scene)
    canvas = sheet.background(scene)
    batch = replace(labelled_batch(rooms.true_poses(2)), poses=poses)
    sheet.paint(canvas, batch, scene, SEMANTIC2D)
    np.testing.assert_array_equal(canvas, sheet.background(scene))


def test_a_map_without_objects_is_shown_whole():
    scene = rooms.room_map()
    scene.occupancy[:] = FREE
    assert Sheet.over(scene).shape == rooms.SHAPE
