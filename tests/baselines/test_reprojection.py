from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from baselines.reprojection import ReprojectedScans, Reprojection
from semantic2d_dataset import load_dataset, open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import mount_in_plane, to_points
from semantic2d_dataset.scene.lidars import (
    HOKUYO_UTM_30LX_EW,
    LIDARS,
    RPLIDAR_S2,
    WLR_716,
    LidarSpec,
)
from tests.generators import SMALL_LIDAR, make_arrays, make_dataset

ALL_AROUND = LidarSpec("round", "Round", 36, 0.0, np.pi / 18, 0.1, 20.0)
OTHER_LIDAR = replace(
    SMALL_LIDAR, name="other", beams=50, angle_min=-1.6, angle_increment=0.07, range_max=15.0
)


def turned(lidar: LidarSpec, *, roll: float = 0.0, yaw: float = 0.0) -> LidarSpec:
    return replace(lidar, base_T_lidar=(0.0, 0.0, 0.0, roll, 0.0, yaw))


def scans_of(lidar: LidarSpec) -> tuple[NDArray, NDArray, NDArray]:
    arrays = make_arrays(5, lidar)
    return tuple(arrays[f"scans/{name}"] for name in ("ranges", "intensities", "labels"))


def distances_to_wall(lidar: LidarSpec, normal_yaw: float, distance: float) -> NDArray[np.float32]:
    """Ranges to an endless wall around the lidar, whose normal has a yaw in the base's frame."""
    rotation, _ = mount_in_plane(lidar.base_T_lidar)
    directions = to_points(np.ones(lidar.beams), lidar.bearings) @ rotation.T
    cosines = directions @ (np.cos(normal_yaw), np.sin(normal_yaw))
    return np.where(cosines > 0.01, distance / cosines, np.inf).astype(np.float32)[None]


@pytest.mark.parametrize("lidar", [*LIDARS.values(), ALL_AROUND, SMALL_LIDAR], ids=lambda x: x.name)
def test_a_lidar_reprojected_to_itself_changes_nothing(lidar: LidarSpec):
    scans = scans_of(lidar)
    reprojection = Reprojection(lidar, lidar)
    for before, after in zip(scans, reprojection.apply(*scans), strict=True):
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(reprojection.back(scans[2]), scans[2])
    assert reprojection.in_view.all()


def test_a_lidar_that_sees_all_around_shifts_by_its_yaw():
    scans = scans_of(ALL_AROUND)
    found = Reprojection(turned(ALL_AROUND, yaw=np.pi / 6), ALL_AROUND).apply(*scans)
    for before, after in zip(scans, found, strict=True):  # its first beam looks where 3 does
        np.testing.assert_array_equal(after, np.roll(before, 3, axis=1))


def test_a_lidar_upside_down_is_mirrored():
    scans = scans_of(SMALL_LIDAR)  # beams lie symmetric around the front
    found = Reprojection(turned(SMALL_LIDAR, roll=3.1415926), SMALL_LIDAR).apply(*scans)
    for before, after in zip(scans, found, strict=True):
        np.testing.assert_array_equal(after, before[:, ::-1])


def test_the_circle_closes_between_the_last_beam_and_the_first():
    between = replace(ALL_AROUND, angle_min=np.pi / 36)
    ranges = np.linspace(1.0, 1.35, 36, dtype=np.float32)[None]
    ranges[0, -1] = 1.02
    found = Reprojection(ALL_AROUND, between).apply(ranges, ranges, np.zeros((1, 36), np.uint8))
    assert found.intensities is not None
    assert found.intensities[0, -1] == pytest.approx(1.01)
    assert found.ranges[0, -1] == pytest.approx(2 / (1 / 1.02 + 1 / 1.0))


@pytest.mark.parametrize("source", LIDARS.values(), ids=lambda x: x.name)
@pytest.mark.parametrize("target", LIDARS.values(), ids=lambda x: x.name)
def test_a_wall_stays_where_it_is(source: LidarSpec, target: LidarSpec):
    for yaw in (0.0, 0.7, -2.0):
        ranges = distances_to_wall(source, yaw, 1.5)
        labels = np.full(ranges.shape, 9, np.uint8)
        found = Reprojection(source, target).apply(ranges, None, labels)
        truth = distances_to_wall(target, yaw, 1.5)
        assert found.intensities is None
        # up to 80 degrees of incidence; beyond, neighbours are farther apart than a surface is
        compared = (found.ranges < 1.5 / np.cos(1.4)) & (truth < 1.5 / np.cos(1.4))
        assert compared.sum() > 0.3 * min(source.beams, target.beams)
        errors = np.abs(found.ranges[compared] / truth[compared] - 1)
        at_the_ends = errors > 2e-5  # half a beam out of view, and taken from the last in view
        assert at_the_ends.sum() <= 2
        assert errors.max() < 0.01


