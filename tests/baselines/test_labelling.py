from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines.checkpoints import Checkpoint, save_checkpoint
from baselines.labelling import label_sequence
from baselines.segmenter import Segmenter
from baselines.torch_segmenter import TorchSegmenter
from semantic2d_dataset.access.features import features_of
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from tests.baselines.generated import make_checkpoint
from tests.conftest import PROJECT
from tests.generators import SMALL_LIDAR, make_sequence

SCANS = 300  # two blocks


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("sequences") / "source.h5"
    make_sequence(path, SCANS)
    return path


@pytest.fixture(scope="module")
def labelled(source: Path, small_onnx: Path, tmp_path_factory):
    out = tmp_path_factory.mktemp("labelled") / "out.h5"
    return out, label_sequence(source, small_onnx, out, samples=3, seed=4)


def test_labels_and_confidence_are_those_of_the_segmenter(labelled, source, small_onnx):
    with SequenceReader(source) as reader:
        ranges, intensities = reader.read("scans/ranges"), reader.read("scans/intensities")
    found = Segmenter(small_onnx, samples=3, seed=4).sample(ranges, intensities)
    has_return = SMALL_LIDAR.has_return(ranges)
    with SequenceReader(labelled[0]) as reader:
        reader.check_values()
        assert np.array_equal(reader.read("scans/labels"), found.labels)
        confidence = reader.read("scans/confidence")
    assert ((found.labels == 255) == ~has_return).all()
    assert (confidence[~has_return] == 0).all()
    chosen = np.take_along_axis(found.probabilities, found.labels[..., None] % 255, 2)[..., 0]
    np.testing.assert_allclose(confidence[has_return] / 255, chosen[has_return], atol=1 / 500)
    assert labelled[1].scans == SCANS
    assert sum(labelled[1].points.values()) == has_return.sum()
    assert labelled[1].points["Person"] == (found.labels == 4).sum()


def test_all_else_is_copied_as_it_is(labelled, source: Path, tmp_path: Path):
    with SequenceReader(source) as before, SequenceReader(labelled[0]) as after:
        assert set(after.names) == {*before.names, "scans/confidence"}
        for name in set(before.names) - {"scans/labels", "provenance"}:
            np.testing.assert_array_equal(after.read(name), before.read(name))
        assert after.read_map().origin == before.read_map().origin
        said = (before.header.provenance, after.header.provenance)
        assert replace(after.header, provenance={}) == replace(before.header, provenance={})
    assert {key: said[1][key] for key in said[0]} == said[0]


def test_only_the_labels_change_the_content(source: Path, small_onnx: Path, tmp_path: Path):
    one, two, other = (tmp_path / name for name in ("one.h5", "two.h5", "other.h5"))
    label_sequence(source, small_onnx, one, samples=1)
    label_sequence(one, small_onnx, two, samples=1)  # its labels are replaced by the same
    label_sequence(source, small_onnx, other, samples=2)
    digests = []
    for path in (one, two, other):
        with SequenceReader(path) as reader:
            digests.append(reader.content_digest())
    assert digests[0] == digests[1] != digests[2]


def test_the_provenance_names_sequence_and_model_by_their_digest(labelled, source, small_onnx):
    with SequenceReader(labelled[0]) as reader:
        facts = reader.header.provenance["baseline"]
    for role, path in (("sequence", source), ("model", small_onnx)):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert facts["inputs"][role] == {"name": path.name, "sha256": digest}
    assert facts["model"] == {"features": "RIA", "dataset": {"name": "generated"}}
    assert facts["parameters"] == {"samples": 3, "seed": 4}


def test_a_run_and_its_export_give_the_same_labels_by_the_mean(source, small_run, small_onnx):
    with SequenceReader(source) as reader:
        ranges, intensities = reader.read("scans/ranges"), reader.read("scans/intensities")
    run, exported = TorchSegmenter(small_run), Segmenter(small_onnx)
    one, other = run.sample(ranges, intensities), exported.sample(ranges, intensities)
    assert np.array_equal(one.labels, other.labels)
    np.testing.assert_allclose(one.probabilities, other.probabilities, atol=1e-4)
    np.testing.assert_allclose(one.entropy, other.entropy, atol=1e-4)


