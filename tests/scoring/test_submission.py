import hashlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from semantic2d_dataset.errors import (
    CorruptFileError,
    DatasetNotFoundError,
    FormatVersionError,
    InvalidInputError,
    Semantic2DError,
    SubmissionError,
    UnsafeFileError,
    WriteError,
)
from semantic2d_dataset.format.manifest import Manifest, publish
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from semantic2d_dataset.format.splits import NONE, TEST, VAL, SplitScheme
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from semantic2d_dataset.scoring import tallies
from semantic2d_dataset.scoring.metrics import EVALUATOR_VERSION, Evaluator
from semantic2d_dataset.scoring.predictions import metadata_problems
from semantic2d_dataset.scoring.submission import (
    PredictionsReader,
    PredictionsWriter,
    format_score,
    result_to_json,
    score_predictions,
    validate,
)

SCANS = 70  # more than one chunk of 64
NEAR = LidarSpec("near", "Near 1", 12, -1.0, 0.1, 0.1, 10.0)
FAR = LidarSpec("far", "Far 1", 9, -1.0, 0.1, 0.1, 30.0)
TEST_SCANS = np.arange(2, SCANS)


@dataclass(frozen=True)
class Folder:
    """A data set in a folder, as the registry would open it."""

    root: Path
    manifest: Manifest
    schemes: dict[str, SplitScheme]

    def scheme(self, name):
        if name not in self.schemes:
            raise DatasetNotFoundError(f"unknown scheme {name!r}; known are block")
        return self.schemes[name]

    def reader(self, sequence_id):
        return SequenceReader(self.root / "sequences" / f"{sequence_id}.h5")


def write_sequence(folder, recording, lidar, seed, *, labelled=True, taxonomy=SEMANTIC2D):
    header = SequenceHeader(
        environment="hall",
        recording=recording,
        lidar=lidar,
        license="unknown",
        stamps_source="synthetic",
        provenance={},
        taxonomy=taxonomy,
    )
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0, 12, (SCANS, lidar.beams)).astype(np.float32)
    ranges[rng.random(ranges.shape) < 0.1] = np.inf
    labels = rng.choice([*range(len(taxonomy)), 255], ranges.shape).astype(np.uint8)
    arrays = {"scans/ranges": ranges, "scans/stamps_ns": np.arange(SCANS) * 50_000_000}
    arrays |= {"scans/labels": labels} if labelled else {}
    with SequenceWriter(folder / "sequences" / f"{header.sequence_id}.h5", header) as writer:
        writer.append(arrays)
    return header.sequence_id


def make_dataset(folder, ids):
    membership = np.full(SCANS, TEST, np.uint8)
    membership[:2] = NONE, VAL
    block = SplitScheme("block", dict.fromkeys(ids, membership), "by hand")
    manifest = publish(folder, name="toy", version="1.2.3", schemes=[block])
    return Folder(folder, manifest, {"block": block})


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("toy")
    (folder / "sequences").mkdir()
    sequences = (("a", NEAR), ("b", NEAR), ("a", FAR))
    ids = [write_sequence(folder, r, lidar, n) for n, (r, lidar) in enumerate(sequences)]
    return make_dataset(folder, ids)


def writer_of(path, **changes):
    said = {
        "dataset": "toy",
        "dataset_version": "1.2.3",
        "scheme": "block",
        "split": "test",
        "taxonomy": SEMANTIC2D,
        "metadata": {"method": "guess"},
    }
    return PredictionsWriter(path, **(said | changes))


def guesses(dataset, name, seed=0):
    """Predictions that are often right, and the order of the scans that they come in."""
    truth = dataset.reader(name).read("scans/labels")[TEST_SCANS]
    rng = np.random.default_rng(seed)
    noise = rng.integers(0, 10, truth.shape).astype(np.uint8)
    return np.where((rng.random(truth.shape) < 0.3) | (truth == 255), noise, truth)


def write_predictions(path, dataset, *, order=slice(None), blocks=2, names=None, **changes):
    with writer_of(path, **changes) as writer:
        for name in names or [entry.id for entry in dataset.manifest.sequences]:
            labels = guesses(dataset, name)[order]
            scans = TEST_SCANS[order]
            for rows in np.array_split(np.arange(len(scans)), blocks):
                writer.add(name, scans[rows], labels[rows])
    return path


