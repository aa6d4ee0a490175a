"""Zip archives that are damaged, or made to do harm."""

import random
import stat
import struct
import zipfile

import pytest

from conversion.layouts import members
from conversion.layouts.trees import open_tree
from semantic2d_dataset.errors import RecordingError
from tests.conversion.layouts.test_trees import FILES, pack


def write(path, entries):
    """Write members as given: (ZipInfo or name, bytes)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for info, content in entries:
            archive.writestr(info, content)
    return path


def read_all(path):
    with open_tree(path) as tree:
        return {name: tree.read(name) for name in tree.names}


def test_names_that_lead_outside_are_ignored_and_counted(tmp_path):
    bad = ["../evil.npy", "/etc/evil.npy", "a/../../evil.npy", "C:\\evil.npy", "..\\evil.npy"]
    path = write(tmp_path / "x.zip", [(name, b"evil") for name in bad] + [("./a//b.npy", b"b")])
    with open_tree(path) as tree:
        assert tree.names == ("a/b.npy",)
        assert tree.read("a/b.npy") == b"b"
        assert tree.notices == ("not read: 5 names that lead out of it",)


def test_links_are_ignored_and_counted(tmp_path):
    info = zipfile.ZipInfo("a.npy")
    info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    with open_tree(write(tmp_path / "x.zip", [(info, b"/etc/passwd"), ("b.npy", b"")])) as tree:
        assert tree.names == ("b.npy",)
        assert tree.notices == ("not read: 1 links",)


def test_an_encrypted_archive_is_refused_with_advice(tmp_path):
    path = pack(tmp_path / "x.zip", {"a.npy": b"a"})
    content = bytearray(path.read_bytes())
    content[content.rfind(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.npy: is encrypted: unpack it"):
        open_tree(path)


def test_other_ways_of_packing_are_refused_with_advice(tmp_path):
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("a.npy", b"a" * 100)
    with pytest.raises(RecordingError, match=r"a\.npy: is packed by method 12; .*unpack"):
        read_all(path)


def test_of_two_files_of_one_name_the_last_counts(tmp_path):
    with pytest.warns(UserWarning, match="Duplicate"):
        path = write(tmp_path / "x.zip", [("a", b"first"), ("b", b"b"), ("a", b"last")])
    assert read_all(path) == {"a": b"last", "b": b"b"}


def test_bytes_before_the_archive_are_allowed(tmp_path):
    path = pack(tmp_path / "x.zip")
    path.write_bytes(b"#!/bin/sh\n" * 9 + path.read_bytes())
    assert read_all(path) == FILES


def test_zip64_is_read(tmp_path):
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w") as archive, archive.open("a", "w", force_zip64=True) as file:
        file.write(b"content")
    assert read_all(path) == {"a": b"content"}


def test_a_directory_of_zip64_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 2)
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 20)
    path = pack(tmp_path / "x.zip")
    assert b"PK\x06\x06" in path.read_bytes()
    assert read_all(path) == FILES


def test_an_archive_cut_off_anywhere_is_refused(tmp_path):
    whole = pack(tmp_path / "x.zip").read_bytes()
    for length in range(0, len(whole), 7):
        cut = tmp_path / "cut.zip"
        cut.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match=r"cut\.zip: truncated or damaged"):
            open_tree(cut)


@pytest.mark.parametrize("stored", [True, False])
def test_any_flipped_byte_is_refused_or_harmless(tmp_path, stored):
    whole = pack(tmp_path / "x.zip", stored=stored).read_bytes()
    found = 0
    for at in range(len(whole)):
        bad = bytearray(whole)
        bad[at] ^= 0x41
        (tmp_path / "bad.zip").write_bytes(bad)
        try:
            read = read_all(tmp_path / "bad.zip")
        except RecordingError:
            found += 1
            continue
        # names, attributes and dates carry no checksum; contents do
        assert set(read.values()) <= set(FILES.values())
    assert found > len(whole) // 4


def test_random_bytes_give_only_our_error(tmp_path):
    rng = random.Random(0)
    whole = pack(tmp_path / "x.zip").read_bytes()
    for _ in range(200):
        bad = bytearray(whole)
        for _ in range(rng.randrange(1, 8)):
            bad[rng.randrange(len(bad))] = rng.randrange(256)
        (tmp_path / "bad.zip").write_bytes(bad)
        try:
            read_all(tmp_path / "bad.zip")
        except RecordingError as err:
            assert "bad.zip" in str(err)  # noqa: PT017


def test_members_that_overlap_are_refused(tmp_path):
    path = pack(tmp_path / "x.zip", {"a": bytes(range(256)), "b": b"b"}, stored=True)
    content = bytearray(path.read_bytes())
    second = content.rfind(b"PK\x01\x02")
    struct.pack_into("<I", content, second + 42, 10)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="overlap or lie outside it: refused as a bomb"):
        open_tree(path)


def test_a_member_that_unpacks_to_more_than_it_says_is_refused(tmp_path):
    path = pack(tmp_path / "x.zip", {"a": bytes(1 << 20)})
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, content.rfind(b"PK\x01\x02") + 24, 100)
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="a: damaged: its size or CRC do not fit"):
        read_all(path)


def test_a_member_that_is_too_large_is_left_out_and_counted(tmp_path):
    path = pack(tmp_path / "x.zip", {"a": b"a", "b": b"b"})
    content = bytearray(path.read_bytes())
    struct.pack_into("<I", content, content.rfind(b"PK\x01\x02") + 24, 1 << 30)
    path.write_bytes(content)
    with open_tree(path) as tree:
        assert tree.names == ("a",)
        assert tree.notices == ("not read: 1 files larger than 256 MiB",)


def test_what_unpacks_to_far_more_than_its_size_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(members, "RATIO_FROM_BYTES", 1000)
    monkeypatch.setattr(members, "MAX_RATIO", 100)
    path = pack(tmp_path / "x.zip", {"a": bytes(1 << 20)})
    with pytest.raises(RecordingError, match="more than 100 times its .* refused as a bomb"):
        open_tree(path)


def test_too_many_members_or_bytes_are_refused(tmp_path, monkeypatch):
    path = pack(tmp_path / "x.zip")
    with monkeypatch.context() as patch:
        patch.setattr(members, "MAX_TOTAL_BYTES", 1000)
        with pytest.raises(RecordingError, match="declares files of more than"):
            open_tree(path)
    monkeypatch.setattr(members, "MAX_MEMBERS", 3)
    with pytest.raises(RecordingError, match="holds more than 3 files"):
        open_tree(path)
