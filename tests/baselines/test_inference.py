from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from baselines.checkpoints import Checkpoint
from baselines.inference import infer, predict
from baselines.networks import Latent, Prediction, SegmentationNetwork
from baselines.s3net import S3Net
from semantic2d_dataset import load_dataset, open_dataset
from semantic2d_dataset.access.torch_datasets import LidarDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from semantic2d_dataset.scoring.submission import PredictionsReader, validate
from tests.baselines.generated import make_scans


@pytest.fixture(scope="module")
def network() -> S3Net:
    torch.manual_seed(0)
    made = S3Net()
    for layer in made.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            layer.momentum = 1.0
    made(make_scans(32, 61)[0])  # now its batch norms are those of a trained network
    return made.eval()


@pytest.fixture(scope="module")
def features() -> torch.Tensor:
    return make_scans(5, 61, seed=1)[0]


def test_the_label_is_the_mode_of_the_samples_and_the_lowest_of_equals(network, features):
    found = infer(network, features, samples=6)
    assert found.samples.shape == (6, 5, 61)
    assert (found.samples != found.samples[0]).any()
    assert np.array_equal(found.labels, stats.mode(found.samples, axis=0).mode)


def test_encoding_once_gives_what_the_whole_network_gives_sample_by_sample(network, features):
    samples = 7
    found = infer(network, features, samples=samples, seed=3)
    noise = torch.randn((5, samples, 1, 15), generator=torch.Generator().manual_seed(3))
    chosen, probabilities = [], []
    with torch.inference_mode():
        for s in range(samples):
            law = network.encode(features)
            logits = network(features, law.mean + law.log_sd.exp() * noise[:, s]).logits
            chosen.append(logits.argmax(1).numpy())
            probabilities.append(logits.softmax(1).numpy())
    mean = np.mean(probabilities, axis=0).transpose(0, 2, 1)
    assert np.array_equal(found.samples, chosen)
    np.testing.assert_allclose(found.probabilities, mean, atol=1e-5)
    entropy = -(mean * np.log(mean)).sum(-1)
    np.testing.assert_allclose(found.entropy, entropy, atol=1e-4)
    own = -(np.array(probabilities) * np.log(probabilities)).sum(2).mean(0)
    np.testing.assert_allclose(found.mutual_information, entropy - own, atol=1e-4)
    assert (found.mutual_information >= 0).all()
    assert found.mutual_information.max() > 0.01


def test_one_sample_disagrees_with_nobody(network, features):
    assert infer(network, features, samples=1).mutual_information.max() < 1e-5


class NoLatent(SegmentationNetwork):
    """A network without a latent: one linear map for every beam."""

    name, title, least_beams = "none", "None", 1

    def __init__(self):
        super().__init__(3, 10)
        self.map = torch.nn.Conv1d(3, 10, 1)

    def forward(self, features):
        return Prediction(self.map(features))

    def expected_logits(self, features):
        return self.map(features)


def test_a_network_without_a_latent_has_no_mutual_information(features):
    found = infer(NoLatent().eval(), features, samples=4)
    assert found.samples.shape == (1, 5, 61)
    assert found.entropy.min() > 0
    assert (found.mutual_information == 0).all()


def test_scans_split_into_chunks_give_what_they_give_together(network, monkeypatch):
    features = make_scans(7, 61)[0]
    together = infer(network, features, samples=5)
    monkeypatch.setattr("baselines.inference._ENCODED_AT_ONCE", 2)
    monkeypatch.setattr("baselines.inference._DECODED_AT_ONCE", 2)
    apart = infer(network, features, samples=5)
    assert np.array_equal(together.samples, apart.samples)
    np.testing.assert_allclose(together.probabilities, apart.probabilities, atol=1e-5)


