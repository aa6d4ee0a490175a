"""What is sent to the viewer, read back from the recording that it would show."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from semantic2d_dataset import viewing
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, WriteError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.geometry import to_base, to_points
from semantic2d_dataset.viewing import view_sequence
from tests.generators import SMALL_LIDAR, make_sequence

SCANS = 150


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "sequence.h5"
    return path, make_sequence(path, SCANS)


@pytest.fixture
def rerun():
    return pytest.importorskip("rerun", reason="needs the extra 'view'")


def rows_of(recording, entity):
    """The columns of an entity over time, each a list of rows, by the end of its name."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(recording).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            for name, column in chunk.to_record_batch().to_pydict().items():
                found.setdefault(name.split(":")[-1], []).extend(column)
    return found


def static_entities(recording):
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(recording).stream() if chunk.is_static}


def test_every_point_is_sent_with_its_class_and_time(sequence, rerun, tmp_path, monkeypatch):
    monkeypatch.setattr(viewing, "_BLOCK", 64)
    path, arrays = sequence
    assert view_sequence(path, save=tmp_path / "out.rrd") == SCANS
    scans = rows_of(tmp_path / "out.rrd", "/robot/scan")
    order = np.argsort(np.array(scans["stamp"], "datetime64[ns]"))
    stamps = np.array(scans["stamp"], "datetime64[ns]")[order]
    np.testing.assert_array_equal(stamps.astype(np.int64), arrays["scans/stamps_ns"])
    points = to_base(
        to_points(arrays["scans/ranges"], SMALL_LIDAR.bearings), SMALL_LIDAR.base_T_lidar
    )
    valid = SMALL_LIDAR.has_return(arrays["scans/ranges"])
    for i in range(SCANS):
        xyz = np.array(scans["positions"][order[i]])
        np.testing.assert_allclose(xyz[:, :2], points[i][valid[i]], atol=1e-5)
        ids = np.array(scans["class_ids"][order[i]])
        np.testing.assert_array_equal(ids, arrays["scans/labels"][i][valid[i]])


def test_poses_move_the_robot(sequence, rerun, tmp_path):
    path, arrays = sequence
    view_sequence(path, save=tmp_path / "out.rrd")
    robot = rows_of(tmp_path / "out.rrd", "/robot")
    places = np.array(robot["translation"], float)[:, 0]
    np.testing.assert_allclose(places[:, :2], arrays["poses/refined"][:, :2], atol=1e-5)
    x, y, z, w = np.array(robot["quaternion"], float)[:, 0].T
    yaw = 2 * np.arctan2(z, w)
    error = np.angle(np.exp(1j * (yaw - arrays["poses/refined"][:, 2])))
    np.testing.assert_allclose(error, 0, atol=1e-5)
    assert not x.any()
    assert not y.any()
    entities = {"/", "/map", "/poses/initial", "/poses/refined", "/robot", "/robot/scan"}
    assert entities <= static_entities(tmp_path / "out.rrd")


@pytest.mark.parametrize("every", [7, 100, 1000])
def test_thinning_keeps_one_scan_of_so_many(sequence, rerun, every, tmp_path, monkeypatch):
    monkeypatch.setattr(viewing, "_BLOCK", 32)
    path, arrays = sequence
    kept = np.arange(0, SCANS, every)
    assert view_sequence(path, every=every, save=tmp_path / "out.rrd") == len(kept)
    stamps = np.array(rows_of(tmp_path / "out.rrd", "/robot")["stamp"], "datetime64[ns]")
    expected = arrays["scans/stamps_ns"][kept]
    np.testing.assert_array_equal(np.sort(stamps.astype(np.int64)), expected)


def test_scans_without_a_pose_are_left_out_unless_none_has_one(rerun, tmp_path, monkeypatch):
    lost = tmp_path / "lost.h5"
    make_sequence(lost, 20, drop=("poses/initial", "poses/refined", "scans/labels"))
    assert view_sequence(lost, save=tmp_path / "lost.rrd") == 20
    assert not np.array(rows_of(tmp_path / "lost.rrd", "/robot")["translation"]).any()
    read = SequenceReader.read_poses

    def forget(reader, *rows):
        poses = read(reader, *rows)
        poses[3:5] = np.nan
        return poses

    make_sequence(tmp_path / "some.h5", 20)
    monkeypatch.setattr(SequenceReader, "read_poses", forget)
    assert view_sequence(tmp_path / "some.h5", save=tmp_path / "some.rrd") == 18


def test_what_fails_leaves_no_recording(sequence, rerun, tmp_path, monkeypatch):
    with pytest.raises(WriteError, match="does not exist"):
        view_sequence(sequence[0], save=tmp_path / "none" / "out.rrd")

    def fail(*_arguments, **_options):
        raise CorruptFileError("damaged")

    (tmp_path / "out.rrd").write_bytes(b"old")
    monkeypatch.setattr(SequenceReader, "batch", fail)
    with pytest.raises(CorruptFileError):
        view_sequence(sequence[0], save=tmp_path / "out.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["out.rrd"]
    assert (tmp_path / "out.rrd").read_bytes() == b"old"


def test_a_full_disk_is_told_before_it_is_full(sequence, rerun, tmp_path, monkeypatch):
    left = iter((1 << 30, 1 << 30, 1 << 20))
    monkeypatch.setattr(viewing, "_BLOCK", 64)
    monkeypatch.setattr(viewing.shutil, "disk_usage", lambda _: SimpleNamespace(free=next(left)))
    with pytest.raises(WriteError, match="out.rrd: the disk is full: 1048576 bytes are free"):
        view_sequence(sequence[0], save=tmp_path / "out.rrd")
    assert not list(tmp_path.iterdir())


def test_the_viewer_is_opened_where_nothing_is_saved(sequence, rerun, monkeypatch):
    opened = []
    spawn = staticmethod(lambda **options: opened.append(options))
    monkeypatch.setattr(rerun.RecordingStream, "spawn", spawn)
    assert view_sequence(sequence[0], every=50) == 3
    assert list(opened[0]) == ["default_blueprint"]


def test_a_viewer_that_does_not_open_is_an_error(sequence, rerun, monkeypatch):
    def fail(**_options):
        raise RuntimeError("no such program\nlong advice")

    monkeypatch.setattr(rerun.RecordingStream, "spawn", staticmethod(fail))
    with pytest.raises(InvalidInputError, match=r"does not open \(no such program\); --save"):
        view_sequence(sequence[0])


def test_without_the_extra_the_error_says_how_to_get_it(sequence, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InvalidInputError, match=r"pip install 'semantic2d-dataset\[view\]'"):
        view_sequence(sequence[0])


def test_every_must_be_positive(sequence):
    with pytest.raises(InvalidInputError, match="expected at least 1, found 0"):
        view_sequence(sequence[0], every=0)
