from dataclasses import replace

import numpy as np
import pytest
import torch

from semantic2d_dataset.access.angular_grids import AngularGrid, common_grid
from semantic2d_dataset.access.histories import History
from semantic2d_dataset.access.torch_samplers import Shard
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.loading import load_dataset, load_lidars
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, RPLIDAR_S2, WLR_716
from tests.generators import SMALL_LIDAR, make_sequence

# hangs upside down, looks to the left, sees less and in coarser steps
OTHER = replace(
    SMALL_LIDAR,
    name="other",
    beams=13,
    angle_min=-0.9822,
    angle_increment=0.1637,  # no bearing halfway between two beams
    range_max=12.0,
    base_T_lidar=(0.0, 0.1, 0.2, 3.141592653589793, 0.0, 0.3),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two") / "data"
    (folder / "sequences").mkdir(parents=True)
    for seed, environment in enumerate(("lobby", "corridor", "office")):
        for lidar in (SMALL_LIDAR, OTHER):
            name = f"{environment}--{lidar.name}.h5"
            make_sequence(
                folder / "sequences" / name, 150, lidar=lidar, environment=environment, seed=seed
            )
    publish(folder, name="two", version="1.0.0")
    return folder


def load(folder, **options):
    return load_lidars(folder, ["small", "other"], **({"scheme": "frame"} | options))


def test_the_grid_of_the_release_is_what_all_see_in_the_steps_of_the_coarsest():
    lidars = (HOKUYO_UTM_30LX_EW, WLR_716, RPLIDAR_S2)
    seen = common_grid(lidars)
    assert seen.beams == 811
    assert seen.angle_min == pytest.approx(WLR_716.angle_min)
    union = common_grid(lidars, "union")
    assert (union.beams, union.angle_min) == (1080, -np.pi)
    assert common_grid([RPLIDAR_S2]).beams == 1971


def test_fields_of_view_are_cut_and_joined_in_the_base():
    seen, any_sees = (common_grid([SMALL_LIDAR, OTHER], f) for f in ("intersection", "union"))
    assert (seen.beams, seen.angle_min) == (13, pytest.approx(-0.6822))  # to 1.2822: the other
    assert any_sees.angle_min >= -1.8
    assert any_sees.beams == 22  # 3.6 rad in steps of 0.1637
    behind = replace(OTHER, base_T_lidar=(0, 0, 0, 0, 0, np.pi))
    with pytest.raises(InvalidInputError, match="see no bearing in common"):
        common_grid([OTHER, behind])


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("grid", ["intersection", "union", AngularGrid(30, -2.9, 0.2)])
def test_every_value_is_that_of_the_beam_nearest_in_bearing(folder, grid, in_memory):
    data = load(folder, grid=grid, in_memory=in_memory)
    bearings = data.lidars[0].bearings
    assert all(np.array_equal(lidar.bearings, bearings) for lidar in data.lidars)
    for number, lidar in enumerate((SMALL_LIDAR, OTHER)):
        plain = load_dataset(folder, lidar=lidar.name, scheme="frame")
        start = 0 if number == 0 else len(data.parts[0])
        sense = -1 if lidar is OTHER else 1
        beams = lidar.base_T_lidar[5] + sense * lidar.bearings  # in the base
        distance = np.abs(bearings[:, None] - beams)
        nearest, seen = distance.argmin(1), distance.min(1) < 0.501 * lidar.angle_increment
        for i in (0, 17, len(plain) - 1):
            item, measured = data[start + i], plain[i]
            assert item["lidar"] == number
            assert item["scan_id"] == measured["scan_id"]
            for name, unseen in (("ranges", np.nan), ("intensities", 0), ("label", 255)):
                expected = np.where(seen, measured[name][nearest], unseen)
                np.testing.assert_array_equal(item[name], expected)
            valid = seen & measured["valid"].numpy()[nearest]
            np.testing.assert_array_equal(item["valid"], valid)


def test_each_lidar_is_standardised_by_its_own_train_split(folder):
    data = load(folder, split="test", features="RI")
    batch = next(iter(data.loader(10_000)))
    assert batch["features"].shape[1:] == (2, 13)
    train = load(folder, features="RI")
    assert [p.statistics for p in train.parts] == [p.statistics for p in data.parts]
    assert train.parts[0].statistics != train.parts[1].statistics
    whole = next(iter(train.loader(10_000)))
    for number in (0, 1):
        mine = whole["lidar"] == number
        beams = whole["features"][mine].permute(1, 0, 2)[:, whole["valid"][mine]]
        torch.testing.assert_close(beams.mean(1), torch.zeros(2), atol=1e-3, rtol=0)


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_shuffled_epoch_has_every_scan_of_each_lidar_once(folder, in_memory):
    data = load(folder, in_memory=in_memory, features="R")
    expected = sorted(i for part in data.parts for i in part.source.scan_ids)
    batches = list(data.loader(32, shuffle=True))
    assert sorted(i for batch in batches for i in batch["scan_id"]) == expected
    assert any(len(set(batch["lidar"].tolist())) == 2 for batch in batches)
    shares = [data.loader(32, shuffle=True, balance=0.5, shard=Shard(r, 2)) for r in (0, 1)]
    assert sum(len(batch["label"]) for share in shares for batch in share) == len(data)
    np.testing.assert_array_equal(data.class_counts, data.scan_class_counts.sum(0))
    batch = next(iter(data.loader(32, shuffle=True)))
    places = {scan_id: n for n, scan_id in enumerate(expected)}
    assert len(places) == len(data)
    for i in (0, 13, 31):
        part = data.parts[batch["lidar"][i]]
        row = part.source.scan_ids.tolist().index(batch["scan_id"][i])
        assert torch.equal(batch["features"][i], part[row]["features"])


def test_fields_that_one_lidar_lacks_are_left_out(tmp_path):
    (tmp_path / "sequences").mkdir()
    make_sequence(tmp_path / "sequences" / "a.h5", 20)
    make_sequence(tmp_path / "sequences" / "b.h5", 20, lidar=OTHER, drop=("scans/intensities",))
    publish(tmp_path, name="two", version="1.0.0")
    data = load_lidars(tmp_path, split=None)
    assert [lidar.name for lidar in data.lidars] == ["other", "small"]
    assert "intensities" not in data[39]
    assert "intensities" in data.parts[1][0]


def test_past_scans_have_the_grid_s_beams(folder):
    data = load(folder, history=History(2, compensate="ranges"), split=None)
    assert data[301 + 150]["history_ranges"].shape == (2, 13)
    assert data[5]["history_valid"].all()
