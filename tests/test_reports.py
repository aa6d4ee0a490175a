import dataclasses
import itertools
import re

import numpy as np
import pytest

from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError, SubmissionError
from semantic2d_dataset.format.splits import TEST
from semantic2d_dataset.plotting_scores import band_label
from semantic2d_dataset.reports import write_report
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.conditions import figure_of
from semantic2d_dataset.scoring.metrics import percent
from semantic2d_dataset.scoring.predictions import PredictionsWriter
from semantic2d_dataset.scoring.submission import score_predictions
from semantic2d_dataset.summaries import describe_file, format_summary
from tests.browsers import CHECK, launched
from tests.generators import SMALL_LIDAR, make_dataset


def write_predictions(path, data, *, wrong=0, leave_out=0, uncertain=False):
    """Predict the truth, with the first `wrong` beams of each scan called Wall.

    If `uncertain`, with class probabilities and two samples.
    """
    with PredictionsWriter(
        path,
        dataset=data.manifest.name,
        dataset_version=data.manifest.version,
        scheme="frame",
        split="test",
        taxonomy=SEMANTIC2D,
        metadata={"method": "Truth & <some> mistakes"},
    ) as writer:
        for entry in data.sequences():
            indices = np.flatnonzero(data.scheme("frame").membership[entry.id] == TEST)
            indices = indices[leave_out:]
            labels = data.reader(entry.id).read("scans/labels")[indices]
            labels[labels == 255] = 0
            labels[:, :wrong] = 9
            more = (np.eye(10, dtype=np.float16)[labels], labels[None].repeat(2, 0))
            writer.add(entry.id, indices, labels, *(more if uncertain else ()))


@pytest.fixture(scope="module")
def told(dataset_folder, tmp_path_factory):
    """A page about predictions with mistakes, probabilities and samples, and their result."""
    folder, data = tmp_path_factory.mktemp("told"), open_dataset(dataset_folder)
    write_predictions(folder / "p.h5", data, wrong=5, uncertain=True)
    write_report(folder / "report.html", folder / "p.h5", data, scans=2)
    page = (folder / "report.html").read_text(encoding="utf-8")
    return page, score_predictions(folder / "p.h5", data)


def test_page_shows_scores_and_pictures_and_needs_nothing_outside(told):
    page, _ = told
    assert "Truth &amp; &lt;some&gt; mistakes" in page
    pictures = re.findall(r'<img src="([^"]{30})', page)
    assert len(pictures) == 2 + 6 + 1 + 1 + 2  # classes, conditions, calibration, map, scans
    assert all(source.startswith("data:image/png;base64,") for source in pictures)
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert all(f"{name}</th>" in page for name in SEMANTIC2D.names)


def test_page_says_intervals_and_how_many_blocks_they_rest_on(told):
    page, result = told
    said = result["intervals"]
    for limits in (said["mIoU"], said["mCA"], *said["classes"].values()):
        assert "{:.1f} to {:.1f}".format(*(100 * limit for limit in limits)) in page
    assert f"from {said['blocks']} blocks of 10 s. So few blocks" in page


def test_page_shows_every_condition_that_divides_the_points(told):
    page, result = told
    for name, bands in result["conditions"].items():
        for band, scores in bands.items():
            figure = percent(scores[figure_of(name)])
            assert f"{band_label(name, band)} {figure} ({scores['points']:,} points)" in page
    assert "Not divided" not in page


def test_page_shows_calibration_and_samples_where_there_are_any(told):
    page, result = told
    assert f"error {percent(result['calibration']['ece'])}&nbsp;%" in page
    assert f"{percent(result['mIoU'])} ± 0.00 % over 2 samples" in page


def test_every_picture_says_what_it_shows_and_every_table_what_it_holds(told):
    page, _ = told
    alts = re.findall(r'<img src="[^"]+" alt="([^"]+)">', page)
    assert len(alts) == len(set(alts)) == page.count("<img")
    assert page.count("<table>") == page.count("<caption>") == 1
    assert not re.findall(r"<th(?! scope=)[ >]", page)


def test_page_can_be_read_at_any_width_in_light_and_dark(told, tmp_path):
    (tmp_path / "report.html").write_text(told[0], encoding="utf-8")
    with launched() as browser:
        for width, scheme in itertools.product((1280, 390), ("light", "dark")):
            size = {"width": width, "height": 800}
            page = browser.new_context(viewport=size, color_scheme=scheme).new_page()
            said = []
            page.on("console", lambda message, said=said: said.append(message.text))
            page.goto((tmp_path / "report.html").as_uri())
            assert page.evaluate(CHECK) == []
            assert said == []


def test_page_of_two_lidars_in_one_block_tells_them_apart_and_has_no_intervals(tmp_path):
    other = dataclasses.replace(SMALL_LIDAR, name="other")
    make_dataset(tmp_path / "data", environments=("lobby",), lidars=(SMALL_LIDAR, other), scans=40)
    data = open_dataset(tmp_path / "data")
    write_predictions(tmp_path / "p.h5", data)
    write_report(tmp_path / "report.html", tmp_path / "p.h5", data, scans=1)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '<th scope="row">other</th>' in page
    assert "No intervals: they need at least two blocks of 10 s, and the split has 1." in page
    assert "environment: lobby" in page[page.index("Not divided") :]
    assert "There is no mistake." in page
    assert "Calibration" not in page
    assert "samples" not in page


def test_predictions_that_cannot_be_scored_leave_no_page(dataset_folder, tmp_path):
    data = open_dataset(dataset_folder)
    write_predictions(tmp_path / "p.h5", data, leave_out=1)
    with pytest.raises(SubmissionError):
        write_report(tmp_path / "report.html", tmp_path / "p.h5", data)
    assert not (tmp_path / "report.html").exists()


def test_at_least_one_scan_is_shown(dataset_folder, tmp_path):
    data = open_dataset(dataset_folder)
    write_predictions(tmp_path / "p.h5", data)
    with pytest.raises(InvalidInputError, match="at least one scan"):
        write_report(tmp_path / "report.html", tmp_path / "p.h5", data, scans=0)


def test_summary_of_predictions_says_what_they_are_for(dataset_folder, tmp_path):
    write_predictions(tmp_path / "p.h5", open_dataset(dataset_folder))
    said = describe_file(tmp_path / "p.h5")
    assert (said["dataset"], said["scheme"], said["split"]) == ("generated", "frame", "test")
    assert said["arrays"]["lobby--first--small/labels"] == [30, 37]
    assert "Truth & <some> mistakes" in format_summary(said)
