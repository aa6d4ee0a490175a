import json
import os
import shutil

import pytest

from leaderboard.adding import add_entry
from leaderboard.at_hand import AtHand
from leaderboard.checking import (
    AS_PUBLISHED,
    UNVERIFIED,
    VERIFIED,
    WRONG,
    check_entries,
    check_entry,
    format_check,
)
from leaderboard.entries import file_name, seal, to_json
from leaderboard.published import published_entries
from semantic2d_dataset.errors import InvalidInputError
from tests.conftest import PROJECT
from tests.leaderboard.boards import (
    DERIVED,
    add,
    assert_every_edit_is_named,
    edited,
    json_path,
    leaves_of,
    write_predictions,
)


@pytest.fixture
def at_hand(dataset_folder, predictions_folder):
    return AtHand([str(dataset_folder)], predictions_folder)


def one_of(board):
    path = sorted(board.iterdir())[0]
    return path, json.loads(path.read_text())


def test_entries_whose_predictions_are_at_hand_are_verified(board, at_hand):
    found = check_entries(board, at_hand)
    assert [each.status for each in found] == [VERIFIED] * 3
    assert not any(each.problems for each in found)


def test_entries_whose_predictions_or_data_are_not_at_hand_are_unverified(board, dataset_folder):
    without = check_entries(board, AtHand([str(dataset_folder)]))
    assert {each.status for each in without} == {UNVERIFIED}
    assert "its predictions are not at hand" in format_check(without)
    assert "generated 1.0.0 is not at hand" in format_check(check_entries(board, AtHand()))


def test_no_entry_that_comes_with_the_project_is_wrong(mini):
    found = check_entries(PROJECT / "leaderboard" / "entries", AtHand())
    assert {each.status for each in found} == {UNVERIFIED, AS_PUBLISHED}, format_check(found)
    reasons = {each.reason for each in found if each.status == UNVERIFIED}
    # data set and evaluator are those of the entries
    assert reasons <= {"its predictions are not at hand", "0 of 3 predictions are at hand"}


@pytest.mark.parametrize("kind", ["pipe", "folder", "broken link", "device"])
def test_what_is_no_file_is_named_and_stops_no_other_entry(board, at_hand, kind):
    path = board / "a--b.json"
    make = {
        "pipe": lambda: os.mkfifo(path),
        "folder": path.mkdir,
        "broken link": lambda: path.symlink_to("nowhere"),
        "device": lambda: path.symlink_to("/dev/zero"),
    }
    make[kind]()
    found = check_entries(board, at_hand)
    assert [each.status for each in found] == [WRONG, VERIFIED, VERIFIED, VERIFIED]
    assert found[0].problems == (("the file", "expected a file"),)


def test_a_figure_that_stands_twice_is_refused(board):
    path, _ = one_of(board)
    path.write_text(path.read_text().replace('"mIoU":', '"mIoU": 0.99, "mIoU":', 1))
    (problem,) = check_entry(path, AtHand()).problems
    assert problem == ("the file", "not JSON: 'mIoU' stands there more than once")


def test_the_published_rows_are_as_published(tmp_path):
    for entry in published_entries():
        add_entry(entry, tmp_path)
    assert {each.status for each in check_entries(tmp_path, AtHand())} == {AS_PUBLISHED}


def some_of(leaves, every):
    """Return all that digests and counts explain, and one of `every` others, of thousands."""
    parts = {True: [], False: []}
    for leaf in leaves:
        parts[leaf[0] == "result" and leaf[1] in DERIVED].append(leaf)
    return parts[False] + parts[True][::every]


@pytest.mark.parametrize("every", [53, pytest.param(1, marks=pytest.mark.long)])
def test_any_edit_of_any_value_fails_and_is_named_without_predictions(board, every):
    path, said = one_of(board)
    assert_every_edit_is_named(path, said, some_of(list(leaves_of(said)), every))


def test_any_edit_of_a_published_figure_fails_and_is_named(tmp_path):
    path = add_entry(list(published_entries())[5], tmp_path)
    said = json.loads(path.read_text())
    assert_every_edit_is_named(path, said, leaves_of(said))


