import hashlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import semantic2d_dataset
from semantic2d_dataset import HokuyoUTM30LXEW, LidarDataset, load_dataset, open_dataset
from semantic2d_dataset.access.features import Statistics
from semantic2d_dataset.access.histories import History
from semantic2d_dataset.access.torch_samplers import Shard
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.scene.geometry import incidence_angles
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from tests.generators import SMALL_LIDAR, make_arrays, make_dataset


@pytest.fixture(scope="module")
def folder(dataset_folder):
    return dataset_folder


def load(folder, **options):
    return load_dataset(folder, **({"lidar": "small", "scheme": "frame"} | options))


def test_items_hold_the_fields_of_one_scan(folder):
    dataset = load(folder, split=None)
    item = dataset[7]
    arrays = make_arrays(150, seed=1)  # corridor comes first
    np.testing.assert_array_equal(item["ranges"], arrays["scans/ranges"][7])
    np.testing.assert_array_equal(item["intensities"], arrays["scans/intensities"][7])
    np.testing.assert_array_equal(item["label"], arrays["scans/labels"][7])
    np.testing.assert_array_equal(item["pose"], arrays["poses/refined"][7])
    np.testing.assert_array_equal(item["valid"], SMALL_LIDAR.has_return(arrays["scans/ranges"][7]))
    np.testing.assert_array_equal(
        item["incidence"],
        incidence_angles(arrays["scans/ranges"][7], SMALL_LIDAR.angle_increment),
    )
    assert item["scan_id"] == "corridor--first--small/7"
    assert item["label"].dtype == torch.int64
    assert item["pose"].dtype == torch.float64


def test_features_are_standardised_by_the_train_split(folder):
    train, test = (load(folder, split=s, features="RIA") for s in ("train", "test"))
    assert train.statistics == test.statistics
    batch = next(iter(train.loader(1000)))
    beams = batch["features"].permute(1, 0, 2)[:, batch["valid"]]
    torch.testing.assert_close(beams.mean(1), torch.zeros(3), atol=1e-3, rtol=0)
    torch.testing.assert_close(beams.std(1), torch.ones(3), atol=1e-2, rtol=0)


def test_given_statistics_are_used(folder):
    statistics = Statistics((1.0,), (2.0,))
    dataset = load(folder, features="R", statistics=statistics)
    raw = load(folder)[0]
    expected = (torch.where(raw["valid"], raw["ranges"], 0) - 1) / 2
    torch.testing.assert_close(dataset[0]["features"][0], expected)


@pytest.mark.parametrize("in_memory", [True, False])
def test_plain_loader_and_own_loader_deliver_the_same(folder, in_memory):
    dataset = load(folder, features="RIA", in_memory=in_memory)
    loaders = (
        DataLoader(dataset, batch_size=64),
        DataLoader(dataset, batch_size=64, collate_fn=dataset.collate),
        dataset.loader(64),
    )
    for plain, collated, own in zip(*loaders, strict=True):
        assert plain["scan_id"] == collated["scan_id"] == own["scan_id"]
        for key in ("features", "label", "valid"):
            assert torch.equal(plain[key], collated[key])
            assert torch.equal(plain[key], own[key])


def digest_of(batch, i):
    arrays = sorted(key for key in batch if key != "scan_id")
    parts = [batch[key][i].numpy().tobytes() for key in arrays]
    return batch["scan_id"][i], hashlib.sha256(b"".join(parts)).hexdigest()


def digests_of(loader):
    return [digest_of(batch, i) for batch in loader for i in range(len(batch["scan_id"]))]


def check_workers(folder, method, workers, *, in_memory, history=None, team=1):
    """Compare two epochs of every process of a team with what one process delivers in order."""
    dataset = load(folder, features="RIA", in_memory=in_memory, history=history)
    expected = Counter(digests_of(dataset.loader(50)))
    loaders = [
        dataset.loader(
            16,
            shuffle=True,
            shard=Shard(rank, team, "keep"),
            num_workers=workers,
            multiprocessing_context=method,
            persistent_workers=True,
        )
        for rank in range(team)
    ]
    orders = []
    for _ in range(2):
        found = [digest for loader in loaders for digest in digests_of(loader)]
        assert Counter(found) == expected
        orders.append([scan_id for scan_id, _ in found])
    assert orders[0] != orders[1]


@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_workers_deliver_every_item_once_and_right(folder, method):
    fork = method == "fork"
    history = None if fork else History(2, compensate="points", across_splits=True)
    check_workers(folder, method, 2, in_memory=fork, history=history, team=2 if fork else 1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("in_memory", "history"),
    [(True, None), (False, History(3, compensate="ranges", across_splits=True))],
)
@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_sixteen_workers_deliver_every_item_once_and_right(folder, method, in_memory, history):
    check_workers(folder, method, 16, in_memory=in_memory, history=history)


