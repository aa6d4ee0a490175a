"""Registries that lie on a web server."""

import json
from types import SimpleNamespace

import pytest

from semantic2d_dataset.access import remote_registry, web
from semantic2d_dataset.access.known_datasets import REGISTRY_VARIABLE, find_known, known_datasets
from semantic2d_dataset.access.places import HOME_VARIABLE, OFFLINE_VARIABLE
from semantic2d_dataset.errors import DownloadError, InvalidInputError, OfflineError
from tests.access import hosts

ENTRY = {"id": "own", "version": "3", "title": "Own", "license": "CC0-1.0", "sources": []}
REGISTRY = {"format": "semantic2d-registry", "format_version": "1.0", "datasets": [ENTRY]}


@pytest.fixture
def host(tmp_path, monkeypatch):
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv(OFFLINE_VARIABLE, raising=False)
    monkeypatch.setattr(web, "time", SimpleNamespace(sleep=lambda _: None, time=lambda: 1e9))
    remote_registry.forget()
    host = hosts.Host({})
    host.pages["/own.json"] = REGISTRY
    yield host
    host.close()


def test_registry_may_be_a_url(host, monkeypatch):
    url = f"{host.url}/own.json"
    assert find_known("own", url).name == "own@3"
    assert find_known("semantic2d", url).name == "semantic2d@2"
    monkeypatch.setenv(REGISTRY_VARIABLE, url)
    assert find_known("own").name == "own@3"
    assert len(host.requests) == 1  # a process asks once


def test_registry_is_kept_for_the_time_without_a_network(host, monkeypatch, capsys):
    url = f"{host.url}/own.json"
    known_datasets(url)
    remote_registry.forget()
    host.list_moods = [hosts.status(404)]
    assert find_known("own", url).name == "own@3"
    assert "answers 404" in capsys.readouterr().err
    remote_registry.forget()
    monkeypatch.setenv(OFFLINE_VARIABLE, "1")
    asked = len(host.requests)
    assert find_known("own", url).name == "own@3"
    with pytest.raises(OfflineError, match="offline, and this registry is not here"):
        find_known("own", f"{host.url}/other.json")
    assert len(host.requests) == asked


def test_registry_that_cannot_be_had_or_read_says_so(host, monkeypatch):
    host.list_moods = [hosts.status(404)]
    with pytest.raises(DownloadError, match=r"own.json: the server answers 404"):
        known_datasets(f"{host.url}/own.json")
    host.pages["/bad.json"] = b"<html>"
    with pytest.raises(InvalidInputError, match="bad.json: "):
        known_datasets(f"{host.url}/bad.json")
    monkeypatch.setattr(remote_registry, "_LONGEST", 100)
    remote_registry.forget()
    with pytest.raises(DownloadError, match="sends more than 100 bytes"):
        known_datasets(f"{host.url}/own.json")


def test_one_bad_answer_does_not_replace_what_was_kept(host, tmp_path):
    url = f"{host.url}/own.json"
    known_datasets(url)
    remote_registry.forget()
    host.pages["/own.json"] = b"<html>"
    with pytest.raises(InvalidInputError):
        known_datasets(url)
    (kept,) = (tmp_path / "registries").iterdir()
    assert json.loads(kept.read_bytes()) == REGISTRY


@pytest.mark.parametrize(
    "url", ["http://example.org/r.json", "ftp://127.0.0.1/r.json", "http://127.0.0.1.evil.org/r"]
)
def test_registry_comes_by_https_or_from_this_machine(url, host):
    with pytest.raises(InvalidInputError, match="comes by https, or by http from this machine"):
        known_datasets(url)
