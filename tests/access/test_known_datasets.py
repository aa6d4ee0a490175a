import json
import re

import pytest

from semantic2d_dataset.access.known_datasets import (
    REGISTRY_VARIABLE,
    FileTable,
    HuggingFaceFolder,
    ZenodoRecord,
    find_known,
    known_datasets,
)
from semantic2d_dataset.errors import (
    DatasetNotFoundError,
    FormatVersionError,
    InvalidInputError,
)
from semantic2d_dataset.simulation.mini import MINI_NAME, MINI_VERSION
from tests.conftest import PROJECT

ENTRY = {
    "id": "own",
    "version": "3",
    "title": "Own",
    "license": "CC0-1.0",
    "sources": [
        {
            "kind": "files",
            "files": [
                {
                    "name": "a.zip",
                    "url": "https://h/a.zip",
                    "size": 1,
                    "checksum": f"md5:{'0' * 32}",
                }
            ],
        }
    ],
}


@pytest.fixture
def registry(tmp_path):
    def write(*entries, version="1.0"):
        path = tmp_path / "registry.json"
        said = {"format": "semantic2d-registry", "format_version": version, "datasets": entries}
        path.write_text(json.dumps(said))
        return path

    return write


def test_published_data_sets_are_known_with_their_hosts():
    assert [each.name for each in known_datasets()] == [
        "semantic2d@2",
        "semantic2d@1",
        "ogm-turtlebot2@1",
        "semantic2d-mini@1.1.0",
    ]
    newest = find_known("semantic2d")
    assert newest.name == "semantic2d@2"
    assert newest.sources == (
        ZenodoRecord("18350696"),
        HuggingFaceFolder("TempleRAIL/semantic2d", "dataset"),
    )
    assert find_known("semantic2d@1").sources == (ZenodoRecord("13730200"),)
    assert find_known("ogm-turtlebot2").sources == (ZenodoRecord("7051560"),)


def test_no_licence_is_made_up():
    assert all(
        "ask the authors" in each.license for each in known_datasets() if each.id != MINI_NAME
    )


def test_embedded_data_set_has_its_true_version_and_no_host():
    mini = find_known(MINI_NAME)
    assert (mini.version, mini.sources) == (MINI_VERSION, ())


def test_own_registry_comes_first_and_replaces(registry, monkeypatch):
    path = registry(ENTRY, ENTRY | {"id": "semantic2d", "version": "2"})
    assert isinstance(find_known("semantic2d@2", path).sources[0], FileTable)
    monkeypatch.setenv(REGISTRY_VARIABLE, str(path))
    names = [each.name for each in known_datasets()]
    assert names[:2] == ["own@3", "semantic2d@2"]
    assert names.count("semantic2d@2") == 1


def test_unknown_data_set_is_answered_with_what_was_meant():
    with pytest.raises(DatasetNotFoundError, match="did you mean 'semantic2d@2'"):
        find_known("semantic2d@3")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": "../up"}, "does not match"),
        ({"license": ""}, "license"),
        ({"sources": [{"kind": "ftp"}]}, "'ftp' is not one of"),
        ({"sources": [{"kind": "zenodo"}]}, "'record' is a required property"),
        ({"sources": [{"kind": "zenodo", "record": "1/../2"}]}, "does not match"),
        ({"sources": [{"kind": "zenodo", "record": "1", "host": "file:///etc"}]}, "not match"),
        ({"checksums": {"a": "crc:1"}}, "does not match"),
        ({"licence": "MIT"}, "licence"),
    ],
)
def test_wrong_entry_is_refused_with_its_place(registry, change, message):
    with pytest.raises(InvalidInputError, match=message) as info:
        known_datasets(registry(ENTRY | change))
    assert "registry.json: $.datasets[0]" in str(info.value)


def test_other_wrong_registries_are_refused(registry, tmp_path):
    with pytest.raises(InvalidInputError, match="lists a data set twice"):
        known_datasets(registry(ENTRY, ENTRY))
    with pytest.raises(FormatVersionError):
        known_datasets(registry(ENTRY, version="9.0"))
    (tmp_path / "registry.json").write_text("{")
    with pytest.raises(InvalidInputError, match=r"registry\.json: not JSON"):
        known_datasets(tmp_path / "registry.json")
    with pytest.raises(FileNotFoundError):
        known_datasets(tmp_path / "none.json")


def test_example_in_the_docs_can_be_read(tmp_path):
    text = (PROJECT / "docs" / "download.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    (tmp_path / "own.json").write_text(example)
    assert len(find_known("my-building", tmp_path / "own.json").sources) == 3
    assert all(f"`{each.name}`" in text for each in known_datasets())


def test_names_tell_raw_recordings_from_processed_data():
    known = find_known("semantic2d")
    raw = ["2024-04-04.bag", "Rosbags.zip", "raw_data.tar.gz", "bags/lobby.mcap"]
    assert all(known.belongs(name, "raw") and not known.belongs(name, "processed") for name in raw)
    assert known.belongs("semantic2d_data.zip", "processed")
    assert all(known.belongs(name, "all") for name in [*raw, "semantic2d_data.zip"])


def test_processed_files_may_be_told_too(registry):
    parts = {"processed": ["*.zip"], "raw": ["raw*"]}
    known = find_known("own", registry(ENTRY | {"parts": parts}))
    assert [n for n in ("raw.zip", "a.zip", "a.txt") if known.belongs(n, "processed")] == ["a.zip"]
    assert not known.belongs("a.txt", "raw")


def test_names_tell_lidars_where_they_do_at_all():
    known = find_known("semantic2d")
    assert known.may_hold("data_WLR716.zip", ["wlr-716"])
    assert not known.may_hold("data_WLR716.zip", ["rplidar-s2"])
    assert known.may_hold("hokuyo_and_rplidar.zip", ["rplidar-s2"])
    assert known.may_hold("everything.zip", ["rplidar-s2"])
    assert known.lidar_names(["hokuyo", "wlr_716"]) == ("hokuyo-utm-30lx-ew", "wlr-716")
    with pytest.raises(InvalidInputError, match="has no lidar 'velodyne'; it has hokuyo"):
        known.lidar_names(["velodyne"])


def test_lidar_of_any_name_is_taken_where_none_is_told(registry):
    known = find_known("own", registry(ENTRY))
    assert known.lidar_names(["mine", "hokuyo"]) == ("mine", "hokuyo-utm-30lx-ew")


def test_registry_of_the_guide_is_one(tmp_path):
    text = (PROJECT / "docs" / "download.md").read_text(encoding="utf-8")
    (tmp_path / "registry.json").write_text(text.partition("```json\n")[2].partition("```")[0])
    known = find_known("my-building", tmp_path / "registry.json")
    assert len(known.sources) == 3
    assert known.lidar_names(["hokuyo", "my-lidar"]) == ("hokuyo-utm-30lx-ew", "my-lidar")
