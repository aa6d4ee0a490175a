"""An inspection as text."""

import re

import numpy as np
import pytest

from conversion.inspection.text import write_report
from tests.conversion.inspection.test_inspection import TENTH, inspect, office
from tests.conversion.recordings import START_NS, Recording, straight_drive


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return write_report(inspect(straight_drive("mcap").write(tmp_path_factory.mktemp("text"))))


def section(report, name):
    """The lines of a section, by its name."""
    lines = report.split(f"\n{name}\n")[1].splitlines()
    return lines[: lines.index("")] if "" in lines else lines


def test_sections_follow_one_another(report):
    assert report.splitlines()[0].endswith("1.1 s, from 2023-11-14T22:13:20.000Z")
    assert re.findall(r"^(\w.*)$", report, re.MULTILINE) == [
        "Topics",
        "Scans of /scan",
        "Transforms",
        "Poses",
        "Conversion",
        "To convert",
    ]


def test_columns_are_aligned(report):
    head, *rows = section(report, "Topics")
    at = head.index("type")
    assert [row[at:].split()[0] for row in rows] == [
        "sensor_msgs/LaserScan",
        "tf2_msgs/TFMessage",
        "tf2_msgs/TFMessage",
    ]
    stop = head.index("messages") + len("messages")
    assert [row[:stop].split()[-1] for row in rows] == ["12", "12", "2"]


def test_scans_are_described_in_units_of_people(report):
    text = " ".join(" ".join(section(report, "Scans of /scan")).split())
    assert "12, each of 8 beams, frame laser" in text
    assert "-57.30 to 42.97 deg (-1.000000 to 0.750000 rad)" in text
    assert "counter-clockwise, 14.3239 deg apart, field of view 100.3 deg" in text
    assert "x y z 0.2 0.1 0.3 m, roll pitch yaw 180 0 17.189 deg, upside down (" in text
    assert "returns: 100 %" in text
    assert "the same as the times of recording" in text


def test_long_texts_are_wrapped_and_no_word_is_lost(tmp_path):
    drive = Recording("ros1")
    for n in range(4):
        for child in range(15):
            drive.add_tf(
                START_NS + n * TENTH, "base_link", f"a_rather_long_frame_{child}", (n, 0, 0)
            )
        drive.add_scan(START_NS + n * TENTH, np.linspace(1, 5, 8))
    found = inspect(drive.write(tmp_path))
    lines = section(write_report(found), "Conversion")
    assert max(map(len, lines)) <= 110
    notice = found.plans[0].notices[-1]
    assert re.sub(r"\s+", " ", notice) in re.sub(r"\s+", " ", " ".join(lines))


def test_many_sequences_are_summed_up(tmp_path):
    drive = Recording("ros1")
    for n in range(60):
        beams = 20 + n // 3 % 2
        drive.add_scan(START_NS + n * TENTH, np.linspace(1, 5, beams), increment=0.05)
    text = write_report(inspect(drive.write(tmp_path)))
    assert text.count("  sequence ") == 3
    assert "and 17 more of /scan, of 3 to 3 scans" in text
    assert text.count("lidar described by its messages") == 1


def test_nothing_but_problems_has_no_empty_tables(tmp_path):
    drive = Recording("mcap")
    drive.add_pose(START_NS, (0.0, 0.0, 0.0), topic="/goal")
    text = write_report(inspect(drive.write(tmp_path)))
    assert "Transforms" not in text
    assert "\nProblems\n" in text
    assert "To convert, once that is solved" in text


def test_suggestions_stand_beside_their_reasons(tmp_path):
    text = write_report(inspect(office(missing=25.5).write(tmp_path)))
    lines = section(text, "Suggested")
    assert lines[0] == "  --no-return 25.5"
    assert "of the ranges of /scan are exactly that" in lines[1]
    assert section(text, "To convert")[0].endswith("--no-return 25.5 --out sequences")
