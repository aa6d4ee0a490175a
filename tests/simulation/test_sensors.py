"""What the sensor models make of exact hits."""

import dataclasses

import numpy as np
import pytest

from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, LIDARS
from semantic2d_dataset.simulation.raycast import Hits
from semantic2d_dataset.simulation.sensors import (
    DRYWALL,
    METAL,
    PLASTIC,
    SENSORS,
    Noise,
    Surfaces,
    measure,
)

SURFACES = Surfaces(
    np.array((9, 3, 1), np.uint8), np.array((DRYWALL, METAL, PLASTIC), np.uint8), np.ones(3)
)
HOKUYO = HOKUYO_UTM_30LX_EW
MODEL = SENSORS[HOKUYO.name]


def flat(distance, primitive=0, cosine=1.0, *, scans=20, beams=HOKUYO.beams):
    shape = (scans, beams)
    return Hits(
        np.full(shape, distance), np.full(shape, primitive, np.int32), np.full(shape, cosine)
    )


def measured(hits, lidar=HOKUYO, model=None, seed=1):
    return measure(hits, SURFACES, lidar, model or SENSORS[lidar.name], Noise.from_seed(seed))


def test_range_noise_has_the_stated_spread_and_no_bias():
    ranges = measured(flat(4.0)).ranges
    errors = ranges[np.isfinite(ranges)] - 4.0
    assert abs(errors.mean()) < 3e-4
    assert errors.std() == pytest.approx(MODEL.range_std_m, rel=0.1)


@pytest.mark.parametrize("name", LIDARS)
def test_values_lie_on_the_steps_of_the_sensor(name):
    model = SENSORS[name]
    found = measured(flat(3.0, beams=LIDARS[name].beams), LIDARS[name])
    ranges = found.ranges[np.isfinite(found.ranges)].astype(np.float64)
    steps = ranges / model.range_step_m
    assert np.abs(steps - np.rint(steps)).max() < 2e-3
    assert (found.intensities % model.intensity_step == 0).all()


def test_no_return_is_plus_infinity_without_intensity_and_labelled_other():
    found = measured(flat(np.inf, -1, 0.0))
    assert np.isposinf(found.ranges).all()
    assert not found.intensities.any()
    assert not found.labels.any()


def test_surface_below_the_least_range_is_minus_infinity():
    found = measured(flat(0.03))
    assert np.isneginf(found.ranges).mean() > 0.95
    assert not found.labels.any()


def test_share_of_unexplained_dropouts_is_that_of_the_model():
    lost = np.isinf(measured(flat(4.0)).ranges).mean()
    assert lost == pytest.approx(MODEL.dropout, rel=0.4)


def test_dark_surface_at_grazing_incidence_gives_no_return():
    assert np.isposinf(measured(flat(8.0, 2, 0.03)).ranges).all()
    assert np.isfinite(measured(flat(8.0, 2, 0.9)).ranges).mean() > 0.99


def test_metal_outshines_drywall_at_the_normal_only():
    def brightness(primitive, cosine):
        return measured(flat(3.0, primitive, cosine)).intensities.mean()

    assert brightness(1, 1.0) > 1.2 * brightness(0, 1.0)
    assert brightness(1, 0.8) < 0.5 * brightness(0, 0.8)


def test_intensity_falls_with_range_and_incidence():
    near, far = (measured(flat(r)).intensities.mean() for r in (2.0, 8.0))
    slanted = measured(flat(2.0, 0, 0.5)).intensities.mean()
    assert far < 0.8 * near
    assert slanted < 0.6 * near


def test_scales_of_the_three_sensors_are_thousands_hundreds_and_tens():
    means = [
        measured(flat(3.0, beams=lidar.beams), lidar).intensities.mean()
        for lidar in (LIDARS["hokuyo-utm-30lx-ew"], LIDARS["wlr-716"], LIDARS["rplidar-s2"])
    ]
    assert [int(np.log10(mean)) for mean in means] == [3, 2, 1]


def test_mixed_pixels_lie_between_two_surfaces_and_keep_the_label_of_the_nearer():
    hits = flat(2.0)
    hits.distances[:, ::2] = 2.8
    hits.primitives[:, ::2] = 1
    model = dataclasses.replace(MODEL, range_std_m=0.0, mixed_share=0.5, dropout=0.0)
    found = measured(hits, model=model)
    between = (found.ranges > 2.01) & (found.ranges < 2.79)
    assert 0.2 < between.mean() < 0.3
    assert (found.labels[between] == 9).all()


def test_surfaces_too_far_apart_do_not_mix():
    hits = flat(2.0)
    hits.distances[:, ::2] = 2.0 + MODEL.mixed_gap_m + 0.1
    model = dataclasses.replace(MODEL, range_std_m=0.0, mixed_share=1.0, dropout=0.0)
    assert np.unique(measured(hits, model=model).ranges).size == 2


def test_same_seed_gives_the_same_measurement_and_another_does_not():
    first, again, other = (measured(flat(4.0), seed=s).ranges for s in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
