"""A board of three methods on a small data set."""

import pytest

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
