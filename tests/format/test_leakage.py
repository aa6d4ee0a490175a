"""The audit finds the nearest train scan that a plain search finds, and says what it means."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic2d_dataset.errors import ChecksumError, DatasetNotFoundError
from semantic2d_dataset.format.leakage import Track, audit_schemes, read_tracks
from semantic2d_dataset.format.leakage_report import describe_audit, format_audit, percent, verdict
from semantic2d_dataset.format.manifest import read_manifest
from semantic2d_dataset.format.split_schemes import make_frame_scheme, schemes_of
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, VAL, SplitScheme

SECOND = 1_000_000_000
RADIUS_M = 0.25 / (2 * math.sin(math.radians(7.5)))


def make_track(name, scans, *, rate_hz=20.0, start_s=0.0, seed=0, step_m=0.05):
    """A robot that wanders about and sometimes stands still."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, step_m, (scans, 3)) * (rng.random((scans, 1)) > 0.2)
    stamps = ((start_s + np.arange(scans) / rate_hz) * SECOND).astype(np.int64)
    return Track(name, stamps, np.cumsum(steps, axis=0))


def audit(membership, tracks, **options):
    ids = {name: np.array(each, np.uint8) for name, each in membership.items()}
    return audit_schemes([SplitScheme("own", ids, "by hand")], tracks, **options)[0]


def search(audited, track, trained):
    """Nearest train scan of every test scan, one by one: s, and m by the measure."""
    for row in np.flatnonzero(audited.scheme.membership[track.sequence_id] == TEST):
        times, distances = [math.inf], [math.inf]
        for other in trained:
            for i in np.flatnonzero(audited.scheme.membership[other.sequence_id] == TRAIN):
                if other.recording == track.recording:
                    times.append(abs(int(other.stamps_ns[i]) - int(track.stamps_ns[row])) / 1e9)
                x, y, yaw = track.poses[row] - other.poses[i]
                chord = 2 * RADIUS_M * math.sin(yaw / 2)
                distances.append(math.sqrt(x * x + y * y + chord * chord))
        yield min(times), min(distances)


@given(st.integers(0, 10**6), st.integers(1, 30), st.integers(1, 30))
def test_nearest_train_scans_are_those_of_a_plain_search(seed, one, other):
    rng = np.random.default_rng(seed)
    tracks = [
        make_track("e--r--a", one, seed=seed, step_m=0.5),
        make_track("e--r--b", other, rate_hz=7.0, seed=seed + 1, step_m=0.5),
        make_track("e--s--a", other, start_s=1e6, seed=seed + 2, step_m=0.5),
    ]
    ids = {t.sequence_id: rng.choice((TRAIN, VAL, TEST, NONE), len(t.poses)) for t in tracks}
    audited = audit(ids, tracks)
    found = audited.of("test")
    by_lidar = sorted(tracks, key=lambda track: (track.lidar, track.recording))
    expected = [pair for track in by_lidar for pair in search(audited, track, tracks)]
    assert len(found) == len(expected)
    if expected:
        np.testing.assert_allclose(found.time_s, [s for s, _ in expected], rtol=1e-6)
        np.testing.assert_allclose(found.pose_m, [m for _, m in expected], rtol=1e-5, atol=1e-6)


def test_neighbours_are_counted_in_the_order_of_their_own_sequence():
    tracks = [make_track("e--r--a", 6), make_track("e--r--b", 6)]
    membership = {"e--r--a": [0, 2, 2, 2, 255, 0], "e--r--b": [0] * 6}
    found = audit(membership, tracks).of("test")
    assert found.next_to_train.tolist() == [True, False, False]
    assert found.time_s.tolist() == [0, 0, 0]  # by the other lidar


