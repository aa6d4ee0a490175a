import h5py
import numpy as np
import pytest

from leaderboard.hiding import hide_labels
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import find_problems
from semantic2d_dataset.scoring.submission import score_predictions


@pytest.fixture(scope="module")
def divided(tmp_path_factory, dataset_folder):
    folder = tmp_path_factory.mktemp("divided")
    hidden = hide_labels(open_dataset(dataset_folder), folder / "public", folder / "private")
    return folder, hidden


def test_train_and_val_keep_their_labels_and_no_other_scan_has_any(divided, dataset_folder):
    folder, hidden = divided
    data, public = open_dataset(dataset_folder), open_dataset(folder / "public")
    scheme, found = data.scheme("block"), 0
    for entry in data.manifest.sequences:
        before = data.reader(entry.id).read("scans/labels")
        after = public.reader(entry.id).read("scans/labels")
        kept = np.isin(scheme.membership[entry.id], (0, 1))
        assert (after[kept] == before[kept]).all()
        assert (after[~kept] == 255).all()
        found += int((~kept).sum())
    assert hidden == found > 0


def test_nothing_else_of_the_public_part_tells_labels(divided):
    folder, _ = divided
    for path in (folder / "public" / "sequences").iterdir():
        with h5py.File(path) as file:
            assert set(file) <= {"scans", "poses", "commands", "lidar", "taxonomy", "provenance"}
            assert "confidence" not in file["scans"]
            assert b"generated" not in bytes(file["provenance"][:])


def test_predictions_for_the_public_part_score_as_against_the_whole(
    divided, dataset_folder, predictions_folder
):
    folder, _ = divided
    path = predictions_folder / "fair.h5"
    whole = score_predictions(path, open_dataset(dataset_folder))
    private = score_predictions(path, open_dataset(folder / "private"))
    assert private == whole
    assert score_predictions(path, open_dataset(folder / "public"))["points"] == 0


def test_both_parts_are_good_data_sets_with_that_scheme_alone(divided):
    folder, _ = divided
    for part in ("public", "private"):
        assert find_problems(folder / part, full=True) == []
        assert set(open_dataset(folder / part).manifest.splits) == {"block"}


def test_folders_that_are_there_are_refused(divided, dataset_folder, tmp_path):
    folder, _ = divided
    with pytest.raises(InvalidInputError, match="exists already"):
        hide_labels(open_dataset(dataset_folder), folder / "public", tmp_path / "private")
    with pytest.raises(InvalidInputError, match="exists already"):
        hide_labels(open_dataset(dataset_folder), tmp_path / "public", folder / "private")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("public", "private"), [("x", "x"), ("x", "x/in"), ("x/in", "x")])
def test_private_labels_never_lie_in_the_public_folder(dataset_folder, tmp_path, public, private):
    with pytest.raises(InvalidInputError, match="side by side"):
        hide_labels(open_dataset(dataset_folder), tmp_path / public, tmp_path / "." / private)
    assert not list(tmp_path.iterdir())