def test_an_edit_that_is_sealed_again_fails_by_its_own_counts(board):
    path, said = one_of(board)
    figures = [leaf for leaf in leaves_of(said["result"]) if leaf[0] not in ("per_lidar", *DERIVED)]
    assert len(figures) > 140
    for leaf in figures:
        path.write_text(to_json(seal(edited(said, ("result", *leaf)))))
        named = [name for name, _ in check_entry(path, AtHand()).problems]
        assert f"result.{json_path(leaf)}" in named, leaf


@pytest.mark.parametrize("every", [331, pytest.param(13, marks=pytest.mark.long)])
def test_an_edit_that_is_sealed_again_fails_against_the_predictions(board, at_hand, every):
    path, said = one_of(board)
    derived = [leaf for leaf in leaves_of(said["result"]) if leaf[0] in DERIVED]
    for leaf in derived[::every]:
        path.write_text(to_json(seal(edited(said, ("result", *leaf)))))
        named = [name for name, _ in check_entry(path, at_hand).problems]
        assert f"result.{json_path(leaf)}" in named, leaf


@pytest.mark.parametrize("name", ["predictions", "split", "taxonomy"])
def test_a_digest_that_is_sealed_again_fails_where_things_are_at_hand(board, at_hand, name):
    path, said = one_of(board)
    said["digests"][name] = "0" * 64
    path.write_text(to_json(seal(said)))
    assert f"digests.{name}" in [field for field, _ in check_entry(path, at_hand).problems]


def test_counts_that_agree_with_themselves_fail_against_the_predictions(
    board, at_hand, dataset_folder, tmp_path
):
    """Another method's figures, whole, under this one's digests."""
    path, said = one_of(board)
    other = json.loads(sorted(board.iterdir())[1].read_text())
    said["result"] = other["result"]
    path.write_text(to_json(seal(said)))
    assert check_entry(path, AtHand([str(dataset_folder)])).status == UNVERIFIED
    named = [field for field, _ in check_entry(path, at_hand).problems]
    assert "result.mIoU" in named
    assert "result.Chair.iou" in named


def test_an_entry_of_an_older_evaluator_is_unverified(board, at_hand):
    path, said = one_of(board)
    said["evaluator_version"] = "0.9"
    path.write_text(to_json(seal(said)))
    found = check_entry(path, at_hand)
    assert found.status == UNVERIFIED
    assert "scored by evaluator 0.9" in found.reason


def test_the_same_predictions_under_two_names_are_refused(board, at_hand):
    _, said = one_of(board)
    said["metadata"]["method"] = "Another name"
    (board / file_name(said)).write_text(to_json(seal(said)))
    wrong = [each for each in check_entries(board, at_hand) if each.status == WRONG]
    assert len(wrong) == 2
    for each in wrong:
        assert any("these predictions are also those of" in what for _, what in each.problems)


def test_a_renamed_file_is_refused(board):
    path, _ = one_of(board)
    path.rename(board / "mine.json")
    found = check_entry(board / "mine.json", AtHand())
    assert [field for field, _ in found.problems] == ["file name"]


@pytest.mark.parametrize("size", range(0, 6000, 731))
def test_truncated_entries_are_refused(board, size):
    path, _ = one_of(board)
    path.write_bytes(path.read_bytes()[:size])
    assert check_entry(path, AtHand()).problems[0][0] == "the file"


@pytest.mark.parametrize(
    "value", [None, 3, [], "x", {}, [[1]], True, 1e308, -1, {"Chair": {"iou": "x"}}]
)
def test_values_of_another_kind_never_break_the_check(board, value):
    path, said = one_of(board)
    for part in ("result", "track", "metadata", "digests", "taxonomy", "seals", "kind"):
        path.write_text(json.dumps(said | {part: value}))
        assert check_entry(path, AtHand()).status == WRONG
    for part in said["result"]:
        path.write_text(json.dumps(said | {"result": said["result"] | {part: value}}))
        assert check_entry(path, AtHand()).status == WRONG


