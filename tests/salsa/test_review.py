import base64
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest

from salsa import inspection, review
from salsa.dropping import drop_scans
from salsa.review import NO_RETURN, write_review
from semantic2d_dataset.errors import InvalidInputError, WriteError
from semantic2d_dataset.format.sequence import SequenceReader
from tests.generators import make_sequence
from tests.salsa import rooms
from tests.salsa.conftest import BLIND, LOST, SCANS

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture(scope="module")
def page(labelled_room, tmp_path_factory):
    path = tmp_path_factory.mktemp("review") / "review.html"
    write_review(path, labelled_room)
    return path


class Page(HTMLParser):
    """Checks that tags close in order; collects attributes and the embedded data."""

    def __init__(self, text):
        super().__init__()
        self.open, self.found, self.data, self.ids = [], [], None, []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.found += [(tag, name, value) for name, value in attrs]
        self.ids += [value for name, value in attrs if name == "id"]
        if tag not in ("meta", "img", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        if ("script", "id", "data") in self.found and self.data is None:
            self.data = json.loads(text, parse_constant=pytest.fail)


def read_page(path):
    return Page(path.read_text(encoding="utf-8"))


def test_the_page_is_whole_and_refers_to_nothing_outside(page):
    text, read = page.read_text(encoding="utf-8"), read_page(page)
    assert "http://" not in text
    assert "https://" not in text
    sources = [value for _, name, value in read.found if name in ("src", "href", "srcset")]
    assert len(sources) == 3
    assert all(value.startswith("data:image/png;base64,") for value in sources)
    assert not re.search(r"url\(|@import", text)
    assert len(set(read.ids)) == len(read.ids)
    assert set(re.findall(r'get\("([\w-]+)"\)', text)) <= set(read.ids)
    assert len(text) < 1e6


def test_the_head_says_what_became_of_the_scans(page):
    text = page.read_text(encoding="utf-8")
    said = dict(re.findall(r"<div>([^<]+)<b>([^<]+)</b></div>", text))
    assert (said["scans"], said["accepted"], said["not accepted"]) == ("60", "55", "4")
    assert said["without pose"] == "1"
    before, after = said["within 10 cm, rough"], said["within 10 cm, refined"]
    assert float(before.split()[0]) < 90 < float(after.split()[0])
    assert 0.5 < float(said["median residual"].split()[0]) < 3
    assert "dropped" not in said
    for name in ("Wall", "Table", "Sofa", "Pillar"):
        assert f"</span>{name}</td>" in text


def test_embedded_scans_are_those_of_the_file(labelled_room, page):
    data = read_page(page).data
    scans, step = data["scans"], data["lidar"]["step_m"]
    shape = (len(scans["index"]), data["lidar"]["beams"])
    codes = np.frombuffer(base64.b64decode(scans["ranges"]), "<u2").reshape(shape)
    labels = np.frombuffer(base64.b64decode(scans["labels"]), np.uint8).reshape(shape)
    with SequenceReader(labelled_room) as reader:
        batch = reader.batch()
        assert scans["index"] == list(range(SCANS))
        np.testing.assert_array_equal(codes != NO_RETURN, batch.valid)
        error = (codes - 1.0) * step - batch.ranges
        assert np.abs(error[batch.valid]).max() <= step / 2 + 1e-6
        assert step < 0.001
        np.testing.assert_array_equal(labels, batch.labels)
        refined = np.array(scans["refined"], float)
        np.testing.assert_allclose(refined, batch.poses, atol=1e-4)
        ratio = reader.read("alignment/inlier_ratio")
    assert scans["inliers"][30] == pytest.approx(100 * ratio[30], abs=0.1)
    assert scans["refined"][LOST] == [None] * 3
    kinds = np.zeros(SCANS, int)
    kinds[list(BLIND)], kinds[LOST] = 1, 3
    assert scans["kind"] == kinds.tolist()


def test_the_fit_over_time_keeps_every_extreme(page, labelled_room, monkeypatch, tmp_path):
    monkeypatch.setattr(review, "_BINS", 7)
    write_review(tmp_path / "review.html", labelled_room)
    short, full = read_page(tmp_path / "review.html").data["time"], read_page(page).data["time"]
    assert len(short["seconds"]) == 7
    assert len(full["seconds"]) == SCANS
    assert full["refused"] == [i in BLIND for i in range(SCANS)]
    assert sum(short["refused"]) in (1, 2)
    for name, series in full["series"].items():
        low, high = (
            [value for value in series[end] if value is not None] for end in ("low", "high")
        )
        assert min(short["series"][name]["low"]) == min(low), name
        assert max(short["series"][name]["high"]) == max(high), name


def test_a_long_recording_is_thinned_but_the_worst_stay(labelled_room, monkeypatch, tmp_path):
    monkeypatch.setattr(review, "_SHOWN", 10)
    monkeypatch.setattr(review, "_WORST", 3)
    write_review(tmp_path / "review.html", labelled_room)
    read = read_page(tmp_path / "review.html")
    (worst,) = (value for _, name, value in read.found if name == "data-scans")
    index = read.data["scans"]["index"]
    assert len(index) <= 13
    assert {0, SCANS - 1, *map(int, worst.split())} <= set(index)
    monkeypatch.setattr(review, "_SCAN_BYTES", 5 * 3 * rooms.LIDAR.beams)
    write_review(tmp_path / "review.html", labelled_room)
    assert len(read_page(tmp_path / "review.html").data["scans"]["index"]) <= 5


def test_blocks_change_nothing(labelled_room, page, monkeypatch, tmp_path):
    monkeypatch.setattr(inspection, "BLOCK_SCANS", 7)
    write_review(tmp_path / "review.html", labelled_room)
    assert (tmp_path / "review.html").read_bytes() == page.read_bytes()


def test_a_cleaned_copy_says_what_was_dropped(labelled_room, tmp_path):
    drop_scans(labelled_room, [20, 21, 22, 40], tmp_path / "cleaned.h5")
    write_review(tmp_path / "review.html", tmp_path / "cleaned.h5")
    text, read = (tmp_path / "review.html").read_text(), read_page(tmp_path / "review.html")
    said = dict(re.findall(r"<div>([^<]+)<b>([^<]+)</b></div>", text))
    assert (said["dropped"], said["not accepted"], said["accepted"]) == ("4", "1", "54")
    assert read.data["dropped"] == ["20-22", "40"]
    (worst,) = (value for _, name, value in read.found if name == "data-scans")
    assert worst.split()[0] == "23"


def test_a_page_can_be_made_where_every_scan_was_dropped(labelled_room, tmp_path):
    drop_scans(labelled_room, np.arange(SCANS), tmp_path / "cleaned.h5")
    write_review(tmp_path / "review.html", tmp_path / "cleaned.h5")
    assert "None is left" in (tmp_path / "review.html").read_text()
    assert read_page(tmp_path / "review.html").data["total"] == SCANS


def test_a_name_cannot_inject_anything(labelled_room, tmp_path):
    odd = tmp_path / "<script>alert(1)<.h5"
    shutil.copyfile(labelled_room, odd)
    write_review(tmp_path / "review.html", odd)
    text = (tmp_path / "review.html").read_text()
    assert "<script>alert" not in text
    assert read_page(tmp_path / "review.html").data["name"] == odd.name


def test_what_is_not_labelled_leaves_no_page(tmp_path):
    make_sequence(tmp_path / "truth.h5", 5)
    with pytest.raises(InvalidInputError, match="has no scans/confidence, .*label it first"):
        write_review(tmp_path / "review.html", tmp_path / "truth.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["truth.h5"]


def test_a_page_needs_its_folder(labelled_room, tmp_path):
    with pytest.raises(WriteError, match="does not exist"):
        write_review(tmp_path / "none" / "review.html", labelled_room)


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium to open the page")
def test_a_browser_draws_the_page_without_complaint(page, tmp_path):
    done = subprocess.run(
        [
            CHROMIUM,
            *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run"),
            *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
            *("--enable-logging=stderr", "--virtual-time-budget=3000", "--dump-dom"),
            f"--user-data-dir={tmp_path / 'profile'}",
            f"{page.as_uri()}#scan=30",
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert "CONSOLE" not in done.stderr
    assert "30 (0 to 59)" in done.stdout
    assert done.stdout.count('class="card"') == 12
