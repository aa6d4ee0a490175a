import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from semantic2d_dataset import load_dataset, open_dataset
from semantic2d_dataset.access.features import features_of
from semantic2d_dataset.access.histories import History, PastScans, see_again
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.access.transforms import Mirror
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceWriter
from semantic2d_dataset.scene.geometry import compose, invert, to_base, transform
from semantic2d_dataset.scene.lidars import RPLIDAR_S2, WLR_716
from tests.generators import SMALL_LIDAR, make_arrays

ALL = {"split": None, "scheme": "frame"}


def load(folder, history, **options):
    return load_dataset(folder, **({"lidar": "small", "history": history} | ALL | options))


@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.parametrize("stride", [1, 3])
def test_past_scans_are_those_before_of_the_same_sequence_the_oldest_first(
    dataset_folder, in_memory, stride
):
    data = load(dataset_folder, History(4, stride), in_memory=in_memory)
    arrays = make_arrays(150, seed=0)  # lobby, the second of three
    batch = data.collate(data.__getitems__(range(150, 300)))
    for row in (0, 1, 2, 7, 63, 64, 65, 149):
        for j, back in enumerate(range(4 * stride, 0, -stride)):
            past = row - back
            assert batch["history_valid"][row, j] == (past >= 0)
            found = {
                name: batch[f"history_{name}"][row, j].numpy()
                for name in ("ranges", "intensities", "poses", "dt_s")
            }
            if past < 0:
                assert np.isnan(found["ranges"]).all()
                assert np.isnan(found["dt_s"])
                assert np.isnan(found["poses"]).all()
                assert (found["intensities"] == 0).all()
                continue
            np.testing.assert_array_equal(found["ranges"], arrays["scans/ranges"][past])
            np.testing.assert_array_equal(found["intensities"], arrays["scans/intensities"][past])
            poses = arrays["poses/refined"]
            motion = compose(invert(poses[row]), poses[past])
            np.testing.assert_allclose(found["poses"], motion, atol=1e-5)
            assert found["dt_s"] == pytest.approx(0.05 * back)


@pytest.mark.parametrize("scheme", ["block", "frame"])
def test_no_scan_of_another_split_comes_unless_asked_for(dataset_folder, scheme):
    source = load(dataset_folder, None, split="test", scheme=scheme).source
    members = set(source.scan_ids)
    row = {i: n for n, i in enumerate(load(dataset_folder, None).source.scan_ids)}
    ranges = torch.stack([item["ranges"] for item in load(dataset_folder, None)])
    for across in (False, True):
        data = load(dataset_folder, History(3, across_splits=across), split="test", scheme=scheme)
        batch = next(iter(data.loader(len(data))))
        for n, scan_id in enumerate(batch["scan_id"]):
            name, index = scan_id.rsplit("/", 1)
            for j, back in enumerate((3, 2, 1)):
                past = f"{name}/{int(index) - back}"
                there = past in row if across else past in members
                assert batch["history_valid"][n, j] == there
                if there:
                    torch.testing.assert_close(
                        batch["history_ranges"][n, j], ranges[row[past]], equal_nan=True
                    )


def write(folder, arrays, lidar=SMALL_LIDAR):
    (folder / "sequences").mkdir(parents=True)
    header = SequenceHeader(environment="hall", recording="first", lidar=lidar)
    with SequenceWriter(folder / "sequences" / "a.h5", header) as writer:
        writer.append(arrays)
    publish(folder, name="own", version="1.0.0")


def test_nothing_before_a_gap_in_time_is_taken(tmp_path):
    arrays = make_arrays(100)
    arrays["scans/stamps_ns"][40:] += 5_000_000_000
    write(tmp_path, arrays)
    data = load(tmp_path, History(2))
    valid = [data[i]["history_valid"].tolist() for i in range(38, 43)]
    assert valid == [[True, True], [True, True], [False, False], [False, True], [True, True]]
    across = load(tmp_path, History(2, max_gap_s=6))
    assert across[40]["history_valid"].all()
    assert across[40]["history_dt_s"].tolist() == pytest.approx([5.1, 5.05])


