from __future__ import annotations

import pytest

from baselines.experiments import (
    COMBINATIONS,
    EXPERIMENTS,
    RunSpec,
    find_experiment,
    parse_seeds,
)
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.published import published_segmentation


def test_every_published_combination_of_features_is_trained_in_its_order():
    published = [row.features for row in published_segmentation().rows if row.features]
    assert list(COMBINATIONS) == published
    for experiment in EXPERIMENTS.values():
        ours = [method.features for method in experiment.methods if method.model == "s3net"]
        assert ours == published


def test_the_main_rows_of_the_table_are_trained_with_every_seed_the_others_once():
    methods = find_experiment("table-segmentation").methods
    counts = {m.features: len(m.runs("hokuyo", (4, 5))) for m in methods if m.model == "s3net"}
    assert {letters for letters, n in counts.items() if n == 2} == {"R", "RI", "RIA"}
    assert set(counts.values()) == {1, 2}


def test_every_run_of_an_experiment_has_a_folder_of_its_own():
    for experiment in EXPERIMENTS.values():
        runs = [run for m in experiment.methods for run in m.runs("wlr716", (0, 1))]
        assert len({run.name for run in runs}) == len(runs)
    assert RunSpec("s3net", "RIA", "wlr716", 3).name == "s3net-RIA-wlr716-seed3"


def test_seeds_are_numbers_between_commas():
    assert parse_seeds("0") == (0,)
    assert parse_seeds("2, 0,11") == (2, 0, 11)


@pytest.mark.parametrize("text", ["", "x", "0,,1", "0,0", "-1", "1.5", "0;1", "²", str(2**32)])
def test_anything_else_is_no_seed(text: str):
    with pytest.raises(InvalidInputError, match="different whole numbers from 0, such as 0,1,2"):
        parse_seeds(text)


def test_an_unknown_experiment_is_told_the_known_ones():
    with pytest.raises(InvalidInputError, match="known are table-segmentation, ablation"):
        find_experiment("table")
