from dataclasses import replace

import numpy as np
import pytest

from salsa.labelling import Transfer, transfer_labels
from semantic2d_dataset.errors import AlignmentError, InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED
from tests.salsa import rooms

PERSON = (5.1, 2.4, 5.4, 2.7)
OTHER, PERSON_ID, WALL = 0, SEMANTIC2D.id_of("Person"), SEMANTIC2D.id_of("Wall")


def scans(count=20, lidar=rooms.LIDAR):
    """Scans at exactly known poses, and which beams meet which box."""
    poses = rooms.true_poses(count)
    batch = rooms.batch_at(poses, poses, lidar, extra=[PERSON], noise=0.003)
    boxes = {**rooms.BOXES, "Person": PERSON}
    ranges = {
        name: [rooms.cast(pose, lidar, [box]) for pose in poses] for name, box in boxes.items()
    }
    stacked = np.stack([np.stack(ranges[name]) for name in boxes])  # (boxes, N, B)
    ids = np.array([SEMANTIC2D.id_of(name) for name in boxes], np.uint8)
    truth = ids[stacked.argmin(axis=0)]
    return batch, poses, np.where(batch.valid, truth, OTHER)


@pytest.mark.parametrize("lidar", [rooms.LIDAR, rooms.UPSIDE_DOWN])
def test_points_take_the_class_of_their_object_and_people_are_found(lidar):
    batch, poses, truth = scans(lidar=lidar)
    labels, _ = transfer_labels(batch, poses, rooms.room_map(), np.ones(20, bool))
    valid = batch.valid
    assert (labels == truth)[valid].mean() > 0.99
    assert (truth == PERSON_ID).sum() > 50
    assert (labels == PERSON_ID)[truth == PERSON_ID].all()


def test_a_beam_without_a_return_is_other_and_of_no_confidence():
    batch, poses, _ = scans(3)
    labels, confidence = transfer_labels(batch, poses, rooms.room_map(), np.ones(3, bool))
    assert (~batch.valid).any()
    assert (labels[~batch.valid] == OTHER).all()
    assert (confidence[~batch.valid] == 0).all()
    assert (confidence[batch.valid] > 0).all()


def test_a_scan_that_is_not_accepted_or_has_no_pose_stays_unlabelled():
    batch, poses, _ = scans(3)
    poses[2] = np.nan
    accepted = np.array((True, False, True))
    labels, confidence = transfer_labels(batch, poses, rooms.room_map(), accepted)
    assert (labels[1:] == UNLABELLED).all()
    assert (confidence[1:] == 0).all()
    assert (labels[0] != UNLABELLED).all()


def test_an_occupied_cell_without_a_class_gives_other():
    batch, poses, truth = scans(3)
    scene = rooms.room_map()
    no_wall = np.where(scene.labels == WALL, UNLABELLED, scene.labels).astype(np.uint8)
    labels, _ = transfer_labels(batch, poses, replace(scene, labels=no_wall), np.ones(3, bool))
    on_wall = batch.valid & (truth == WALL)
    assert (labels[on_wall] == OTHER).mean() > 0.98
    assert not (labels == WALL).any()


def test_points_in_unknown_or_unmapped_space_are_other_and_never_person():
    batch, poses, _ = scans(3)
    batch.ranges[0] = 3.9  # beyond the walls on three sides
    batch.ranges[1] = 19.0  # beyond the map
    labels, _ = transfer_labels(batch, poses, rooms.room_map(), np.ones(3, bool))
    assert (labels[1] == OTHER).all()
    assert (labels[0] == OTHER).sum() > 100


def test_a_person_in_the_map_is_free_space():
    batch, poses, _ = scans(3)
    scene = rooms.room_map()
    cells = scene.cells_of(np.array(((5.1, 2.4), (5.4, 2.7))))
    occupancy, mapped = scene.occupancy.copy(), scene.labels.copy()
    place = slice(cells[0, 0], cells[1, 0] + 1), slice(cells[0, 1], cells[1, 1] + 1)
    occupancy[place], mapped[place] = 100, PERSON_ID
    haunted = replace(scene, occupancy=occupancy, labels=mapped)
    labels, confidence = transfer_labels(batch, poses, haunted, np.ones(3, bool))
    plain, sure = transfer_labels(batch, poses, scene, np.ones(3, bool))
    np.testing.assert_array_equal(labels, plain)
    np.testing.assert_array_equal(confidence, sure)


def test_confidence_falls_with_distance_and_with_the_quality_of_the_scan():
    batch, poses, truth = scans(3)
    scene, accepted = rooms.room_map(), np.ones(3, bool)
    _, sure = transfer_labels(batch, poses, scene, accepted)
    _, half = transfer_labels(batch, poses, scene, accepted, quality=np.full(3, 0.5))
    _, off = transfer_labels(batch, poses + np.array((0.08, 0.08, 0.0)), scene, accepted)
    wall = batch.valid & (truth == WALL)
    np.testing.assert_allclose(half[wall], sure[wall] / 2, atol=1)
    assert off[wall].mean() < 0.8 * sure[wall].mean()


def test_a_map_without_a_class_is_an_error():
    batch, poses, _ = scans(1)
    scene = rooms.room_map()
    bare = replace(scene, labels=np.full_like(scene.labels, UNLABELLED))
    with pytest.raises(AlignmentError, match="annotate the map first"):
        transfer_labels(batch, poses, bare, np.ones(1, bool))


def test_distances_out_of_range_are_refused():
    with pytest.raises(InvalidInputError, match="transfer distances"):
        Transfer(object_m=0.0)
