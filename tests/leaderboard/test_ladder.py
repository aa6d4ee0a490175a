import hashlib
import json
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from leaderboard.hiding import hide_labels
from leaderboard.ladder import bests_of, climb, read_ledger, score_privately
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, SubmissionError
from semantic2d_dataset.scoring.submission import score_predictions


@pytest.fixture
def ask(dataset_folder, predictions_folder, tmp_path):
    data = open_dataset(dataset_folder)

    def ask_for(name, submitter="ann", **options):
        path = predictions_folder / f"{name}.h5"
        return score_privately(path, data, tmp_path / "ledger.json", submitter, **options)

    return ask_for


def test_a_score_is_told_rounded_and_only_where_it_is_better(ask):
    fair, poor, good = ask("fair"), ask("poor"), ask("good")
    assert [line["better"] for line in (fair, poor, good)] == [True, False, True]
    assert (poor["mIoU"], poor["mCA"]) == (fair["mIoU"], fair["mCA"])
    assert good["mIoU"] > fair["mIoU"]
    for line in (fair, good):
        assert line["mIoU"] == pytest.approx(round(line["mIoU"], 2), abs=1e-12)


def test_only_what_was_told_is_kept(ask, tmp_path, dataset_folder, predictions_folder):
    ask("fair")
    ask("poor")
    raw = score_predictions(predictions_folder / "poor.h5", open_dataset(dataset_folder))
    text = (tmp_path / "ledger.json").read_text()
    assert str(raw["mIoU"])[:6] not in text
    assert "Chair" not in text


def test_every_submitter_climbs_alone(ask, tmp_path):
    ask("good", "ann")
    assert ask("poor", "bob")["better"]
    bests = bests_of(read_ledger(tmp_path / "ledger.json"))
    assert [line["submitter"] for line in bests] == ["ann", "bob"]


@pytest.mark.parametrize("other", ["Ann Lee", " ann  lee ", "\uff41nn lee"])
def test_a_submitter_is_the_same_however_the_name_is_typed(ask, tmp_path, other):
    ask("good", "ann lee", per_day=1)
    with pytest.raises(InvalidInputError, match="1 of 1 submissions today"):
        ask("fair", other, per_day=1)
    assert not ask("fair", other)["better"]
    assert len(bests_of(read_ledger(tmp_path / "ledger.json"))) == 1


def test_submissions_of_a_day_are_limited(ask):
    ask("poor", per_day=2)
    ask("fair", per_day=2)
    with pytest.raises(InvalidInputError, match="2 of 2 submissions today"):
        ask("good", per_day=2)
    assert ask("good", "bob", per_day=2)["number"] == 3


def test_a_ledger_keeps_its_step(ask):
    ask("poor")
    with pytest.raises(InvalidInputError, match="keep the step"):
        ask("fair", step=0.0001)


@pytest.mark.parametrize(
    "options",
    [*({"step": step} for step in (0, -1, 1.5, 1e-320, float("nan"))), {"submitter": " "}],
)
def test_wrong_questions_are_refused(ask, options):
    with pytest.raises(InvalidInputError):
        ask("poor", **options)


def test_predictions_that_cannot_be_scored_are_not_counted(ask, tmp_path, predictions_folder):
    ask("poor")
    before = (tmp_path / "ledger.json").read_bytes()
    with pytest.raises((SubmissionError, FileNotFoundError, CorruptFileError)):
        ask("none")
    assert (tmp_path / "ledger.json").read_bytes() == before


def test_labels_that_hide_everything_tell_nothing_and_cost_nothing(
    dataset_folder, predictions_folder, tmp_path
):
    hide_labels(open_dataset(dataset_folder), tmp_path / "public", tmp_path / "private")
    public, ledger = open_dataset(tmp_path / "public"), tmp_path / "ledger.json"
    with pytest.raises(InvalidInputError, match="has no label of what was predicted"):
        score_privately(predictions_folder / "good.h5", public, ledger, "ann")
    assert not ledger.exists()