def test_nothing_is_invented_between_two_surfaces_or_beside_a_lost_beam():
    coarse = replace(SMALL_LIDAR, beams=5)
    fine = replace(SMALL_LIDAR, beams=17, angle_increment=0.025)
    ranges = np.array([[1.0, 3.0, np.inf, 2.0, 2.02]], np.float32)
    labels = np.array([[4, 9, 0, 1, 2]], np.uint8)
    found = Reprojection(coarse, fine).apply(ranges, 100 * ranges, labels)
    assert set(found.ranges[0, :13]) == {1.0, 3.0, np.inf, 2.0}
    assert set(found.labels[0]) == {4, 9, 0, 1, 2}
    assert found.ranges[0, 12:].tolist() == sorted(set(found.ranges[0, 12:].tolist()))
    assert found.intensities is not None
    assert found.intensities[0, 14] == pytest.approx(201)


def test_what_the_source_cannot_see_has_no_return_and_no_label():
    scans = distances_to_wall(HOKUYO_UTM_30LX_EW, 0.0, 2.0), None, np.ones((1, 1081), np.uint8)
    found = Reprojection(HOKUYO_UTM_30LX_EW, RPLIDAR_S2).apply(*scans)
    outside = found.labels[0] == 255
    assert np.isposinf(found.ranges[0, outside]).all()
    assert outside.mean() == pytest.approx(0.25, abs=0.002)
    front = np.abs(RPLIDAR_S2.bearings) < np.pi / 4  # it is mounted backwards
    np.testing.assert_array_equal(outside, front)


@pytest.mark.parametrize("source", LIDARS.values(), ids=lambda x: x.name)
@pytest.mark.parametrize("target", LIDARS.values(), ids=lambda x: x.name)
def test_labels_come_back_to_the_beams_that_they_came_from(source: LidarSpec, target: LidarSpec):
    scans = scans_of(source)
    reprojection = Reprojection(source, target)
    back = reprojection.back(reprojection.apply(*scans).labels, outside=77)
    kept = reprojection.in_view
    assert (back[:, ~kept] == 77).all()
    share = {"wlr-716": 0.75, "hokuyo-utm-30lx-ew": 0.75}.get(target.name, 1.0)
    assert kept.mean() == pytest.approx(share if source is RPLIDAR_S2 else 1.0, abs=0.002)
    if target.beams / target.angle_increment >= 0.9 * source.beams / source.angle_increment:
        np.testing.assert_array_equal(back[:, kept], scans[2][:, kept])


def test_a_mount_on_its_side_and_arrays_of_another_lidar_are_refused():
    with pytest.raises(InvalidInputError, match="'small': expected a level mount"):
        Reprojection(turned(SMALL_LIDAR, roll=np.pi / 2), WLR_716)
    reprojection = Reprojection(SMALL_LIDAR, WLR_716)
    with pytest.raises(InvalidInputError, match=r"ranges: expected float32 \(any, 37\)"):
        reprojection.apply(*scans_of(WLR_716))
    with pytest.raises(InvalidInputError, match=r"labels: expected uint8 \(any, 811\)"):
        reprojection.back(scans_of(SMALL_LIDAR)[2])


@pytest.fixture(scope="module")
def two_lidars(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "two"
    make_dataset(folder, lidars=(SMALL_LIDAR, OTHER_LIDAR))
    return folder


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_data_set_reads_as_if_another_lidar_had_measured_it(two_lidars: Path, *, in_memory):
    data = open_dataset(two_lidars)
    options = {"features": "RIA", "in_memory": in_memory}
    scans = ReprojectedScans(data, lidar="small", target=OTHER_LIDAR, split="val", **options)
    own = load_dataset(two_lidars, lidar="small", split="val")
    assert scans.lidar == OTHER_LIDAR
    assert len(scans) == len(own)
    batch = next(iter(scans.loader(len(own))))
    assert batch["features"].shape == (len(own), 3, 50)
    raw = next(iter(own.loader(len(own))))
    expected = scans.source.reprojection.apply(
        raw["ranges"].numpy(), raw["intensities"].numpy(), raw["label"].numpy().astype(np.uint8)
    )
    np.testing.assert_array_equal(batch["label"], expected.labels)
    np.testing.assert_array_equal(batch["valid"], OTHER_LIDAR.has_return(expected.ranges))
    labelled = expected.labels[batch["valid"].numpy() & (expected.labels != 255)]
    np.testing.assert_array_equal(scans.class_counts, np.bincount(labelled, minlength=10))
    assert batch["scan_id"] == raw["scan_id"]


def test_statistics_are_those_of_the_reprojected_training_split(two_lidars: Path):
    data = open_dataset(two_lidars)
    options = {"lidar": "small", "target": OTHER_LIDAR, "features": "RI"}
    train, val = (ReprojectedScans(data, split=split, **options) for split in ("train", "val"))
    assert val.statistics == train.statistics
    batch = next(iter(train.loader(len(train))))
    values = batch["features"].transpose(0, 1)[:, batch["valid"]]
    np.testing.assert_allclose(values.mean(1), 0, atol=1e-3)
    np.testing.assert_allclose(values.std(1), 1, atol=1e-3)


def test_reprojected_scans_are_pickled_for_workers_without_their_data(two_lidars: Path):
    data = open_dataset(two_lidars)
    scans = ReprojectedScans(data, lidar="small", target=OTHER_LIDAR, features="R", split="train")
    content = pickle.dumps(scans)
    assert len(content) < 100_000
    again = pickle.loads(content)
    np.testing.assert_array_equal(again[3]["features"], scans[3]["features"])
