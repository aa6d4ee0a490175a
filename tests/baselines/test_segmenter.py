from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from baselines.checkpoints import Checkpoint
from baselines.onnx_export import export_onnx
from baselines.onnx_files import seal
from baselines.segmenter import Segmenter
from semantic2d_dataset.access.features import features_of
from semantic2d_dataset.errors import CorruptFileError, FormatVersionError, InvalidInputError
from tests.baselines.generated import make_checkpoint
from tests.baselines.test_onnx_export import Plain
from tests.conftest import PROJECT
from tests.generators import SMALL_LIDAR, make_arrays


@pytest.fixture(scope="module")
def scans() -> tuple[np.ndarray, np.ndarray]:
    arrays = make_arrays(20)
    return arrays["scans/ranges"], arrays["scans/intensities"]


@pytest.fixture(scope="module")
def segmenter(small_onnx: Path) -> Segmenter:
    return Segmenter(small_onnx)


def torch_features(checkpoint: Checkpoint, ranges: np.ndarray, intensities: np.ndarray):
    parts = (checkpoint.lidar, checkpoint.features, checkpoint.statistics)
    return torch.from_numpy(features_of(ranges, intensities, *parts))


def test_labels_are_those_of_torch_and_255_without_a_return(segmenter, small_checkpoint, scans):
    with torch.inference_mode():
        logits = small_checkpoint.network.expected_logits(torch_features(small_checkpoint, *scans))
    expected = logits.argmax(1).numpy()
    expected[~SMALL_LIDAR.has_return(scans[0])] = 255
    found = segmenter(*scans)
    assert found.dtype == np.uint8
    assert np.array_equal(found, expected)
    assert len(np.unique(found)) > 3


def test_one_scan_gives_one_row_the_same_alone_and_in_a_batch(small_onnx: Path, scans):
    segmenter = Segmenter(small_onnx, samples=11)
    together = segmenter(*scans)
    alone = segmenter(scans[0][7].tolist(), scans[1][7].astype(np.float64))
    assert np.array_equal(alone, together[7])
    assert segmenter(scans[0][:0], scans[1][:0]).shape == (0, 37)


def test_samples_are_those_that_torch_decodes_from_the_same_noise(
    small_onnx: Path, small_checkpoint: Checkpoint, scans
):
    found = Segmenter(small_onnx, samples=19, seed=5).sample(*scans)
    noise = torch.from_numpy(np.random.default_rng(5).standard_normal((19, 1, 9), np.float32))
    network = small_checkpoint.network
    with torch.inference_mode():
        law = network.encode(torch_features(small_checkpoint, *scans))
        logits = torch.stack([network.decode(law.mean + law.log_sd.exp() * z, 37) for z in noise])
    probabilities = logits.softmax(2).mean(0).transpose(1, 2)
    assert np.array_equal(found.samples, logits.argmax(2).numpy())
    np.testing.assert_allclose(found.probabilities, probabilities, atol=1e-4)
    entropy = torch.special.entr(probabilities).sum(2)
    np.testing.assert_allclose(found.entropy, entropy, atol=1e-4)
    has_return = SMALL_LIDAR.has_return(scans[0])
    majority = logits.argmax(2).mode(0).values.numpy()
    assert np.array_equal(found.labels, np.where(has_return, majority, 255))
    assert (found.samples != found.samples[0]).any()


def test_calling_it_gives_the_labels_of_its_samples(small_onnx: Path, scans):
    segmenter = Segmenter(small_onnx, samples=9, seed=1)
    assert np.array_equal(segmenter(*scans), segmenter.sample(*scans).labels)


def test_a_model_without_latent_and_intensities_needs_neither(tmp_path: Path, scans):
    checkpoint = make_checkpoint(SMALL_LIDAR, "P")
    network = Plain(2).eval()
    export_onnx(replace(checkpoint, network=network), tmp_path / "m.onnx")
    found = Segmenter(tmp_path / "m.onnx", samples=4).sample(scans[0])
    with torch.inference_mode():
        features = torch_features(checkpoint, scans[0], None)
        expected = network.expected_logits(features).softmax(1).transpose(1, 2)
    assert found.samples.shape == (1, 20, 37)
    np.testing.assert_allclose(found.probabilities, expected, atol=1e-4)


