import numpy as np
import pytest

from leaderboard.sanity import predict_sanity
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.predictions import PredictionsReader
from semantic2d_dataset.scoring.submission import score_predictions


def predict(kind, folder, tmp_path):
    path, data = tmp_path / f"{kind}.h5", open_dataset(folder)
    predict_sanity(kind, data, path, lidar="small", scheme="block", split="test")
    return path, score_predictions(path, data)


def test_perfect_scores_exactly_one(dataset_folder, tmp_path):
    _, result = predict("perfect", dataset_folder, tmp_path)
    assert result["mIoU"] == result["mCA"] == 1.0


def test_majority_is_the_class_that_the_train_split_holds_most_of(dataset_folder, tmp_path):
    path, result = predict("majority", dataset_folder, tmp_path)
    data = open_dataset(dataset_folder)
    scheme, counts = data.scheme("block"), np.zeros(256, int)
    for entry in data.manifest.sequences:
        batch = data.reader(entry.id).batch()
        train = scheme.scans_of(entry.id, "train")
        counts += np.bincount(batch.labels[train][batch.valid[train]], minlength=256)
    common = int(counts[1:10].argmax()) + 1
    with PredictionsReader(path) as reader:
        for name in reader.sequence_ids:
            assert (reader.read(name, "labels") == common).all()
    assert 0 < result["mIoU"] < 0.1


def test_another_kind_is_refused(dataset_folder, tmp_path):
    with pytest.raises(InvalidInputError, match="majority, perfect"):
        predict("best", dataset_folder, tmp_path)
