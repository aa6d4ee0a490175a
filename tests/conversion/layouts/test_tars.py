"""Tar archives that are damaged, or made to do harm."""

import io
import shutil
import subprocess
import tarfile

import pytest

from conversion.layouts import members, tars
from conversion.layouts.trees import open_tree
from semantic2d_dataset.errors import RecordingError
from tests.conversion.layouts.test_trees import FILES, pack, put


def read_all(path):
    with open_tree(path) as tree:
        return {name: tree.read(name) for name in tree.names}


def write(path, entries):
    """Write members as given: TarInfo with its bytes."""
    with tarfile.open(path, "w") as archive:
        for info, content in entries:
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return path


@pytest.mark.parametrize("style", [tarfile.GNU_FORMAT, tarfile.PAX_FORMAT, tarfile.USTAR_FORMAT])
@pytest.mark.parametrize("ending", ["tar", "tar.gz"])
def test_long_and_foreign_names_are_read(tmp_path, style, ending):
    deep = "folder/" * 20 + "0.npy"
    files = {deep: b"deep", "b/y.npy": b"y"}
    if style != tarfile.USTAR_FORMAT:
        files |= {"ü" * 120 + ".npy": b"wide"}
    assert read_all(pack(tmp_path / f"x.{ending}", files, format=style)) == files


@pytest.mark.parametrize(
    "how", [["--format=gnu"], ["--format=pax"], ["--format=v7"], ["--format=oldgnu"]]
)
def test_what_the_tar_command_writes_is_read(tmp_path, how):
    if shutil.which("tar") is None:
        pytest.skip("there is no tar command here")
    put(tmp_path / "release")
    path = tmp_path / "x.tar"
    subprocess.run(["tar", *how, "-cf", path, "-C", tmp_path / "release", "."], check=True)
    assert read_all(path) == FILES


def test_entries_that_are_no_files_are_ignored_and_counted(tmp_path):
    entries = []
    for name, kind in (
        ("folder", tarfile.DIRTYPE),
        ("link", tarfile.SYMTYPE),
        ("hard", tarfile.LNKTYPE),
        ("device", tarfile.CHRTYPE),
        ("pipe", tarfile.FIFOTYPE),
    ):
        info = tarfile.TarInfo(name)
        info.type, info.linkname = kind, "/etc/passwd"
        entries.append((info, b""))
    outside = [tarfile.TarInfo(name) for name in ("../evil", "/evil", "a/../../evil")]
    entries += [(info, b"evil") for info in outside] + [(tarfile.TarInfo("a"), b"a")]
    with open_tree(write(tmp_path / "x.tar", entries)) as tree:
        assert tree.names == ("a",)
        assert tree.read("a") == b"a"
        assert tree.notices == (
            "not read: 2 links",
            "not read: 2 things that are neither files nor folders",
            "not read: 3 names that lead out of it",
        )


def test_a_sparse_file_is_not_taken_for_its_map(tmp_path):
    info = tarfile.TarInfo("GNUSparseFile.0/a")
    info.pax_headers = {"GNU.sparse.major": "1", "GNU.sparse.name": "a"}
    with open_tree(write(tmp_path / "x.tar", [(info, b"1\n0\n5\n")])) as tree:
        assert tree.names == ()
        assert tree.notices == ("not read: 1 things that are neither files nor folders",)


def test_of_two_files_of_one_name_the_last_counts(tmp_path):
    entries = [
        (tarfile.TarInfo(name), text) for name, text in (("a", b"1"), ("b", b"2"), ("a", b"3"))
    ]
    assert read_all(write(tmp_path / "x.tar", entries)) == {"a": b"3", "b": b"2"}


@pytest.mark.parametrize("ending", ["tar", "tar.gz", "tar.bz2", "tar.xz"])
def test_an_archive_cut_off_anywhere_is_refused(tmp_path, ending):
    whole = pack(tmp_path / f"x.{ending}").read_bytes()
    cut = tmp_path / f"cut.{ending}"
    # a plain tar ends at its first empty block; what follows only fills it up
    last = len(whole) if ending != "tar" else whole.rstrip(b"\0").__len__() + 1
    step = 64 if ending == "tar" else 3
    for length in range(0, last, step):
        cut.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=rf"cut\.{ending}: truncated or damaged"):
            open_tree(cut)


@pytest.mark.parametrize("ending", ["tar.gz", "tar.bz2", "tar.xz"])
def test_any_flipped_byte_of_a_packed_archive_is_refused_or_harmless(tmp_path, ending):
    whole = pack(tmp_path / f"x.{ending}").read_bytes()
    for at in range(0, len(whole), 3):
        bad = bytearray(whole)
        bad[at] ^= 0x41
        (tmp_path / f"bad.{ending}").write_bytes(bad)
        try:
            assert read_all(tmp_path / f"bad.{ending}") == FILES
        except RecordingError as err:
            assert "bad.tar" in str(err)  # noqa: PT017


def test_flipped_headers_of_a_plain_tar_are_refused(tmp_path):
    whole = pack(tmp_path / "x.tar", format=tarfile.USTAR_FORMAT).read_bytes()
    for at in range(0, 512, 3):
        bad = bytearray(whole)
        bad[at] ^= 0x41
        (tmp_path / "bad.tar").write_bytes(bad)
        with pytest.raises(RecordingError, match=r"bad\.tar: truncated or damaged"):
            open_tree(tmp_path / "bad.tar")


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(members, "RATIO_FROM_BYTES", 1 << 20)
    monkeypatch.setattr(members, "MAX_RATIO", 100)
    path = pack(tmp_path / "x.tar.xz", {"a": bytes(1 << 23)})
    with pytest.raises(RecordingError, match="refused as a bomb"):
        open_tree(path)


def test_a_file_that_is_too_large_is_left_out_of_the_tree_and_of_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(tars, "MAX_MEMBER_BYTES", 100)
    with open_tree(pack(tmp_path / "x.tar.gz", {"a": b"a", "b": bytes(101)})) as tree:
        assert tree.names == ("a",)
        assert tree.notices == ("not read: 1 files larger than 256 MiB",)


def test_a_disk_without_room_is_not_filled(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    with pytest.raises(RecordingError, match=r"only 1000 bytes are free: set TMPDIR"):
        open_tree(pack(tmp_path / "x.tar.gz"))


def test_a_name_of_absurd_length_is_refused(tmp_path):
    info = tarfile.TarInfo("././@LongLink")
    info.type = tarfile.GNUTYPE_LONGNAME
    with pytest.raises(RecordingError, match="a header of 2097152 bytes"):
        open_tree(write(tmp_path / "x.tar", [(info, bytes(1 << 21))]))