@pytest.fixture(scope="module")
def predictions(dataset, tmp_path_factory):
    return write_predictions(tmp_path_factory.mktemp("predictions") / "p.h5", dataset)


@pytest.fixture
def copy(predictions, tmp_path):
    return Path(shutil.copy(predictions, tmp_path / "copy.h5"))


def replace(path, name, array):
    """Replace an array, stored as the format wants it."""
    with h5py.File(path, "r+") as file:
        if name in file:
            del file[name]
        file.create_dataset(name, data=array, chunks=array.shape, fletcher32=True)


FIRST = "hall--a--near"


def test_predictions_come_back_as_written(dataset, tmp_path):
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 10, (5, 12)).astype(np.uint8)
    probabilities = rng.random((5, 12, 10)).astype(np.float16)
    samples = rng.integers(0, 10, (3, 5, 12)).astype(np.uint8)
    with writer_of(tmp_path / "p.h5", metadata={"method": "m", "seeds": [1]}) as writer:
        for rows in (slice(0, 2), slice(2, 5)):
            part = [array.copy() for array in (labels[rows], probabilities[rows], samples[:, rows])]
            writer.add(FIRST, np.arange(5)[rows], *part)
            for array in part:
                array.fill(0)  # callers may use their arrays again
    with PredictionsReader(tmp_path / "p.h5") as reader:
        assert reader.sequence_ids == (FIRST,)
        assert (reader.read(FIRST, "scan_index") == np.arange(5)).all()
        assert (reader.read(FIRST, "labels") == labels).all()
        assert (reader.read(FIRST, "labels", 1, 3) == labels[1:3]).all()
        assert (reader.read(FIRST, "probabilities") == probabilities).all()
        assert (reader.read(FIRST, "samples") == samples).all()
        assert reader.metadata == {"method": "m", "seeds": [1]}
        assert (reader.dataset, reader.scheme, reader.split) == ("toy", "block", "test")


def test_an_error_while_writing_leaves_no_file(tmp_path):
    with pytest.raises(RuntimeError, match="stop"), writer_of(tmp_path / "p.h5"):
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


UNFIT = [
    ("scan_index: expected int64", np.arange(2.0), np.zeros((2, 4), np.uint8)),
    (r"labels: expected uint8 \(2, any\)", np.arange(2), np.zeros((3, 4), np.uint8)),
    ("labels: expected uint8", np.arange(2), np.zeros((2, 4), np.int64)),
    ("class ids 0 to 9, found 10", np.arange(2), np.full((2, 4), 10, np.uint8)),
    (
        r"probabilities: expected float16 \(2, 4, 10\)",
        *(np.arange(2), np.zeros((2, 4), np.uint8), np.zeros((2, 4, 9), np.float16)),
    ),
    (
        r"samples: expected uint8 \(any, 2, 4\)",
        *(np.arange(2), np.zeros((2, 4), np.uint8), None, np.zeros((3, 2, 5), np.uint8)),
    ),
    ("the same parts, beams and samples", np.arange(2), np.zeros((2, 5), np.uint8)),
]


def test_writer_refuses_what_the_validator_would(tmp_path):
    with writer_of(tmp_path / "p.h5") as writer:
        writer.add(FIRST, np.arange(2), np.zeros((2, 4), np.uint8))
        for message, *arrays in UNFIT:
            with pytest.raises(InvalidInputError, match=message):
                writer.add(FIRST, *arrays)
        with pytest.raises(InvalidInputError, match="class ids 0 to 9, found 11"):
            samples = np.full((1, 2, 4), 11, np.uint8)
            writer.add("hall--b--near", np.arange(2), samples[0] - 11, samples=samples)
    with PredictionsReader(tmp_path / "p.h5") as reader:
        assert reader.shape(FIRST, "labels") == (2, 4)
        assert reader.sequence_ids == (FIRST,)


@pytest.mark.parametrize(
    "metadata", [{}, {"method": ""}, {"method": "\x1b[2J"}, {"method": "m", "parameters": -1}]
)
def test_writer_refuses_metadata_that_do_not_fit_the_schema(tmp_path, metadata):
    with pytest.raises(InvalidInputError, match="metadata"):
        writer_of(tmp_path / "p.h5", metadata=metadata)


