"""A registry that lies on a web server, kept for the time without a network."""

from __future__ import annotations

import hashlib
import ipaddress
import sys
from functools import cache
from pathlib import Path
from urllib.parse import urlsplit

from tqdm import tqdm

from semantic2d_dataset.access.places import home, is_offline
from semantic2d_dataset.access.web import get_body, new_session
from semantic2d_dataset.errors import DownloadError, InvalidInputError, OfflineError
from semantic2d_dataset.format.writing import write_bytes_atomically

_LONGEST = 1 << 22


def fetch_registry(url: str) -> bytes:
    """Get a registry; as it was last seen where no host may be asked, or none answers.

    A process asks once.

    Raises
    ------
    InvalidInputError
        If the URL is neither https, nor http on this machine.
    DownloadError, OfflineError
        If it cannot be had, and was not before.
    """
    _check_url(url)
    kept = _place(url)
    if is_offline():
        if not kept.is_file():
            raise OfflineError(f"{url}: offline, and this registry is not here; use a file instead")
        return kept.read_bytes()
    try:
        return _fetch(url)
    except DownloadError as err:
        if not kept.is_file():
            raise
        tqdm.write(f"{err}; this registry is used as it was last seen", file=sys.stderr)
        return kept.read_bytes()


def forget() -> None:
    """Ask hosts again."""
    _fetch.cache_clear()


@cache
def _fetch(url: str) -> bytes:
    with new_session() as session:
        return get_body(session, url, _LONGEST)


def keep_registry(url: str, text: bytes) -> None:
    """Keep a registry that was read well."""
    kept = _place(url)
    if not kept.is_file() or kept.read_bytes() != text:
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_bytes_atomically(kept, text)


def _place(url: str) -> Path:
    return home() / "registries" / f"{hashlib.sha256(url.encode()).hexdigest()[:16]}.json"


def _check_url(url: str) -> None:
    parts = urlsplit(url)
    if parts.scheme == "https" or (parts.scheme == "http" and _is_here(parts.hostname or "")):
        return
    raise InvalidInputError(
        f"{url}: a registry says what is trusted, so it comes by https, or by http from this "
        "machine, or is a file"
    )


def _is_here(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
