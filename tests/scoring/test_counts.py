"""Parts of a score that several machines share."""

import copy
import json
import shutil
import subprocess
import sys
from itertools import permutations

import h5py
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import (
    CorruptFileError,
    FormatVersionError,
    InvalidInputError,
    Semantic2DError,
    SubmissionError,
)
from semantic2d_dataset.scoring.counts import read_counts, write_counts
from semantic2d_dataset.scoring.submission import (
    count_predictions,
    result_to_json,
    score_counts,
    score_predictions,
)
from tests.clusters import cluster
from tests.conftest import PROJECT
from tests.generators import make_dataset
from tests.scoring.guesses import write_guesses

WORKERS = 4


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shared") / "data"
    make_dataset(folder, environments=("attic", "cellar", "hall", "shed", "tower"), scans=60)
    return open_dataset(folder)


@pytest.fixture(scope="module")
def predictions(data, tmp_path_factory):
    return write_guesses(tmp_path_factory.mktemp("shared") / "p.h5", data)


@pytest.fixture(scope="module")
def parts(data, predictions, tmp_path_factory):
    """Files of counts of four workers."""
    folder = tmp_path_factory.mktemp("parts")
    paths = [folder / f"{k}.json" for k in range(1, WORKERS + 1)]
    for k, path in enumerate(paths, start=1):
        write_counts(count_predictions(predictions, data, part=(k, WORKERS)), path)
    return paths


@pytest.fixture(scope="module")
def said(parts):
    """What the first file says; has samples and probabilities."""
    return json.loads(parts[0].read_text())


def test_parts_of_four_workers_merge_to_the_bytes_of_one_in_any_order(data, predictions, parts):
    alone = result_to_json(score_predictions(predictions, data))
    assert '"calibration"' in alone
    assert '"samples"' in alone
    read = [read_counts(path) for path in parts]
    for order in permutations(read):
        assert result_to_json(score_counts(order)) == alone


def test_parts_hold_every_sequence_once(data, parts):
    names = [tally.sequence_id for path in parts for tally in read_counts(path).tallies]
    assert sorted(names) == sorted(entry.id for entry in data.manifest.sequences)


def run(*words, folder=PROJECT):
    command = [sys.executable, "-m", "semantic2d_dataset.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)


def start(*words):
    return subprocess.Popen([sys.executable, "-m", "semantic2d_dataset.cli", *map(str, words)])


@pytest.mark.long
def test_four_processes_and_a_cluster_write_the_same_bytes(data, predictions, tmp_path):
    pytest.importorskip("distributed")
    where = ("--data", data.root)
    files = [tmp_path / f"{k}.json" for k in range(1, WORKERS + 1)]
    working = [
        start("score-part", predictions, f"{k}/{WORKERS}", path, *where)
        for k, path in enumerate(files, start=1)
    ]
    assert [process.wait() for process in working] == [0] * WORKERS
    assert run("score-merge", *files, "--out", tmp_path / "merged.json").returncode == 0
    assert run("score", predictions, *where, "--out", tmp_path / "alone.json").returncode == 0
    with cluster(tmp_path) as (address, _):
        words = (
            "--data",
            data.root.name,
            "--scheduler",
            address,
            "--out",
            tmp_path / "cluster.json",
        )
        relative = f"../{predictions.parent.name}/{predictions.name}"
        assert run("score", relative, *words, folder=data.root.parent).returncode == 0
    alone = (tmp_path / "alone.json").read_bytes()
    assert (tmp_path / "merged.json").read_bytes() == alone
    assert (tmp_path / "cluster.json").read_bytes() == alone


def test_a_part_that_is_missing_is_named_by_its_sequences(parts):
    read = [read_counts(path) for path in parts]
    with pytest.raises(InvalidInputError, match="1 of 5 sequences were counted in no part: shed"):
        score_counts(read[:3])
    with pytest.raises(InvalidInputError, match="counted twice"):
        score_counts([*read, read[1]])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"method": "other"}, "digests.predictions is .* and .* in another"),
        ({"version": "1.1.0"}, "dataset_version is '1.0.0' in one and '1.1.0' in another"),
    ],
)
def test_parts_of_two_submissions_never_merge(data, parts, tmp_path, change, named):
    if "method" in change:
        path = write_guesses(tmp_path / "q.h5", data, **change)
        other = count_predictions(path, data, part=(2, WORKERS))
    else:
        changed = json.loads(parts[1].read_text())
        changed["submission"]["dataset_version"] = change["version"]
        (tmp_path / "part.json").write_text(json.dumps(changed))
        other = read_counts(tmp_path / "part.json")
    with pytest.raises(InvalidInputError, match=named):
        score_counts([read_counts(parts[0]), other])


