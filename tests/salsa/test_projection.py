"""Detections projected onto the beams of a room with a dog and people in it."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from salsa.cameras import Camera, mount_matrix, project
from salsa.detections import Detections
from salsa.labelling import transfer_labels
from salsa.projection import Matching, apply_detections, check_detections
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import compose
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from tests.salsa import rooms

TAXONOMY = Taxonomy(
    (*SEMANTIC2D.names, "Dog", "Bicycle"), (*SEMANTIC2D.colours, (120, 80, 20), (20, 80, 120))
)
PERSON, DOG, BICYCLE = (TAXONOMY.id_of(name) for name in ("Person", "Dog", "Bicycle"))
OTHER = 0

POSE = np.array((1.2, 3.5, 0.0))
FORWARD = (0.2, 0.05, 0.6, -np.pi / 2, 0.0, -np.pi / 2)
CAMERA = Camera(
    640, 480, 300.0, 305.0, 322.0, 238.0, mount_matrix(FORWARD), distortion=(-0.1, 0.01, 0, 0, 0)
)
UPRIGHT = replace(rooms.LIDAR, base_T_lidar=(-0.12, 0.05, 0.15, 0.0, 0.0, 0.0))
SIDEWAYS = replace(rooms.LIDAR, base_T_lidar=(0.065, 0.0, 0.11, 0.02, -0.01, np.pi / 2))
# x1, y1, x2, y2, height in m: a dog, one who walks beside it, and one who is seen past its back
THE_DOG = (3.2, 3.4, 3.8, 3.65, 0.5)
BESIDE = (3.4, 4.3, 3.7, 4.6, 1.7)
BEHIND = (5.5, 3.7, 5.8, 4.2, 1.7)
THINGS = (THE_DOG, BESIDE, BEHIND)


def scans(poses, lidar=UPRIGHT, things=THINGS):
    """A batch, its labels and confidence by the map, and which thing each beam meets (N, B)."""
    poses = np.atleast_2d(poses)
    batch = rooms.batch_at(poses, poses, lidar, [thing[:4] for thing in things], noise=0.003)
    ranges = [
        [rooms.cast(pose, lidar, boxes) for pose in poses]
        for boxes in (list(rooms.BOXES.values()), *([thing[:4]] for thing in things))
    ]
    meets = np.where(batch.valid, np.array(ranges).argmin(axis=0) - 1, -1)  # -1: mapped
    accepted = np.ones(len(poses), bool)
    labels, confidence = transfer_labels(batch, poses, rooms.room_map(), accepted)
    assert all((labels[meets == n] == PERSON).all() for n in range(len(things)))
    return batch, labels, confidence, meets


def box_of(thing, pose=POSE, camera=CAMERA, lidar=UPRIGHT):
    """The box of a thing in the image, exactly, cut at its borders."""
    x1, y1, x2, y2, height = thing
    grid = [np.linspace(*ends, 9) for ends in ((x1, x2), (y1, y2), (0.0, height))]
    corners = np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 3)
    base = mount_matrix((pose[0], pose[1], 0, 0, 0, pose[2]))
    camera_T_map = np.linalg.inv(base @ camera.in_base(lidar))
    pixels = project(corners @ camera_T_map[:3, :3].T + camera_T_map[:3, 3], camera)
    size = (camera.width, camera.height)
    return (*pixels.min(axis=0).clip(0, size), *pixels.max(axis=0).clip(0, size))


def seen(batch, boxes, ids, *, scores=None, late_s=0.0):
    """Detections of the same boxes in the image of each scan."""
    count, frames = len(boxes), len(batch)
    return Detections(
        batch.stamps_ns + int(late_s * 1e9),
        np.arange(frames + 1) * count,
        np.tile(np.array(boxes, float).reshape(-1, 4), (frames, 1)),
        np.tile(np.array(ids, np.uint8), frames),
        np.tile(np.ones(count) if scores is None else np.array(scores, float), frames),
    )


def apply(made, detections, *, camera=CAMERA, poses=None, matching=None):
    batch, labels, confidence, _ = made
    return apply_detections(
        batch,
        batch.poses if poses is None else poses,
        labels,
        confidence,
        camera,
        detections,
        matching=matching or Matching(),
        taxonomy=TAXONOMY,
    )


@pytest.mark.parametrize("lidar", [UPRIGHT, rooms.UPSIDE_DOWN, SIDEWAYS])
@pytest.mark.parametrize("on_lidar", [False, True])
def test_the_dog_becomes_a_dog_and_all_else_stays(lidar, on_lidar):
    made = scans(POSE, lidar)
    batch, before, _, meets = made
    camera = CAMERA
    if on_lidar:
        pose = np.linalg.inv(mount_matrix(lidar.base_T_lidar)) @ CAMERA.parent_T_camera
        camera = replace(CAMERA, parent="lidar", parent_T_camera=pose)
    boxes = [box_of(thing, camera=camera, lidar=lidar) for thing in THINGS]
    labels, _ = apply(made, seen(batch, boxes, [DOG, PERSON, PERSON]), camera=camera)
    assert (meets == 0).sum() > 10
    assert (meets == 2).sum() > 2
    assert (labels[meets == 0] == DOG).all()
    np.testing.assert_array_equal(labels[meets != 0], before[meets != 0])


def test_who_is_seen_past_the_dog_stays_a_person_without_a_detection_too():
    made = scans(POSE)
    batch, _, _, meets = made
    left, top, right, bottom = box_of(THE_DOG)
    wide = (left - 60, top, right + 60, bottom)  # and shows the person behind, and walls
    labels, _ = apply(made, seen(batch, [wide], [DOG]), matching=Matching(above=None))
    assert (labels[meets == 0] == DOG).all()
    assert (labels[meets == 2] == PERSON).all()
    assert not (labels[meets == -1] == DOG).any()


def test_what_moves_and_is_not_detected_stays_a_person():
    made = scans(POSE)
    batch, before, confidence, _ = made
    none = Detections(
        batch.stamps_ns, np.zeros(2, np.int64), np.empty((0, 4)), np.empty(0, np.uint8), np.empty(0)
    )
    for detections in (none, replace(none, stamps_ns=none.stamps_ns[:0], offsets=np.zeros(1, int))):
        labels, sure = apply(made, detections)
        np.testing.assert_array_equal(labels, before)
        np.testing.assert_array_equal(sure, confidence)


def test_the_inputs_are_left_as_they_are_and_confidence_falls_with_the_score():
    made = scans(POSE)
    batch, before, confidence, meets = made
    kept = before.copy(), confidence.copy()
    boxes = [box_of(THE_DOG), box_of(BESIDE)]
    labels, sure = apply(made, seen(batch, boxes, [DOG, PERSON], scores=[0.5, 0.5]))
    np.testing.assert_array_equal(before, kept[0])
    np.testing.assert_array_equal(confidence, kept[1])
    assert (labels[meets == 0] == DOG).all()
    np.testing.assert_array_equal(sure[meets == 0], confidence[meets == 0] // 2)
    np.testing.assert_array_equal(sure[meets != 0], confidence[meets != 0])


@pytest.mark.parametrize("yaw", [np.pi, np.pi / 2, -np.pi / 2])
def test_a_camera_turned_away_changes_nothing(yaw):
    made = scans(POSE)
    batch, before, _, _ = made
    turned = replace(
        CAMERA,
        parent_T_camera=mount_matrix((0, 0, 0, 0, 0, yaw)) @ CAMERA.parent_T_camera,
    )
    whole = [(0, 0, CAMERA.width, CAMERA.height)]
    labels, _ = apply(made, seen(batch, whole, [DOG]), camera=turned)
    outside = np.isin(made[3], (0, 1, 2))
    np.testing.assert_array_equal(labels[outside], before[outside])


def test_images_of_another_time_change_nothing_and_a_clock_offset_brings_them_back():
    made = scans(POSE)
    batch, before, _, meets = made
    late = seen(batch, [box_of(THE_DOG)], [DOG], late_s=0.3)
    np.testing.assert_array_equal(apply(made, late)[0], before)
    for matching in (Matching(max_gap_s=0.31), Matching(clock_offset_s=-0.3)):
        assert (apply(made, late, matching=matching)[0][meets == 0] == DOG).all()


def test_only_the_nearest_image_counts():
    made = scans(POSE)
    batch, before, _, meets = made
    stamp, box = int(batch.stamps_ns[0]), box_of(THE_DOG)
    for empty_s, dog_s, found in ((0.02, -0.05, False), (0.05, -0.02, True)):
        taken = np.array((stamp + int(dog_s * 1e9), stamp + int(empty_s * 1e9)))
        one = np.ones(1)
        detections = Detections(
            taken, np.array((0, 1, 1)), np.array([box]), np.array([DOG], np.uint8), one
        )
        labels, _ = apply(made, detections)
        assert (labels[meets == 0] == (DOG if found else PERSON)).all()
        np.testing.assert_array_equal(labels[meets != 0], before[meets != 0])


def test_what_the_robot_turns_between_image_and_scan_is_taken_into_account():
    poses = compose(POSE, np.stack((np.zeros(5), np.zeros(5), np.linspace(-0.1, 0.1, 5)), axis=-1))
    made = scans(poses)
    batch, _, _, meets = made
    between = compose(POSE, (0.0, 0.0, 0.025))  # half a scan after the third, at 1 rad/s
    detections = Detections(
        batch.stamps_ns[2:3] + 25_000_000,
        np.array((0, 1)),
        np.array([box_of(THE_DOG, between)]),
        np.array([DOG], np.uint8),
        np.ones(1),
    )
    patient = Matching(max_gap_s=0.2)
    labels, _ = apply(made, detections, matching=patient)
    assert (meets == 0).sum() > 50
    assert (labels[meets == 0] == DOG).all()
    still, _ = apply(made, detections, poses=np.tile(POSE, (5, 1)), matching=patient)
    assert (still[meets == 0] == DOG).mean() < 0.9


def test_a_dog_before_a_person_is_told_from_the_person():
    behind = (4.6, 3.3, 4.9, 4.0, 1.7)
    made = scans(POSE, things=(THE_DOG, behind))
    batch, _, _, meets = made
    boxes = [box_of(behind), box_of(THE_DOG)]
    labels, _ = apply(made, seen(batch, boxes, [BICYCLE, DOG]))
    assert (labels[meets == 0] == DOG).all()
    assert (meets == 1).sum() > 2
    assert (labels[meets == 1] == BICYCLE).all()


def test_a_person_before_something_large_or_with_a_bag_stays_a_person():
    made = scans(POSE, things=(BESIDE,))
    batch, before, _, meets = made
    left, top, right, bottom = box_of(BESIDE)
    bag = (left, bottom - 40, (left + right) / 2, bottom)
    large = (left - 150, top, right + 100, bottom)
    boxes = [large, bag, (left, top, right, bottom)]
    labels, _ = apply(made, seen(batch, boxes, [BICYCLE, DOG, PERSON]))
    np.testing.assert_array_equal(labels, before)
    assert (meets == 0).any()
    alone, _ = apply(made, seen(batch, boxes[:1], [BICYCLE]))
    assert (alone[meets == 0] == BICYCLE).all()


def test_a_box_above_the_scan_is_not_met_unless_any_height_is():
    made = scans(POSE)
    batch, before, _, meets = made
    left, top, right, _ = box_of(THE_DOG)
    shelf = [(left, top - 80, right, top - 40)]
    np.testing.assert_array_equal(apply(made, seen(batch, shelf, [DOG]))[0], before)
    labels, _ = apply(made, seen(batch, shelf, [DOG]), matching=Matching(above=None))
    assert (labels[meets == 0] == DOG).all()


@pytest.mark.parametrize(
    ("thing", "tilt", "cut", "shift"),
    [
        ((1.9, 3.4, 2.3, 3.65, 0.5), 0.3, (3, CAMERA.height), (0, 0, 0, -10)),
        ((3.15, 3.4, 3.5, 3.65, 0.5), -1.0, (1, 0), (0, 10, 0, 0)),
    ],
)
def test_a_box_cut_by_the_border_of_the_image_goes_on_beyond_it(thing, tilt, cut, shift):
    made = scans(POSE, things=(thing,))
    batch, _, _, meets = made
    tilted = mount_matrix((*FORWARD[:3], FORWARD[3] + tilt, *FORWARD[4:]))
    camera = replace(CAMERA, parent_T_camera=tilted)
    box = box_of(thing, camera=camera)
    assert box[cut[0]] == cut[1]
    for boxes, found in (([box], DOG), ([np.add(box, shift)], PERSON)):
        detections = seen(batch, boxes, [DOG])
        labels, _ = apply(made, detections, camera=camera, matching=Matching(above=0.0))
        assert (labels[meets == 0] == found).all()


@settings(max_examples=30)
@given(
    mount=st.tuples(*[st.floats(-1, 1)] * 3, *[st.floats(-3.2, 3.2)] * 3),
    corner=st.tuples(st.floats(0, 600), st.floats(0, 440)),
    size=st.tuples(st.floats(1, 640), st.floats(1, 480)),
)
def test_only_points_of_people_in_the_box_ever_change(mount, corner, size):
    made = scans(POSE, rooms.UPSIDE_DOWN)
    batch, before, _, _ = made
    camera = replace(CAMERA, parent_T_camera=mount_matrix(mount))
    box = (*corner, min(corner[0] + size[0], 640), min(corner[1] + size[1], 480))
    exact = Matching(beside=0.0, above=None)
    labels, _ = apply(made, seen(batch, [box], [DOG]), camera=camera, matching=exact)
    changed = labels != before
    assert (before[changed] == PERSON).all()
    assert (labels[changed] == DOG).all()
    bearings, ranges = batch.lidar.bearings[changed[0]], batch.ranges[changed].astype(float)
    zeros = np.zeros_like(ranges)
    points = np.stack((ranges * np.cos(bearings), ranges * np.sin(bearings), zeros), axis=-1)
    chain = np.linalg.inv(camera.parent_T_camera) @ mount_matrix(batch.lidar.base_T_lidar)
    u = project(points @ chain[:3, :3].T + chain[:3, 3], camera)[:, 0]
    assert ((u >= box[0] - 1e-6) & (u <= box[2] + 1e-6)).all()


def test_scans_that_are_not_labelled_stay_so():
    made = scans(np.tile(POSE, (3, 1)))
    batch, before, _, meets = made
    before[1] = 255
    poses = batch.poses.copy()
    poses[1] = np.nan
    labels, _ = apply(made, seen(batch, [box_of(THE_DOG)], [DOG]), poses=poses)
    assert (labels[1] == 255).all()
    assert (labels[[0, 2]][meets[[0, 2]] == 0] == DOG).all()


def test_boxes_of_an_image_of_another_size_are_refused():
    made = scans(POSE)
    with pytest.raises(InvalidInputError, match=r"1 of 1 boxes lie outside .* 640 x 480 .*size\?"):
        apply(made, seen(made[0], [(700, 10, 900, 100)], [DOG]))


def test_classes_beyond_the_taxonomy_are_refused():
    made = scans(POSE)
    with pytest.raises(InvalidInputError, match="expected class ids 0 to 11, found 12"):
        apply(made, seen(made[0], [(10, 10, 20, 20)], [12]))


def test_detections_of_another_time_are_told_before_any_work():
    batch = scans(np.tile(POSE, (4, 1)))[0]
    late = seen(batch, [box_of(THE_DOG)], [DOG], late_s=100.0)
    check = partial(check_detections, batch.stamps_ns, CAMERA, taxonomy=TAXONOMY)
    with pytest.raises(
        InvalidInputError,
        match=r"within 0.1 s of a scan: .* 1700000000.000 to 1700000000.150 s, .* 1700000100.000",
    ):
        check(late)
    assert check(late, matching=Matching(clock_offset_s=-100.0)) == 4
    assert check(late, matching=Matching(clock_offset_s=-99.86)) == 3
    with pytest.raises(InvalidInputError, match="outside the camera's image"):
        check(seen(batch, [(700, 10, 900, 100)], [DOG]))


@pytest.mark.parametrize(
    "wrong",
    [{"max_gap_s": -1.0}, {"above": np.nan}, {"beside": np.inf}, {"clock_offset_s": np.nan}],
)
def test_limits_out_of_range_are_refused(wrong):
    with pytest.raises(InvalidInputError, match="finite"):
        Matching(**wrong)
