import json

import pytest

from leaderboard.adding import add_entry, make_entry
from leaderboard.entries import read_entry
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, SubmissionError
from semantic2d_dataset.scoring.submission import score_predictions
from tests.leaderboard.boards import add, write_predictions


@pytest.fixture
def entries(tmp_path):
    (tmp_path / "entries").mkdir()
    return tmp_path / "entries"


def test_an_entry_holds_the_whole_result_with_full_precision(
    entries, dataset_folder, predictions_folder
):
    path = predictions_folder / "fair.h5"
    said = read_entry(add(path, dataset_folder, entries)).said
    result = score_predictions(path, open_dataset(dataset_folder))
    assert said["result"] == {k: v for k, v in result.items() if k != "submission"}
    assert said["digests"] == result["submission"]["digests"]
    assert said["evaluator_version"] == result["submission"]["evaluator_version"]


def test_adding_twice_writes_the_same_bytes(entries, dataset_folder, predictions_folder):
    path = add(predictions_folder / "fair.h5", dataset_folder, entries)
    before = path.read_bytes()
    path.unlink()
    assert add(predictions_folder / "fair.h5", dataset_folder, entries).read_bytes() == before


def test_a_method_replaces_its_entry_only_by_force(tmp_path, entries, dataset_folder):
    first = write_predictions(tmp_path / "1.h5", dataset_folder, method="Mine")
    second = write_predictions(tmp_path / "2.h5", dataset_folder, method="Mine", right=0.9)
    path = add(first, dataset_folder, entries)
    before = path.read_bytes()
    entry = make_entry(second, open_dataset(dataset_folder))
    with pytest.raises(InvalidInputError, match="replace it with --force"):
        add_entry(entry, entries)
    assert path.read_bytes() == before
    assert add_entry(entry, entries, force=True) == path
    assert path.read_bytes() != before


@pytest.mark.parametrize(
    "theirs",
    [
        {"method": "mine!"},
        {"method": "Mine", "authors": ["Somebody Else"]},
    ],
)
def test_another_methods_entry_is_never_replaced(tmp_path, entries, dataset_folder, theirs):
    path = add(
        write_predictions(tmp_path / "1.h5", dataset_folder, **theirs), dataset_folder, entries
    )
    before = path.read_bytes()
    mine = write_predictions(tmp_path / "2.h5", dataset_folder, method="Mine")
    for force in (False, True):
        with pytest.raises(InvalidInputError, match="holds the entry of"):
            add_entry(make_entry(mine, open_dataset(dataset_folder)), entries, force=force)
    assert path.read_bytes() == before


def test_features_make_another_method(tmp_path, entries, dataset_folder):
    for features in ("R", "RIA"):
        path = write_predictions(
            tmp_path / f"{features}.h5", dataset_folder, method="Net", features=features
        )
        add(path, dataset_folder, entries)
    assert sorted(read_entry(p).method for p in entries.iterdir()) == ["Net (R)", "Net (RIA)"]


def test_names_in_other_letters_keep_apart(tmp_path, entries, dataset_folder):
    for n, method in enumerate(("方法", "метод")):
        path = write_predictions(tmp_path / f"{n}.h5", dataset_folder, method=method)
        add(path, dataset_folder, entries)
    assert len(list(entries.iterdir())) == 2


def test_wrong_predictions_are_refused_with_every_problem(tmp_path, entries, dataset_folder):
    path = write_predictions(tmp_path / "1.h5", dataset_folder)
    with pytest.raises(SubmissionError, match="split"):
        make_entry(path, open_dataset(dataset_folder), split="val")
    with pytest.raises(CorruptFileError):
        make_entry(__file__, open_dataset(dataset_folder))


@pytest.mark.parametrize("url", ["http://host/x.h5", "javascript:alert(1)", "https://a b"])
def test_predictions_are_offered_over_https_only(dataset_folder, predictions_folder, url):
    with pytest.raises(InvalidInputError, match="predictions_url"):
        make_entry(predictions_folder / "fair.h5", open_dataset(dataset_folder), url=url)


def test_an_entry_of_a_newer_format_says_so(board):
    path = next(board.iterdir())
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format_version": "9.0"}))
    with pytest.raises(Exception, match=r"written in format 9\.0"):
        read_entry(path)
