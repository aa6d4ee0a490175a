"""Getting the predictions that entries point to: from few hosts, of few bytes, of one digest."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

import requests
from tqdm import tqdm

from leaderboard.entries import Entry, file_digest
from semantic2d_dataset.access.web import new_session, open_url, persist
from semantic2d_dataset.errors import ChecksumError, DownloadError, InvalidInputError
from semantic2d_dataset.format.writing import write_bytes_atomically


def fetch_predictions(
    entry: Entry, folder: Path, *, most_bytes: int, hosts: Sequence[str] = ()
) -> Path | None:
    """Get the predictions of an entry into a folder, named by their digest.

    Parameters
    ----------
    entry
        The entry.
    folder
        Where to put the file.
    most_bytes
        Larger ones are not read on.
    hosts
        The only ones that may be asked; any where there are none.

    Returns
    -------
    Path or None
        The file; None where the entry points nowhere.

    Raises
    ------
    InvalidInputError
        If the host is not one of those, or the address is none.
    DownloadError
        If the file cannot be had, or is too large.
    ChecksumError
        If it is not the file that was scored, or another one has its place in the folder.
    """
    url = entry.said.get("predictions_url")
    if url is None:
        return None
    path = folder / f"{entry.digest}.h5"
    if path.exists():
        if not path.is_file() or file_digest(path) != entry.digest:
            raise ChecksumError(f"{path}: is not the file that its name says; remove it")
        return path
    asked, host = _address_of(entry, url)
    if hosts and host not in hosts:
        raise InvalidInputError(
            f"{entry.path}: predictions_url: {host} is none of {', '.join(hosts)}"
        )
    with new_session() as session:
        content = persist(lambda: _get(session, asked, most_bytes))
    found = hashlib.sha256(content).hexdigest()
    if found != entry.digest:
        raise ChecksumError(
            f"{entry.path}: digests.predictions: expected {entry.digest}, and {url} has {found}"
        )
    write_bytes_atomically(path, content)
    return path


def _address_of(entry: Entry, url: str) -> tuple[str, str]:
    r"""Return the address that will really be asked, and its host.

    Parsers differ in what the host of ``https://one\@other/`` is.
    """
    try:
        asked = str(requests.Request("GET", url).prepare().url)
    except (requests.RequestException, ValueError) as err:
        raise InvalidInputError(f"{entry.path}: predictions_url: {err}") from err
    return asked, urlsplit(asked).hostname or ""


def _get(session: requests.Session, url: str, most_bytes: int) -> bytes:
    content = bytearray()
    with (
        open_url(session, url) as response,
        tqdm(desc=url, unit="B", unit_scale=True, disable=None, leave=False) as bar,
    ):
        for chunk in response.iter_content(1 << 16):
            content += chunk
            bar.update(len(chunk))
            if len(content) > most_bytes:
                raise DownloadError(f"{url}: larger than the {most_bytes} bytes that are allowed")
    return bytes(content)
