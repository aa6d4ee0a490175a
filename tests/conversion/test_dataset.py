from __future__ import annotations

import numpy as np
import pytest

from conversion.convert import Kept, convert_recording
from conversion.options import Options
from conversion.summary import Summary
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.manifest import find_problems
from tests.conversion.releases import SESSIONS, contents, make_release, make_session, small_lidar


@pytest.fixture
def small(tmp_path):
    return Options(lidar=small_lidar(tmp_path / "small.yaml"))


def members_of_lists(session, scans):
    """What the lists of a session say of each scan."""
    found = np.full(scans, 255)
    for split, name in enumerate(("train", "dev", "test")):
        for line in (session / f"{name}.txt").read_text().splitlines():
            found[int(line.split(".")[0])] = split
    return found.tolist()


def test_a_release_becomes_a_data_set_with_its_own_lists(tmp_path, small):
    release = make_release(tmp_path / "release", scans=20, beams=7)
    convert_recording(release, tmp_path / "data", small)
    assert find_problems(tmp_path / "data", full=True) == []
    data = open_dataset(str(tmp_path / "data"))
    assert sorted(data.manifest.splits) == ["block", "frame"]
    frame = data.scheme("frame")
    for entry in data.manifest.sequences:
        session = release / entry.id.split("--")[1]
        assert frame.membership[entry.id].tolist() == members_of_lists(session, 20)
        kept = contents(tmp_path / "data" / "splits" / "frame" / entry.id)
        assert kept == {
            f"{n}.txt": (session / f"{n}.txt").read_bytes() for n in ("train", "dev", "test")
        }


def test_another_session_joins_a_data_set_that_is_there(tmp_path, small):
    release = make_release(tmp_path / "release", scans=12, beams=7)
    convert_recording(release, tmp_path / "data", small)
    more = make_session(tmp_path / "more" / "2024-05-01", scans=10, beams=7, seed=9)
    convert_recording(more, tmp_path / "data", small)
    assert find_problems(tmp_path / "data", full=True) == []
    data = open_dataset(str(tmp_path / "data"))
    sizes = sorted(len(ids) for ids in data.scheme("frame").membership.values())
    assert sizes == [10, 12, 12]
    assert all(set(ids.tolist()) == {0, 1, 2} for ids in data.scheme("frame").membership.values())


def test_what_is_missing_of_a_release_is_made_again_and_the_rest_kept(tmp_path, small):
    release = make_release(tmp_path / "release", scans=6, beams=7)
    first = convert_recording(release, tmp_path / "data", small)
    (tmp_path / "data" / "dataset.json").unlink()
    path = next((tmp_path / "data" / "sequences").glob(f"*{SESSIONS[1]}*"))
    path.unlink()
    again = convert_recording(release, tmp_path / "data", small)
    assert [type(result) for result in again] == [Kept, Summary]
    assert [result.sequence_id for result in again] == [result.sequence_id for result in first]
    assert find_problems(tmp_path / "data", full=True) == []


def test_a_release_needs_a_folder(tmp_path, small):
    release = make_release(tmp_path / "release", scans=3, beams=7)
    with pytest.raises(InvalidInputError, match="becomes a data set: give a folder as --out"):
        convert_recording(release, tmp_path / "data.h5", small)
    assert not (tmp_path / "data.h5").exists()
