import copy
import itertools
import json

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from leaderboard.adding import make_entry, make_entry_of_seeds
from leaderboard.at_hand import AtHand
from leaderboard.checking import UNVERIFIED, WRONG, check_entries, check_entry
from leaderboard.entries import SANITY, read_entry, schema_problems, seal, taxonomy_of, to_json
from leaderboard.figures import find_inconsistencies
from leaderboard.seeds import find_slips_of_seeds, names_of_runs, summarise
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.submission import score_predictions
from tests.leaderboard.boards import (
    add_seeds,
    assert_every_edit_is_named,
    edited,
    json_path,
    leaves_of,
    write_predictions,
)

LIDAR = "small"


def slips_of(said):
    """Return the fields that contradict the counts of an entry, whatever its seals say."""
    taxonomy = taxonomy_of(said)
    found = (*find_inconsistencies(said, taxonomy), *find_slips_of_seeds(said, taxonomy))
    return [field for field, _ in found]


def one_of(board):
    (path,) = board.iterdir()
    return path, json.loads(path.read_text())


def test_an_entry_of_seeds_holds_the_scores_of_each_and_their_spread(
    entry_of_seeds, seeds_folder, dataset_folder
):
    data = open_dataset(dataset_folder)
    results = [score_predictions(path, data) for path in sorted(seeds_folder.iterdir())]
    runs, spread = entry_of_seeds["seeds"]["runs"], entry_of_seeds["seeds"]["spread"]
    assert [run["seeds"] for run in runs] == [[0], [1], [2]]
    for run, result in zip(runs, results, strict=True):
        own, of = run["per_lidar"][LIDAR], dict(result["per_lidar"][LIDAR])
        del of["intervals"]
        assert own == of
    means = [result["mIoU"] for result in results]
    assert spread["mIoU"] == {"mean": np.mean(means), "std": np.std(means)}
    assert spread["per_lidar"][LIDAR]["mIoU"] == spread["mIoU"]
    assert spread["count"] == 3


def test_the_seed_with_the_median_miou_is_shown(entry_of_seeds, seeds_folder, dataset_folder):
    shown = make_entry(seeds_folder / "seed0.h5", open_dataset(dataset_folder))  # 0.5, 0.6, 0.7
    for part in ("result", "metadata", "digests", "track"):
        assert entry_of_seeds[part] == shown[part]


def test_of_two_seeds_the_lower_one_is_shown(seeds_folder, dataset_folder):
    data = open_dataset(dataset_folder)
    paths = [seeds_folder / "seed1.h5", seeds_folder / "seed0.h5"]
    said = make_entry_of_seeds(paths, data)
    assert said["metadata"]["seeds"] == [0]
    assert said["seeds"]["spread"]["mIoU"]["mean"] > said["result"]["mIoU"]


def test_the_order_of_the_files_changes_nothing(seeds_folder, dataset_folder):
    data = open_dataset(dataset_folder)
    paths = sorted(seeds_folder.iterdir())
    pairs = [(score_predictions(path, data), f"https://host/{path.name}") for path in paths]
    orders = [zip(*order, strict=True) for order in itertools.permutations(pairs)]
    texts = {json.dumps(summarise(results, urls)) for results, urls in orders}
    (text,) = texts
    runs = json.loads(text)[1]["runs"]
    assert [run["url"] for run in runs] == [f"https://host/seed{n}.h5" for n in range(3)]


def test_seeds_that_say_no_seeds_are_in_the_order_of_their_digests(tmp_path, dataset_folder):
    paths = [write_predictions(tmp_path / f"{n}.h5", dataset_folder, seed=n) for n in range(3)]
    said = make_entry_of_seeds(paths, open_dataset(dataset_folder))
    digests = [run["predictions"] for run in said["seeds"]["runs"]]
    assert digests == sorted(digests)
    assert slips_of(said) == []
    assert names_of_runs(said["seeds"]["runs"]) == ("training 1", "training 2", "training 3")


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"method": "Other"}, "semantic2d compare"),
        ({"features": "RIA"}, "metadata.features is None in one file and 'RIA' in another"),
        ({"authors": ["A. Nother"]}, "metadata.authors"),
        ({"parameters": 7}, "metadata.parameters"),
        ({"track": {"other_data": "the test split"}}, "metadata.track"),
    ],
)
def test_only_seeds_of_one_method_are_one_entry(
    tmp_path, seeds_folder, dataset_folder, metadata, message
):
    other = write_predictions(tmp_path / "p.h5", dataset_folder, **({"method": "Net"} | metadata))
    with pytest.raises(InvalidInputError, match=message):
        make_entry_of_seeds([seeds_folder / "seed0.h5", other], open_dataset(dataset_folder))


