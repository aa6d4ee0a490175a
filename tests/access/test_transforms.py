import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semantic2d_dataset import load_dataset
from semantic2d_dataset.access.transforms import (
    BeamDropout,
    Compose,
    IntensityNoise,
    Mirror,
    RangeNoise,
    Roll,
    default_augmentation,
)
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.geometry import to_points
from semantic2d_dataset.scene.lidars import LIDARS, RPLIDAR_S2, LidarSpec
from tests.generators import SMALL_LIDAR, make_arrays

LOPSIDED = LidarSpec("lopsided", "Sees more of the left", 37, -1.0, 0.1, 0.1, 20.0)
STEP = 2 * np.pi / 36
AROUND = LidarSpec("around", "Sees all around", 36, -np.pi + STEP / 2, STEP, 0.1, 20.0)
ALL = (Mirror(), Roll(), RangeNoise(0.1), IntensityNoise(0.5), BeamDropout(0.3))


def fields_of(lidar, scans=20, seed=0):
    arrays = make_arrays(scans, lidar, seed)
    names = ("ranges", "intensities", "labels")
    return {name: arrays[f"scans/{name}"] for name in names} | {"poses": arrays["poses/refined"]}


def apply(transform, lidar=SMALL_LIDAR, seed=0, **changes):
    fields = fields_of(lidar) | changes
    return fields, transform(fields, lidar, np.random.default_rng(seed))


@settings(deadline=None)
@given(st.sampled_from(ALL), st.integers(0, 2**32 - 1))
def test_every_transform_keeps_names_shapes_dtypes_and_its_input(transform, seed):
    before = fields_of(AROUND)
    given_fields, found = apply(transform, AROUND, seed)
    assert found.keys() == before.keys()
    for name, values in before.items():
        np.testing.assert_array_equal(given_fields[name], values)
        assert (found[name].shape, found[name].dtype) == (values.shape, values.dtype)
    np.testing.assert_array_equal(found["poses"], before["poses"])
    again = apply(transform, AROUND, seed)[1]
    assert all(
        np.array_equal(found[name], again[name], equal_nan=name != "labels") for name in found
    )


def test_a_mirrored_scan_is_the_world_with_left_and_right_swapped():
    before, after = apply(Mirror(share=1.0))
    points, mirrored = (to_points(f["ranges"], SMALL_LIDAR.bearings) for f in (before, after))
    valid = SMALL_LIDAR.has_return(after["ranges"])
    expected = (points * (1, -1))[:, ::-1]
    np.testing.assert_allclose(mirrored[valid], expected[valid], atol=1e-5)
    np.testing.assert_array_equal(after["labels"], before["labels"][:, ::-1])
    np.testing.assert_array_equal(after["intensities"], before["intensities"][:, ::-1])


def test_a_share_of_the_scans_is_mirrored():
    before, after = apply(Mirror(share=0.5))
    mirrored = (after["labels"] == before["labels"][:, ::-1]).all(axis=1)
    same = (after["labels"] == before["labels"]).all(axis=1)
    assert (mirrored ^ same).all()
    assert 0 < mirrored.sum() < len(mirrored)


def test_each_scan_is_rolled_as_a_whole_by_a_shift_of_its_own():
    before, after = apply(Roll(), AROUND)
    shifts = []
    for n, ranges in enumerate(before["ranges"]):
        turned = [
            k
            for k in range(AROUND.beams)
            if np.array_equal(np.roll(ranges, k), after["ranges"][n], equal_nan=True)
        ]
        shifts += turned
        assert len(turned) == 1
        np.testing.assert_array_equal(np.roll(before["labels"][n], turned[0]), after["labels"][n])
    assert len(set(shifts)) > 5


def test_noise_on_ranges_has_its_deviation_and_leaves_what_is_no_return():
    before, after = apply(RangeNoise(0.1), ranges=np.full((500, 37), 5, np.float32))
    assert (after["ranges"] - before["ranges"]).std() == pytest.approx(0.1, rel=0.03)
    before, after = apply(RangeNoise(3.0))
    valid = SMALL_LIDAR.has_return(before["ranges"])
    np.testing.assert_array_equal(SMALL_LIDAR.has_return(after["ranges"]), valid)
    np.testing.assert_array_equal(before["ranges"][~valid], after["ranges"][~valid])


