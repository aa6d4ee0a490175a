"""Requests that are polite to servers, patient with them, and believe little of what they say."""

from __future__ import annotations

import contextlib
import datetime
import email.utils
import random
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, TypeVar
from urllib.parse import urljoin, urlsplit

import requests
from tqdm import tqdm

import semantic2d_dataset
from semantic2d_dataset.errors import DownloadError, InvalidInputError
from semantic2d_dataset.format.container import load_json

RETRIES = 5
LONGEST_WAIT_S = 120
ENOUGH_PROGRESS = 1 << 20
"""Bytes after which a connection that breaks is no failure: long downloads break often."""

TIMEOUTS_S = (10, 30)
"""To connect, and between bytes."""

_REDIRECTS = 10
_UNREACHED = "cannot be reached; is there a network, or a proxy to be named in HTTPS_PROXY?"
_LONGEST_ANSWER = 1 << 26
_GONE = {400, 401, 404, 405, 406, 410, 414, 416, 451}
"""Statuses that stay. 403 is not among them: some hosts say it to those who ask too often."""

_T = TypeVar("_T")


class AttemptError(DownloadError):
    """A request failed.

    Parameters
    ----------
    message
        What happened where.
    again
        Whether the same request may work later.
    wait_s
        How long the server asks to wait, s.
    """

    def __init__(self, message: str, *, again: bool = True, wait_s: float | None = None) -> None:
        super().__init__(message)
        self.again = again
        self.wait_s = wait_s


class _Session(requests.Session):
    """Leaves redirects to `open_url`; the library would read their bodies, however long."""

    def get_redirect_target(self, resp: requests.Response) -> None:  # noqa: ARG002
        return None


def new_session() -> requests.Session:
    """Return a session that says who asks, and wants files as they are."""
    session = _Session()
    session.headers["User-Agent"] = f"semantic2d-dataset/{semantic2d_dataset.__version__}"
    session.headers["Accept-Encoding"] = "identity"
    return session


def persist(attempt: Callable[[], _T], progress: Callable[[], int] = lambda: 0) -> _T:
    """Try up to six times, waiting longer each time or as long as the server asks.

    Parameters
    ----------
    attempt
        Raises `AttemptError` where it fails.
    progress
        Bytes that have arrived; an attempt that brought many does not count as failed.

    Raises
    ------
    AttemptError
        That of the last attempt.
    """
    failures = 0
    while True:
        before = progress()
        try:
            return attempt()
        except AttemptError as err:
            failures = 1 if progress() - before >= ENOUGH_PROGRESS else failures + 1
            if not err.again or failures > RETRIES:
                raise
            backoff = 2**failures * random.uniform(0.5, 1)  # noqa: S311 - spreads clients
            wait_s = backoff if err.wait_s is None else err.wait_s
            tqdm.write(f"{err}; trying again in {wait_s:.0f} s", file=sys.stderr)
            time.sleep(wait_s)


@contextlib.contextmanager
def open_url(session: requests.Session, url: str, offset: int = 0) -> Iterator[requests.Response]:
    """Get a URL from an offset on; yields an answer of status 200 or 206, its body unread.

    Redirects are followed, but never from https to http.

    Raises
    ------
    AttemptError
        If the server cannot be reached, breaks off while the answer is read, or refuses.
    """
    headers = {"Range": f"bytes={offset}-"} if offset else {}
    try:
        with _follow(session, url, headers) as response:
            _check_status(response, url)
            yield response
    except requests.RequestException as err:
        raise AttemptError(f"{url}: {_in_words(err)}") from err


def get_body(session: requests.Session, url: str, most: int) -> bytes:
    """Get a document whole, patiently.

    Parameters
    ----------
    session
        Asks the host.
    url
        Where it lies.
    most
        Bytes that it may have.

    Raises
    ------
    AttemptError
        If it cannot be had, or is longer.
    """

    def attempt() -> bytes:
        with open_url(session, url) as response:
            return _read_body(response, url, most)

    return persist(attempt)


