"""Standard schemes: what each promises, for recordings of any length, rate and number."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.split_schemes import (
    make_block_scheme,
    make_environment_scheme,
    make_frame_scheme,
    make_lidar_scheme,
    schemes_of,
)
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, VAL


def stamps(seconds, rate_hz=20.0, start_s=1e9):
    return (start_s * 1e9 + np.arange(0, seconds, 1 / rate_hz) * 1e9).astype(np.int64)


@st.composite
def recordings(draw, *, least_environments=1, least_lidars=1):
    """Stamps by sequence id: environments, drives and lidars of different rates and lengths."""
    places = draw(st.integers(least_environments, 5))
    lidars = "abcd"[: draw(st.integers(least_lidars, 4))]
    found = {}
    for place, drive in itertools.product(range(places), range(draw(st.integers(1, 2)))):
        seconds, start_s = draw(st.floats(0, 400)), draw(st.floats(-1e6, 1e9))
        for lidar in lidars:
            taken = stamps(seconds, draw(st.sampled_from((2.0, 5.0))), start_s)
            found[f"e{place}--r{drive}--{lidar}"] = taken + draw(st.integers(0, 10**8))
    return found


@given(recordings())
def test_every_scheme_says_once_of_every_scan_where_it_belongs(given_stamps):
    made = schemes_of(given_stamps)
    assert len({scheme.name for scheme in made}) == len(made)
    for scheme in made:
        assert scheme.membership.keys() == given_stamps.keys()
        for name, taken in given_stamps.items():
            parts = [scheme.scans_of(name, split) for split in ("train", "val", "test")]
            ids = scheme.membership[name]
            kept = np.concatenate([*parts, np.flatnonzero(ids == NONE)])
            assert (ids.dtype, sorted(kept.tolist())) == (np.uint8, [*range(len(taken))])


@given(recordings())
def test_schemes_are_the_same_every_time_and_in_any_order(given_stamps):
    turned = dict(reversed(given_stamps.items()))
    for one, other in zip(schemes_of(given_stamps), schemes_of(turned), strict=True):
        assert (one.name, one.digest, one.made_by) == (other.name, other.digest, other.made_by)


@given(recordings(least_environments=3))
def test_no_environment_is_in_two_splits(given_stamps):
    lengths = {name: len(taken) for name, taken in given_stamps.items()}
    found = {}
    for name, ids in make_environment_scheme(lengths).membership.items():
        found.setdefault(name.split("--")[0], set()).update(ids.tolist())
    assert all(len(splits) <= 1 for splits in found.values())


@given(recordings(least_lidars=2))
def test_a_lidar_scheme_trains_as_the_block_scheme_and_tests_on_other_lidars(given_stamps):
    block, scheme = make_block_scheme(given_stamps), make_lidar_scheme(given_stamps)
    tested, trained = set(), set()
    for name, ids in scheme.membership.items():
        lidar = name.rsplit("--", 1)[1]
        if (ids == TEST).any():
            assert (ids == TEST).all()
            tested.add(lidar)
        elif len(ids):
            trained.add(lidar)
            for split in ("train", "val"):
                np.testing.assert_array_equal(
                    scheme.scans_of(name, split), block.scans_of(name, split)
                )
    assert not tested & trained


@given(st.floats(30, 2000), st.integers(1, 4), st.floats(0.1, 2.0))
def test_blocks_are_disjoint_in_time_with_a_gap(seconds, recordings, gap_s):
    given_stamps = {f"e--r{i}--l": stamps(seconds, 5.0) for i in range(recordings)}
    scheme = make_block_scheme(given_stamps, gap_s=gap_s)
    for sequence_id, ids in scheme.membership.items():
        times = given_stamps[sequence_id] / 1e9
        parts = [times[ids == s] for s in (TRAIN, VAL, TEST)]
        for a in range(3):
            for b in range(a):
                if len(parts[a]) and len(parts[b]):
                    nearest = np.abs(parts[a][:, None] - parts[b]).min()
                    assert nearest >= gap_s - 1e-3


def test_blocks_have_about_the_published_shares():
    scheme = make_block_scheme({"e--r--l": stamps(600.0)})
    ids = scheme.membership["e--r--l"]
    kept = ids[ids != NONE]
    shares = [np.mean(kept == s) for s in (TRAIN, VAL, TEST)]
    np.testing.assert_allclose(shares, [0.7, 0.1, 0.2], atol=0.01)
    assert np.mean(ids == NONE) < 0.02


def test_lidars_of_a_recording_share_its_blocks():
    shared = make_block_scheme({"e--r--a": stamps(60.0), "e--r--b": stamps(60.0)})
    np.testing.assert_array_equal(shared.membership["e--r--a"], shared.membership["e--r--b"])


def test_another_rate_changes_no_border():
    fast, slow = stamps(60.0), stamps(60.0)[::4]
    membership = make_block_scheme({"e--r--a": fast, "e--r--b": slow}).membership
    np.testing.assert_array_equal(membership["e--r--a"][::4], membership["e--r--b"])


def test_test_blocks_do_not_all_lie_at_the_end():
    made = make_block_scheme({f"e{i}--r--l": stamps(60.0) for i in range(3)}).membership
    assert {int(ids[0]) for ids in made.values()} == {TRAIN, VAL, TEST}


def test_environments_are_held_out_whole():
    lengths = {f"e{i}--r--{lidar}": 5 for i in range(10) for lidar in "ab"}
    scheme = make_environment_scheme(lengths)
    by_environment = {}
    for sequence_id, ids in scheme.membership.items():
        assert len(set(ids.tolist())) == 1
        by_environment.setdefault(sequence_id.split("--")[0], set()).add(int(ids[0]))
    assert all(len(found) == 1 for found in by_environment.values())
    counts = [sum(found == {s} for found in by_environment.values()) for s in (TRAIN, VAL, TEST)]
    assert counts == [7, 1, 2]


def test_named_environments_are_held_out():
    lengths = {f"e{i}--r--l": 5 for i in range(4)}
    scheme = make_environment_scheme(lengths, val=["e0"], test=["e3"])
    assert [int(ids[0]) for ids in scheme.membership.values()] == [VAL, TRAIN, TRAIN, TEST]
    with pytest.raises(InvalidInputError, match="unknown environments"):
        make_environment_scheme(lengths, val=["e9"], test=["e3"])


def test_one_named_environment_is_kept_and_the_other_chosen():
    lengths = {f"e{i}--r--l": 5 for i in range(10)}
    made = make_environment_scheme(lengths, val=["e3"]).membership
    assert [i for i, ids in made.items() if ids[0] == VAL] == ["e3--r--l"]
    assert sum(ids[0] == TEST for ids in made.values()) == 2
    with pytest.raises(InvalidInputError, match="both in val and test"):
        make_environment_scheme(lengths, val=["e3"], test=["e3"])


def test_leaping_stamps_make_no_more_rounds_than_scans():
    leaping = np.concatenate(([0], stamps(60.0)))
    ids = make_block_scheme({"e--r--l": leaping}).membership["e--r--l"]
    assert len(set(ids.tolist())) <= 3


def test_short_recording_still_has_all_three_parts():
    ids = make_block_scheme({"e--r--l": stamps(3.0)}).membership["e--r--l"]
    assert {TRAIN, VAL, TEST} <= set(ids.tolist())


def test_two_environments_are_too_few_to_hold_out():
    with pytest.raises(InvalidInputError, match="at least 3 environments"):
        make_environment_scheme({"a--r--l": 5, "b--r--l": 5})


def test_frames_have_the_published_shares_and_follow_the_seed():
    lengths = {"e--r--l": 1000}
    made = [make_frame_scheme(lengths, seed=s).membership["e--r--l"] for s in (1, 1, 2)]
    np.testing.assert_array_equal(made[0], made[1])
    assert (made[0] != made[2]).any()
    assert np.bincount(made[0]).tolist() == [700, 100, 200]


LIDAR_STAMPS = {f"e--r--{name}": stamps(60.0) for name in ("a", "b", "c")}


def splits_of(scheme):
    """By lidar, the splits that its scans are in."""
    ids = {name.rsplit("--", 1)[1]: each for name, each in scheme.membership.items()}
    return {lidar: sorted(set(each.tolist())) for lidar, each in ids.items()}


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ({"test": ["b"]}, {"a": [0, 1, 255], "b": [2], "c": [0, 1, 255]}),
        ({"train": ["b"]}, {"a": [2], "b": [0, 1, 255], "c": [2]}),
        ({"train": ["a"], "test": ["b"]}, {"a": [0, 1, 255], "b": [2], "c": [255]}),
    ],
)
def test_chosen_lidars_are_trained_on_and_tested(said, expected):
    assert splits_of(make_lidar_scheme(LIDAR_STAMPS, **said)) == expected


def test_lidars_of_the_release_are_chosen_by_their_short_names_too():
    found = {f"e--r--{name}": stamps(60.0) for name in ("hokuyo-utm-30lx-ew", "wlr-716")}
    scheme = make_lidar_scheme(found, train=["hokuyo"])
    assert splits_of(scheme) == {"hokuyo-utm-30lx-ew": [0, 1, 255], "wlr-716": [2]}
    assert scheme.made_by.startswith("train hokuyo-utm-30lx-ew; test wlr-716; ")


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"test": ["d"]}, "no sequence of the lidar 'd'; known are a, b, c"),
        ({"train": ["a"], "test": ["a"]}, "found train a and test a"),
        ({"test": ["a", "b", "c"]}, "found train none and test a, b, c"),
        ({"test": []}, "found train a, b, c and test none"),
    ],
)
def test_lidars_that_cannot_be_divided_so_are_told(said, message):
    with pytest.raises(InvalidInputError) as told:
        make_lidar_scheme(LIDAR_STAMPS, **said)
    assert message in str(told.value)


def test_one_lidar_is_too_few_to_train_on_another():
    with pytest.raises(InvalidInputError, match="at least 2 lidars, found a"):
        make_lidar_scheme({"e--r--a": stamps(60.0)})
    assert [each.name for each in schemes_of({"e--r--a": stamps(60.0)})] == ["block", "frame"]
