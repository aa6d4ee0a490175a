"""Counting what is wrong in a release."""

import json
import zipfile

import numpy as np
import pytest

from conversion.layouts.audit import audit
from conversion.layouts.session_audit import EXPLANATIONS
from semantic2d_dataset.errors import RecordingError
from tests.conversion.releases import (
    SESSIONS,
    make_release,
    make_session,
    pack_tar,
    pack_zip,
    save,
)

BEAMS = 7
FIRST = SESSIONS[0]


@pytest.fixture
def release(tmp_path):
    return make_release(tmp_path / "release", scans=6, beams=BEAMS, more=True)


def change(path, values):
    """Overwrite the first values of an array."""
    array = np.load(path, allow_pickle=False)
    array[: len(values)] = values
    np.save(path, array)


def counts(found):
    return {kind: total["count"] for kind, total in found.totals.items()}


def test_a_good_release_has_no_problems(release, tmp_path):
    for path in (release, release / FIRST, pack_zip(release, tmp_path / "a.zip")):
        found = audit(path)
        assert (found.problems, found.totals) == (0, {})
        assert "nothing is wrong with it" in str(found)
    assert [each.scans for each in found.sessions] == [6, 6]
    assert found.sessions[0].session == f"release/{FIRST}"
    assert found.sessions[0].files["valid_mask_lidar"] == 6


def test_person_on_beams_without_return_is_counted(release):
    change(release / FIRST / "scans_lidar" / "0000002.npy", [0, 0, 0, 5])
    change(release / FIRST / "semantic_label" / "0000002.npy", [4, 4, 1, 4])
    found = audit(release)
    assert counts(found) == {"person without return": 2}
    assert found.totals["person without return"]["example"] == (
        f"{FIRST}/semantic_label/0000002.npy"
    )
    assert [each.problems for each in found.sessions] == [2, 0]


def test_labels_that_are_no_classes_are_counted(release):
    change(release / FIRST / "semantic_label" / "0000001.npy", [10, -1, 255, 2.5, np.nan, 12.5])
    change(release / FIRST / "semantic_label" / "0000004.npy", [0.5])
    assert counts(audit(release)) == {"label outside 0..9": 4, "label not an integer": 3}


def test_ranges_and_values_that_are_no_numbers_are_counted(release):
    change(release / FIRST / "scans_lidar" / "0000001.npy", [np.nan, np.inf, -np.inf, -1])
    change(release / FIRST / "positions" / "0000001.npy", [np.nan])
    change(release / FIRST / "intensities_lidar" / "0000001.npy", [np.inf])
    save(release / FIRST / "line_segments" / "0000001.npy", np.full((2, 4), np.nan))
    assert counts(audit(release)) == {
        "range not finite": 3,
        "range below 0": 1,
        "value not finite": 10,
    }


def test_shapes_and_dtypes_are_counted(release):
    save(release / FIRST / "scans_lidar" / "0000001.npy", np.ones((1, BEAMS)))
    save(release / FIRST / "semantic_label" / "0000001.npy", np.ones(BEAMS + 1))
    save(release / FIRST / "velocities" / "0000001.npy", np.ones(3))
    save(release / FIRST / "line_segments" / "0000001.npy", np.ones((4, 3)))
    save(release / FIRST / "positions" / "0000001.npy", np.array(["a", "b", "c"]))
    save(release / FIRST / "intensities_lidar" / "0000001.npy", np.ones(BEAMS, np.complex64))
    assert counts(audit(release)) == {"wrong shape": 4, "wrong dtype": 2}


def test_values_of_an_odd_shape_are_checked_all_the_same(release):
    save(release / FIRST / "scans_lidar" / "0000001.npy", np.zeros((1, BEAMS)))
    save(release / FIRST / "semantic_label" / "0000001.npy", np.full((BEAMS, 1), 4))
    assert counts(audit(release)) == {"wrong shape": 2, "person without return": BEAMS}


def test_fields_of_different_length_are_counted(release):
    (release / FIRST / "semantic_label" / "0000001.npy").unlink()
    (release / FIRST / "valid_mask_lidar" / "0000001.npy").unlink()
    save(release / FIRST / "positions" / "9999999.npy", np.ones(3))
    found = audit(release)
    assert counts(found) == {"missing file": 2, "file without scan": 1}
    assert {each.where for each in found.all_findings} == {
        "semantic_label",
        "valid_mask_lidar",
        "positions",
    }


def test_lists_are_checked(release):
    first = release / FIRST
    names = [f"{n:07d}.npy" for n in range(6)]
    (first / "train.txt").write_text("\n".join([*names[:3], names[0], "gone.npy"]))
    (first / "dev.txt").write_text(names[2])
    (first / "test.txt").unlink()
    assert counts(audit(release)) == {
        "list not there": 1,
        "scan in several lists": 1,
        "scan in no list": 3,
        "listed file not there": 1,
        "file listed twice": 1,
    }


