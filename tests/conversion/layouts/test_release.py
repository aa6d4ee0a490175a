"""The published layout as a source of sequences."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from conversion.layouts import session_blocks
from conversion.layouts.release import ReleaseSource
from conversion.layouts.trees import open_tree
from conversion.options import Options
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.lidars import LIDARS
from tests.conversion.releases import (
    SESSIONS,
    make_release,
    make_session,
    pack_tar,
    pack_zip,
    save,
    small_lidar,
    write_sequences,
)

BEAMS = 7


@pytest.fixture
def options(tmp_path):
    return Options(lidar=small_lidar(tmp_path / "small.yaml", BEAMS))


@pytest.fixture
def session(tmp_path):
    return make_session(tmp_path / "lobby" / "2024-04-04", scans=10, beams=BEAMS)


def plan_of(path, options):
    with ReleaseSource(path) as source:
        (plan,) = source.plans(options)
    return plan


def blocks_of(path, options):
    """The arrays of one session, all blocks joined."""
    with ReleaseSource(path) as source:
        (plan,) = source.plans(options)
        parts = {}
        for block in plan.blocks():
            for name, rows in block.items():
                parts.setdefault(name, []).append(rows)
    return {name: np.concatenate(rows) for name, rows in parts.items()}


def field(session, name):
    return [np.load(path, allow_pickle=False) for path in sorted((session / name).iterdir())]


def test_a_session_becomes_a_sequence_with_all_that_it_holds(session, options, tmp_path):
    (file,) = write_sequences(session, tmp_path, options)
    assert file.name == "lobby--2024-04-04--small.h5"
    with SequenceReader(file) as reader:
        reader.check_values()
        assert reader.header.stamps_source == "synthetic"
        ranges = np.array(field(session, "scans_lidar"))
        np.testing.assert_array_equal(
            reader.read("scans/ranges"), np.where(ranges == 0, np.inf, ranges)
        )
        for name, array in (
            ("intensities_lidar", "scans/intensities"),
            ("semantic_label", "scans/labels"),
            ("positions", "poses/initial"),
            ("velocities", "commands/velocity"),
        ):
            np.testing.assert_array_equal(reader.read(array), field(session, name))
        lines = field(session, "line_segments")
        assert np.diff(reader.read("lines/offsets")).tolist() == [each.size // 4 for each in lines]
        np.testing.assert_array_equal(
            reader.read("lines/segments"),
            np.concatenate([each.reshape(-1, 4) for each in lines]).astype(np.float32),
        )
        assert np.diff(reader.read("scans/stamps_ns")).tolist() == [50_000_000] * 9


def test_folder_zip_and_tar_give_the_same_sequences(tmp_path, options):
    release = make_release(tmp_path / "lobby", scans=5, beams=BEAMS, more=True)
    shutil.copytree(release, tmp_path / "in" / "lobby")
    paths = [release, pack_zip(release, tmp_path / "a.zip"), pack_tar(release, tmp_path / "a.tgz")]
    digests = []
    for n, path in enumerate(paths):
        (tmp_path / str(n)).mkdir()
        files = write_sequences(path, tmp_path / str(n), options)
        assert [file.name for file in files] == [f"lobby--{name}--small.h5" for name in SESSIONS]
        digests.append([SequenceReader(file).content_digest() for file in files])
    assert digests[0] == digests[1] == digests[2]


def test_each_lidar_of_the_release_is_recognised_by_its_beams(tmp_path):
    for spec in LIDARS.values():
        folder = make_session(tmp_path / spec.name, scans=1, beams=spec.beams)
        plan = plan_of(folder, Options())
        assert plan.header.lidar == spec
        assert f"lidar recognised by its {spec.beams} beams; --lidar names another" in plan.notices


def test_an_unknown_lidar_is_refused_with_what_to_do(session, tmp_path):
    with pytest.raises(RecordingError, match=r"found 7 beams; describe the lidar .*--lidar FILE"):
        plan_of(session, Options())
    make_session(tmp_path / "more", scans=2, beams=9, more=True)
    match = r"found 9 beams \(by angles_lidar: angle_min -2.356194, angle_increment 0.589049\)"
    with pytest.raises(RecordingError, match=match):
        plan_of(tmp_path / "more", Options())


def test_a_lidar_of_other_beams_than_the_scans_is_refused(session):
    with pytest.raises(RecordingError, match="expected the 1081 beams of hokuyo.*found 7 beams"):
        plan_of(session, Options(lidar="hokuyo"))


def test_angles_that_do_not_fit_the_lidar_are_noticed(tmp_path):
    folder = make_session(tmp_path / "a", scans=1, more=True)
    assert not [text for text in plan_of(folder, Options()).notices if "angles_lidar" in text]
    save(folder / "angles_lidar" / "0000000.npy", np.linspace(0, 1, 1081))
    assert any("angles_lidar does not fit" in text for text in plan_of(folder, Options()).notices)


def test_options_are_honoured(session, options):
    mount = (0.1, 0.0, 0.2, 0.0, 0.0, 0.0)
    given = replace(options, environment="office", recording="first", license="MIT", mount=mount)
    header = plan_of(session, given).header
    assert header.sequence_id == "office--first--small"
    assert (header.license, header.lidar.base_T_lidar) == ("MIT", mount)
    plain = blocks_of(session, options)
    turned = blocks_of(session, replace(options, reverse_intensities=True))
    np.testing.assert_array_equal(turned["scans/intensities"], plain["scans/intensities"][:, ::-1])


@pytest.mark.parametrize(
    "asked", [{"poses": "tf"}, {"streams": ("all",)}, {"stamps": "header"}, {"max_gap_s": 1.0}]
)
def test_options_without_meaning_here_are_refused(session, options, asked):
    with pytest.raises(InvalidInputError, match="has no meaning for a published Semantic2D layout"):
        plan_of(session, replace(options, **asked))


def test_one_name_for_several_recordings_is_refused(tmp_path, options):
    release = make_release(tmp_path / "lobby", scans=1, beams=BEAMS)
    match = "holds 2 sessions, and a name"
    with ReleaseSource(release) as source, pytest.raises(InvalidInputError, match=match):
        source.plans(replace(options, recording="first"))


def test_sessions_of_one_name_are_told_apart_by_more_folders(tmp_path, options):
    for floor in ("first", "second"):
        make_session(tmp_path / floor / "lobby" / "2024-04-04", scans=1, beams=BEAMS)
    with ReleaseSource(tmp_path) as source:
        ids = [plan.header.sequence_id for plan in source.plans(options)]
        assert ids == ["first-lobby--2024-04-04--small", "second-lobby--2024-04-04--small"]
        with pytest.raises(RecordingError, match="2 sessions would all become x--2024-04-04"):
            source.plans(replace(options, environment="x"))


def test_lists_become_members_and_keep_their_bytes(session, options):
    plan = plan_of(session, options)
    assert set(plan.lists) == {"train", "dev", "test"}
    assert plan.lists["dev"] == (session / "dev.txt").read_bytes()
    names = sorted(path.name for path in (session / "scans_lidar").iterdir())
    train = (session / "train.txt").read_text().split()
    assert {names[n] for n in np.flatnonzero(plan.members == 0)} == set(train)
    assert np.bincount(plan.members).tolist() == [7, 1, 2]


def test_a_session_without_lists_has_no_members(session, options):
    for path in session.glob("*.txt"):
        path.unlink()
    plan = plan_of(session, options)
    assert plan.lists == {}
    assert plan.members is None


def test_missing_and_extra_files_are_counted_and_do_no_harm(session, options):
    (session / "semantic_label" / "0000003.npy").unlink()
    (session / "positions" / "0000000.npy").unlink()
    (session / "scans_lidar" / "0000009.npy").unlink()
    (session / "notes.txt").write_text("rainy")
    plan = plan_of(session, options)
    assert (plan.scans_in, plan.scans_out, plan.scans_with_pose) == (9, 9, 8)
    notices = "\n".join(plan.notices)
    assert "1 of 9 scans have no file in semantic_label/ (first: 0000003.npy)" in notices
    assert "1 of 9 scans have no file in positions/ (first: 0000000.npy)" in notices
    assert "6 files belong to no scan" in notices
    assert "lists: 1 files are listed and do not exist (first: 0000009.npy)" in notices
    arrays = blocks_of(session, options)
    assert (arrays["scans/labels"][3] == 255).all()
    assert np.isnan(arrays["poses/initial"][0]).all()
    assert len(arrays["scans/ranges"]) == 9


def test_fields_that_are_not_there_are_left_out(session, options):
    for name in ("semantic_label", "positions", "velocities", "intensities_lidar", "line_segments"):
        shutil.rmtree(session / name)
    plan = plan_of(session, options)
    assert {"no semantic_label/", "no positions/"} <= set(plan.notices)
    assert (plan.pose_source, plan.scans_with_pose) == ("none", 0)
    named = {n for n in blocks_of(session, options) if not n.startswith("original/")}
    assert named == {"scans/ranges", "scans/stamps_ns"}


def test_scans_without_a_pose_are_dropped_on_request(session, options):
    save(session / "positions" / "0000002.npy", np.array([np.nan, 0, 0]))
    (session / "positions" / "0000004.npy").unlink()
    given = replace(options, drop_without_pose=True)
    plan = plan_of(session, given)
    assert (plan.scans_in, plan.scans_out, len(plan.members)) == (10, 8, 8)
    arrays = blocks_of(session, given)
    kept = [0, 1, 3, 5, 6, 7, 8, 9]
    assert (arrays["scans/stamps_ns"] // 50_000_000).tolist() == kept
    np.testing.assert_array_equal(
        arrays["scans/labels"], np.array(field(session, "semantic_label"))[kept]
    )
    shutil.rmtree(session / "positions")
    with pytest.raises(RecordingError, match="no scan has a pose"):
        plan_of(session, given)


def test_scans_of_another_shape_are_taken_and_of_another_number_left_empty(session, options):
    save(session / "scans_lidar" / "0000001.npy", np.ones((1, BEAMS), np.float32))
    save(session / "scans_lidar" / "0000002.npy", np.ones(BEAMS + 1, np.float32))
    plan = plan_of(session, options)
    assert any(text.startswith("1 scan files do not hold 7 values") for text in plan.notices)
    ranges = blocks_of(session, options)["scans/ranges"]
    assert (ranges[1] == 1).all()
    assert np.isnan(ranges[2]).all()


@pytest.mark.parametrize("name", ["scans_lidar", "semantic_label", "positions"])
def test_a_damaged_file_is_refused_by_name(session, options, name):
    file = session / name / "0000005.npy"
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(RecordingError, match=rf"{name}/0000005\.npy: truncated"):
        blocks_of(session, options)


def test_pickled_objects_are_refused_by_name(session, options):
    np.save(session / "sub_goals", 0)
    (session / "extra").mkdir()
    np.save(session / "extra" / "0000000.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(RecordingError, match=r"extra/0000000\.npy: holds pickled Python objects"):
        blocks_of(session, options)


def test_a_tree_without_sessions_is_refused(tmp_path):
    (tmp_path / "scans").mkdir()
    with pytest.raises(RecordingError, match=r"expected folders with scans_lidar/\*\.npy"):
        ReleaseSource(tmp_path)


def test_files_are_those_that_are_read(session, tmp_path):
    with ReleaseSource(session) as source:
        assert sorted(source.files()) == sorted(p for p in session.rglob("*") if p.is_file())
    archive = pack_zip(session, tmp_path / "x.zip")
    with ReleaseSource(archive, open_tree(archive)) as source:
        assert list(source.files()) == [archive]


def test_blocks_are_bounded_where_files_are_large(session, options, monkeypatch):
    monkeypatch.setattr(session_blocks, "_BLOCK_BYTES", 2500)
    whole = blocks_of(session, options)
    with ReleaseSource(session) as source:
        (plan,) = source.plans(options)
        sizes = [len(b["scans/ranges"]) for b in plan.blocks() if "scans/ranges" in b]
    assert max(sizes) < 10
    assert sum(sizes) == 10
    monkeypatch.undo()
    for name, rows in blocks_of(session, options).items():
        np.testing.assert_array_equal(rows, whole[name])


def test_a_file_too_large_to_be_kept_is_named(session, options, monkeypatch):
    (session / "drive.bag").write_bytes(bytes(1000))
    assert "original/kept.bytes" in blocks_of(session, options)
    monkeypatch.setattr(session_blocks, "MAX_KEPT_BYTES", 999)
    monkeypatch.setattr("conversion.layouts.release.MAX_KEPT_BYTES", 999)
    assert (
        "1 files are too large to be kept (first: drive.bag)" in plan_of(session, options).notices
    )
    kept = blocks_of(session, options)["original/kept.names"].tobytes()
    assert b"drive.bag" not in kept
    assert b"train.txt" in kept