def test_turns_count_across_the_seam_of_the_circle():
    poses = np.array([[0, 0, math.radians(179)], [0, 0, math.radians(-179)]])
    track = Track("e--r--a", np.array([0, 10 * SECOND]), poses)
    found = audit({"e--r--a": [0, 2]}, [track]).of("test")
    assert found.turn_rad[0] == pytest.approx(math.radians(2), rel=1e-4)
    assert found.pose_m[0] == pytest.approx(2 * RADIUS_M * math.sin(math.radians(1)), rel=1e-4)


def test_fifteen_degrees_count_as_a_quarter_of_a_metre():
    poses = np.array([[0, 0, 0], [0, 0, math.radians(15)]])
    track = Track("e--r--a", np.array([0, 10 * SECOND]), poses)
    assert audit({"e--r--a": [0, 2]}, [track]).of("test").pose_m[0] == pytest.approx(0.25)


def test_scans_without_a_pose_are_left_out_of_shares_of_poses():
    poses = np.array([[0, 0, 0], [np.nan] * 3, [0.1, 0, 0]])
    said = audit({"e--r--a": [0, 2, 2]}, [Track("e--r--a", np.arange(3), poses)]).of("test")
    figures = said.summarise()
    assert (figures["scans"], figures["scans_with_pose"]) == (2, 1)
    assert figures["within_25_cm_15_deg"] == 1
    blind = Track("e--r--a", np.arange(3), np.full((3, 3), np.nan))
    figures = audit({"e--r--a": [0, 2, 2]}, [blind]).of("test").summarise()
    assert figures["within_25_cm_15_deg"] is figures["median_pose_m"] is None


def test_stamps_that_leap_as_far_as_they_can_have_a_right_distance():
    ends = np.array([-(1 << 62) * 2, (1 << 62) * 2 - 1], np.int64)
    found = audit({"e--r--a": [0, 2]}, [Track("e--r--a", ends, np.zeros((2, 3)))]).of("test")
    assert found.time_s[0] == pytest.approx((2**64 - 1) / 1e9)


def standard(minutes=4.0, environments=10):
    scans = int(minutes * 60 * 5)
    tracks = [
        make_track(f"e{place}--r--{lidar}", scans, rate_hz=5.0, start_s=1e9, seed=place)
        for place in range(environments)
        for lidar in ("a", "b")
    ]
    schemes = schemes_of({track.sequence_id: track.stamps_ns for track in tracks})
    return {a.scheme.name: describe_audit(a) for a in audit_schemes(schemes, tracks)}


def test_frames_leak_and_blocks_environments_and_other_lidars_have_no_neighbour():
    said = standard()
    # a test scan has no neighbour in train where both are val or test: 0.3 x 0.3
    assert said["frame"]["test"]["next_to_train"] == pytest.approx(1 - 0.3**2, abs=0.01)
    assert said["frame"]["verdict"] == (
        "leaks: 91 % of test scans lie next to a train scan; "
        "for comparison with published figures only"
    )
    assert [said[n]["test"]["next_to_train"] for n in ("block", "environment", "lidar")] == [0] * 3
    assert said["block"]["test"]["nearest_s"] >= 1
    assert said["block"]["val"]["nearest_s"] >= 1
    assert said["block"]["verdict"].startswith("disjoint in time: test scans lie 1")
    assert said["environment"]["verdict"].startswith("no test recording is trained on; disjoint")
    assert said["environment"]["test"]["same_environment"] == 0
    assert said["lidar"]["verdict"].startswith("shares moments: 7")
    assert said["lidar"]["val"]["within_1_s"] == 0


@pytest.mark.parametrize(
    ("ids", "says"),
    [
        ([0] * 50 + [2] * 50, "leaks: 2 % of test scans lie next to a train scan; leave a gap"),
        ([0] * 50 + [255] * 10 + [2] * 40, "leaks a little: 22 % of test scans were taken within"),
        ([255] * 100, "has no test scan"),
        ([2] * 100, "no test recording is trained on; disjoint in place too"),
    ],
)
def test_schemes_of_ones_own_are_judged_by_what_they_do(ids, says):
    audited = audit({"e--r--a": ids}, [make_track("e--r--a", 100)])
    assert verdict(audited.of("test").summarise()).startswith(says)


