from __future__ import annotations

import numpy as np
import pytest

from conversion.convert import convert_recording
from conversion.options import Options
from conversion.presets import apply_preset
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import SequenceReader
from tests.conversion.recordings import START_NS, Recording

TENTH = 100_000_000


def stata_drive(folder, *, truth=True):
    """A PR2's bag and its ground truth: the laser, 0.275 m ahead of the base, drives along y."""
    drive = Recording("ros1")
    lines = []
    for n in range(20):
        ns = START_NS + n * TENTH
        drive.add_tf(ns, "/base_footprint", "/base_laser_link", (0.275, 0.0, 0.252))
        for topic, beams in (("/base_scan", 1040), ("/tilt_scan", 640)):
            drive.add_scan(
                ns, np.full(beams, 2.0), topic=topic, frame="/base_laser_link",
                angle_min=-2.268928, increment=4.537856 / beams,
            )  # fmt: skip
        lines.append(f"{ns // 1000},3.0,{0.1 * n},{np.pi / 2}\n")
    if truth:
        (folder / "2011-01-18-06-37-58.gt.laser.poses").write_text("".join(lines))
    return drive.write(folder, "2011-01-18-06-37-58")


def test_stata_takes_the_base_laser_and_the_ground_truth_beside_the_bag(tmp_path):
    path = stata_drive(tmp_path)
    (summary,) = convert_recording(path, tmp_path / "out", Options(preset="stata"))
    assert summary.sequence_id == "stata-center--2011-01-18-06-37-58--base-scan-1040"
    assert summary.scans_with_pose == summary.scans_out == 20
    with SequenceReader(tmp_path / "out" / f"{summary.sequence_id}.h5") as sequence:
        poses = sequence.read("poses/initial")
    expected = [[3.0, 0.1 * n - 0.275, np.pi / 2] for n in range(20)]
    np.testing.assert_allclose(poses, expected, atol=1e-6)


def test_a_clock_offset_moves_the_ground_truth(tmp_path):
    path = stata_drive(tmp_path)
    late = Options(preset="stata", clock_offset_s=1.0)
    (summary,) = convert_recording(path, tmp_path / "out.h5", late)
    assert summary.scans_with_pose == 10
    with pytest.raises(RecordingError, match="clock"):
        convert_recording(path, tmp_path / "far.h5", Options(preset="stata", clock_offset_s=1e6))


def test_stata_without_ground_truth_takes_the_recorded_poses(tmp_path):
    path = stata_drive(tmp_path, truth=False)
    (summary,) = convert_recording(path, tmp_path / "out.h5", Options(preset="stata"))
    assert (summary.scans_out, summary.scans_with_pose) == (20, 0)


def test_what_the_user_says_counts_more_than_a_preset(tmp_path):
    given = Options(preset="stata", scan_topics=("/tilt_scan",), poses="tf", environment="lab")
    path = stata_drive(tmp_path)
    assert apply_preset(given, [path]) == given


def test_an_unknown_preset_is_refused_with_those_there_are(tmp_path):
    with pytest.raises(InvalidInputError, match="'kitti'; known are stata, ogm-turtlebot2"):
        apply_preset(Options(preset="kitti"), [tmp_path])