def test_one_seed_gives_one_result(network, features):
    first, again, other = (infer(network, features, samples=4, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first.samples, again.samples)
    assert not np.array_equal(first.samples, other.samples)


def test_no_samples_and_no_seed_are_refused(network, features):
    with pytest.raises(InvalidInputError, match="at least 1, found 0"):
        infer(network, features, samples=0)
    for seed in (-1, 2**32):
        with pytest.raises(InvalidInputError, match=f"seed: expected .*, found {seed}"):
            infer(network, features, seed=seed)


@pytest.fixture(scope="module")
def scans(dataset_folder: Path) -> LidarDataset:
    return load_dataset(dataset_folder, lidar="small", split="test", features="RIA")


@pytest.fixture(scope="module")
def checkpoint(network: S3Net, scans: LidarDataset) -> Checkpoint:
    return Checkpoint(network, "RIA", scans.statistics, scans.lidar, scans.taxonomy)


def test_predictions_say_with_which_seed_their_model_was_trained(checkpoint, scans, tmp_path: Path):
    trained = replace(checkpoint, training={"seed": 7})
    for name, model in (("unknown", checkpoint), ("trained", trained)):
        predict(model, scans, tmp_path / f"{name}.h5", samples=1, seed=3)
    with PredictionsReader(tmp_path / "trained.h5") as reader:
        assert (reader.metadata["seeds"], reader.metadata["sampling_seed"]) == ([7], 3)
    with PredictionsReader(tmp_path / "unknown.h5") as reader:
        assert "seeds" not in reader.metadata


def test_predictions_of_a_split_are_valid_and_complete(
    checkpoint, scans, dataset_folder: Path, tmp_path: Path
):
    path = tmp_path / "predictions.h5"
    count = predict(checkpoint, scans, path, samples=3, with_probabilities=True, with_samples=True)
    assert count == len(scans)
    assert validate(path, open_dataset(dataset_folder)) == []
    with PredictionsReader(path) as reader:
        assert (reader.scheme, reader.split) == ("block", "test")
        assert reader.metadata["features"] == "RIA"
        name = reader.sequence_ids[0]
        probabilities = reader.read(name, "probabilities").astype(np.float32)
        assert len(reader.read(name, "labels")) == len(probabilities)
        samples = reader.read(name, "samples")
        assert np.array_equal(stats.mode(samples, axis=0).mode, reader.read(name, "labels"))
        assert len(samples) == 3
    np.testing.assert_allclose(probabilities.sum(-1), 1, atol=0.01)


def test_predictions_belong_to_the_scans_they_name(checkpoint, scans, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("baselines.inference._WRITTEN_AT_ONCE", 7)  # batches span sequences

    def draw_mean(law: Latent, samples: int, noise: object) -> torch.Tensor:
        return law.mean[:, None]

    monkeypatch.setattr("baselines.inference._draw", draw_mean)
    path = tmp_path / "predictions.h5"
    predict(checkpoint, scans, path, samples=1)
    with PredictionsReader(path) as reader:
        for i in range(0, len(scans), 11):
            item = scans[i]
            name, _, index = item["scan_id"].rpartition("/")
            row = reader.read(name, "scan_index").tolist().index(int(index))
            with torch.inference_mode():
                law = checkpoint.network.encode(item["features"][None])
                expected = checkpoint.network.decode(law.mean, 37).argmax(1)[0]
            assert reader.read(name, "labels")[row].tolist() == expected.tolist()


def test_scans_that_do_not_fit_the_model_are_refused(checkpoint, scans, tmp_path: Path):
    path = tmp_path / "predictions.h5"
    other = replace(checkpoint, lidar=HOKUYO_UTM_30LX_EW)
    with pytest.raises(InvalidInputError, match=r"trained on hokuyo-utm-30lx-ew \(1081 beams\)"):
        predict(other, scans, path)
    with pytest.raises(InvalidInputError, match="features='RI'"):
        predict(replace(checkpoint, features="RI"), scans, path)
    with pytest.raises(InvalidInputError, match="seed: expected"):
        predict(checkpoint, scans, path, seed=-1)
    assert not path.exists()