@pytest.mark.parametrize(
    "method",
    [
        *(f"S3{hidden}-Net" for hidden in "\u00ad\u061c\u115f\u180e\u200b\u202e\u3164\ufe0f"),
        *("S3-Net\U000e0041", "S3-Net ", " S3-Net", "S3-Net\u00a0", " ", ""),
    ],
)
def test_no_method_is_called_what_looks_like_the_name_of_another(method):
    assert "metadata.method" in metadata_problems({"method": method})[0]
    assert "metadata.authors[0]" in metadata_problems({"method": "M", "authors": [method]})[0]


def test_names_are_of_any_language_and_a_bad_one_is_told_in_words():
    names = ["\u674e \u96f7", "Zo\u00eb", "\u0411\u043e\u0440\u0438\u0441"]
    assert metadata_problems({"method": "\u7f51 2", "authors": names}) == []
    (problem,) = metadata_problems({"method": "S3\u200b-Net"})
    assert problem == (
        "metadata.method: expected text in one line, without control or invisible characters, "
        "found 'S3\\u200b-Net'"
    )


def test_writer_says_that_the_folder_is_missing(tmp_path):
    with pytest.raises(WriteError, match="does not exist"):
        writer_of(tmp_path / "none" / "p.h5")


def test_score_is_the_evaluator_over_valid_beams_of_the_split(dataset, predictions):
    result = score_predictions(predictions, dataset)
    total, per_lidar = Evaluator(), {"near": Evaluator(), "far": Evaluator()}
    for entry in dataset.manifest.sequences:
        batch = dataset.reader(entry.id).batch()
        part = batch.labels[TEST_SCANS], guesses(dataset, entry.id), batch.valid[TEST_SCANS]
        total.update(*part)
        per_lidar[entry.lidar].update(*part)
    assert {key: result[key] for key in total.compute()} == total.compute()
    for name, scores in result["per_lidar"].items():
        assert scores.items() >= per_lidar[name].compute().items()
    assert list(result["per_lidar"]) == ["far", "near"]
    assert result["ignored"] > 0


def test_result_says_what_was_scored(dataset, predictions):
    said = score_predictions(predictions, dataset)["submission"]
    digest = hashlib.sha256(predictions.read_bytes()).hexdigest()
    assert said == {
        "dataset": "toy",
        "dataset_version": "1.2.3",
        "scheme": "block",
        "split": "test",
        "lidars": ["far", "near"],
        "scans": 3 * len(TEST_SCANS),
        "metadata": {"method": "guess"},
        "digests": {
            "predictions": digest,
            "split": dataset.scheme("block").digest,
            "taxonomy": SEMANTIC2D.digest,
        },
        "evaluator_version": EVALUATOR_VERSION,
    }


def test_result_survives_json(dataset, predictions):
    result = score_predictions(predictions, dataset)
    assert json.loads(result_to_json(result)) == result


def test_score_as_text_says_what_was_scored_and_how_each_lidar_did(dataset, predictions):
    result = score_predictions(predictions, dataset)
    lines = format_score(result).splitlines()
    assert lines[0] == "guess on toy 1.2.3, split test of block: 204 scans"
    assert lines[-2].startswith(f"far: mIoU {100 * result['per_lidar']['far']['mIoU']:.2f}, mCA")
    assert any(line.startswith("Mean") for line in lines)


def write_everything(path, dataset, *, shuffled):
    """Labels, probabilities and samples; scans and sequences in order, or in none."""
    rng = np.random.default_rng(3)
    names = [entry.id for entry in dataset.manifest.sequences]
    with writer_of(path) as writer:
        for name in names[::-1] if shuffled else names:
            labels = guesses(dataset, name)
            scans = np.arange(len(TEST_SCANS))
            scans = rng.permutation(scans) if shuffled else scans
            probabilities = np.eye(10)[guesses(dataset, name, 1)] * 0.75 + 0.025
            samples = np.stack([guesses(dataset, name, seed) for seed in (2, 3)])
            for rows in np.array_split(scans, 3 if shuffled else 1):
                said = labels[rows], probabilities[rows].astype(np.float16), samples[:, rows]
                writer.add(name, TEST_SCANS[rows], *said)
    return path


def test_order_of_scans_sequences_and_blocks_changes_no_byte_of_the_result(
    dataset, tmp_path, monkeypatch
):
    written = []
    for shuffled, block in ((False, tallies._BLOCK), (True, 7)):
        monkeypatch.setattr(tallies, "_BLOCK", block)
        path = write_everything(tmp_path / f"{block}.h5", dataset, shuffled=shuffled)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        written.append(result_to_json(score_predictions(path, dataset)).replace(digest, "?"))
    assert written[0] == written[1]
    assert json.loads(written[0])["submission"]["digests"]["predictions"] == "?"
    assert {"calibration", "samples"} < {*json.loads(written[0])}