def test_seeds_may_differ_in_how_fast_they_were(tmp_path, seeds_folder, dataset_folder):
    measured = {"hardware": "a card", "scans_per_second": 12.5, "scans_per_second_measured": "so"}
    other = write_predictions(tmp_path / "p.h5", dataset_folder, method="Net", seed=9, **measured)
    paths = [seeds_folder / "seed0.h5", other]
    assert slips_of(make_entry_of_seeds(paths, open_dataset(dataset_folder))) == []


def test_a_training_is_given_once(tmp_path, seeds_folder, dataset_folder):
    data = open_dataset(dataset_folder)
    first = seeds_folder / "seed0.h5"
    with pytest.raises(InvalidInputError, match="two of the files are the same"):
        make_entry_of_seeds([first, first], data)
    again = {
        "method": "Net",
        "right": 0.6,
        "seed": 0,
        "seeds": [7],
    }  # the same labels, another digest
    again = write_predictions(tmp_path / "p.h5", dataset_folder, **again)
    with pytest.raises(InvalidInputError, match="give each training once"):
        make_entry_of_seeds([first, seeds_folder / "seed1.h5", again], data)


def test_an_entry_of_seeds_is_unverified_without_its_predictions(board_of_seeds, dataset_folder):
    (found,) = check_entries(board_of_seeds, AtHand([str(dataset_folder)]))
    assert (found.status, found.problems) == (UNVERIFIED, ())
    assert found.reason == "0 of 3 predictions are at hand"


@pytest.mark.parametrize("every", [11, pytest.param(1, marks=pytest.mark.long)])
def test_any_edit_of_any_value_of_seeds_fails_and_is_named(board_of_seeds, every):
    path, said = one_of(board_of_seeds)
    leaves = [leaf for leaf in leaves_of(said) if leaf[0] == "seeds" or "seeds" in str(leaf[-1])]
    assert len(leaves) > 500
    assert_every_edit_is_named(path, said, leaves[::every])


def test_an_edit_of_seeds_that_is_sealed_again_fails_by_their_own_counts(entry_of_seeds):
    leaves = [
        leaf
        for leaf in leaves_of(entry_of_seeds["seeds"])
        if not {*leaf[2:3]} & {"predictions", "seeds", "url"}  # only the files tell of those
    ]
    assert len(leaves) > 500
    for leaf in leaves:
        fields = slips_of(edited(entry_of_seeds, ("seeds", *leaf)))
        where = f"seeds.{json_path(leaf)}"
        assert any(where.startswith(field) for field in fields), (where, fields)


def test_an_edit_of_the_result_that_is_sealed_again_contradicts_its_seed(entry_of_seeds):
    result = entry_of_seeds["result"]["per_lidar"][LIDAR]
    for leaf in (leaf for leaf in leaves_of(result) if leaf[0] != "intervals"):
        changed = edited(entry_of_seeds, ("result", "per_lidar", LIDAR, *leaf))
        field = f"seeds.runs[0].per_lidar.{LIDAR}.{json_path(leaf)}"
        assert field in slips_of(changed), leaf