def test_parts_with_and_without_samples_never_merge(parts, tmp_path):
    changed = json.loads(parts[1].read_text())
    for counted in changed["counted"]:
        counted["samples"] = []
    (tmp_path / "part.json").write_text(json.dumps(changed))
    read = [read_counts(path) for path in (parts[0], tmp_path / "part.json", *parts[2:])]
    with pytest.raises(InvalidInputError, match="samples or probabilities"):
        score_counts(read)


@pytest.mark.parametrize(
    ("part", "message"),
    [((0, 4), "expected 1/4 to 4/4"), ((5, 4), "expected 1/4"), ((1, 6), "5 sequences to share")],
)
def test_a_part_that_cannot_be_is_refused(data, predictions, part, message):
    with pytest.raises(InvalidInputError, match=message):
        count_predictions(predictions, data, part=part)


def test_a_wrong_label_stops_the_part_that_counts_it_alone(data, predictions, tmp_path):
    path = tmp_path / "p.h5"
    shutil.copy(predictions, path)
    wrong = sorted(entry.id for entry in data.manifest.sequences)[2]
    with h5py.File(path, "r+") as file:
        file[f"predictions/{wrong}/labels"][0, 0] = 77
    assert count_predictions(path, data, part=(2, WORKERS)).tallies
    with pytest.raises(SubmissionError, match=f"{wrong}/.*beam 0 holds 77"):
        count_predictions(path, data, part=(3, WORKERS))


WRONG = {
    "confusion": lambda counted: counted["confusion"][1].__setitem__(1, 10**6),
    "windows": lambda counted: counted["windows"].pop(),
    "conditions.border": lambda counted: (
        counted["conditions"]["border"].reverse()
        or (counted["conditions"]["border"][0][0].__setitem__(0, 10**6))
    ),
    "conditions": lambda counted: counted["conditions"].pop("people"),
    "samples": lambda counted: counted["samples"][0][1][0].__setitem__(0, 10**6),
    "calibration": lambda counted: counted["calibration"]["by_entropy"][5].__setitem__(0, 10**6),
    "whole numbers": lambda counted: counted["confusion"][0].__setitem__(0, 1.5),
    "from 0": lambda counted: counted["confusion"][0].__setitem__(0, -1),
    "lengths": lambda counted: counted["confusion"][0].pop(),
    "bool": lambda counted: counted.__setitem__("confusion", [[True] * 10] * 10),
    "object": lambda counted: counted["confusion"][0].__setitem__(0, 2**70),
    "not one of the sequences": lambda counted: counted.__setitem__("sequence_id", "elsewhere"),
}


@pytest.mark.parametrize("named", WRONG)
def test_counts_that_contradict_each_other_are_refused(said, tmp_path, named):
    changed = copy.deepcopy(said)
    WRONG[named](changed["counted"][0])
    path = tmp_path / "part.json"
    path.write_text(json.dumps(changed))
    with pytest.raises(CorruptFileError, match=f"{path}: .*{named}"):
        read_counts(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not JSON"),
        ("[]", "expected counts, which semantic2d score-part writes"),
        ('{"mIoU": 1.0}', "expected counts"),
        ('{"format": "semantic2d-counts", "format_version": "1.0"}', "4 problems"),
        ('{"format": "semantic2d-counts", "format_version": "x"}', "expected a format version"),
    ],
)
def test_what_is_no_file_of_counts_is_refused(tmp_path, content, message):
    (tmp_path / "part.json").write_text(content)
    with pytest.raises(CorruptFileError, match=message):
        read_counts(tmp_path / "part.json")


def test_counts_of_a_newer_format_say_what_to_install(said, tmp_path):
    (tmp_path / "part.json").write_text(json.dumps(said | {"format_version": "2.0"}))
    with pytest.raises(FormatVersionError, match="install"):
        read_counts(tmp_path / "part.json")


def leaves_of(value, path=()):
    """Yield the path of everything in a document."""
    if path:
        yield path
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from leaves_of(inner, (*path, key))


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_any_mutation_is_read_or_refused_with_our_own_error(said, tmp_path_factory, data):
    changed = copy.deepcopy(said)
    changed["counted"] = changed["counted"][:1]
    *way, last = data.draw(st.sampled_from(list(leaves_of(changed))))
    inner = changed
    for key in way:
        inner = inner[key]
    inner[last] = data.draw(
        st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.just([]))
    )
    path = tmp_path_factory.getbasetemp() / "mutated.json"
    path.write_text(json.dumps(changed))
    message = f"{path}: "
    try:
        read_counts(path)
    except Semantic2DError as err:
        message = str(err)
    assert message.startswith(f"{path}: ")
