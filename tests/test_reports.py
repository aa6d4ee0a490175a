import re

import numpy as np
import pytest

from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError, SubmissionError
from semantic2d_dataset.format.splits import TEST
from semantic2d_dataset.reports import write_report
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from semantic2d_dataset.scoring.predictions import PredictionsWriter
from semantic2d_dataset.summaries import describe_file, format_summary


def write_predictions(path, data, *, wrong=0, leave_out=0):
    """Predict the truth, with the first `wrong` beams of each scan called Wall."""
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
            writer.add(entry.id, indices, labels)


def test_page_shows_scores_and_pictures_and_needs_nothing_outside(dataset_folder, tmp_path):
    data = open_dataset(dataset_folder)
    write_predictions(tmp_path / "p.h5", data, wrong=5)
    write_report(tmp_path / "report.html", tmp_path / "p.h5", data, scans=3)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Truth &amp; &lt;some&gt; mistakes" in page
    pictures = re.findall(r'<img src="([^"]{30})', page)
    assert len(pictures) == 3 + 3
    assert all(source.startswith("data:image/png;base64,") for source in pictures)
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert all(f"{name}</td>" in page for name in SEMANTIC2D.names)


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