def test_no_values_of_another_kind_go_unseen_or_break_the_check(board_of_seeds, entry_of_seeds):
    path = next(board_of_seeds.iterdir())
    leaves = [leaf for leaf in leaves_of(entry_of_seeds) if leaf[0] not in ("result", "seals")]
    value = st.one_of(st.none(), st.integers(-9, 1 << 50), st.floats(0, 1), st.text(max_size=70))
    edits = st.lists(st.tuples(st.sampled_from(leaves), value), min_size=1, max_size=4)

    @settings(max_examples=50, deadline=None)
    @given(edits)
    def check(chosen):
        said = copy.deepcopy(entry_of_seeds)
        for leaf, new in chosen:
            owner = said
            for key in leaf[:-1]:
                owner = owner[key]
            owner[leaf[-1]] = new
        assume(said != entry_of_seeds)
        path.write_text(json.dumps(said))
        assert check_entry(path, AtHand()).status == WRONG

    check()


def test_another_seed_than_the_median_one_is_not_shown(
    entry_of_seeds, seeds_folder, dataset_folder
):
    best = make_entry(seeds_folder / "seed1.h5", open_dataset(dataset_folder))
    said = seal(best | {"seeds": entry_of_seeds["seeds"]})
    assert slips_of(said) == ["digests.predictions"]


def test_seeds_in_another_order_are_refused(entry_of_seeds):
    said = copy.deepcopy(entry_of_seeds)
    said["seeds"]["runs"].reverse()
    assert "seeds.runs" in slips_of(said)


def test_a_seed_is_listed_once(entry_of_seeds):
    said = copy.deepcopy(entry_of_seeds)
    runs = said["seeds"]["runs"]
    runs[1]["predictions"] = runs[2]["predictions"]
    fields = slips_of(said)
    assert {"seeds.runs[1].predictions", "seeds.runs[2].predictions"} <= {*fields}
    said = copy.deepcopy(entry_of_seeds)
    said["seeds"]["runs"][2]["per_lidar"] = said["seeds"]["runs"][1]["per_lidar"]
    assert "seeds.runs[2].per_lidar" in slips_of(said)


def test_counts_of_another_shape_or_lidar_are_named(entry_of_seeds):
    said = copy.deepcopy(entry_of_seeds)
    said["seeds"]["runs"][1]["per_lidar"][LIDAR]["confusion"].pop()
    assert f"seeds.runs[1].per_lidar.{LIDAR}.confusion" in slips_of(said)
    said = copy.deepcopy(entry_of_seeds)
    said["seeds"]["runs"][1]["per_lidar"]["other"] = said["seeds"]["runs"][1]["per_lidar"][LIDAR]
    assert "seeds.runs[1].per_lidar" in slips_of(said)


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": SANITY},
        {"predictions_url": "https://host/p.h5"},
        {"seeds": {"runs": [], "spread": {}}},
        {"seeds": []},
        {"seeds": None},
    ],
)
def test_seeds_belong_to_scored_entries_and_hold_two_or_more(entry_of_seeds, changes):
    assert schema_problems(entry_of_seeds) == []
    assert schema_problems(entry_of_seeds | changes)


def test_seeds_of_several_lidars_are_counted_for_each(tmp_path):
    from dataclasses import replace

    from tests.generators import SMALL_LIDAR, make_dataset

    make_dataset(
        tmp_path / "data",
        lidars=(SMALL_LIDAR, replace(SMALL_LIDAR, name="tiny", beams=11)),
        scans=60,
    )
    paths = [
        write_predictions(tmp_path / f"{n}.h5", tmp_path / "data", right=n / 4, seed=n)
        for n in (1, 3)
    ]
    (tmp_path / "entries").mkdir()
    path = add_seeds(paths, tmp_path / "data", tmp_path / "entries")
    assert check_entry(path, AtHand([str(tmp_path / "data")])).status == UNVERIFIED
    spread = read_entry(path).said["seeds"]["spread"]
    assert sorted(spread["per_lidar"]) == ["small", "tiny"]
    assert spread["per_lidar"]["tiny"]["mIoU"] != spread["mIoU"]
    said = json.loads(path.read_text())
    said["seeds"]["runs"][0]["per_lidar"]["tiny"]["confusion"][4][4] += 1
    path.write_text(to_json(seal(said)))
    fields = [field for field, _ in check_entry(path, AtHand()).problems]
    assert "seeds.runs[0].per_lidar.tiny.confusion[4]" in fields