def test_any_change_to_any_line_is_found(ask, tmp_path):
    for name in ("poor", "fair", "good"):
        ask(name)
    path = tmp_path / "ledger.json"
    lines = path.read_text().splitlines()
    for number, text in enumerate(lines):
        for key, value in json.loads(text).items():
            other = value + 1 if isinstance(value, int | float) else f"{value}x"
            changed = [*lines]
            changed[number] = json.dumps(json.loads(text) | {key: other})
            path.write_text("\n".join(changed) + "\n")
            with pytest.raises(CorruptFileError, match="was changed"):
                read_ledger(path)
    for order in ([1, 2], [0, 2], [1, 0, 2], [0, 1, 1, 2]):
        path.write_text("\n".join(lines[n] for n in order) + "\n")
        with pytest.raises(CorruptFileError):
            read_ledger(path)


def test_a_figure_that_only_people_would_read_is_found(ask, tmp_path):
    ask("good")
    path = tmp_path / "ledger.json"
    path.write_text(path.read_text().replace('"mIoU"', '"mIoU": 1.0, "mIoU"'))
    with pytest.raises(CorruptFileError):
        read_ledger(path)


@pytest.mark.parametrize(
    ("name", "value"), [("at", 1), ("task", []), ("submitter", None), ("mIoU", "1"), ("better", 1)]
)
def test_a_forged_line_of_other_types_is_refused(ask, tmp_path, name, value):
    line = ask("good") | {name: value}
    said = {key: each for key, each in line.items() if key != "digest"}
    digest = hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()
    (tmp_path / "ledger.json").write_text(json.dumps(line | {"digest": digest}) + "\n")
    with pytest.raises(CorruptFileError, match="no line of a ledger"):
        read_ledger(tmp_path / "ledger.json")


def test_a_ledger_that_is_no_file_is_refused_at_once(ask, tmp_path):
    os.mkfifo(tmp_path / "ledger.json")
    with pytest.raises(CorruptFileError, match="found no file"):
        ask("good")


def test_a_published_digest_tells_of_lines_that_were_cut_off(ask, tmp_path):
    ask("poor")
    head = ask("fair")["digest"]
    path = tmp_path / "ledger.json"
    assert len(read_ledger(path, head=head)) == 2
    path.write_text(path.read_text().splitlines()[0] + "\n")
    assert len(read_ledger(path)) == 1
    with pytest.raises(CorruptFileError, match="cut off"):
        read_ledger(path, head=head)


def test_a_damaged_ledger_is_never_written_on(ask, tmp_path):
    ask("poor")
    (tmp_path / "ledger.json").write_text("[]\n")
    with pytest.raises(CorruptFileError):
        ask("fair")
    assert (tmp_path / "ledger.json").read_text() == "[]\n"


def test_two_at_once_lose_no_line(ask, tmp_path):
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda n: ask("fair", f"s{n}"), range(8)))
    lines = read_ledger(tmp_path / "ledger.json")
    assert sorted(line["submitter"] for line in lines) == [f"s{n}" for n in range(8)]


@given(st.floats(0, 1), st.floats(0.0001, 0.99))
def test_what_is_told_is_a_fraction_whatever_the_step(score, step):
    assert 0 <= climb(None, score, step) <= 1


@given(st.lists(st.floats(0, 1), max_size=50), st.sampled_from([0.001, 0.01, 0.05]))
def test_what_is_told_only_ever_rises(scores, step):
    best, told = None, []
    for score in scores:
        new = climb(best, score, step)
        if new is not None:
            assert abs(new - score) <= step / 2 + 1e-9
            best = new
        told.append(best)
    assert told == sorted(told)
    assert len(set(told)) <= 1 / step + 2


def attack(tell, labels, questions, rng):
    """Keep guesses that are told to be better than chance, and let them vote."""
    guesses = rng.integers(0, 2, (questions, labels.size))
    told = [tell(float((guess == labels).mean())) for guess in guesses]
    better = np.array([score > 0.5 for score in told])
    votes = guesses[better].mean(axis=0) if better.any() else np.full(labels.size, 0.5)
    return float(((votes > 0.5) == labels).mean())


def test_asking_often_teaches_little_where_the_ladder_stands():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 2, 4000)
    best = None

    def tell_by_ladder(score):
        nonlocal best
        told = climb(best, score, 0.01)
        best = best if told is None else told
        return 0.0 if told is None else told  # not better than before: the guess is dropped

    raw = attack(lambda score: score, labels, 1000, rng)
    laddered = attack(tell_by_ladder, labels, 1000, rng)
    assert raw > 0.6
    assert laddered < 0.53