def test_ground_truth_given_as_predictions_scores_exactly_one(dataset, tmp_path):
    with writer_of(tmp_path / "p.h5") as writer:
        for entry in dataset.manifest.sequences:
            labels = dataset.reader(entry.id).read("scans/labels")[TEST_SCANS]
            writer.add(entry.id, TEST_SCANS, np.where(labels == 255, 0, labels).astype(np.uint8))
    result = score_predictions(tmp_path / "p.h5", dataset)
    assert result["mIoU"] == result["mCA"] == result["mCA_tn"] == 1.0


def test_predictions_of_one_lidar_are_scored_on_that_lidar_alone(dataset, tmp_path):
    names = ["hall--a--near", "hall--b--near"]
    result = score_predictions(write_predictions(tmp_path / "p.h5", dataset, names=names), dataset)
    assert result["submission"]["lidars"] == ["near"]
    (near,) = result["per_lidar"].values()
    assert {**result, **near} == result


def test_a_lidar_has_the_intervals_that_it_has_alone(dataset, predictions, tmp_path):
    names = ["hall--a--near", "hall--b--near"]
    alone = score_predictions(write_predictions(tmp_path / "p.h5", dataset, names=names), dataset)
    among = score_predictions(predictions, dataset)
    assert among["per_lidar"]["near"]["intervals"] == alone["intervals"] != among["intervals"]


def test_scheme_and_split_may_be_given_where_the_file_is_silent(dataset, copy):
    with h5py.File(copy, "r+") as file:
        del file.attrs["scheme"], file.attrs["split"], file.attrs["dataset"]
    assert validate(copy, dataset) != []
    assert validate(copy, dataset, scheme="block", split="test") == []


def test_dev_is_val(dataset, tmp_path):
    with writer_of(tmp_path / "p.h5", split="dev") as writer:
        for entry in dataset.manifest.sequences:
            writer.add(entry.id, np.array([1]), guesses(dataset, entry.id)[:1])
    result = score_predictions(tmp_path / "p.h5", dataset, split="val")
    assert result["submission"]["split"] == "val"


def test_a_patch_of_the_data_set_changes_nothing(dataset, copy):
    with h5py.File(copy, "r+") as file:
        file.attrs["dataset_version"] = np.bytes_("1.2.9")
    assert validate(copy, dataset) == []


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("dataset", "other", "dataset: expected 'toy', the file says 'other'"),
        ("dataset_version", "1.3.0", "dataset_version: expected '1.2.3', the file says '1.3.0'"),
        ("dataset_version", "x", "dataset_version: expected '1.2.3'"),
        ("scheme", "frame", "unknown scheme 'frame'"),
        ("split", "all", "unknown split 'all'"),
        ("split", "train", "no sequence that has scans in split 'train'"),
        ("taxonomy_digest", "0" * 64, "taxonomy: expected digest"),
    ],
)
def test_wrong_identity_is_a_problem(dataset, copy, name, value, message):
    with h5py.File(copy, "r+") as file:
        file.attrs[name] = np.bytes_(value)
    assert any(message in problem for problem in validate(copy, dataset))
    with pytest.raises(SubmissionError):
        score_predictions(copy, dataset)


def test_given_scheme_and_split_must_agree_with_the_file(dataset, predictions):
    found = validate(predictions, dataset, split="val")
    assert "split: expected 'val', the file says 'test'" in found


def first_labels(**changes):
    labels = np.zeros((len(TEST_SCANS), 12), np.uint8)
    for at, value in changes.get("at", {}).items():
        labels[at] = value
    return labels