def test_conditions_are_compared_with_their_bands(board):
    path, said = one_of(board)
    names = said["taxonomy"]["names"]
    band = {"iou": dict.fromkeys(names, 0.5), "ca": dict.fromkeys(names, 0.25)}
    band |= {"mIoU": 0.5, "mCA": 0.25, "points": said["result"]["points"]}
    said["result"]["conditions"] = {"range_m": {"0-1": band}}
    path.write_text(to_json(seal(said)))
    assert check_entry(path, AtHand()).problems == ()
    band["mIoU"] = 0.6
    path.write_text(to_json(seal(said)))
    fields = [field for field, _ in check_entry(path, AtHand()).problems]
    assert fields == ["result.conditions.range_m.0-1.mIoU"]


def test_a_folder_without_entries_is_no_board(tmp_path):
    with pytest.raises(InvalidInputError, match="expected a folder of entries"):
        check_entries(tmp_path / "none", AtHand())


def test_other_predictions_of_a_method_are_named_and_no_proof(board, dataset_folder, tmp_path):
    """Whoever trains a known network again has such a file."""
    shutil.rmtree(board)
    board.mkdir()
    folder = tmp_path / "predictions"
    folder.mkdir()
    path = write_predictions(folder / "mine.h5", dataset_folder, method="Mine", seed=7)
    add(path, dataset_folder, board)
    write_predictions(path, dataset_folder, method="Mine", seed=8)
    (found,) = check_entries(board, AtHand([str(dataset_folder)], folder))
    assert (found.status, found.problems) == (UNVERIFIED, ())
    assert "mine.h5 says the same of itself, and is another file" in found.reason


def test_a_digest_that_was_edited_is_named_where_its_file_is_at_hand(board, at_hand):
    path, said = one_of(board)
    digest = said["digests"]["predictions"]
    said["digests"]["predictions"] = "0" * 64
    path.write_text(to_json(seal(said)))
    found = check_entry(path, at_hand)
    (problem,) = found.problems
    assert problem[0] == "digests.predictions"
    assert problem[1].endswith(f"scores this, and its SHA-256 is {digest}")


@pytest.mark.parametrize("owner", ["whole", "lidar"])
def test_an_interval_that_is_upside_down_is_named(board, owner):
    path, said = one_of(board)
    result, field = said["result"], "result"
    if owner == "lidar":
        result, field = result["per_lidar"]["small"], "result.per_lidar.small"
    result["intervals"]["mCA"] = [0.9, 0.1]
    result["intervals"]["classes"]["Chair"] = [0.6, 0.5]
    path.write_text(to_json(seal(said)))
    named = {name for name, _ in check_entry(path, AtHand()).problems}
    assert named == {f"{field}.intervals.mCA", f"{field}.intervals.classes.Chair"}


def test_a_pipe_among_the_predictions_is_passed_over(board, predictions_folder, tmp_path):
    os.mkfifo(tmp_path / "never.h5")
    (tmp_path / "gone.h5").symlink_to(tmp_path / "nowhere")
    (tmp_path / "folder.h5").mkdir()
    shutil.copy(predictions_folder / "fair.h5", tmp_path)
    at_hand = AtHand(predictions=tmp_path)
    digests = [json.loads(p.read_text())["digests"]["predictions"] for p in sorted(board.iterdir())]
    assert [at_hand.file(d) is not None for d in digests] == [True, False, False]


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("predictions_url", f"https://{rest}") for rest in ("", "a\\@b/c", 'a/"x', "a/\u202ex")),
        ("predictions_url", "http://a/b"),
        *(("evaluator_version", version) for version in ("01.0", "1.00", "1", "1.0\n")),
        ("digests.split", "0" * 64 + "\n"),
        ("track.split", "train"),
        ("taxonomy.names", ["Other", "Cha\u200bir"]),
    ],
)
def test_values_that_nobody_needs_are_refused(board, field, value):
    path, said = one_of(board)
    *owners, name = field.split(".")
    owner = said
    for each in owners:
        owner = owner[each]
    owner[name] = value
    path.write_text(to_json(seal(said)))
    checked = check_entry(path, AtHand())
    assert checked.status == WRONG
    assert field in str(checked.problems)