def test_unknown_poses_are_nan_and_absent_only_where_motion_is_compensated(tmp_path):
    arrays = make_arrays(10)
    arrays["poses/refined"][3] = np.nan
    write(tmp_path, arrays)
    plain, moved = (load(tmp_path, History(2, compensate=c)) for c in (None, "ranges"))
    assert plain[4]["history_valid"].tolist() == [True, True]
    assert torch.isnan(plain[4]["history_poses"]).all(-1).tolist() == [False, True]
    assert moved[4]["history_valid"].tolist() == [True, False]
    assert torch.isnan(moved[4]["history_ranges"][1]).all()
    assert moved[3]["history_valid"].tolist() == [False, False]


def box_scans(lidar, poses):
    """Ranges (N, B) in a room of 8 m x 6 m, exactly, from poses of the base."""
    half = np.array((4.0, 3.0))
    mount = np.array((lidar.base_T_lidar[0], lidar.base_T_lidar[1]))
    ranges = []
    for x, y, yaw in poses:
        c, s = np.cos(yaw), np.sin(yaw)
        origin = np.array((x, y)) + np.array(
            (c * mount[0] - s * mount[1], s * mount[0] + c * mount[1])
        )
        sense = -1 if abs(lidar.base_T_lidar[3]) > 3 else 1
        angles = yaw + lidar.base_T_lidar[5] + sense * lidar.bearings
        steps = np.stack((np.cos(angles), np.sin(angles)), -1)
        with np.errstate(divide="ignore"):
            ranges.append(((np.copysign(half, steps) - origin) / steps).min(-1))
    return np.array(ranges, np.float32)


@pytest.fixture(scope="module", params=[SMALL_LIDAR, WLR_716, RPLIDAR_S2], ids=lambda s: s.name)
def room(request, tmp_path_factory):
    lidar = request.param
    steps = np.arange(12)
    poses = np.stack((-1 + 0.1 * steps, 0.5 - 0.05 * steps, -0.3 + 0.08 * steps), -1)
    ranges = box_scans(lidar, poses)
    folder = tmp_path_factory.mktemp("room")
    write(
        folder,
        {
            "scans/ranges": ranges,
            "scans/intensities": 100 * ranges,
            "scans/labels": np.full(ranges.shape, 9, np.uint8),
            "scans/stamps_ns": steps * 50_000_000,
            "poses/refined": poses,
        },
        lidar,
    )
    return folder, lidar


def test_compensated_ranges_are_those_that_the_lidar_measures_now(room):
    folder, lidar = room
    data = load(folder, History(3, compensate="ranges", labels=True), lidar=lidar.name)
    item = data[11]
    now, past = item["ranges"].numpy(), item["history_ranges"].numpy()
    for j in range(3):
        seen = np.isfinite(past[j])
        assert seen.mean() > 0.7  # what turned out of view is not there
        steepness = np.abs(np.gradient(now)) + 0.02  # half a beam off, on a wall that is grazed
        assert np.quantile(np.abs(past[j] - now)[seen] / steepness[seen], 0.95) < 2
        assert np.median(np.abs(past[j] - now)[seen]) < 0.02 + 0.4 * lidar.angle_increment
        intensities = item["history_intensities"][j].numpy()
        assert (intensities[~seen] == 0).all()
        assert np.median(np.abs(intensities[seen] / 100 - now[seen])) < 0.3
        np.testing.assert_array_equal(item["history_label"][j].numpy(), np.where(seen, 9, 255))
    raw = load(folder, History(3), lidar=lidar.name)[11]["history_ranges"].numpy()
    assert np.median(np.abs(raw[0] - now)) > 0.06


def test_compensated_points_lie_on_the_walls_around_the_lidar_now(room):
    folder, lidar = room
    item = load(folder, History(3, compensate="points"), lidar=lidar.name)[11]
    points = item["history_points"].numpy()
    assert points.shape == (3, lidar.beams, 2)
    in_base = to_base(points, lidar.base_T_lidar)
    on_map = np.abs(transform(item["pose"].numpy(), in_base))
    np.testing.assert_allclose(np.abs(on_map - (4, 3)).min(-1), 0, atol=1e-4)


def test_a_lidar_that_stands_still_sees_the_same_again():
    ranges = make_arrays(5)["scans/ranges"]
    turn, shift = np.broadcast_to(np.eye(2), (5, 2, 2)), np.zeros((5, 2))
    seen, beams = see_again(ranges, SMALL_LIDAR, turn, shift)
    returned = SMALL_LIDAR.has_return(ranges)
    np.testing.assert_allclose(seen[returned], ranges[returned], rtol=1e-6)
    assert np.isinf(seen[~returned]).all()
    np.testing.assert_array_equal(beams, np.where(returned, np.arange(37), -1))


