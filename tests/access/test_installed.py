"""Opening data sets that were installed, by their names."""

import shutil

import pytest

from semantic2d_dataset.access.installed import (
    Part,
    find_installed,
    includes,
    installed,
    read_record,
    write_record,
)
from semantic2d_dataset.access.places import HOME_VARIABLE
from semantic2d_dataset.access.registry import find_folder, open_dataset
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def put(home, dataset_folder):
    """Install a small data set under a name."""

    def make(name):
        folder = home / "datasets" / name.replace("@", "-")
        shutil.copytree(dataset_folder, folder)
        write_record(folder, name)
        return folder

    return make


def test_installed_data_set_opens_by_its_name(put):
    folder = put("semantic2d@2")
    assert open_dataset("semantic2d").root == folder
    assert open_dataset("semantic2d@2").root == folder
    assert open_dataset("semantic2d", version="2").root == folder


def test_known_data_set_that_is_not_installed_says_how_to_get_it(put):
    with pytest.raises(DatasetNotFoundError, match=r"semantic2d download semantic2d@2 \(load_data"):
        open_dataset("semantic2d")
    put("semantic2d@1")
    with pytest.raises(DatasetNotFoundError, match=r"not installed \(semantic2d@1 is\); get it"):
        open_dataset("semantic2d")
    assert open_dataset("semantic2d@1").manifest.name == "generated"


def test_data_set_of_a_registry_that_is_not_given_opens_still(put):
    folder = put("lab@1")
    assert open_dataset("lab").root == open_dataset("lab@1").root == folder
    put("lab@2")
    with pytest.raises(DatasetNotFoundError, match="lab: neither a folder"):
        open_dataset("lab")
    assert [name for name, _ in installed()] == ["lab@1", "lab@2"]


def test_folder_of_that_name_comes_first(put, tmp_path, dataset_folder, monkeypatch):
    put("semantic2d@2")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(dataset_folder, tmp_path / "semantic2d")
    assert str(open_dataset("semantic2d").root) == "semantic2d"
    with pytest.raises(InvalidInputError, match="a version goes with the name"):
        open_dataset(tmp_path / "semantic2d", version="2")


def test_damaged_data_set_is_found_for_repair(put):
    folder = put("semantic2d@2")
    (folder / "dataset.json").unlink()
    assert find_folder("semantic2d") == find_installed("semantic2d") == folder


def test_record_reads_as_it_was_written(put):
    folder = put("lab@1")
    parts = (Part("a.zip", "md5:0", None, ("x", "y")), Part("b.zip", "md5:1", ("small",), ()))
    write_record(folder, "lab@1", ("small",), parts)
    record = read_record(folder)
    assert (record.dataset, record.lidars, record.parts) == ("lab@1", ("small",), parts)
    assert record.manifest == (folder / "dataset.json").read_text()
    assert record.schemes["block"] == open_dataset(folder).scheme("block").digest


@pytest.mark.parametrize(
    "text", ["{", "[]", "null", '{"format": "semantic2d-installation", "format_version": "2.0"}']
)
def test_damaged_record_is_none(text, put):
    folder = put("lab@1")
    (folder / ".installed.json").write_text(text)
    assert read_record(folder) is None


def test_all_lidars_include_any():
    assert includes(None, None)
    assert includes(None, ("a",))
    assert includes(("a", "b"), ("a",))
    assert not includes(("a",), ("a", "b"))
    assert not includes(("a",), None)
