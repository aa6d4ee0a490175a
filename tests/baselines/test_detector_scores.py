from __future__ import annotations

import pytest

from baselines.detector_scores import score_detector
from baselines.detectors import DETECTORS
from baselines.experiments import Experiment, Method
from baselines.reporting import make_table
from baselines.reproduction import run_experiment
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.scoring.published import published_segmentation
from tests.baselines.test_reproduction import settings_of


@pytest.mark.parametrize("name", DETECTORS)
def test_all_classes_that_a_detector_cannot_tell_apart_have_the_figure_of_the_merged_one(
    name: str, mini
):
    detector = DETECTORS[name]
    found = score_detector(detector, ScanSource(mini, lidar="wlr716", split="val", scheme="block"))
    for figures in found.figures.values():
        assert set(figures) == {"All", *detector.truth}
        assert len(set(figures.values())) == 1
        ((mean, std),) = set(figures.values())
        assert 0 < mean < 1
        assert std is None
    assert found.figures["IoU"]["All"][0] <= found.figures["CA"]["All"][0]
    assert found.result["points"] > 0
    assert found.speed["one_pass"] > 0


def test_detectors_stand_beside_their_published_rows_and_are_not_ranked(dataset_folder, tmp_path):
    experiment = Experiment("detectors", "Detectors", tuple(Method(n, "") for n in DETECTORS))
    settings = settings_of(dataset_folder, seeds=(0,))
    results = run_experiment(experiment, settings, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        *("lines-small-seed0", "legs-small-seed0", ".lock")
    }
    table = make_table(experiment, settings, results)
    names = [row.method for row in table.rows]
    assert names == ["Line extraction"] * 2 + ["Leg detection"] * 2
    assert [row.published for row in table.rows] == [False, True] * 2
    assert not any(row.ranked for row in table.rows)
    assert table.rows[1].figures == published_segmentation().find("Line extraction").figures
