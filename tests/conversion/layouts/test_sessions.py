"""Session folders, found in a tree of files."""

import pytest

from conversion.layouts.sessions import check_listing, find_sessions, is_release
from conversion.layouts.trees import open_tree
from tests.conversion.layouts.test_trees import put
from tests.conversion.releases import SESSIONS, make_release, make_session, pack_zip

SMALL = {"scans": 2, "beams": 3}


def folders(path):
    with open_tree(path) as tree:
        return [session.folder for session in find_sessions(tree)]


def test_sessions_are_found_at_any_depth(tmp_path):
    release = make_release(tmp_path / "release", **SMALL)
    make_session(release / "more" / "hokuyo" / "2024-05-01", **SMALL)
    assert folders(release) == [*SESSIONS, "more/hokuyo/2024-05-01"]
    assert folders(release / "more") == ["hokuyo/2024-05-01"]
    assert folders(release / SESSIONS[0]) == [""]
    assert folders(pack_zip(release, tmp_path / "x.zip")) == [
        f"release/{name}" for name in (*SESSIONS, "more/hokuyo/2024-05-01")
    ]


@pytest.mark.parametrize(
    "name",
    [
        "scans_lidar.npy",
        "a/scans_lidar/0.txt",
        "a/scans_lidar/deeper/0.npy",
        "a/scans_lidar_old/0.npy",
        "a/my_scans_lidar/0.npy",
        "scans/0.npy",
    ],
)
def test_other_folders_are_no_sessions(tmp_path, name):
    put(tmp_path, {name: b""})
    assert folders(tmp_path) == []
    assert not is_release([name])


def test_a_session_in_a_session_is_one_of_its_own(tmp_path):
    make_session(tmp_path / "a", **SMALL)
    make_session(tmp_path / "a" / "b", **SMALL)
    with open_tree(tmp_path) as tree:
        outer, inner = find_sessions(tree)
        assert (outer.folder, inner.folder) == ("a", "a/b")
        assert not [name for name in outer.inside if name.startswith("b/")]
        assert set(inner.inside) < set(tree.names) | set(inner.inside)
        assert sorted(f"a/{name}" for name in outer.inside) + sorted(
            f"a/b/{name}" for name in inner.inside
        ) == sorted(tree.names, key=lambda name: (name.startswith("a/b/"), name))


def test_scans_come_in_the_order_of_their_numbers(tmp_path):
    names = ["0.npy", "1.npy", "2.npy", "10.npy", "100.npy", "extra.npy"]
    put(tmp_path, {f"scans_lidar/{name}": b"" for name in names})
    with open_tree(tmp_path) as tree:
        (session,) = find_sessions(tree)
        assert session.scans == tuple(names)


def test_only_folders_of_arrays_are_fields(tmp_path):
    put(
        tmp_path,
        {
            "scans_lidar/0.npy": b"",
            "scans_lidar/notes.txt": b"",
            "positions/0.npy": b"",
            "pictures/0.png": b"",
            "odd.name/0.npy": b"",
            "deep/er/0.npy": b"",
        },
    )
    with open_tree(tmp_path) as tree:
        assert set(find_sessions(tree)[0].files) == {"scans_lidar", "positions"}


def test_the_place_of_a_session_is_where_its_folders_lead(tmp_path):
    release = make_release(tmp_path / "lobby", sessions=SESSIONS[:1], **SMALL)
    archive = pack_zip(release, tmp_path / "Semantic2D.v2.zip")
    for path, place in (
        (release / SESSIONS[0], ("lobby", SESSIONS[0])),
        (release, (tmp_path.name, "lobby", SESSIONS[0])),
        (archive, (tmp_path.name, "Semantic2D.v2", "lobby", SESSIONS[0])),
    ):
        with open_tree(path) as tree:
            assert find_sessions(tree)[0].place == place


def test_dataset_txt_is_compared_with_what_is_there(tmp_path):
    release = make_release(tmp_path / "release", **SMALL)
    listed = f"# sessions\n{SESSIONS[0]}/\n2024-gone\nno dash here? ignored\n".replace("# s", "s")
    (release / "dataset.txt").write_text(listed)
    with open_tree(tmp_path) as tree:
        listing = check_listing(tree, find_sessions(tree))
    assert listing.missing == ("release/2024-gone",)
    assert listing.unlisted == (f"release/{SESSIONS[1]}",)
    assert len(listing.notices) == 2
