import json
import shutil

import h5py
import pytest

from leaderboard.at_hand import AtHand
from leaderboard.checking import VERIFIED, WRONG, check_entries, format_check
from leaderboard.entries import read_entry, seal, to_json
from leaderboard.twins import find_same_counts, find_same_files
from semantic2d_dataset.scoring.about import pack
from tests.leaderboard.boards import add, add_seeds

LIDAR = "small"


def entries_of(folder):
    return [read_entry(path) for path in sorted(folder.iterdir())]


@pytest.fixture
def copied(board, predictions_folder, dataset_folder, tmp_path):
    """Somebody else's predictions, packed again under a better name."""
    path = tmp_path / "p.h5"
    pack(predictions_folder / "good.h5", {"method": "Super", "authors": ["Somebody Else"]}, path)
    add(path, dataset_folder, board)
    return path


def test_predictions_packed_again_under_another_name_are_found(board, copied):
    assert find_same_files(entries_of(board)) == {}
    found, _ = find_same_counts(entries_of(board))
    (good,) = (path for path in found if path.name.endswith("good.json"))
    (superb,) = (path for path in found if path.name.endswith("super.json"))
    assert found[good] == [
        (
            "digests.predictions",
            f"these predictions score what those of {superb.name} do, in every count",
        )
    ]
    checked = check_entries(board, AtHand())
    assert {each.path for each in checked if each.status == WRONG} == {good, superb}


def test_one_seed_of_another_method_is_found_too(
    board_of_seeds, seeds_folder, dataset_folder, tmp_path
):
    pack(seeds_folder / "seed2.h5", {"method": "Mine"}, tmp_path / "p.h5")
    add(tmp_path / "p.h5", dataset_folder, board_of_seeds)
    found, _ = find_same_counts(entries_of(board_of_seeds))
    assert sorted(field for slips in found.values() for field, _ in slips) == [
        "digests.predictions",
        "seeds.runs[2].predictions",
    ]


def test_a_copy_with_some_labels_changed_is_noted_and_not_refused(
    board, copied, predictions_folder, dataset_folder, tmp_path
):
    with h5py.File(copied, "r+") as file:
        for group in file["predictions"].values():
            group["labels"][0, :3] = 3
    next(board.glob("*super.json")).unlink()
    add(copied, dataset_folder, board)
    same, nearly = find_same_counts(entries_of(board))
    assert (same, len(nearly)) == ({}, 2)
    shutil.copytree(predictions_folder, tmp_path / "predictions")
    shutil.copy(copied, tmp_path / "predictions")
    at_hand = AtHand([str(dataset_folder)], tmp_path / "predictions")
    checked = check_entries(board, at_hand)
    assert {each.status for each in checked} == {VERIFIED}
    assert format_check(checked).count("note: its counts are those of ") == 2


def test_methods_of_different_skill_are_no_copies(board):
    assert find_same_counts(entries_of(board)) == ({}, {})


def test_equal_counts_on_two_tasks_or_of_a_sanity_row_are_no_copies(
    board, predictions_folder, dataset_folder
):
    path = next(board.glob("*good.json"))
    other = json.loads(path.read_text())
    other["track"]["dataset_version"] = "1.0.1"
    (board / "other.json").write_text(to_json(seal(other)))
    other = json.loads(path.read_text()) | {"kind": "sanity"}
    (board / "sanity.json").write_text(to_json(seal(other)))
    assert find_same_counts(entries_of(board)) == ({}, {})


def test_seeds_of_one_entry_are_not_compared_with_each_other(
    seeds_folder, dataset_folder, tmp_path
):
    (tmp_path / "entries").mkdir()
    add_seeds(sorted(seeds_folder.iterdir()), dataset_folder, tmp_path / "entries")
    assert find_same_counts(entries_of(tmp_path / "entries")) == ({}, {})


def test_counts_of_other_classes_are_not_compared(board):
    path = next(board.glob("*good.json"))
    other = json.loads(path.read_text())
    for scores in (other["result"], other["result"]["per_lidar"][LIDAR]):
        scores["confusion"] = [row[:-1] for row in scores["confusion"][:-1]]
    other["digests"]["taxonomy"] = "0" * 64
    (board / "other.json").write_text(to_json(seal(other)))
    assert find_same_counts(entries_of(board)) == ({}, {})