MUTATIONS = {
    "label 10": ("labels", first_labels(at={(3, 5): 10}), f"{FIRST}/5: labels: beam 5 holds 10"),
    "label 255": ("labels", first_labels(at={(66, 0): 255}), f"{FIRST}/68: labels: beam 0"),
    "missing row": ("labels", first_labels()[1:], f"{FIRST}: labels: expected shape (68, 12)"),
    "beams": ("labels", first_labels()[:, 1:], "expected shape (68, 12), found (68, 11)"),
    "missing scan": ("scan_index", TEST_SCANS[1:], f"{FIRST}/2: scan missing (1 such"),
    "extra scan": ("scan_index", np.r_[TEST_SCANS, 0], f"{FIRST}/0: scan not in the split"),
    "scan beyond the end": ("scan_index", np.r_[TEST_SCANS, SCANS], f"{FIRST}/70: scan not in"),
    "negative scan": ("scan_index", np.r_[-1, TEST_SCANS], f"{FIRST}/-1: scan not in the split"),
    "duplicate": ("scan_index", np.r_[TEST_SCANS[1:], 3], f"{FIRST}/3: scan given more than once"),
    "sample 10": (
        "samples",
        np.stack((first_labels(), first_labels(at={(4, 1): 11}))),
        f"{FIRST}/6: samples: beam 1 holds 11",
    ),
    "too many samples": (
        "samples",
        np.zeros((1025, len(TEST_SCANS), 12), np.uint8),
        f"{FIRST}: samples: expected 1 to 1024, found 1025",
    ),
    "classes": (
        "probabilities",
        np.full((len(TEST_SCANS), 12, 9), 1 / 9, np.float16),
        "probabilities: expected shape (68, 12, 10), found (68, 12, 9)",
    ),
    "samples shape": ("samples", first_labels()[None, 1:], "samples: expected shape (any, 68, 12)"),
}


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_wrong_contents_are_named_with_sequence_and_scan(dataset, copy, mutation):
    part, array, message = MUTATIONS[mutation]
    replace(copy, f"predictions/{FIRST}/{part}", array)
    found = validate(copy, dataset)
    assert any(message in problem for problem in found), found
    with pytest.raises(SubmissionError) as caught:
        score_predictions(copy, dataset)
    assert caught.value.problems == tuple(found)


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.5, 1.5])
def test_probabilities_outside_zero_to_one_are_a_problem(dataset, copy, value):
    probabilities = np.full((len(TEST_SCANS), 12, 10), 0.1, np.float16)
    for entry in dataset.manifest.sequences:
        beams = dataset.reader(entry.id).lidar.beams
        replace(copy, f"predictions/{entry.id}/probabilities", probabilities[:, :beams])
    assert validate(copy, dataset) == []
    probabilities[9, 3, 2] = value
    replace(copy, f"predictions/{FIRST}/probabilities", probabilities)
    (problem,) = validate(copy, dataset)
    assert problem.startswith(f"{FIRST}/11: probabilities: beam 3 holds [")
    assert f" {value}" in problem


def test_probabilities_that_do_not_add_up_to_one_are_a_problem(dataset, copy):
    probabilities = np.full((len(TEST_SCANS), 9, 10), 0.2, np.float16)
    replace(copy, "predictions/hall--a--far/probabilities", probabilities)
    assert any("numbers from 0 to 1 that add up to 1" in line for line in validate(copy, dataset))


def test_optional_parts_are_given_for_all_sequences_or_for_none(dataset, copy):
    replace(copy, f"predictions/{FIRST}/samples", first_labels()[None])
    (problem,) = validate(copy, dataset)
    assert problem.startswith("hall--a--far: samples are missing; 1 of 3 sequences have them")
    replace(copy, "predictions/hall--b--near/samples", np.stack([first_labels()] * 2))
    replace(copy, "predictions/hall--a--far/samples", first_labels()[None, :, :9])
    assert validate(copy, dataset) == [
        "hall--b--near: samples: 2, but 1 in hall--a--far; draw the same number"
    ]


@pytest.mark.parametrize("array", [first_labels().astype(np.int64), first_labels()[None]])
def test_other_dtypes_and_ranks_are_refused_at_opening(dataset, copy, array):
    replace(copy, f"predictions/{FIRST}/labels", array)
    with pytest.raises(UnsafeFileError, match=f"{FIRST}/labels: expected"):
        score_predictions(copy, dataset)


def test_missing_and_extra_sequences_are_named(dataset, copy):
    with h5py.File(copy, "r+") as file:
        file.move("predictions/hall--b--near", "predictions/hall--c--near")
        del file["predictions/hall--a--far/labels"]
    found = validate(copy, dataset)
    assert [problem.split(":")[0] for problem in found] == [
        "hall--c--near",
        "hall--a--far",
        "hall--b--near",
    ]