def test_noise_on_intensities_is_relative_to_them():
    values = np.full((500, 37), 1000, np.float32)
    values[:250] = 10
    before, after = apply(IntensityNoise(0.05), intensities=values)
    factors = after["intensities"] / values
    assert factors[:250].std() == pytest.approx(0.05, rel=0.05)
    assert factors[250:].std() == pytest.approx(0.05, rel=0.05)
    fields = {name: v for name, v in before.items() if name != "intensities"}
    assert IntensityNoise(0.05)(fields, SMALL_LIDAR, np.random.default_rng(0)) == fields


def test_dropped_beams_have_no_return_and_their_share_is_as_told():
    before, after = apply(BeamDropout(0.2), ranges=np.full((500, 37), 5, np.float32))
    valid = SMALL_LIDAR.has_return(after["ranges"])
    assert valid.mean() == pytest.approx(0.8, abs=0.01)
    np.testing.assert_array_equal(after["ranges"][valid], before["ranges"][valid])


def test_what_a_lidar_cannot_have_measured_is_refused():
    with pytest.raises(
        InvalidInputError, match=r"Mirror: lopsided sees from -1.0000 to 2.6000 rad"
    ):
        apply(Mirror(), LOPSIDED)
    with pytest.raises(InvalidInputError, match=r"Roll: small sees 206.3 degrees"):
        apply(Roll())


@pytest.mark.parametrize("make", [Mirror, BeamDropout, RangeNoise, IntensityNoise])
@pytest.mark.parametrize("wrong", [-0.1, float("nan")])
def test_settings_outside_their_domain_are_refused(make, wrong):
    with pytest.raises(InvalidInputError, match=make.__name__):
        make(wrong)


@pytest.mark.parametrize("lidar", [*LIDARS.values(), LOPSIDED], ids=lambda lidar: lidar.name)
def test_the_default_is_what_the_lidar_allows(lidar):
    chosen = default_augmentation(lidar)
    kinds = {type(transform) for transform in chosen.transforms}
    assert (Mirror in kinds) == (lidar is not LOPSIDED)
    assert (Roll in kinds) == (lidar is RPLIDAR_S2)
    apply(chosen, lidar)


DOUBLE = Compose((RangeNoise(0.05), Mirror()))


@pytest.mark.parametrize("in_memory", [True, False])
def test_features_and_labels_are_those_of_the_changed_scans(dataset_folder, in_memory):
    options = {"lidar": "small", "scheme": "frame", "in_memory": in_memory}
    plain = load_dataset(dataset_folder, features="RIA", **options)
    changed = load_dataset(dataset_folder, features="RIA", transform=Mirror(1.0), **options)
    assert changed.statistics == plain.statistics
    np.testing.assert_array_equal(changed.class_counts, plain.class_counts)
    for one, other in zip(plain.loader(64), changed.loader(64), strict=True):
        assert one["scan_id"] == other["scan_id"]
        for name in ("label", "valid"):
            np.testing.assert_array_equal(one[name].flip(1), other[name])
        np.testing.assert_array_equal(one["features"][:, :2].flip(2), other["features"][:, :2])
        assert (one["features"][:, 2].flip(1) != other["features"][:, 2]).any()  # incidence


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_randomness_follows_the_seed_and_not_the_workers(dataset_folder):
    options = {"lidar": "small", "scheme": "frame", "transform": DOUBLE}
    first, again, other = (
        load_dataset(dataset_folder, transform_seed=seed, **options) for seed in (1, 1, 2)
    )

    def ranges_of(dataset, **loading):
        return np.concatenate([b["ranges"] for b in dataset.loader(16, shuffle=True, **loading)])

    found = ranges_of(first)
    np.testing.assert_array_equal(
        found, ranges_of(again, num_workers=2, multiprocessing_context="fork")
    )
    assert not np.array_equal(found, ranges_of(other), equal_nan=True)


def test_epochs_differ_when_they_are_shuffled(dataset_folder):
    options = {"lidar": "small", "scheme": "frame", "transform": RangeNoise(0.05)}
    dataset = load_dataset(dataset_folder, **options)
    loader = dataset.loader(16, shuffle=True)

    def noisy_range_of_one_scan():
        for batch in loader:
            if "lobby--first--small/3" in batch["scan_id"]:
                row = batch["scan_id"].index("lobby--first--small/3")
                return batch["ranges"][row][batch["valid"][row]][0].item()
        return None

    assert noisy_range_of_one_scan() != noisy_range_of_one_scan()
