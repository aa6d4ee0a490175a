from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from conversion.options import Options
from conversion.sources import find_recordings, open_source
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import KINDS, straight_drive
from tests.conversion.releases import make_release, make_session, pack_tar, pack_zip


def kind_of(path: Path, **options) -> str:
    with open_source([path], Options(**options)) as source:
        return source.kind


@pytest.mark.parametrize("kind", KINDS)
def test_bags_are_known_by_their_content(kind, tmp_path):
    path = straight_drive(kind).write(tmp_path)
    assert kind_of(path) == ("ROS 1 bag" if kind == "ros1" else "ROS 2 bag")
    if kind != "ros1":
        assert kind_of(path / "metadata.yaml") == "ROS 2 bag"
        (file,) = (each for each in path.iterdir() if each.suffix != ".yaml")
        assert kind_of(file) == "ROS 2 bag"


def test_the_published_layout_is_known_as_session_release_and_archive(tmp_path):
    session = make_session(tmp_path / "lobby" / "2024-04-04", scans=2, beams=8)
    release = make_release(tmp_path / "release", scans=2, beams=8)
    zipped = pack_zip(release, tmp_path / "release.zip")
    packed = pack_tar(release, tmp_path / "release.tar.gz")
    kinds = {kind_of(path) for path in (session, session.parent, release, zipped, packed)}
    assert kinds == {"published Semantic2D layout"}


def test_a_carmen_log_is_known_by_its_lines(tmp_path):
    path = tmp_path / "run.txt"
    path.write_text("# a log\nFLASER 3 1.0 2.0 3.0 0.0 0.0 0.0 0.0 0.0 0.0 1.5 host 0.5\n")
    assert "CARMEN" in kind_of(path)


def test_an_archive_of_bags_says_to_unpack_it(tmp_path):
    path = straight_drive("ros1").write(tmp_path)
    with zipfile.ZipFile(tmp_path / "drive.zip", "w") as archive:
        archive.write(path, "drive.bag")
    with pytest.raises(RecordingError, match=r"holds bags \(drive.bag\): unpack it"):
        kind_of(tmp_path / "drive.zip")


def test_a_folder_of_something_else_says_what_is_expected(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"\xff\xd8")
    with pytest.raises(RecordingError, match=r"holds no recording that is known.*found photo.jpg"):
        kind_of(tmp_path)


def test_nothing_there_is_file_not_found(tmp_path):
    with pytest.raises(FileNotFoundError):
        kind_of(tmp_path / "none.bag")


def test_a_folder_stands_for_the_bags_in_it(tmp_path):
    one = straight_drive("ros1").write(tmp_path, "one")
    two = straight_drive("mcap").write(tmp_path, "two")
    assert sorted(find_recordings([tmp_path])) == [(one,), (two,)]
    assert find_recordings([two, one]) == [(two,), (one,)]


def test_a_layout_is_one_recording(tmp_path):
    release = make_release(tmp_path / "release", scans=2, beams=8)
    assert find_recordings([release]) == [(release,)]