@pytest.mark.parametrize(
    ("ranges", "intensities", "message"),
    [
        (np.ones(36), np.ones(36), r"ranges: expected \(37,\) or \(N, 37\).*found \(36,\)"),
        (np.ones((1, 1, 37)), np.ones(37), r"ranges: expected .* found \(1, 1, 37\)"),
        (np.ones(37), np.ones(36), r"intensities: expected .* found \(36,\)"),
        (np.ones((2, 37)), np.ones(37), r"intensities: expected .*\(2, 37\)"),
        (np.ones(37), None, "a model of the features RIA needs intensities"),
    ],
)
def test_scans_that_do_not_fit_are_refused(segmenter, ranges, intensities, message: str):
    for method in (segmenter, segmenter.sample):
        with pytest.raises(InvalidInputError, match=message):
            method(ranges, intensities)


def test_no_sample_no_thread_and_no_seed_are_refused(small_onnx: Path):
    with pytest.raises(InvalidInputError, match="samples: expected at least 1, found 0"):
        Segmenter(small_onnx, samples=0)
    with pytest.raises(InvalidInputError, match="threads: expected at least 1, found 0"):
        Segmenter(small_onnx, threads=0)
    with pytest.raises(InvalidInputError, match="seed: expected a whole number"):
        Segmenter(small_onnx, seed=-1)


def test_any_damage_is_noticed(small_onnx: Path, tmp_path: Path):
    content, path = small_onnx.read_bytes(), tmp_path / "m.onnx"
    rng = np.random.default_rng(0)
    for at in [0, len(content) - 1, *rng.integers(0, len(content), 30)]:
        flipped = bytearray(content)
        flipped[at] ^= 1 << int(rng.integers(8))
        for damaged in (bytes(flipped), content[:at]):
            path.write_bytes(damaged)
            with pytest.raises(CorruptFileError, match="damaged") as caught:
                Segmenter(path)
            assert "\n" not in str(caught.value)


def tiny_model() -> onnx.ModelProto:
    """Any ONNX model."""
    shape = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    other = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])
    node = onnx.helper.make_node("Relu", ["x"], ["y"])
    graph = onnx.helper.make_graph([node], "tiny", [shape], [other])
    versions = [onnx.helper.make_opsetid("", 18)]
    return onnx.helper.make_model(graph, opset_imports=versions, ir_version=10)


def said_of(path: Path) -> dict:
    return json.loads({p.key: p.value for p in onnx.load(path).metadata_props}["semantic2d"])


def test_other_files_are_refused(small_onnx: Path, tmp_path: Path):
    path = tmp_path / "m.onnx"
    said = said_of(small_onnx)
    for content in (b"", b"hello", tiny_model().SerializeToString()):
        path.write_bytes(content)
        with pytest.raises(CorruptFileError, match="not a model that"):
            Segmenter(path)
    for changed, message in (
        ({"format": "other"}, "semantic2d-onnx"),
        ({"lidar": {}}, "not the description of a model"),
        ({}, "expected the inputs features and noise"),
    ):
        path.write_bytes(seal(tiny_model(), said | changed))
        with pytest.raises(CorruptFileError, match=message):
            Segmenter(path)
    path.write_bytes(seal(tiny_model(), said | {"format_version": "9.0"}))
    with pytest.raises(FormatVersionError, match=r"written in format 9.0"):
        Segmenter(path)
    with pytest.raises(FileNotFoundError):
        Segmenter(tmp_path / "none.onnx")


def test_weights_in_another_file_are_refused(small_onnx: Path, tmp_path: Path):
    model = onnx.load(small_onnx)
    (tmp_path / "secret").write_bytes(bytes(1 << 20))
    onnx.external_data_helper.set_external_data(model.graph.initializer[0], "secret")
    model.graph.initializer[0].ClearField("raw_data")
    path = tmp_path / "m.onnx"
    path.write_bytes(seal(model, said_of(small_onnx)))
    with pytest.raises(CorruptFileError, match="ONNX Runtime cannot open it"):
        Segmenter(path)


def test_it_runs_without_torch(small_onnx: Path):
    code = (
        "import sys, numpy as np; from baselines.segmenter import Segmenter\n"
        f"labels = Segmenter({str(small_onnx)!r}, samples=3)(np.ones(37), np.ones(37))\n"
        "print(labels.shape, {'torch', 'safetensors', 'onnx', 'h5py'} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PROJECT
    )
    assert done.stdout.strip() == "(37,) set()"
    assert done.stderr == ""


def test_without_onnx_runtime_it_says_what_to_install(small_onnx: Path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"pip install 'semantic2d-dataset\[onnx\]'"):
        Segmenter(small_onnx)
