"""Fixtures for tests that install data sets from a host on this machine."""

import shutil
from types import SimpleNamespace

import pytest

from semantic2d_dataset.access import web
from semantic2d_dataset.access.places import HOME_VARIABLE, OFFLINE_VARIABLE
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.pipeline.installation import install
from tests.access.hosts import Host
from tests.pipeline.published import archives_at, pack_archives


@pytest.fixture
def home(tmp_path, monkeypatch):
    """An empty home; waits between attempts take no time."""
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "home"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv(OFFLINE_VARIABLE, raising=False)
    monkeypatch.setattr(web, "time", SimpleNamespace(sleep=lambda _: None, time=lambda: 1e9))
    monkeypatch.setattr(web, "TIMEOUTS_S", (2, 0.3))
    return tmp_path / "home"


@pytest.fixture
def make_host(home):
    made = []

    def make(files):
        made.append(Host(files))
        return made[-1]

    yield make
    for host in made:
        host.close()


@pytest.fixture(scope="session")
def archives(tmp_path_factory):
    return pack_archives(tmp_path_factory.mktemp("archives"))


@pytest.fixture
def host(make_host, archives):
    """Serves two archives of the published layout, and one of raw bags."""
    return make_host(archives)


@pytest.fixture(scope="session")
def installed_once(archives, tmp_path_factory):
    """A home with the data set of these archives."""
    home = tmp_path_factory.mktemp("installed")
    host = Host(archives)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(HOME_VARIABLE, str(home))
        patch.setenv("NO_PROXY", "127.0.0.1")
        patch.delenv(OFFLINE_VARIABLE, raising=False)
        install(archives_at(host))
    host.close()
    return home


@pytest.fixture
def installed(installed_once, home):
    """The data set of these archives, which are kept, in the home of this test."""
    shutil.copytree(installed_once, home)
    return open_dataset("d@1")
