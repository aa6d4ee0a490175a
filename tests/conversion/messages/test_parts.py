from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from conversion.messages.source import MessageSource
from conversion.options import Options
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import BEAMS, KINDS, START_NS, Recording, straight_drive

TENTH = 100_000_000


def convert(path: Path, **options):
    """The plans of a recording, and the arrays of each."""
    with MessageSource(RosRecording(Bag(path))) as source:
        plans = source.plans(Options(**options))
        arrays = [list(plan.blocks()) for plan in plans]
    assert all(len(blocks) == 1 for blocks in arrays)
    return plans, [blocks[0] for blocks in arrays]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ranges": [1.0] * 7}, "7 beams after 8"),
        ({"increment": 0.2}, "angles -1.000000 to 0.400000 after -1.000000 to 0.750000 rad"),
        ({"frame": "rear"}, "frame 'rear' after 'laser'"),
    ],
)
def test_a_sequence_ends_where_the_beams_change(change, message, tmp_path):
    drive = Recording("ros1")
    for n in range(4):
        changed = change if n >= 2 else {}
        drive.add_scan(START_NS + n * TENTH, **{"ranges": [1.0 + n] * BEAMS} | changed)
    plans, arrays = convert(drive.write(tmp_path))
    assert [plan.header.recording for plan in plans] == ["drive-part-1", "drive-part-2"]
    assert [plan.scans_out for plan in plans] == [2, 2]
    assert f"begins where {message}" in plans[1].notices
    assert arrays[0]["scans/ranges"][:, 0].tolist() == [1.0, 2.0]
    assert len(arrays[1]["scans/ranges"]) == 2


@pytest.mark.parametrize("kind", KINDS)
def test_a_sequence_ends_where_stamps_go_backward(kind, tmp_path):
    drive = Recording(kind)
    for n, stamp in enumerate((0, 2, 1, 3, 3, 0)):
        # of one time of recording, so that the second part begins among equals
        record_ns = START_NS + max(0, n - 2)
        drive.add_scan(START_NS + stamp * TENTH, [1.0 * n] * BEAMS, record_ns=record_ns)
    plans, arrays = convert(drive.write(tmp_path))
    found = [((a["scans/stamps_ns"] - START_NS) // TENTH).tolist() for a in arrays]
    assert found == [[0, 2], [1, 3, 3], [0]]
    assert [a["scans/ranges"][:, 0].tolist() for a in arrays] == [[0, 1], [2, 3, 4], [5]]
    assert "begins where stamps go back by 0.100 s to 1700000000.100 s" in plans[1].notices


def test_times_of_recording_keep_one_sequence(tmp_path):
    drive = Recording("mcap")
    for n, stamp in enumerate((0, 2, 1, 3)):
        drive.add_scan(START_NS + stamp * TENTH, [1.0 * n] * BEAMS, record_ns=START_NS + n)
    (plan,), (arrays,) = convert(drive.write(tmp_path), stamps="record")
    assert (arrays["scans/stamps_ns"] - START_NS).tolist() == [0, 1, 2, 3]
    assert plan.header.stamps_source == "record"


def test_more_parts_than_a_person_wants_are_refused_with_the_cause(tmp_path):
    drive = Recording("db3")
    for n in range(210):
        drive.add_scan(START_NS - n // 2 * TENTH, [1.0] * 2, record_ns=START_NS + n)
    path = drive.write(tmp_path)
    with pytest.raises(RecordingError, match="105 sequences: stamps go backward 104 times") as err:
        convert(path, stamps="header")
    assert "first by 0.100 s to 1699999999.900 s; pass --stamps record" in str(err.value)
    (plan,), _ = convert(path)
    assert plan.header.stamps_source == "record"
    assert any("go backward 104 times: record times taken" in notice for notice in plan.notices)


def test_stamps_that_were_never_set_give_way_to_times_of_recording(tmp_path):
    drive = Recording("db3")
    for n in range(3):
        drive.add_scan(0, [1.0] * BEAMS, record_ns=START_NS + n)
    path = drive.write(tmp_path)
    (plan,), (arrays,) = convert(path)
    assert arrays["scans/stamps_ns"].tolist() == [START_NS, START_NS + 1, START_NS + 2]
    assert "all headers of /scan have one stamp: record times taken" in plan.notices
    with pytest.raises(RecordingError, match="all 3 scans have one stamp; pass --stamps record"):
        convert(path, stamps="header")


def test_record_times_that_stand_still_are_refused_without_the_advice_to_use_them(tmp_path):
    drive = Recording("db3")
    for n in range(3):
        drive.add_scan(START_NS + n * TENTH, [1.0] * BEAMS, record_ns=START_NS)
    with pytest.raises(RecordingError, match="all 3 scans have one stamp") as caught:
        convert(drive.write(tmp_path), stamps="record")
    assert "--stamps" not in str(caught.value)


def with_lidar_clock(ahead_ns: int) -> Recording:
    """A drive whose lidar's clock is ahead of the clock of everything else."""
    source, drive = straight_drive("db3"), Recording("db3")
    for topic, _, record_ns, message in source.messages:
        if topic == "/scan":
            message.header.stamp = drive.stamp(record_ns + ahead_ns)
        drive.add(topic, message, record_ns)
    return drive


def test_a_lidar_clock_a_year_ahead_gives_way_to_times_of_recording(tmp_path):
    path = with_lidar_clock(365 * 86_400 * 10**9).write(tmp_path)
    (plan,), (arrays,) = convert(path)
    assert plan.header.stamps_source == "record"
    assert plan.scans_with_pose == 11
    assert any("31536000.0 s off the poses'" in notice for notice in plan.notices)
    (plan,), (arrays,) = convert(path, stamps="header")
    assert plan.scans_with_pose == 0
    assert arrays["scans/stamps_ns"][0] > START_NS + 3 * 10**16


def test_clocks_that_agree_within_seconds_keep_the_headers(tmp_path):
    (plan,), _ = convert(with_lidar_clock(10**9).write(tmp_path))
    assert plan.header.stamps_source == "header"


def test_messages_without_beams_are_left_out_and_told(tmp_path):
    drive = Recording("ros1")
    for n in range(5):
        drive.add_scan(START_NS + n * TENTH, [] if n in (0, 2) else [1.0 * n] * BEAMS)
    (plan,), (arrays,) = convert(drive.write(tmp_path))
    assert arrays["scans/ranges"][:, 0].tolist() == [1, 3, 4]
    assert "2 messages of /scan without beams: left out" in plan.notices


def test_a_topic_of_nothing_but_empty_messages_is_refused(tmp_path):
    drive = Recording("ros1")
    for n in range(3):
        drive.add_scan(START_NS + n, [])
    with pytest.raises(RecordingError, match="expected 3 scans, found 0 and 3 without beams"):
        convert(drive.write(tmp_path))


def test_parts_keep_their_poses(tmp_path):
    drive = straight_drive("mcap", scans=12)
    for n in range(12, 20):
        t = n * 0.1
        drive.add_tf(START_NS + n * TENTH, "odom", "base_link", (t, 0, 0), (0, 0, 0.5 * t))
        drive.add_scan(START_NS + n * TENTH, [1.0] * 5)
    _, (first, second) = convert(drive.write(tmp_path))
    np.testing.assert_allclose(first["poses/initial"][:, 0], 5.05 + np.arange(12) * 0.1, atol=1e-9)
    np.testing.assert_allclose(
        second["poses/initial"][:, 0], 5 + np.arange(12, 20) * 0.1, atol=1e-9
    )