def get_json(session: requests.Session, url: str) -> tuple[Any, str | None]:
    """Get a JSON document, patiently, and the URL of its next page where it has one.

    Raises
    ------
    AttemptError
        If it cannot be had, or is not JSON.
    """

    def attempt() -> tuple[Any, str | None]:
        with open_url(session, url) as response:
            body = _read_body(response, url, _LONGEST_ANSWER)
            following = response.links.get("next", {}).get("url")
        try:
            return load_json(body), following and urljoin(url, following)
        except InvalidInputError as err:
            raise AttemptError(f"{url}: expected a list of files: {err}") from err

    return persist(attempt)


def _read_body(response: requests.Response, url: str, most: int) -> bytes:
    body = b""
    for chunk in response.iter_content(1 << 16):
        body += chunk
        if len(body) > most:
            raise AttemptError(f"{url}: sends more than {most} bytes", again=False)
    return body


def check_scheme(before: str, after: str) -> None:
    """Refuse a way that leaves https, or the web.

    Raises
    ------
    AttemptError
        If `after` is neither https nor, where `before` was http, http.
    """
    schemes = {"https"} if urlsplit(before).scheme == "https" else {"https", "http"}
    if urlsplit(after).scheme not in schemes:
        raise AttemptError(
            f"{before}: leads to {after}, which is not {' or '.join(sorted(schemes))}", again=False
        )


@contextlib.contextmanager
def _follow(
    session: requests.Session, url: str, headers: dict[str, str]
) -> Iterator[requests.Response]:
    here = url
    for _ in range(_REDIRECTS):
        with session.get(
            here, headers=headers, stream=True, timeout=TIMEOUTS_S, allow_redirects=False
        ) as response:
            if not response.is_redirect:
                yield response
                return
            try:
                there = urljoin(here, response.headers["Location"])
                check_scheme(here, there)
            except ValueError as err:
                raise AttemptError(f"{url}: leads to no URL: {err}", again=False) from err
            here = there
    raise AttemptError(f"{url}: more than {_REDIRECTS} redirects", again=False)


def _check_status(response: requests.Response, url: str) -> None:
    status = response.status_code
    if status not in (200, 206):
        wait_s = _retry_after(response.headers.get("Retry-After"))
        message = f"{url}: the server answers {status} {response.reason or ''}".rstrip()
        if wait_s is not None and wait_s > LONGEST_WAIT_S:
            raise AttemptError(f"{message} and asks to wait {wait_s:.0f} s", again=False)
        raise AttemptError(message, again=status not in _GONE, wait_s=wait_s)
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise AttemptError(f"{url}: the server packs what should come as it is", again=False)


def _retry_after(text: str | None) -> float | None:
    """Return seconds; the header has those, or a date."""
    if text is None:
        return None
    if text.strip().isdecimal():
        return float(text)
    try:
        until = email.utils.parsedate_to_datetime(text)
    except ValueError:
        return None
    if until.tzinfo is None:
        until = until.replace(tzinfo=datetime.UTC)
    return max(0.0, until.timestamp() - time.time())


def _in_words(err: requests.RequestException) -> str:
    """Return a reason without the names of nested Python objects."""
    if isinstance(err, requests.exceptions.SSLError):
        return "the certificate or the encryption is not right"
    if isinstance(err, requests.exceptions.ProxyError):
        return "the proxy cannot be used"
    if isinstance(err, requests.Timeout) or "timed out" in str(err):
        return "no answer in time"
    if isinstance(err, (requests.ConnectionError, requests.exceptions.ChunkedEncodingError)):
        broken = isinstance(err, requests.exceptions.ChunkedEncodingError) or "aborted" in str(err)
        return "the connection broke off" if broken else _UNREACHED
    return " ".join(str(err).split())