def test_a_run_votes_as_predictions_do(source, small_run, small_checkpoint: Checkpoint):
    from baselines.inference import infer

    with SequenceReader(source) as reader:
        ranges, intensities = (reader.read(f"scans/{of}", 0, 9) for of in ("ranges", "intensities"))
    about = small_checkpoint.description
    given = features_of(ranges, intensities, about.lidar, about.features, about.statistics)
    expected = infer(small_checkpoint.network, torch.from_numpy(given), samples=4, seed=2)
    found = TorchSegmenter(small_run, samples=4, seed=2).sample(ranges, intensities)
    assert np.array_equal(found.samples, expected.samples)
    has_return = SMALL_LIDAR.has_return(ranges)
    assert np.array_equal(found.labels[has_return], expected.labels[has_return])


def test_another_name_mount_and_range_of_the_same_beams_are_taken(small_run, tmp_path: Path):
    lidar = replace(SMALL_LIDAR, name="mine", range_max=30.0, base_T_lidar=(0.0,) * 6)
    lidar = replace(lidar, angle_increment=0.1 + 1e-5)
    make_sequence(tmp_path / "mine.h5", 5, lidar=lidar)
    label_sequence(tmp_path / "mine.h5", small_run, tmp_path / "out.h5", samples=1)
    with SequenceReader(tmp_path / "out.h5") as reader:
        assert reader.lidar == lidar


@pytest.mark.parametrize(
    ("lidar", "message"),
    [
        (replace(SMALL_LIDAR, beams=36), "is for small.*expected 37 beams, found 36"),
        (replace(SMALL_LIDAR, angle_min=-1.7), "angle_min -1.8 rad, found -1.7; take"),
        (replace(SMALL_LIDAR, angle_increment=0.101), "angle_increment 0.1 rad, found 0.101"),
    ],
)
def test_beams_that_lie_elsewhere_are_refused(lidar, message: str, small_run, tmp_path: Path):
    make_sequence(tmp_path / "s.h5", 5, lidar=lidar)
    with pytest.raises(InvalidInputError, match=message):
        label_sequence(tmp_path / "s.h5", small_run, tmp_path / "out.h5")
    assert not (tmp_path / "out.h5").exists()


def test_what_the_model_cannot_label_is_refused_before_work(source, small_run, tmp_path: Path):
    out = tmp_path / "out.h5"
    make_sequence(tmp_path / "dark.h5", 5, drop=("scans/intensities",))
    with pytest.raises(InvalidInputError, match="has no intensities, which a model of the feat"):
        label_sequence(tmp_path / "dark.h5", small_run, out)
    named = replace(SEMANTIC2D, names=(*SEMANTIC2D.names[:-1], "Fence"))
    save_checkpoint(tmp_path, replace(make_checkpoint(SMALL_LIDAR), taxonomy=named))
    with pytest.raises(InvalidInputError, match="its map is annotated with other classes"):
        label_sequence(source, tmp_path, out)
    with pytest.raises(InvalidInputError, match="is an input itself"):
        label_sequence(source, small_run, source, force=True)
    assert not out.exists()


SLOWLY = """
import sys, time
from pathlib import Path
import baselines.labelling as labelling
confidence = labelling._confidence
labelling._BLOCK_SCANS = 2
def slow(found):
    time.sleep(0.05)
    return confidence(found)
labelling._confidence = slow
from semantic2d_dataset.cli import main
sys.argv[1:] = ["baseline", "label", *sys.argv[1:]]
main()
"""


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_labelling_leaves_no_file_and_runs_again(
    sign: int, source: Path, small_onnx: Path, tmp_path: Path
):
    out = tmp_path / "out.h5"
    words = [source, "--model", small_onnx, "--samples", "1", "--out", out]
    command = [sys.executable, "-c", SLOWLY, *map(str, words)]
    with subprocess.Popen(command, cwd=PROJECT, stderr=subprocess.PIPE, text=True) as process:
        until = time.monotonic() + 60
        while not list(tmp_path.glob(".*.partial")) and time.monotonic() < until:
            time.sleep(0.01)
        process.send_signal(sign)
        said = process.stderr.read()
        status = process.wait(timeout=60)
    assert not out.exists()
    if sign == signal.SIGINT:
        assert (status, said.splitlines()[-1]) == (130, "interrupted; nothing half done was left")
        assert list(tmp_path.iterdir()) == []
    label_sequence(source, small_onnx, out, samples=1)
    assert [path.name for path in tmp_path.iterdir()] == ["out.h5"]
