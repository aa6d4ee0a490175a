"""``SHA256SUMS``: digests of all files of a data set, for ``sha256sum -c`` and for people."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from semantic2d_dataset.errors import ChecksumError
from semantic2d_dataset.format.writing import write_text_atomically

CHECKSUMS_NAME = "SHA256SUMS"


def size_and_digest(path: Path) -> tuple[int, str]:
    """Return the size of a file in bytes and its SHA-256, hex."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return path.stat().st_size, digest


def write_checksums(folder: Path, digests: Mapping[str, str]) -> None:
    """Write ``SHA256SUMS`` into a folder: SHA-256 by relative file name."""
    write_text_atomically(folder / CHECKSUMS_NAME, _text(digests))


def check_checksums(folder: Path, digests: Mapping[str, str]) -> None:
    """Check that ``SHA256SUMS``, where a folder has it, lists these files and digests.

    Raises
    ------
    ChecksumError
        If it lists others.
    """
    path = folder / CHECKSUMS_NAME
    if path.is_file() and path.read_bytes() != _text(digests).encode():
        raise ChecksumError(
            f"{path}: lists other files or digests than the manifest; get it again, or make it "
            "again with: semantic2d release"
        )


def _text(digests: Mapping[str, str]) -> str:
    return "".join(f"{digest}  {file}\n" for file, digest in sorted(digests.items()))
