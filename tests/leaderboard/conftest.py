"""A board of three methods on a small data set."""

import json

import pytest

from leaderboard.adding import add_entry, make_entry_of_seeds
from leaderboard.entries import to_json
from semantic2d_dataset.access.registry import open_dataset
from tests.leaderboard.boards import add, write_predictions


@pytest.fixture(scope="session")
def predictions_folder(tmp_path_factory, dataset_folder):
    """Predictions of three methods; do not change them."""
    folder = tmp_path_factory.mktemp("predictions")
    for seed, (method, right) in enumerate((("Poor", 0.3), ("Fair", 0.6), ("Good", 0.9))):
        path = folder / f"{method.lower()}.h5"
        write_predictions(path, dataset_folder, method=method, right=right, seed=seed)
    return folder


@pytest.fixture
def board(tmp_path, dataset_folder, predictions_folder):
    """A folder of entries of those three."""
    folder = tmp_path / "entries"
    folder.mkdir()
    for path in sorted(predictions_folder.iterdir()):
        add(path, dataset_folder, folder)
    return folder


@pytest.fixture(scope="session")
def seeds_folder(tmp_path_factory, dataset_folder):
    """Predictions of three trainings of one method; do not change them."""
    folder = tmp_path_factory.mktemp("seeds")
    for seed, right in enumerate((0.6, 0.7, 0.5)):
        path = folder / f"seed{seed}.h5"
        write_predictions(path, dataset_folder, method="Net", right=right, seed=seed, seeds=[seed])
    return folder


@pytest.fixture(scope="session")
def entry_of_seeds(seeds_folder, dataset_folder):
    """The entry of those three; do not change it."""
    entry = make_entry_of_seeds(sorted(seeds_folder.iterdir()), open_dataset(dataset_folder))
    return json.loads(to_json(entry))  # no part is the same object as another


@pytest.fixture
def board_of_seeds(tmp_path, entry_of_seeds):
    """A folder of that one entry."""
    folder = tmp_path / "seeds"
    folder.mkdir()
    add_entry(entry_of_seeds, folder)
    return folder
