from dataclasses import replace

import pytest

from semantic2d_dataset.access.download import download, download_folder
from semantic2d_dataset.access.installed import data_folder
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.pipeline.catalogue import (
    describe_known,
    format_known,
    format_line,
    list_datasets,
    remove,
)
from semantic2d_dataset.pipeline.installation import install
from tests.generators import make_dataset
from tests.pipeline.published import HOKUYO, WLR, archives_at, files_at, files_in, write_registry


@pytest.fixture
def small(make_host, home, tmp_path):
    """The entry of a small data set that is quick to install, of a registry that is not given."""
    make_dataset(tmp_path / "there", scans=20)
    return files_at(make_host(files_in(tmp_path / "there")))


def test_list_tells_what_is_known_and_what_is_here(small):
    assert [each["dataset"] for each in list_datasets() if "folder" in each] == []
    data = install(small).data
    (found,) = (each for each in list_datasets() if "folder" in each)
    assert found["dataset"] == "d@1"
    assert found["lidars"] == ["small"]
    assert (found["sequences"], found["scans"]) == (3, 60)
    assert found["folder"] == str(data.root)
    assert found["bytes"] >= sum(entry.bytes for entry in data.manifest.files)
    assert f"MB in {data.root}" in format_line(found)
    (data.root / "dataset.json").write_text("{")
    (found,) = (each for each in list_datasets() if "folder" in each)
    assert "dataset.json" in found["problem"]
    assert f"damaged, in {data.root}" in format_line(found)


def test_show_tells_licence_citation_sources_and_versions(host, home, tmp_path):
    registry = write_registry(tmp_path / "registry.json", host)
    text = format_known(describe_known("d", registry))
    for part in (f"lidars: {HOKUYO}, {WLR}", "license: CC0-1.0", "cite: We, 2024", "10.1/x"):
        assert part in text
    assert f"from: ZenodoRecord 7 {host.url}" in text
    assert describe_known("semantic2d@1")["versions"] == ["2", "1"]
    with pytest.raises(DatasetNotFoundError, match="not a known data set"):
        describe_known("nothing")


def test_show_knows_what_is_installed_without_its_registry(small):
    install(small)
    text = format_known(describe_known("d"))
    assert "license: CC0-1.0" in text
    assert "from: unknown" in text


def test_remove_frees_the_data_set_and_keeps_archives_unless_told(host, home, tmp_path):
    known = archives_at(host)
    registry = write_registry(tmp_path / "registry.json", host)
    install(known, lidars=["hokuyo"])
    freed = remove("d")
    assert list(freed) == [str(data_folder(known))]
    assert freed[str(data_folder(known))] > 10_000
    assert not data_folder(known).exists()
    with pytest.raises(DatasetNotFoundError, match=r"not installed; its archives are in .*-too"):
        remove("d", registry=registry)
    assert list(remove("d", archives_too=True, registry=registry)) == [str(download_folder(known))]
    assert [p.name for p in home.rglob("*") if p.is_file()] == [".d-1.lock"]


def test_remove_takes_what_unfinished_runs_left(host, home, tmp_path):
    registry = write_registry(tmp_path / "registry.json", host)
    left = home / "datasets" / ".d-1.resume" / "data"
    left.mkdir(parents=True)
    (left / "half").write_text("half")
    assert list(remove("d", registry=registry).values()) == [4]
    assert not left.exists()


def test_remove_refuses_what_is_unknown_or_several_or_elsewhere(small, tmp_path):
    with pytest.raises(DatasetNotFoundError, match="semantic3d: not a known data set"):
        remove("semantic3d")
    with pytest.raises(DatasetNotFoundError, match="semantic2d@2: not installed"):
        remove("semantic2d")
    with pytest.raises(DatasetNotFoundError, match="not a known data set"):
        remove(str(tmp_path / "there"))
    folder = install(small).data.root
    folder.rename(tmp_path / "moved")
    folder.symlink_to(tmp_path / "moved")
    with pytest.raises(InvalidInputError, match="is a link"):
        remove("d")
    assert (tmp_path / "moved" / "dataset.json").is_file()


def test_remove_asks_which_version(make_host, small):
    install(small)
    install(replace(small, version="2"))
    with pytest.raises(InvalidInputError, match="say which: d@1, d@2"):
        remove("d")
    remove("d@1")
    assert next(iter(remove("d"))).endswith("d-2")


def test_downloaded_files_alone_can_be_removed(host, home, tmp_path):
    registry = write_registry(tmp_path / "registry.json", host)
    known = archives_at(host)
    download(known, download_folder(known))
    assert len(remove("d", archives_too=True, registry=registry)) == 1
    assert not download_folder(known).exists()
