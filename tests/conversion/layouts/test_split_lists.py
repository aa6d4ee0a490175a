"""Split lists of a published layout."""

import pytest

from conversion.layouts.split_lists import check_lists, frame_members
from semantic2d_dataset.errors import InvalidInputError

NAMES = [f"{n:07d}.npy" for n in range(6)]


def test_each_scan_belongs_to_the_list_that_names_it():
    lists = {
        "train": b"0000000.npy\n0000003.npy\n",
        "dev": b"0000001.npy\r\n\r\n",
        "test": b" scans_lidar/0000002.npy \n0000004",
    }
    assert frame_members(lists, NAMES).tolist() == [0, 1, 2, 0, 2, 255]


def test_test_counts_before_val_before_train():
    lists = {
        "test": b"0000002.npy\n0000000.npy\n",
        "val": b"0000001.npy\n0000002.npy\n",
        "train": b"0000000.npy\n0000001.npy\n0000002.npy\n0000003.npy\n",
    }
    check = check_lists(lists, NAMES)
    assert check.members.tolist() == [2, 1, 2, 0, 255, 255]
    assert check.overlapping == ("0000000.npy", "0000001.npy", "0000002.npy")


def test_what_is_wrong_with_lists_is_counted():
    lists = {"train": b"0000000.npy\n0000000.npy\ngone.npy\n", "test": b"0000000.npy\n"}
    check = check_lists(lists, NAMES[:2])
    assert check.missing == ("gone.npy",)
    assert check.repeated == ("0000000.npy",)
    assert check.left_out == ("0000001.npy",)
    order = "test counts before val before train"
    assert check.notices == (
        f"lists: 1 scans are in several lists: {order} (first: 0000000.npy)",
        "lists: 1 files are listed and do not exist (first: gone.npy)",
        "lists: 1 scans are in no list (first: 0000001.npy)",
    )


def test_no_lists_leave_nothing_out():
    check = check_lists({}, NAMES)
    assert check.members.tolist() == [255] * 6
    assert check.notices == ()


def test_bytes_that_are_no_text_name_nothing():
    check = check_lists({"train": b"\xff\xfe\x00\n"}, NAMES)
    assert check.members.tolist() == [255] * 6
    assert len(check.missing) == 1


def test_an_unknown_list_is_refused():
    with pytest.raises(InvalidInputError, match="unknown split 'training'"):
        frame_members({"training": b""}, NAMES)
