"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

from semantic2d_dataset.access.registry import open_dataset
from tests.generators import make_dataset

# the first call of a compiled function takes seconds
settings.register_profile("project", deadline=None, print_blob=True)
settings.load_profile("project")

# for the processes that tests run in and start: two of them share two cores
for _library in ("OMP", "OPENBLAS"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

PROJECT = Path(__file__).resolve().parents[1]
SHARED_DATA = PROJECT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, which is not part of the project."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"the real recordings are not present at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture(scope="session")
def dataset_folder(tmp_path_factory) -> Path:
    """A small published data set; do not change it."""
    folder = tmp_path_factory.mktemp("data") / "generated"
    make_dataset(folder)
    return folder


@pytest.fixture(scope="session")
def mini_home(tmp_path_factory) -> Path:
    """A home with semantic2d-mini, made once and shared by parallel test processes."""
    base = tmp_path_factory.getbasetemp()
    home = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "mini-home"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SEMANTIC2D_HOME", str(home))
        open_dataset("semantic2d-mini")
    return home


@pytest.fixture
def mini(mini_home, monkeypatch):
    """semantic2d-mini, open; the name works in the test too."""
    monkeypatch.setenv("SEMANTIC2D_HOME", str(mini_home))
    return open_dataset("semantic2d-mini")