def test_the_nearest_of_two_points_on_a_beam_is_seen():
    lidar = replace(SMALL_LIDAR, angle_increment=0.01)
    ranges = np.full((1, 37), np.inf, np.float32)
    ranges[0, [5, 6]] = 8, 5
    seen, beams = see_again(ranges, lidar, 1e-3 * np.eye(2)[None], np.array([[4.0, 0.0]]))
    assert (beams >= 0).sum() <= 1  # all shrinks to one place, ahead
    ahead = replace(lidar, angle_min=-0.18)
    seen, beams = see_again(ranges, ahead, 1e-3 * np.eye(2)[None], np.array([[4.0, 0.0]]))
    assert beams[0].max() == 6
    assert np.isfinite(seen).sum() == 1


@pytest.mark.parametrize("compensate", [None, "ranges"])
def test_features_of_past_scans_are_those_of_scans(dataset_folder, compensate):
    options = {"features": "RIPA", "split": "train", "scheme": "block"}
    history = History(2, compensate=compensate)
    data, raw = (
        load(dataset_folder, history, **(options | {"features": f})) for f in ("RIPA", None)
    )
    batch, plain = (next(iter(d.loader(64))) for d in (data, raw))
    assert batch["history_features"].shape == (64, 2, 5, 37)
    assert "history_ranges" not in batch
    expected = features_of(
        plain["history_ranges"].numpy().reshape(-1, 37),
        plain["history_intensities"].numpy().reshape(-1, 37),
        SMALL_LIDAR,
        "RIPA",
        data.statistics,
    )
    np.testing.assert_array_equal(batch["history_features"].numpy().reshape(-1, 5, 37), expected)
    alone = load(dataset_folder, None, **options)
    torch.testing.assert_close(batch["features"], next(iter(alone.loader(64)))["features"])


def test_labels_of_past_scans_come_where_they_are_wanted(dataset_folder):
    data = load(dataset_folder, History(1, labels=True), split="train", scheme="block")
    items = data.collate(data.__getitems__(range(20)))
    valid = items["history_valid"][1:, 0]
    assert torch.equal(items["history_label"][1:, 0][valid], items["label"][:-1][valid])
    assert (items["history_label"][0] == 255).all()
    assert items["history_label"].dtype == torch.int64


def test_streamed_past_costs_few_chunks_more(dataset_folder, monkeypatch):
    data = load(dataset_folder, History(5), in_memory=False)
    read = []
    whole = ScanSource._read
    monkeypatch.setattr(
        ScanSource, "_read", lambda self, *what: (read.append(what[1:]), whole(self, *what))[1]
    )
    list(data.loader(32, shuffle=True))
    assert len(read) == 9 * 4  # nine chunks, four fields: each once


def test_a_data_set_with_history_travels_to_workers(dataset_folder):
    data = load(dataset_folder, History(2, across_splits=True), split="test", in_memory=False)
    again = pickle.loads(pickle.dumps(data))
    for key, value in data[5].items():
        assert (
            value == again[5][key]
            if key == "scan_id"
            else torch.equal(torch.nan_to_num(value), torch.nan_to_num(again[5][key]))
        )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"scans": 0}, "above 0"),
        ({"scans": 2, "stride": 0}, "above 0"),
        ({"scans": 2, "compensate": "yes"}, "'ranges', 'points' or None, found 'yes'"),
        ({"scans": 2, "labels": True, "across_splits": True}, "either labels or across_splits"),
    ],
)
def test_a_history_that_cannot_be_is_refused(options, says):
    with pytest.raises(InvalidInputError, match=says):
        History(**options)


def test_history_beside_a_transform_is_refused(dataset_folder):
    with pytest.raises(InvalidInputError, match="either history or transform"):
        load(dataset_folder, History(1), transform=Mirror())


def test_motion_of_a_lidar_that_is_not_level_is_refused(tmp_path):
    lidar = replace(SMALL_LIDAR, base_T_lidar=(0, 0, 0, 0, 1.5, 0))
    write(tmp_path, make_arrays(5, lidar), lidar)
    source = ScanSource(open_dataset(tmp_path), lidar="small", **ALL)
    PastScans(source, History(1))
    with pytest.raises(InvalidInputError, match="expected a level mount"):
        PastScans(source, History(1, compensate="points"))
