from pathlib import Path

from semantic2d_dataset.pipeline.config import Config
from semantic2d_dataset.pipeline.labelling import Labelled
from semantic2d_dataset.pipeline.report import Report, Row

CONFIG = Config(Path("/c.yaml"), "rooms", "1.0.0", "MIT", Path("/rooms"), (), None)


def labelled(scans: int, accepted: int, share: float, *, kept: bool) -> Labelled:
    return Labelled(Path("x.h5"), "a--b--c", scans, accepted, share, kept)


LONG, SHORT = labelled(300, 290, 0.9, kept=True), labelled(100, 60, 0.5, kept=False)


def test_a_row_adds_its_sequences_up():
    row = Row("lab--a", (LONG, SHORT))
    assert (row.scans, row.accepted, row.labelled_share) == (400, 350, 0.8)


def test_the_state_tells_how_far_back_work_was_done():
    assert Row("lab--a", (LONG,)).state == "kept"
    assert Row("lab--a", (LONG, SHORT)).state == "labelled"
    assert Row("lab--a", (LONG, SHORT), converted=True).state == "made"
    assert Row("lab--a", error="is damaged").state == "failed"


def test_the_table_has_a_line_for_each_recording_and_an_end():
    rows = (Row("lab--a", (LONG,), seconds=1.25), Row("lab--long-name", error="it is damaged"))
    report = Report(CONFIG, rows, published=False, changed=False)
    head, first, second, end = str(report).splitlines()
    names = ["recording", "sequences", "scans", "accepted", "labelled", "seconds", "state"]
    assert head.split() == names
    assert first.split() == ["lab--a", "1", "300", "290", "90.0%", "1.2", "kept"]
    assert second.endswith("  failed: it is damaged")
    assert second.index("failed") == first.index("kept")
    assert end.startswith("1 of 2 recordings failed, so nothing was published")
    assert report.as_dict()["recordings"][1]["error"] == "it is damaged"


def test_the_end_says_what_became_of_the_data_set():
    rows = (Row("lab--a", (LONG,)),)
    made = Report(CONFIG, rows, published=True, changed=True)
    assert str(made).endswith(
        "/rooms: published rooms 1.0.0; look at it with: semantic2d info /rooms"
    )
    kept = Report(CONFIG, rows, published=True, changed=False)
    assert str(kept).endswith("/rooms: rooms 1.0.0 is complete already")