def test_dataset_txt_is_checked(release):
    (release / "dataset.txt").write_text(f"{FIRST}\n2024-gone\n")
    assert counts(audit(release)) == {"listed session not there": 1, "session not listed": 1}
    assert audit(release / FIRST).problems == 0


def test_a_badly_damaged_release_is_gone_through_to_its_end(release):
    first = release / FIRST
    for n in range(5):
        (first / "scans_lidar" / f"{n:07d}.npy").write_bytes(b"\x93NUMPY" if n else b"")
    file = first / "semantic_label" / "0000000.npy"
    file.write_bytes(file.read_bytes()[:-3])
    np.save(first / "positions" / "0000001.npy", np.array([None]), allow_pickle=True)
    np.save(first / "sub_goals_local" / "0000001.npy", np.array([None]), allow_pickle=True)
    change(first / "semantic_label" / "0000005.npy", [99])
    found = audit(release)
    assert counts(found) == {"unreadable file": 8, "label outside 0..9": 1}
    assert found.sessions[0].beams == BEAMS


def test_a_session_of_which_nothing_can_be_read_is_told(tmp_path):
    make_session(tmp_path / "a", scans=2, beams=BEAMS)
    for file in (tmp_path / "a").rglob("*.npy"):
        file.write_bytes(b"nothing")
    found = audit(tmp_path)
    assert counts(found) == {"unreadable file": 12}
    assert (found.sessions[0].beams, found.sessions[0].lidar) == (0, None)
    assert "unknown" in str(found)


def test_damaged_members_of_an_archive_are_counted(release, tmp_path):
    path = pack_zip(release, tmp_path / "a.zip")
    with zipfile.ZipFile(path) as archive:
        places = [
            archive.getinfo(f"release/{FIRST}/{name}").header_offset
            for name in ("scans_lidar/0000001.npy", "train.txt")
        ]
        places.append(archive.getinfo("release/dataset.txt").header_offset)
    content = bytearray(path.read_bytes())
    for place in places:
        content[place : place + 4] = b"gone"
    path.write_bytes(content)
    assert counts(audit(path)) == {"unreadable file": 3}


def test_links_are_told_and_are_no_problem(release):
    (release / FIRST / "link.npy").symlink_to(release)
    found = audit(release)
    assert (found.problems, found.notes) == (0, ("not read: 1 links",))
    assert "not read: 1 links" in str(found)


def test_lidars_are_recognised(tmp_path):
    make_session(tmp_path / "a", scans=1)
    assert audit(tmp_path).sessions[0].lidar == "hokuyo-utm-30lx-ew"


def test_the_text_explains_every_kind_with_an_example(release):
    change(release / FIRST / "semantic_label" / "0000001.npy", [10])
    change(release / SESSIONS[1] / "semantic_label" / "0000003.npy", [11, 12])
    lines = str(audit(release)).splitlines()
    assert lines[0] == f"{release}: 2 sessions, 12 scans"
    assert lines[2].split() == ["session", "scans", "beams", "lidar", "problems"]
    assert lines[3].split() == [FIRST, "6", "7", "unknown", "1"]
    at = next(n for n, line in enumerate(lines) if "label outside" in line)
    assert lines[at].strip() == f"3 x label outside 0..9: {EXPLANATIONS['label outside 0..9']}"
    assert lines[at + 1].strip() == (
        f"3 in semantic_label, first {FIRST}/semantic_label/0000001.npy"
    )


def test_the_dictionary_is_plain_json(release, tmp_path):
    change(release / FIRST / "semantic_label" / "0000001.npy", [10])
    found = audit(pack_tar(release, tmp_path / "a.tar.gz"))
    said = json.loads(json.dumps(found.as_dict()))
    assert said["problems"] == 1
    assert said["sessions"][0]["findings"] == [
        {
            "kind": "label outside 0..9",
            "where": "semantic_label",
            "count": 1,
            "example": f"release/{FIRST}/semantic_label/0000001.npy",
        }
    ]


def test_large_sessions_are_read_by_blocks(release, monkeypatch):
    change(release / FIRST / "semantic_label" / "0000001.npy", [10])
    change(release / FIRST / "semantic_label" / "0000005.npy", [10])
    monkeypatch.setattr("conversion.layouts.session_audit._BLOCK_VALUES", 2 * BEAMS)
    assert counts(audit(release)) == {"label outside 0..9": 2}


def test_what_holds_no_session_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="found none"):
        audit(tmp_path)
    with pytest.raises(FileNotFoundError):
        audit(tmp_path / "nothing")
