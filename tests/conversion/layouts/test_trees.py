"""Folders and archives as trees of files."""

import io
import os
import tarfile
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from conversion.layouts.trees import is_archive, open_tree
from semantic2d_dataset.errors import RecordingError

FILES = {
    "a/scans_lidar/0000000.npy": b"zero",
    "a/scans_lidar/0000001.npy": b"one" * 500,
    "a/train.txt": b"0000000.npy\n",
    "a-b/train.txt": b"",
    "dataset.txt": b"a\na-b\n",
}
ENDINGS = ("folder", "zip", "tar", "tar.gz", "tgz", "tar.bz2", "tar.xz")


def put(folder: Path, files=FILES) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def pack(target: Path, files=FILES, *, stored=False, **options) -> Path:
    """Write files as a folder or an archive, by the ending of the name."""
    if "." not in target.name:
        return put(target, files)
    if target.suffix == ".zip":
        with zipfile.ZipFile(target, "w", 0 if stored else zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return target
    mode = {"tar": "w", "bz2": "w:bz2", "xz": "w:xz"}.get(target.suffix[1:], "w:gz")
    with tarfile.open(target, mode, **options) as archive:
        for name, content in files.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return target


@pytest.fixture(params=ENDINGS)
def tree_path(request, tmp_path):
    ending = "" if request.param == "folder" else f".{request.param}"
    return pack(tmp_path / f"release{ending}")


def test_every_kind_of_tree_gives_the_same_names_and_bytes(tree_path):
    with open_tree(tree_path) as tree:
        assert tree.names == tuple(sorted(FILES))
        assert {name: tree.read(name) for name in tree.names} == FILES
        assert {name: tree.size(name) for name in tree.names} == {
            name: len(content) for name, content in FILES.items()
        }
        assert tree.notices == ()


def test_a_folder_of_a_tree_ends_where_its_name_does(tree_path):
    with open_tree(tree_path) as tree:
        assert tree.under("a") == tuple(sorted(name for name in FILES if name.startswith("a/")))
        assert tree.under("a/scans") == ()
        assert tree.under("") == tree.names


def test_a_file_that_is_not_there_is_named(tree_path):
    with open_tree(tree_path) as tree:
        assert "a/train.txt" in tree
        assert "a/train" not in tree
        with pytest.raises(RecordingError, match=r"release.*has no file a/train"):
            tree.read("a/train")


def test_nothing_is_left_beside_an_archive(tree_path):
    with open_tree(tree_path) as tree:
        tree.read("a/train.txt")
        assert list(tree_path.parent.iterdir()) == [tree_path]
    assert list(tree_path.parent.iterdir()) == [tree_path]


def test_files_are_those_on_disk(tree_path):
    with open_tree(tree_path) as tree:
        files = tree.files()
    if tree_path.is_dir():
        assert list(files) == [tree_path / name for name in sorted(FILES)]
        assert list(files[1:3]) == list(files)[1:3]
    else:
        assert list(files) == [tree_path]


@pytest.mark.parametrize("ending", ["", ".zip", ".tar", ".tar.gz"])
def test_many_files_come_in_the_order_asked_for(tmp_path, ending):
    files = {f"s/{i:04d}.npy": b"%d" % i * (i % 7) for i in range(300)}
    with open_tree(pack(tmp_path / f"release{ending}", files)) as tree:
        wanted = list(reversed(tree.names))
        assert tree.read_many(wanted) == [files[name] for name in wanted]
        with pytest.raises(RecordingError, match="has no file s/none"):
            tree.read_many([*wanted, "s/none"])


def test_an_array_is_read(tmp_path):
    stream = io.BytesIO()
    values = np.arange(12.0).reshape(3, 4)
    np.save(stream, values)
    with open_tree(pack(tmp_path / "x.zip", {"a.npy": stream.getvalue()})) as tree:
        np.testing.assert_array_equal(tree.read_array("a.npy"), values)


def test_a_cut_off_array_is_refused_with_its_name(tmp_path):
    stream = io.BytesIO()
    np.save(stream, np.arange(12.0))
    folder = pack(tmp_path / "x", {"a.npy": stream.getvalue()[:-1]})
    match = r"a\.npy: truncated.*96 bytes, and 95 follow"
    with open_tree(folder) as tree, pytest.raises(RecordingError, match=match):
        tree.read_array("a.npy")


def test_pickled_objects_are_never_read(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with open_tree(tmp_path) as tree, pytest.raises(RecordingError, match=r"a\.npy: holds pickled"):
        tree.read_array("a.npy")


def test_links_in_a_folder_are_not_followed(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(b"secret")
    folder = put(tmp_path / "release", {"a.npy": b"a"})
    (folder / "b.npy").symlink_to(secret)
    (folder / "c").symlink_to(tmp_path)
    os.mkfifo(folder / "d.npy")
    with open_tree(folder) as tree:
        assert tree.names == ("a.npy",)
        assert tree.notices == (
            "not read: 2 links",
            "not read: 1 things that are neither files nor folders",
        )
        (folder / "a.npy").unlink()
        (folder / "a.npy").symlink_to(secret)
        with pytest.raises(OSError, match=r"a\.npy"):
            tree.read("a.npy")


def test_a_file_removed_meanwhile_is_named(tmp_path):
    folder = put(tmp_path / "release", {"a.npy": b"a"})
    with open_tree(folder) as tree:
        (folder / "a.npy").unlink()
        with pytest.raises(RecordingError, match=r"a\.npy: was removed"):
            tree.read("a.npy")


def test_a_huge_file_of_a_folder_is_refused_before_it_is_read(tmp_path):
    with (tmp_path / "a.npy").open("wb") as file:
        file.truncate(1 << 40)
    with open_tree(tmp_path) as tree, pytest.raises(RecordingError, match="at most 268435456"):
        tree.read("a.npy")


@pytest.mark.parametrize("ending", ["", ".zip", ".tar"])
def test_what_file_managers_leave_behind_is_left_out(tmp_path, ending):
    litter = {"__MACOSX/a/scans_lidar/._0.npy": b"", "a/.DS_Store": b"", "a/._b": b""}
    with open_tree(pack(tmp_path / f"release{ending}", FILES | litter)) as tree:
        assert tree.names == tuple(sorted(FILES))


def test_a_missing_path_is_reported_as_such(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing"):
        open_tree(tmp_path / "nothing")


def test_what_is_neither_folder_nor_archive_is_refused(tmp_path):
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" * 100)
    assert not is_archive(tmp_path / "a.bag")
    with pytest.raises(RecordingError, match=r"a\.bag: expected a folder, a \.zip"):
        open_tree(tmp_path / "a.bag")


def test_archives_are_told_by_content_or_by_name(tmp_path):
    for ending in ENDINGS[1:]:
        packed = pack(tmp_path / f"x.{ending}")
        assert is_archive(packed.rename(tmp_path / "no-ending"))
        empty = tmp_path / f"empty.{ending}"
        empty.touch()
        assert is_archive(empty)
        with pytest.raises(RecordingError, match="truncated or damaged"):
            open_tree(empty)


def test_a_packed_log_is_no_archive(shared_data):
    assert not is_archive(shared_data / "carmen" / "intel-corrected.log.gz")


def test_a_packed_tar_is_put_aside_where_one_says(tmp_path, monkeypatch):
    archive = pack(tmp_path / "x.tar.gz")
    asked = []
    make = tempfile.TemporaryFile
    monkeypatch.setattr(
        tempfile, "TemporaryFile", lambda **how: asked.append(Path(how["dir"])) or make(**how)
    )
    monkeypatch.delenv("TMPDIR", raising=False)
    own, other = tmp_path, tmp_path / "other"
    other.mkdir()
    with open_tree(archive), open_tree(archive, spool_dir=other):
        pass
    monkeypatch.setenv("TMPDIR", str(other))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with open_tree(archive):
        pass
    assert asked == [own, other, other]
