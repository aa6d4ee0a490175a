import json

import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.robustness import format_robustness, summarise_robustness


@pytest.fixture
def write(tmp_path):
    def write_result(dataset, score, **changes):
        said = {
            "dataset": dataset,
            "dataset_version": "1.0.0",
            "scheme": "block",
            "split": "test",
            "lidars": ["near"],
            "evaluator_version": "1.0",
            "metadata": {"method": "guess"},
        }
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.json"
        path.write_text(json.dumps({"mIoU": score, "submission": said | changes}))
        return path

    return write_result


def test_kinds_count_alike_however_many_severities_they_have(write):
    clean = write("toy", 0.8)
    sets = {"rain-1": 0.6, "rain-5": 0.2, "range-noise-2-seed7": 0.6}
    said = summarise_robustness(clean, [write(f"toy-1.0.0-{k}", v) for k, v in sets.items()])
    assert said["kinds"]["rain"]["severity"] == {1: 0.6, 5: 0.2}
    assert said["kinds"]["rain"]["mean"] == pytest.approx(0.4)
    assert said["kinds"]["rain"]["retained"] == pytest.approx(0.5)
    assert said["kinds"]["rain"]["relative_error"] == pytest.approx(3.0)
    assert said["mean"] == pytest.approx(0.5)
    lines = format_robustness(said).splitlines()
    assert lines[0] == "guess: mIoU 80.00 without corruption, by severity:"
    assert lines[2].split() == ["rain", "60.00", "-", "20.00", "40.00", "50.00", "3.00"]
    assert lines[-1].split() == ["mean", "50.00", "62.50", "2.50"]


def test_what_does_not_belong_together_is_refused(write):
    model = {"method": "guess", "features": "RIA", "seeds": [0]}
    clean, rain = write("toy", 0.8, metadata=model), write("toy-1.0.0-rain-1", 0.6)
    cases = {
        "no corrupted set of toy-1.0.0": [write("toy", 0.8)],
        "is no corrupted set": [write("toys-1.0.0-rain-1", 0.5)],
        "given already": [rain, rain],
        "method is 'x'": [write("toy-1.0.0-rain-1", 0.6, metadata={"method": "x"})],
        "seeds is \\[1\\], but \\[0\\]": [
            write("toy-1.0.0-rain-1", 0.6, metadata={"method": "guess", "seeds": [1]})
        ],
        "features is 'R', but 'RIA'": [
            write("toy-1.0.0-rain-1", 0.6, metadata={"method": "guess", "track": {"features": "R"}})
        ],
        "split is 'val'": [write("toy-1.0.0-rain-1", 0.6, split="val")],
        "that has an mIoU": [write("toy-1.0.0-rain-1", None)],
        "at least one": [],
    }
    for message, results in cases.items():
        with pytest.raises(InvalidInputError, match=message):
            summarise_robustness(clean, results)


def test_the_clean_result_comes_first(write):
    clean, rain = write("toy", 0.8), write("toy-1.0.0-rain-1", 0.6)
    with pytest.raises(InvalidInputError, match="give the result on the clean set first"):
        summarise_robustness(rain, [clean])


def test_results_of_several_seeds_are_no_result_of_one_model(write, tmp_path):
    (tmp_path / "seeds.json").write_text(json.dumps({"spread": {}, "results": []}))
    with pytest.raises(InvalidInputError, match="holds several seeds; score each alone"):
        summarise_robustness(tmp_path / "seeds.json", [])


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"mIoU": 1, "submission": []}', "[" * 10**5])
def test_files_that_are_no_results_are_refused(write, tmp_path, text):
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(InvalidInputError, match=r"bad\.json"):
        summarise_robustness(tmp_path / "bad.json", [])