def test_all_problems_are_listed_at_once(dataset, copy):
    replace(copy, f"predictions/{FIRST}/labels", first_labels(at={(0, 0): 10}))
    replace(copy, "predictions/hall--b--near/scan_index", TEST_SCANS[::-1] + 1)
    replace(copy, "metadata", np.frombuffer(b'{"method": 3}', np.uint8))
    with h5py.File(copy, "r+") as file:
        file.attrs["dataset"] = np.bytes_("other")
    found = validate(copy, dataset)
    assert len(found) == 5
    assert "metadata.method" in found[1]


def test_a_thousand_problems_are_listed_and_the_rest_counted(dataset, copy):
    with h5py.File(copy, "r+") as file:
        for n in range(1_100):
            file.create_group(f"predictions/{n}{'x' * 600}")
    found = validate(copy, dataset)
    assert len(found) == 1_001
    assert found[-1] == "and 100 more such problems"
    assert {len(problem) for problem in found[:-1]} == {504}


@pytest.mark.parametrize("text", [b"{", b"[]", b'"method"', b"\xff"])
def test_metadata_that_are_no_description_are_a_problem(dataset, copy, text):
    replace(copy, "metadata", np.frombuffer(text, np.uint8))
    (problem,) = validate(copy, dataset)
    assert "metadata" in problem


def test_missing_metadata_are_a_problem(dataset, copy):
    with h5py.File(copy, "r+") as file:
        del file["metadata"]
    (problem,) = validate(copy, dataset)
    assert "metadata" in problem


def test_a_file_without_predictions_is_a_problem(dataset, tmp_path):
    with writer_of(tmp_path / "p.h5"):
        pass
    assert validate(tmp_path / "p.h5", dataset) == [
        "the file predicts no sequence that has scans in split 'test' of scheme 'block'"
    ]


def test_files_of_another_kind_are_refused(dataset, tmp_path):
    (tmp_path / "empty.h5").touch()
    (tmp_path / "text.h5").write_text("no HDF5")
    sequence = dataset.root / dataset.manifest.sequences[0].file
    for path in (tmp_path / "empty.h5", tmp_path / "text.h5", sequence):
        with pytest.raises(Semantic2DError, match=path.name):
            score_predictions(path, dataset)
    with pytest.raises(FileNotFoundError):
        score_predictions(tmp_path / "none.h5", dataset)


def test_truncated_predictions_are_never_scored(dataset, copy):
    whole = copy.read_bytes()
    for size in np.linspace(1, len(whole) - 1, 25).astype(int):
        copy.write_bytes(whole[:size])
        with pytest.raises(CorruptFileError):
            score_predictions(copy, dataset)


def test_newer_formats_and_links_are_refused(dataset, copy):
    with h5py.File(copy, "r+") as file:
        file[f"predictions/{FIRST}/samples"] = h5py.ExternalLink("/etc/hostname", "x")
    with pytest.raises(UnsafeFileError):
        score_predictions(copy, dataset)
    with h5py.File(copy, "r+") as file:
        del file[f"predictions/{FIRST}/samples"]
        file.attrs["format_version"] = np.bytes_("2.0")
    with pytest.raises(FormatVersionError):
        score_predictions(copy, dataset)


def test_sequences_that_cannot_be_scored_are_named(tmp_path):
    (tmp_path / "sequences").mkdir()
    name = write_sequence(tmp_path, "a", NEAR, 0, labelled=False)
    dataset = make_dataset(tmp_path, [name])
    with writer_of(tmp_path / "p.h5") as writer:
        writer.add(name, TEST_SCANS, first_labels())
    with pytest.raises(InvalidInputError, match=f"{name}: has no labels to score against"):
        score_predictions(tmp_path / "p.h5", dataset)


def test_sequences_of_different_taxonomies_are_not_scored_together(tmp_path):
    (tmp_path / "sequences").mkdir()
    two = Taxonomy(("Other", "Wall"), ((0, 0, 0), (9, 9, 9)))
    names = [
        write_sequence(tmp_path, "a", NEAR, 0),
        write_sequence(tmp_path, "b", NEAR, 0, taxonomy=two),
    ]
    dataset = make_dataset(tmp_path, names)
    with writer_of(tmp_path / "p.h5") as writer:
        writer.add(names[0], TEST_SCANS, first_labels())
    (problem,) = validate(tmp_path / "p.h5", dataset)
    assert "2 taxonomies" in problem
