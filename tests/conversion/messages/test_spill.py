from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest

from conversion.messages.spill import Spill
from conversion.temporary import temporary_folder


@pytest.mark.parametrize("in_memory", [10, 10**6])
def test_what_was_kept_is_found_again(in_memory, monkeypatch):
    monkeypatch.setattr("conversion.messages.spill._IN_MEMORY", in_memory)
    spill = Spill()
    pieces = [bytes([n]) * (n % 7) for n in range(200)]
    places = [spill.append(piece) for piece in pieces[:100]]
    assert spill.read(places[50], len(pieces[50])) == pieces[50]
    places += [spill.append(piece) for piece in pieces[100:]]
    for at, piece in zip(places, pieces, strict=True):
        assert spill.read(at, len(piece)) == piece


def test_the_file_has_no_name_and_vanishes(tmp_path, monkeypatch):
    monkeypatch.setattr("conversion.messages.spill._IN_MEMORY", 10)
    monkeypatch.setattr("conversion.messages.spill.temporary_folder", lambda: str(tmp_path))
    spill = Spill()
    spill.append(bytes(100))
    assert list(tmp_path.iterdir()) == []
    open_files = len(list(Path("/proc/self/fd").iterdir()))
    del spill
    gc.collect()
    assert len(list(Path("/proc/self/fd").iterdir())) == open_files - 1


def test_large_files_go_to_disk_unless_the_user_says_where(monkeypatch):
    monkeypatch.setenv("TMPDIR", "/somewhere")
    assert temporary_folder() is None
    monkeypatch.delenv("TMPDIR")
    expected = "/var/tmp" if os.access("/var/tmp", os.W_OK) else None
    assert temporary_folder() == expected