def test_other_recordings_of_a_known_environment_share_its_place():
    tracks = [make_track("e--r--a", 50), make_track("e--s--a", 50, start_s=1e6)]
    said = describe_audit(audit({"e--r--a": [0] * 50, "e--s--a": [2] * 50}, tracks))
    assert said["verdict"].startswith(
        "no test recording is trained on; environments are shared: 100 % of test scans"
    )


def test_one_lidar_is_looked_at_where_one_is_named():
    tracks = [make_track(f"e--r--{lidar}", 200, seed=1) for lidar in "ab"]
    scheme = make_frame_scheme({track.sequence_id: 200 for track in tracks}, seed=0)
    one = audit_schemes([scheme], tracks, lidar="a")[0]
    both = audit_schemes([scheme], tracks)[0]
    assert [*one.timelines] == ["e--r--a"]
    assert one.nearness["test"].keys() == {"a"}
    np.testing.assert_array_equal(
        one.nearness["test"]["a"].time_s, both.nearness["test"]["a"].time_s
    )


def test_sequences_that_a_scheme_does_not_cover_belong_to_no_split():
    tracks = [make_track("e--r--a", 10), make_track("f--r--a", 10)]
    audited = audit({"e--r--a": [0] * 5 + [2] * 5}, tracks)
    assert len(audited.of("test")) == 5
    assert set(audited.timelines["f--r--a"].tolist()) == {NONE}


def test_timelines_show_each_split_for_its_share_of_the_recording():
    tracks = [make_track("e--r--a", 100), make_track("e--r--b", 50)]  # b stops half-way
    membership = {"e--r--a": [0] * 70 + [1] * 10 + [2] * 20, "e--r--b": [0] * 25 + [2] * 25}
    lines = audit(membership, tracks).timelines
    shares = np.bincount(lines["e--r--a"]) / len(lines["e--r--a"])
    np.testing.assert_allclose(shares, [0.7, 0.1, 0.2], atol=0.01)
    assert lines["e--r--b"][0] == TRAIN
    assert np.argmax(lines["e--r--b"] == TEST) == pytest.approx(150, abs=3)


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (None, "-"),
        (0.0, "0 %"),
        (1.0, "100 %"),
        (0.913, "91 %"),
        (0.0012, "0.12 %"),
        (0.999, "> 99 %"),
    ],
)
def test_shares_never_look_like_all_or_nothing_when_they_are_not(share, text):
    assert percent(share) == text


def test_table_names_every_lidar_and_split(dataset_folder):
    manifest = read_manifest(dataset_folder)
    tracks = [*read_tracks(dataset_folder, manifest)]
    assert [track.sequence_id for track in tracks] == sorted(manifest.lengths)
    scheme = make_frame_scheme(manifest.lengths, seed=0)
    text = format_audit(describe_audit(audit_schemes([scheme], tracks)[0]))
    first, head, test, val = text.splitlines()
    assert first.startswith("frame: leaks: 89 % of test scans")
    assert head.split()[:3] == ["scans", "next", "to"]
    assert (test.split()[:2], val.split()[:2]) == (["test", "90"], ["val", "45"])


def test_changed_sequence_is_not_audited(dataset_folder, tmp_path):
    manifest = read_manifest(dataset_folder)
    (tmp_path / "sequences").mkdir()
    for entry in manifest.sequences:
        (tmp_path / entry.file).write_bytes(b"x")
    with pytest.raises(ChecksumError, match="expected .* bytes, found 1"):
        [*read_tracks(tmp_path, manifest)]


def test_missing_sequence_is_named_with_what_to_do(dataset_folder, tmp_path):
    with pytest.raises(DatasetNotFoundError, match="missing, though dataset.json .* get it again"):
        [*read_tracks(tmp_path, read_manifest(dataset_folder))]
