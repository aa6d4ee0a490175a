import pytest
import requests

from semantic2d_dataset.access import web
from semantic2d_dataset.access.web import (
    AttemptError,
    check_scheme,
    get_json,
    new_session,
    open_url,
)
from tests.access import hosts


@pytest.fixture
def host(monkeypatch):
    monkeypatch.setattr(web, "RETRIES", 0)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    made = hosts.Host({"a": b"content"})
    yield made
    made.close()


@pytest.mark.parametrize(
    ("before", "after", "allowed"),
    [
        ("https://a/x", "https://b/y", True),
        ("https://a/x", "http://a/x", False),
        ("http://a/x", "https://a/x", True),
        ("http://a/x", "http://b/x", True),
        ("http://a/x", "file:///etc/passwd", False),
        ("https://a/x", "ftp://a/x", False),
    ],
)
def test_way_never_leads_from_https_to_less(before, after, allowed):
    if allowed:
        check_scheme(before, after)
        return
    with pytest.raises(AttemptError, match="which is not http") as info:
        check_scheme(before, after)
    assert not info.value.again


def test_redirect_from_https_to_http_is_not_followed(host, monkeypatch):
    asked = []
    real = requests.Session.get

    def get(self, url, **options):
        """Speaks http to the host on this machine where https is asked for."""
        asked.append(url)
        return real(self, url.replace("https:", "http:"), **options)

    monkeypatch.setattr(requests.Session, "get", get)
    host.moods = [hosts.redirect_to(f"{host.url}/records/7/files/a")]
    url = f"{host.url}/records/7/files/a".replace("http:", "https:")
    with (
        new_session() as session,
        pytest.raises(AttemptError, match="which is not https"),
        open_url(session, url),
    ):
        pass
    assert asked == [url]


def test_redirect_is_followed_with_its_range(host):
    host.moods = [hosts.redirect_to("/records/7/files/a?again")]
    host.files["a?again"] = b"content"
    with new_session() as session, open_url(session, f"{host.url}/records/7/files/a", 3) as answer:
        assert answer.content == b"tent"


def test_host_that_is_not_there_is_said_in_words():
    with (
        new_session() as session,
        pytest.raises(
            AttemptError, match=r"^http://127\.0\.0\.1:9/x: cannot be reached; is there"
        ) as info,
        open_url(session, "http://127.0.0.1:9/x"),
    ):
        pass
    assert info.value.again


def test_proxy_of_the_environment_is_used(host, monkeypatch):
    monkeypatch.delenv("NO_PROXY")
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.setenv("http_proxy", host.url)
    with (
        new_session() as session,
        open_url(session, "http://elsewhere.invalid/records/7/files/a") as answer,
    ):
        assert answer.content == b"content"
    assert host.requests[0][0].startswith("http://elsewhere.invalid/")


@pytest.mark.parametrize("body", [b"<html>", b"\xff", b"[" * 100_000, b'{"a": NaN}'])
def test_what_is_no_json_is_refused(body, host):
    host.pages["/list"] = body
    with new_session() as session, pytest.raises(AttemptError, match="expected a list of files"):
        get_json(session, f"{host.url}/list")


def test_endless_document_is_refused(host, monkeypatch):
    monkeypatch.setattr(web, "_LONGEST_ANSWER", 1000)
    host.pages["/list"] = b" " * 1001
    with new_session() as session, pytest.raises(AttemptError, match="sends more than 1000 bytes"):
        get_json(session, f"{host.url}/list")
