"""What ``semantic2d inspect`` says of recordings whose contents are known."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from conversion.cli import convert
from conversion.inspection.inspection import inspect_source
from conversion.inspection.plot import plot_inspection
from conversion.messages.source import MessageSource
from conversion.options import Options
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from semantic2d_dataset.format.sequence import SequenceReader
from tests.conversion.recordings import (
    AMCL,
    BEAMS,
    KINDS,
    ODOMETRY,
    POSE,
    START_NS,
    Recording,
    straight_drive,
)

SECOND = 10**9
TENTH = SECOND // 10
DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


def inspect(path, **options):
    with MessageSource(RosRecording(Bag(path))) as source:
        return inspect_source(source, Options(**options))


def office(kind="ros1", *, scans=40, header_lead_ns=0, missing=np.inf):
    """A lidar at 10 Hz in a room, poses of amcl once a second, odometry at 10 Hz."""
    drive = Recording(kind)
    random = np.random.default_rng(5)
    for n in range(scans):
        ns = START_NS + n * TENTH
        drive.add_pose(ns, (0.1 * n, 0.0, 0.0), topic="/odom", type_=ODOMETRY, frame="odom")
        if n % 10 == 0:
            drive.add_pose(ns, (0.1 * n, 1.0, 0.0), topic="/amcl_pose", type_=AMCL)
        ranges = random.uniform(0.5, 9.0, 60)
        away = random.random(60) < 0.2
        drive.add_scan(
            ns + header_lead_ns,
            np.where(away, missing, ranges),
            intensities=np.where(away, 0.0, 100.0),
            angle_min=-1.5,
            increment=0.05,
            record_ns=ns,
        )
    return drive


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_is_understood(kind, tmp_path):
    found = inspect(straight_drive(kind).write(tmp_path))
    assert [topic.name for topic in found.topics] == ["/scan", "/tf", "/tf_static"]
    assert [topic.role for topic in found.topics] == ["scans", "transforms", "transforms"]
    assert [topic.messages for topic in found.topics] == [12, 12, 2]
    assert found.topics[0].rate_hz == pytest.approx(10)
    assert found.topics[0].regularity == 1
    (scans,) = found.scans
    assert (scans.scans, scans.beams, scans.frame) == (12, BEAMS, "laser")
    assert scans.mount == pytest.approx((0.2, 0.1, 0.3, math.pi, 0.0, 0.3))
    assert scans.upside_down
    assert found.problems == ()
    assert found.poses[0].name == "tf map -> odom -> base_link"
    assert found.poses[0].coverage == {"/scan": pytest.approx(11 / 12)}
    (plan,) = found.plans
    assert plan.pose_source == found.poses[0].name
    assert plan.scans_with_pose == 11
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["kind"] == found.kind


def test_sources_of_poses_are_compared(tmp_path):
    found = inspect(office().write(tmp_path))
    poses = {pose.name: pose for pose in found.poses}
    assert list(poses) == ["/amcl_pose", "/odom"]
    amcl, odometry = poses["/amcl_pose"], poses["/odom"]
    assert (amcl.samples, amcl.longest_gap_s, amcl.automatic) == (4, 1.0, True)
    assert amcl.max_gap_s == 2
    assert amcl.coverage == {"/scan": pytest.approx(31 / 40)}
    assert odometry.coverage == {"/scan": 1.0}
    assert odometry.notes == ("in 'odom', not in 'map'",)
    assert odometry.length_m == pytest.approx(3.9)
    assert (odometry.start_s, odometry.stop_s) == (0.0, pytest.approx(3.9))


def test_odometry_is_proposed_where_nothing_else_has_poses(tmp_path):
    drive = Recording("ros1")
    for n in range(20):
        ns = START_NS + n * TENTH
        drive.add_pose(ns, (0.1 * n, 0.0, 0.0), topic="/odom", type_=ODOMETRY, frame="odom")
        drive.add_scan(ns, np.linspace(1, 5, 20))
    found = inspect(drive.write(tmp_path))
    (suggestion,) = found.suggestions
    assert suggestion.option == "--poses /odom"
    assert "drifts" in suggestion.why


def test_ground_truth_is_proposed_before_odometry(tmp_path):
    drive = Recording("ros1")
    for n in range(20):
        ns, pose = START_NS + n * TENTH, (0.1 * n, 0.0, 0.0)
        for topic in ("/odom", "/base_pose_ground_truth"):
            drive.add_pose(ns, pose, topic=topic, type_=ODOMETRY, frame="odom")
        drive.add_scan(ns, np.linspace(1, 5, 20))
    found = inspect(drive.write(tmp_path))
    assert [s.option for s in found.suggestions] == ["--poses /base_pose_ground_truth"]


def test_a_goal_is_no_pose_of_the_robot(tmp_path):
    drive = office()
    for n in range(40):
        drive.add_pose(START_NS + n * TENTH, (n, 0.0, 0.0), topic="/move/goal", type_=POSE)
    goal = next(p for p in inspect(drive.write(tmp_path)).poses if p.name == "/move/goal")
    assert not goal.automatic


def test_no_return_by_a_number_is_proposed_with_its_share(tmp_path):
    found = inspect(office(missing=25.5).write(tmp_path))
    (value,) = found.scans[0].recurring
    assert value.value_m == 25.5
    assert value.counts_as_return
    assert "--no-return 25.5" in [s.option for s in found.suggestions]
    assert "--no-return 25.5" in found.command
    given = inspect(office(missing=25.5).write(tmp_path, "again"), no_return=(25.5,))
    assert given.suggestions == ()
    assert given.command.count("--no-return 25.5") == 1


def test_intensities_against_the_ranges_are_noticed(tmp_path):
    drive = office()
    for _, _, _, message in drive.messages:
        if message.__msgtype__.endswith("LaserScan"):
            message.intensities = message.intensities[::-1].copy()
    found = inspect(drive.write(tmp_path))
    assert found.scans[0].intensities_run_backward
    assert [s.option for s in found.suggestions] == ["--reverse-intensities"]
    given = inspect(drive.write(tmp_path, "again"), reverse_intensities=True)
    assert given.suggestions == ()
    assert given.remarks == ()


def test_reversing_intensities_that_are_right_is_remarked(tmp_path):
    found = inspect(office().write(tmp_path), reverse_intensities=True)
    assert any("nothing shows" in text for text in found.remarks)


@pytest.mark.parametrize(
    ("lead_s", "said"),
    [(-31_557_600.0, "1.0 years behind"), (7200.0, "2.0 h ahead of"), (90.0, "90.0 s ahead of")],
)
def test_clocks_that_differ_are_remarked(lead_s, said, tmp_path):
    found = inspect(office(header_lead_ns=round(lead_s * SECOND)).write(tmp_path))
    assert found.scans[0].stamps.lead_s == pytest.approx(lead_s)
    assert any(f"header stamps are {said} the times of recording" in t for t in found.remarks)


def backward(times, *, scans=300):
    """Scans of which every so many is stamped 0.3 s too early."""
    drive = Recording("ros1")
    for n in range(scans):
        ns = START_NS + n * TENTH
        early = n % (scans // times) == scans // times - 1
        drive.add_scan(ns - early * 3 * TENTH, np.linspace(1, 5, 20), record_ns=ns)
    return drive


def test_stamps_that_go_backward_now_and_then_can_be_taken_from_the_recording(tmp_path):
    found = inspect(backward(3).write(tmp_path))
    assert found.scans[0].stamps.backward == 3
    assert len(found.plans) == 4
    assert [s.option for s in found.suggestions] == ["--stamps record"]
    assert any("go backward 3 times, at most by 200 ms" in text for text in found.remarks)
    assert len(inspect(backward(3).write(tmp_path, "again"), stamps="record").plans) == 1


def test_what_blocks_a_conversion_is_said_with_the_way_out(tmp_path):
    found = inspect(backward(150).write(tmp_path), stamps="header")
    assert found.plans == ()
    assert "stamps go backward" in found.problems[0]
    assert [s.option for s in found.suggestions] == ["--stamps record"]
    assert found.command.count("--stamps") == 1


def test_three_lidars_are_told_apart(tmp_path):
    drive = office()
    for n in range(40):
        ns = START_NS + n * TENTH
        drive.add_scan(ns, np.linspace(1, 5, 30), topic="/rear/scan", frame="rear", increment=0.1)
        drive.add_scan(ns, np.linspace(5, 1, 9), topic="/top/scan", frame="top", increment=-0.25)
    found = inspect(drive.write(tmp_path))
    assert [scans.topic for scans in found.scans] == ["/rear/scan", "/scan", "/top/scan"]
    assert [scans.direction for scans in found.scans][-1] == "clockwise"
    assert len(found.plans) == 3
    assert set(found.pictures.samples) == {"/scan", "/rear/scan", "/top/scan"}


def test_a_lidar_that_cannot_be_is_left_out_by_naming_the_others(tmp_path):
    drive = office()
    for n in range(40):
        drive.add_scan(START_NS + n * TENTH, np.linspace(1, 5, 90), topic="/wound", increment=0.25)
    found = inspect(drive.write(tmp_path))
    assert "/wound" in found.problems[0]
    assert [s.option for s in found.suggestions] == ["--scan-topic /scan"]


def test_intensities_of_one_lidar_only_are_no_option_for_all(tmp_path):
    drive = office()
    for n in range(40):
        away = np.arange(60) < 20
        drive.add_scan(
            START_NS + n * TENTH,
            np.where(away, np.inf, 2.0),
            intensities=np.where(away, 0.0, 9.0)[::-1],
            topic="/rear",
            increment=0.1,
        )
    found = inspect(drive.write(tmp_path))
    assert found.suggestions == ()
    assert any("/rear only" in text and "--scan-topic" in text for text in found.remarks)


@pytest.mark.parametrize(
    "odd",
    [
        {"ranges": []},
        {"ranges": [1.0]},
        {"ranges": [math.nan] * 8},
        {"ranges": [1e38] * 8},
        {"increment": math.nan},
        {"increment": 0.0},
        {"angle_min": 1e30},
        {"limits": (0.0, math.inf)},
        {"limits": (math.nan, math.nan)},
        {"limits": (5.0, 1.0)},
        {"intensities": [math.nan] * 8},
        {"intensities": [1e-44] * 8},
        {"record_ns": 0},
    ],
    ids=str,
)
def test_whatever_scans_say_is_reported_and_drawn(odd, tmp_path):
    drive = Recording("ros1")
    for n in range(4):
        given = {"ranges": np.linspace(1, 5, 8)} | odd
        drive.add_scan(START_NS + n * TENTH, given.pop("ranges"), **given)
    found = inspect(drive.write(tmp_path))
    assert "/scan" in str(found)
    assert len(found.plans) + len(found.problems) > 0
    json.dumps(found.as_dict(), allow_nan=False)
    plot_inspection(found)


def test_a_recording_without_scans_says_what_it_holds(tmp_path):
    drive = Recording("mcap")
    drive.add_pose(START_NS, (0.0, 0.0, 0.0), topic="/amcl_pose")
    found = inspect(drive.write(tmp_path))
    assert found.scans == ()
    assert found.plans == ()
    assert "LaserScan" in found.problems[0]
    assert "/amcl_pose" in str(found)


def test_a_damaged_bag_is_shown_as_far_as_it_can_be_read(tmp_path):
    path = office(scans=400).write(tmp_path, compression="bz2", chunk=20_000)
    content = bytearray(path.read_bytes())
    middle = content.index(b"BZh", len(content) // 2) + 50
    content[middle : middle + 200] = bytes(200)
    path.write_bytes(content)
    found = inspect(path)
    (problem,) = found.problems
    assert "damaged" in problem
    assert 100 < found.scans[0].scans < 300
    assert found.topics[-1].messages == found.scans[0].scans
    assert found.plans == ()
    assert problem.split(",")[0] in str(found)


def test_a_topic_that_cannot_be_decoded_is_counted_and_named(tmp_path):
    drive = office()
    path = drive.write(tmp_path)
    content = path.read_bytes()
    broken = content.replace(b"float64[36] covariance", b"float64[99] covariance")
    path.write_bytes(broken)
    found = inspect(path)
    assert {topic.name: topic.messages for topic in found.topics}["/amcl_pose"] == 4
    assert any(text.startswith("/amcl_pose") for text in found.remarks)
    assert found.scans[0].scans == 40


def test_a_pose_file_is_compared_with_the_other_sources(tmp_path):
    path = office().write(tmp_path)
    lines = (f"{(START_NS + n * TENTH) / 1e9:.3f} {n} 0 0 0 0 0 1\n" for n in range(5, 40))
    (tmp_path / "poses.txt").write_text("".join(lines))
    found = inspect(path, poses=str(tmp_path / "poses.txt"))
    assert found.poses[0].name == "poses.txt"
    assert found.poses[0].coverage == {"/scan": pytest.approx(35 / 40)}
    assert f"--poses {tmp_path / 'poses.txt'}" in found.command


def test_the_command_that_it_gives_converts_the_recording(tmp_path, monkeypatch):
    path = office(missing=25.5).write(tmp_path)
    found = inspect(path, map_frame="map", license="CC-BY-4.0", mount=(0.1, 0, 0.2, 0, 0, 3.14))
    app = typer.Typer()
    app.command()(convert)
    monkeypatch.chdir(tmp_path)
    words = shlex.split(found.command)
    assert words[:2] == ["semantic2d", "convert"]
    outcome = CliRunner().invoke(app, words[2:], catch_exceptions=False)
    assert outcome.exit_code == 0, outcome.output
    (sequence,) = (tmp_path / "sequences").glob("*.h5")
    with SequenceReader(sequence) as reader:
        assert reader.header.license == "CC-BY-4.0"
        assert reader.header.sequence_id == found.plans[0].sequence_id
        assert np.isposinf(reader.read("scans/ranges")).mean() > 0.1


def test_the_cart_of_the_stock_room_is_understood():
    path = DATA / "thesis_cart" / "rosbag" / "rosbag2_test"
    if not path.is_dir():
        pytest.skip(f"the real recordings are not present at {DATA}")
    found = inspect(path)
    assert [s.option for s in found.suggestions] == ["--reverse-intensities"]
    assert found.poses[0].name == "tf map -> odom -> base_link"
    assert found.poses[0].covers > 0.95
    amcl = next(pose for pose in found.poses if pose.name == "/amcl_pose")
    assert (amcl.samples, amcl.longest_gap_s > 10) == (29, True)
    assert found.scans[0].kinds["no return (+inf)"] == pytest.approx(0.5736, abs=1e-4)


def test_the_simulated_robot_is_understood():
    path = DATA / "pf_localisation" / "simpath2.bag"
    if not path.is_file():
        pytest.skip(f"the real recordings are not present at {DATA}")
    options = [suggestion.option for suggestion in inspect(path).suggestions]
    assert options == ["--poses /base_pose_ground_truth", "--no-return 5.6"]
