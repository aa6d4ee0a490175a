import json

import numpy as np
import pytest

from semantic2d_dataset import cli
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.executors import Processes
from semantic2d_dataset.scene.geometry import to_base, to_points, transform
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring import comparison
from semantic2d_dataset.scoring.comparison import (
    CELL_M,
    compare_predictions,
    format_comparison,
)
from semantic2d_dataset.scoring.submission import PredictionsWriter, score_predictions


@pytest.fixture(scope="module")
def data(dataset_folder):
    return open_dataset(dataset_folder)


def labels_of(data, name, seed, split="test"):
    indices = data.scheme("frame").scans_of(name, split)
    truth = data.reader(name).read("scans/labels")[indices]
    rng = np.random.default_rng(seed)
    guess = np.where(rng.random(truth.shape) < 0.1 * (1 + seed), 9, truth)
    return indices, np.where(guess == 255, 0, guess).astype(np.uint8)


def write(path, data, seed, method, split="test"):
    with PredictionsWriter(
        path,
        dataset=str(data.root),
        dataset_version="1.0.0",
        scheme="frame",
        split=split,
        taxonomy=SEMANTIC2D,
        metadata={"method": method},
    ) as writer:
        for entry in data.manifest.sequences:
            indices, labels = labels_of(data, entry.id, seed, split)
            order = np.random.default_rng(seed).permutation(len(indices))
            writer.add(entry.id, indices[order], labels[order])
    return path


@pytest.fixture(scope="module")
def pair(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    return write(folder / "a.h5", data, 3, "worse"), write(folder / "b.h5", data, 1, "better")


@pytest.fixture
def named(pair, data, tmp_path):
    """The pair, for a data set by its name, as the manifest has it."""
    import h5py

    files = []
    for path in pair:
        copy = tmp_path / path.name
        copy.write_bytes(path.read_bytes())
        with h5py.File(copy, "r+") as file:
            file.attrs["dataset"] = np.bytes_("generated")
        files.append(copy)
    return files


def test_outcomes_and_cells_are_those_of_the_points(named, data, monkeypatch):
    monkeypatch.setattr(comparison, "_BLOCK", 7)  # scans at a time
    found = compare_predictions(*named, data)
    outcomes = np.zeros(4, int)
    cells = {}
    for entry in data.manifest.sequences:
        batch = data.reader(entry.id).batch()
        indices, a = labels_of(data, entry.id, 3)
        _, b = labels_of(data, entry.id, 1)
        truth, valid = batch.labels[indices], batch.valid[indices]
        points = to_base(
            to_points(batch.ranges[indices], batch.lidar.bearings), batch.lidar.base_T_lidar
        )
        points = transform(batch.poses[indices], points)
        for n, k in np.argwhere(valid & (truth != 255)):
            outcome = 2 * (a[n, k] != truth[n, k]) + (b[n, k] != truth[n, k])
            outcomes[outcome] += 1
            cell = (entry.environment, *np.floor(points[n, k] / CELL_M).astype(int).tolist())
            cells.setdefault(cell, np.zeros(4, int))[outcome] += 1
    both, only_a, only_b, neither = outcomes.tolist()
    assert found.outcomes == {
        "both": both,
        "only_a": only_a,
        "only_b": only_b,
        "neither": neither,
    }
    telling = [place.outcomes[1] + place.outcomes[2] for place in found.places]
    assert telling == sorted(telling, reverse=True)
    assert (np.sum([place.outcomes for place in found.places], axis=0) == outcomes).all()
    for place in found.places:
        for cell, counts in zip(place.cells.tolist(), place.counts, strict=True):
            assert (cells.pop((place.environment, *cell)) == counts).all()
    assert not cells


def test_scores_are_those_of_the_two_results(named, data):
    found = compare_predictions(*named, data)
    a, b = (score_predictions(path, data) for path in named)
    for name in ("mIoU", "mCA"):
        row = found.scores[name]
        assert row["a"] == pytest.approx(a[name], abs=1e-12)
        assert row["difference"] == pytest.approx(b[name] - a[name], abs=1e-12)
    assert set(found.conditions) == {*a["conditions"]} - {"environment"}
    for name, bands in found.conditions.items():
        assert bands
        for band, row in bands.items():
            one, other = (result["conditions"][name][band] for result in (a, b))
            figure = "mCA" if name == "motion" else "mIoU"
            assert (row["a"], row["b"], row["points"]) == (
                one[figure],
                other[figure],
                one["points"],
            )
            assert row["difference"] == row["b"] - row["a"]
    assert found.scores["mIoU"]["difference"] > 0
    with Processes(2) as executor:
        again = compare_predictions(*named, data, executor=executor)
    assert json.dumps(again.as_dict()) == json.dumps(found.as_dict())
    text = format_comparison(found)
    assert text.startswith("A: worse\nB: better\non generated 1.0.0, split test of frame, small\n")


def test_methods_of_one_name_are_told_apart_by_their_files(named, data, tmp_path):
    (tmp_path / "other").mkdir()
    same = tmp_path / "other" / named[0].name
    same.write_bytes(named[0].read_bytes())
    copy = same.with_name("again.h5")
    copy.write_bytes(named[0].read_bytes())
    assert compare_predictions(named[0], copy, data).names == ("worse (a.h5)", "worse (again.h5)")
    assert compare_predictions(named[0], same, data).names == (
        f"worse ({named[0]})",
        f"worse ({same})",
    )


def test_a_submission_is_as_good_as_itself_and_signs_turn_with_the_order(named, data):
    one, other = (compare_predictions(*pair, data) for pair in (named, named[::-1]))
    alone = compare_predictions(named[0], named[0], data)
    for name in ("mIoU", "mCA"):
        a, b, same = (found.scores[name] for found in (one, other, alone))
        assert (a["a"], a["b"], a["difference"]) == (b["b"], b["a"], -b["difference"])
        assert a["interval"] == pytest.approx([-limit for limit in b["interval"][::-1]])
        assert a["p"] == b["p"]
        assert (same["difference"], same["interval"], same["p"]) == (0, [0, 0], 1)
    assert one.outcomes["only_a"] == other.outcomes["only_b"]
    assert alone.outcomes["only_a"] == alone.outcomes["only_b"] == 0


def test_a_picture_never_takes_the_place_of_what_is_compared(named, data, monkeypatch, capsys):
    picture = named[0].rename(named[0].with_name("a.png"))
    before = picture.read_bytes()
    cases = {picture: "is an input itself", named[0].with_name("no") / "x.png": "does not exist"}
    for out, message in cases.items():
        words = [
            "compare",
            str(picture),
            str(named[1]),
            "--data",
            str(data.root),
            "--out",
            str(out),
        ]
        monkeypatch.setattr("sys.argv", ["semantic2d", *words])
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert (end.value.code, message in capsys.readouterr().err) == (1, True)
    assert picture.read_bytes() == before


def test_submissions_for_different_scans_are_not_compared(named, data, tmp_path):
    other = write(tmp_path / "val.h5", data, 2, "other", split="val")
    with pytest.raises(InvalidInputError, match=r"val\.h5: split val, but test in"):
        compare_predictions(named[0], other, data)


def test_the_command_prints_and_draws(named, data, tmp_path, monkeypatch, capsys):
    picture = tmp_path / "differences.png"
    words = ["compare", *map(str, named), "--data", str(data.root), "--out", str(picture)]
    monkeypatch.setattr("sys.argv", ["semantic2d", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code in (0, None)
    assert "B: better" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")
