import numpy as np
import pytest
from torch import distributed

from semantic2d_dataset import load_dataset
from semantic2d_dataset.access.class_counts import balancing_weights
from semantic2d_dataset.access.torch_samplers import (
    BlockShuffleSampler,
    ClassBalancedSampler,
    Shard,
)
from semantic2d_dataset.errors import InvalidInputError

RUNS = [range(i * 64, min((i + 1) * 64, 6390)) for i in range(100)]


def test_block_shuffling_reads_few_chunks_for_a_batch():
    runs = [range(i * 64, (i + 1) * 64) for i in range(100)]
    sampler = BlockShuffleSampler(runs, seed=3, window=4)
    first, second = list(sampler), list(sampler)
    assert sorted(first) == sorted(second) == list(range(6400))
    assert first != second
    for start in range(0, 6400, 256):
        assert len({i // 64 for i in first[start : start + 256]}) <= 4


def shares_of(replicas, uneven, *, epoch=0, count=6390, window=16):
    runs = [range(i, min(i + 64, count)) for i in range(0, count, 64)]
    samplers = [
        BlockShuffleSampler(runs, seed=5, window=window, shard=Shard(rank, replicas, uneven))
        for rank in range(replicas)
    ]
    for sampler in samplers:
        sampler.set_epoch(epoch)
    shares = [list(sampler) for sampler in samplers]
    assert [len(share) for share in shares] == [len(sampler) for sampler in samplers]
    return shares


@pytest.mark.parametrize("window", [16, None])
@pytest.mark.parametrize("replicas", [1, 2, 3, 8, 64])
def test_processes_draw_disjoint_items_and_equally_many(replicas, window):
    shares = shares_of(replicas, "drop", window=window)
    assert {len(share) for share in shares} == {6390 // replicas}
    drawn = [i for share in shares for i in share]
    assert len(set(drawn)) == len(drawn) > 6390 - replicas


def test_what_is_dropped_differs_between_epochs():
    dropped = [
        set(range(6390)) - {i for share in shares_of(64, "drop", epoch=e) for i in share}
        for e in (0, 1)
    ]
    assert dropped[0] != dropped[1]
    assert {len(each) for each in dropped} == {6390 % 64}


def test_padding_draws_all_and_a_few_twice():
    shares = shares_of(64, "pad")
    assert {len(share) for share in shares} == {100}
    drawn = [i for share in shares for i in share]
    assert set(drawn) == set(range(6390))
    assert len(drawn) == 6400


def test_keeping_draws_each_once_with_one_more_here_and_there():
    shares = shares_of(7, "keep")
    assert sorted(i for share in shares for i in share) == list(range(6390))
    assert {len(share) for share in shares} == {912, 913}


def test_a_process_reads_whole_chunks_but_for_two():
    for share in shares_of(8, "drop"):
        chunks, counts = np.unique(np.array(share) // 64, return_counts=True)
        assert (counts < 64).sum() <= 3  # the last chunk of all is short, too
        assert len(chunks) <= -(-6390 // 8 // 64) + 2


def test_an_epoch_is_resumed_by_its_number():
    whole, resumed = (BlockShuffleSampler(RUNS, seed=1) for _ in range(2))
    epochs = [list(whole) for _ in range(3)]
    resumed.set_epoch(2)
    assert list(resumed) == epochs[2]
    assert epochs[0] != epochs[1] != epochs[2]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"rank": 2, "replicas": 2}, "expected a rank of 0 to 1, found 2"),
        ({"uneven": "cut"}, "must be 'drop', 'pad' or 'keep', found 'cut'"),
    ],
)
def test_a_part_that_cannot_be_is_refused(options, says):
    with pytest.raises(InvalidInputError, match=says):
        Shard(**options)


def test_fewer_items_than_processes_are_refused():
    with pytest.raises(InvalidInputError, match="2 items are too few for 3 processes"):
        len(BlockShuffleSampler([range(2)], shard=Shard(0, 3)))


def test_the_part_is_that_of_torch_distributed_where_it_is_in_use(tmp_path):
    assert Shard.current() == Shard(0, 1)
    distributed.init_process_group(
        "gloo", init_method=f"file://{tmp_path / 'meet'}", rank=0, world_size=1
    )
    try:
        assert Shard.current("pad") == Shard(0, 1, "pad")
    finally:
        distributed.destroy_process_group()


def counts_with_a_rare_class(scans=6390):
    counts = np.zeros((scans, 3), np.int32)
    counts[:, 0] = 90
    counts[:, 1] = 10
    counts[::100] = (50, 10, 40)
    return counts


@pytest.mark.parametrize("power", [0.5, 1.0])
def test_scans_of_rare_classes_are_drawn_as_often_as_their_weight_says(power):
    counts = counts_with_a_rare_class()
    weights = balancing_weights(counts, power)
    assert weights.mean() == pytest.approx(1)
    sampler = ClassBalancedSampler(RUNS, weights, seed=0)
    drawn = np.zeros(len(counts))
    for _ in range(20):
        items = list(sampler)
        assert len(items) == len(sampler) == len(counts)
        drawn += np.bincount(items, minlength=len(counts))
    share = counts[:, 2].sum() / counts.sum()
    seen = (counts[:, 2] * drawn).sum() / (counts.sum(1) * drawn).sum()
    expected = (counts[:, 2] * weights).sum() / (counts.sum(1) * weights).sum()
    assert seen == pytest.approx(expected, rel=0.02)
    assert seen > (1.5 if power == 0.5 else 8) * share


def test_no_power_draws_every_scan_once():
    weights = balancing_weights(counts_with_a_rare_class(), 0.0)
    assert sorted(ClassBalancedSampler(RUNS, weights)) == list(range(6390))


def test_balanced_processes_make_up_one_epoch_and_stream_whole_chunks():
    weights = balancing_weights(counts_with_a_rare_class(), 1.0)
    whole = sorted(ClassBalancedSampler(RUNS, weights, seed=4))
    shares = [
        list(ClassBalancedSampler(RUNS, weights, seed=4, shard=Shard(r, 5))) for r in range(5)
    ]
    assert {len(share) for share in shares} == {6390 // 5}
    assert sorted(i for share in shares for i in share) == whole
    for share in shares:
        for start in range(0, len(share), 256):
            assert len({i // 64 for i in share[start : start + 256]}) <= 32  # two windows
        assert len(np.unique(np.array(share) // 64)) <= 100 // 5 + 15


def test_scans_without_labels_are_never_drawn():
    counts = counts_with_a_rare_class()
    counts[:640] = 0
    assert min(ClassBalancedSampler(RUNS, balancing_weights(counts, 0.5))) >= 640


@pytest.mark.parametrize(
    ("counts", "power", "says"),
    [
        (np.ones((4, 2), np.int32), 1.5, "expected a power of 0 to 1, found 1.5"),
        (np.zeros((4, 2), np.int32), 0.5, "no beam of these scans is labelled"),
    ],
)
def test_weights_that_cannot_be_are_refused(counts, power, says):
    with pytest.raises(InvalidInputError, match=says):
        balancing_weights(counts, power)
    with pytest.raises(InvalidInputError, match="expected 6390 weights of 0 or more"):
        ClassBalancedSampler(RUNS, np.ones(3))


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_loader_shards_and_balances(dataset_folder, in_memory):
    data = load_dataset(dataset_folder, lidar="small", scheme="frame", in_memory=in_memory)
    ids = []
    for rank in range(3):
        loader = data.loader(20, shuffle=True, seed=2, balance=0.5, shard=Shard(rank, 3))
        loader.sampler.set_epoch(4)
        ids.append([i for batch in loader for i in batch["scan_id"]])
        assert len(ids[-1]) == len(data) // 3 == len(loader.sampler)
    alone = data.loader(20, shuffle=True, seed=2, balance=0.5)
    alone.sampler.set_epoch(4)
    assert sorted(i for share in ids for i in share) == sorted(
        i for batch in alone for i in batch["scan_id"]
    )
    kept = [data.loader(20, shard=Shard(r, 2, "keep")) for r in range(2)]
    in_order = [i for loader in kept for batch in loader for i in batch["scan_id"]]
    assert in_order == data.source.scan_ids.tolist()


def test_balance_without_shuffling_is_refused(dataset_folder):
    data = load_dataset(dataset_folder, lidar="small", scheme="frame")
    with pytest.raises(InvalidInputError, match="it needs shuffle=True"):
        data.loader(20, balance=0.5)
