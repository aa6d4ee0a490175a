import json
import shutil

import pytest

from leaderboard.at_hand import AtHand
from leaderboard.checking import UNVERIFIED, VERIFIED, WRONG, check_entries, check_entry
from leaderboard.entries import seal, to_json
from tests.leaderboard.boards import add, edited, json_path, write_predictions


@pytest.fixture
def at_hand(dataset_folder, seeds_folder):
    return AtHand([str(dataset_folder)], seeds_folder)


@pytest.fixture
def some_at_hand(dataset_folder, seeds_folder, tmp_path):
    """Two of the three files."""
    shutil.copytree(seeds_folder, tmp_path / "some")
    (tmp_path / "some" / "seed2.h5").unlink()
    return AtHand([str(dataset_folder)], tmp_path / "some")


def one_of(board):
    (path,) = board.iterdir()
    return path, json.loads(path.read_text())


def test_an_entry_is_verified_when_every_seed_scores_the_same(
    board_of_seeds, at_hand, seeds_folder
):
    (found,) = check_entries(board_of_seeds, at_hand)
    assert (found.status, found.problems) == (VERIFIED, ())
    assert found.predictions == seeds_folder / "seed0.h5"  # the median one is shown


def test_an_entry_is_unverified_while_one_seed_is_not_at_hand(board_of_seeds, some_at_hand):
    (found,) = check_entries(board_of_seeds, some_at_hand)
    assert (found.status, found.reason) == (UNVERIFIED, "2 of 3 predictions are at hand")
    assert found.predictions is None


def seed_leaves():
    counts = ("per_lidar", "small", "confusion", 4, 4)
    figures = (("per_lidar", "small", "Chair", "iou"), ("per_lidar", "small", "mIoU"), counts)
    return [(n, leaf) for n in range(3) for leaf in (("predictions",), ("seeds", 0), *figures)]


@pytest.mark.parametrize(("n", "leaf"), seed_leaves())
def test_an_edit_of_a_seed_that_is_sealed_again_fails_against_the_predictions(
    board_of_seeds, at_hand, n, leaf
):
    path, said = one_of(board_of_seeds)
    leaf = ("seeds", "runs", n, *leaf)
    path.write_text(to_json(seal(edited(said, leaf))))
    found = check_entry(path, at_hand)
    assert found.status == WRONG
    fields = [field for field, _ in found.problems]
    assert any(json_path(leaf).startswith(field) for field in fields), fields


def test_a_seed_at_hand_is_scored_while_another_is_missing(board_of_seeds, some_at_hand):
    path, said = one_of(board_of_seeds)
    path.write_text(to_json(seal(edited(said, ("seeds", "runs", 1, "seeds", 0)))))
    found = check_entry(path, some_at_hand)
    assert "seeds.runs[1].seeds[0]" in [field for field, _ in found.problems]


def test_metadata_that_another_seed_does_not_say_is_named(
    board_of_seeds, dataset_folder, seeds_folder, tmp_path
):
    path, said = one_of(board_of_seeds)
    said["metadata"]["hardware"] = "mine"  # the shown file alone says it, or not
    path.write_text(to_json(seal(said)))
    (tmp_path / "one").mkdir()
    shutil.copy(seeds_folder / "seed1.h5", tmp_path / "one")
    other = AtHand([str(dataset_folder)], tmp_path / "one")
    assert check_entry(path, other).status == UNVERIFIED
    said["metadata"]["parameters"] = 7
    path.write_text(to_json(seal(said)))
    assert [f for f, _ in check_entry(path, other).problems] == ["metadata.parameters"]


def test_another_file_of_a_seed_is_named_and_makes_the_entry_unverified(
    board_of_seeds, dataset_folder, some_at_hand
):
    write_predictions(
        some_at_hand.predictions / "seed2.h5",
        dataset_folder,
        method="Net",
        right=0.9,
        seed=2,
        seeds=[2],
    )
    (found,) = check_entries(board_of_seeds, some_at_hand)
    assert (found.status, found.problems) == (UNVERIFIED, ())
    assert "seed2.h5 says the same of itself, and is another file" in found.reason


def test_a_file_of_a_seed_that_the_entry_does_not_name_is_no_problem(
    board_of_seeds, dataset_folder, some_at_hand
):
    path = some_at_hand.predictions / "seed3.h5"
    write_predictions(path, dataset_folder, method="Net", seed=3, seeds=[3])
    (found,) = check_entries(board_of_seeds, some_at_hand)
    assert (found.status, found.problems) == (UNVERIFIED, ())


@pytest.mark.parametrize("file", ["seed0.h5", "seed2.h5"])
def test_predictions_of_a_seed_under_another_name_are_refused(
    board_of_seeds, at_hand, dataset_folder, seeds_folder, file
):
    (path,) = board_of_seeds.iterdir()
    alone = add(seeds_folder / file, dataset_folder, board_of_seeds.parent)
    said = json.loads(alone.read_text())
    said["metadata"]["method"] = "Mine"
    other = board_of_seeds / alone.name.replace("net.json", "mine.json")
    other.write_text(to_json(seal(said)))
    found = {each.path: each for each in check_entries(board_of_seeds, at_hand)}
    assert {each.status for each in found.values()} == {WRONG}
    field = f"seeds.runs[{file[4]}].predictions"
    assert dict(found[path].problems)[field] == f"these predictions are also those of {other.name}"
    assert dict(found[other].problems)["digests.predictions"].endswith(path.name)


def test_two_entries_that_share_a_seed_are_both_refused(board_of_seeds, at_hand):
    path, said = one_of(board_of_seeds)
    said["metadata"]["method"] = "Mine"
    (board_of_seeds / path.name.replace("net.json", "mine.json")).write_text(to_json(seal(said)))
    for each in check_entries(board_of_seeds, AtHand()):
        assert each.status == WRONG
        assert [field for field, _ in each.problems] == [
            f"seeds.runs[{n}].predictions" for n in range(3)
        ]
