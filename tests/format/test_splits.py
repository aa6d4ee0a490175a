import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.splits import (
    NONE,
    TEST,
    TRAIN,
    VAL,
    SplitScheme,
    make_block_scheme,
    make_environment_scheme,
    make_frame_scheme,
    read_scheme,
    split_id,
    write_scheme,
)


def stamps(seconds, rate_hz=20.0, start_s=1e9):
    return (start_s * 1e9 + np.arange(0, seconds, 1 / rate_hz) * 1e9).astype(np.int64)


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


def test_scheme_reads_back_the_same(tmp_path):
    scheme = make_block_scheme({"e--r--a": stamps(60.0), "e--s--a": stamps(30.0)})
    lengths = {i: len(ids) for i, ids in scheme.membership.items()}
    write_scheme(tmp_path / "block.h5", scheme)
    found = read_scheme(tmp_path / "block.h5", "block", lengths)
    assert (found.name, found.made_by, found.digest) == (
        scheme.name,
        scheme.made_by,
        scheme.digest,
    )


def test_scheme_of_another_name_is_refused(tmp_path):
    write_scheme(tmp_path / "s.h5", SplitScheme("s", {"e--r--a": np.zeros(4, np.uint8)}, ""))
    with pytest.raises(CorruptFileError, match="expected the scheme block, found s"):
        read_scheme(tmp_path / "s.h5", "block", {"e--r--a": 4})


@pytest.mark.parametrize("lengths", [{"e--r--a": 3}, {}])
def test_scheme_for_other_sequences_is_refused(lengths, tmp_path):
    write_scheme(tmp_path / "s.h5", SplitScheme("s", {"e--r--a": np.zeros(4, np.uint8)}, ""))
    with pytest.raises(CorruptFileError, match="e--r--a: 4 members for a sequence of"):
        read_scheme(tmp_path / "s.h5", "s", lengths)


def test_membership_outside_the_domain_is_refused():
    with pytest.raises(InvalidInputError, match="expected only 0 train"):
        SplitScheme("s", {"e--r--a": np.array([0, 3], np.uint8)}, "")


def test_dev_is_val_and_unknown_splits_list_the_known():
    assert split_id("dev") == split_id("val") == VAL
    with pytest.raises(InvalidInputError, match="unknown split 'validation'; known are train"):
        split_id("validation")


def test_unknown_sequence_is_named():
    scheme = SplitScheme("s", {"e--r--a": np.array([0, 2], np.uint8)}, "")
    assert scheme.scans_of("e--r--a", "test").tolist() == [1]
    with pytest.raises(InvalidInputError, match="does not cover x"):
        scheme.scans_of("x", "test")