@pytest.mark.long
@pytest.mark.parametrize("in_memory", [True, False])
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
def test_a_team_of_four_with_sixteen_workers_delivers_every_item_once(folder, in_memory):
    check_workers(folder, "fork", 4, in_memory=in_memory, team=4)


def test_batches_that_are_kept_are_never_overwritten(folder):
    dataset = load(folder, features="RIA")
    kept = list(dataset.loader(100))
    copies = [{k: v.clone() for k, v in b.items() if k != "scan_id"} for b in kept]
    for _ in range(5):
        list(dataset.loader(100, shuffle=True))
    for batch, copy in zip(kept, copies, strict=True):
        assert all(torch.equal(batch[key], copy[key]) for key in copy)


def test_shuffling_follows_the_seed(folder):
    dataset = load(folder)
    orders = [
        [i for batch in dataset.loader(50, shuffle=True, seed=s) for i in batch["scan_id"]]
        for s in (0, 0, 1)
    ]
    assert orders[0] == orders[1] != orders[2]
    assert sorted(orders[0]) == sorted(orders[2])


def test_class_counts_and_taxonomy_describe_the_split(folder):
    dataset = load(folder, split="test")
    labels = np.concatenate([b["label"][b["valid"]] for b in dataset.loader(100)])
    expected = np.bincount(labels[labels != 255], minlength=10)
    np.testing.assert_array_equal(dataset.class_counts, expected)
    assert dataset.taxonomy.names[9] == "Wall"


def test_indices_beyond_the_end_are_refused(folder):
    dataset = load(folder)
    assert dataset[-1]["scan_id"] == dataset[len(dataset) - 1]["scan_id"]
    with pytest.raises(IndexError):
        dataset[len(dataset)]


def test_each_lidar_has_its_class(tmp_path):
    make_dataset(tmp_path, lidars=(HOKUYO_UTM_30LX_EW,), environments=("a", "b", "c"), scans=30)
    found = load_dataset(tmp_path, lidar="hokuyo", scheme="frame")
    assert type(found) is HokuyoUTM30LXEW
    direct = HokuyoUTM30LXEW.from_path(tmp_path, split="train", scheme="frame")
    assert len(direct) == len(found)
    assert direct.lidar == HOKUYO_UTM_30LX_EW
    with pytest.raises(DatasetNotFoundError, match="no sequence of the lidar 'wlr-716'"):
        semantic2d_dataset.WLR716.from_path(tmp_path)


@pytest.mark.parametrize(
    ("options", "error", "says"),
    [
        ({"features": "XYZ"}, InvalidInputError, "unknown features"),
        ({"features": ""}, InvalidInputError, "unknown features"),
        (
            {"features": "RIA", "statistics": Statistics((1.0,), (2.0,))},
            InvalidInputError,
            "have 3 channels, the statistics 1",
        ),
        ({"split": "validation"}, InvalidInputError, "unknown split"),
        ({"scheme": "random"}, InvalidInputError, "unknown scheme"),
        ({"lidar": "velodyne"}, DatasetNotFoundError, "no sequence of the lidar"),
    ],
)
def test_unknown_options_say_what_there_is(options, error, says, folder):
    with pytest.raises(error, match=says):
        load(folder, **options)


def test_dataset_without_lidar_is_refused(folder):
    with pytest.raises(InvalidInputError, match="say which lidar"):
        LidarDataset(open_dataset(folder))


def test_lidar_without_train_scans_says_whose_statistics_to_give(tmp_path):
    other = replace(SMALL_LIDAR, name="other")
    make_dataset(tmp_path, environments=("lobby",), lidars=(SMALL_LIDAR, other), scans=200)
    options = {"scheme": "lidar", "features": "RIA"}
    tested, *trained = sorted(
        ("small", "other"),
        key=lambda name: name not in open_dataset(tmp_path).lidars_of("lidar", "test"),
    )
    with pytest.raises(InvalidInputError) as told:
        load_dataset(tmp_path, lidar=tested, split="test", **options)
    assert str(told.value) == (
        f"generated: the scheme 'lidar' has no train scan of {tested} to standardise its features "
        f"by; load the scans that the model is trained on (split='train', lidar='{trained[0]}'), "
        "and give their statistics here: statistics=train.statistics"
    )
    train = load_dataset(tmp_path, lidar=trained[0], **options)
    test = load_dataset(
        tmp_path, lidar=tested, split="test", statistics=train.statistics, **options
    )
    assert (len(test), test.statistics) == (200, train.statistics)
    with pytest.raises(DatasetNotFoundError, match=f"that split has scans of {trained[0]}"):
        load_dataset(tmp_path, lidar=tested, split="train", **options)
