import pytest
import yaml

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.pipeline.config import read_config
from tests.pipeline.drives import config, two_drives, write_config


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("config")
    two_drives(folder, scans=3)
    (folder / "bags").mkdir()
    for name in ("one.bag", "two.bag"):
        (folder / "bags" / name).write_bytes((folder / "monday.bag").read_bytes())
    (folder / "drop.txt").write_text("1\n")
    return folder


def read(folder, **changes):
    return read_config(write_config(folder, config() | changes, "changed.yaml"))


def recording(**more):
    return [{"path": "monday.bag", "map": "room"} | more]


def test_paths_are_relative_to_the_configuration(folder, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    said = read_config(folder / "data.yaml")
    assert said.out == folder / "data"
    first, second = said.recordings
    assert first.paths == (folder / "monday.bag",)
    assert (first.map_yaml, first.annotation) == (folder / "room.yaml", folder / "room.json")
    assert (first.id, second.id) == ("room--monday", "room--second")
    assert first.convert.environment == "room"
    assert (first.convert.recording, second.convert.recording) == (None, "second")
    assert first.convert.license == "CC0-1.0"


@pytest.mark.parametrize("path", ["bags", "bags/*.bag", "ba*/**/*.bag"])
def test_a_folder_or_a_pattern_stands_for_all_in_it(path, folder):
    found = read(folder, recordings=recording(path=path)).recordings
    assert [each.id for each in found] == ["room--one", "room--two"]


def test_parts_are_one_recording(folder):
    parts = ["bags/one.bag", "bags/two.bag"]
    (found,) = read(folder, recordings=[{"parts": parts, "map": "room"}]).recordings
    assert found.paths == tuple(folder / part for part in parts)
    assert found.id == "room--one"


def test_what_is_said_of_all_holds_unless_one_says_otherwise(folder):
    found = read(
        folder,
        convert={"poses": "tf", "mount": [0.1, 0, 0, 0, 0, 3.14], "no_return": [0]},
        salsa={"acceptance": {"inlier_m": 0.2, "max_residual_m": 0.1}},
        recordings=[
            *recording(convert={"poses": "/amcl_pose"}),
            *recording(recording="b", salsa={"acceptance": {"inlier_m": 0.15}}),
        ],
    ).recordings
    assert [each.convert.poses for each in found] == ["/amcl_pose", "tf"]
    assert found[0].convert.mount == (0.1, 0, 0, 0, 0, 3.14)
    assert found[0].convert.no_return == (0.0,)
    assert [each.salsa.acceptance.inlier_m for each in found] == [0.2, 0.15]
    assert [each.salsa.acceptance.max_residual_m for each in found] == [0.1, 0.1]


def test_a_camera_and_other_classes_are_told_by_files(folder):
    (folder / "classes.yaml").write_text("extends: semantic2d\nclasses: {Dog: [9, 9, 9]}")
    for name in ("camera.yaml", "seen.json", "names.yaml"):
        (folder / name).write_text("{}")
    camera = {"calibration": "camera.yaml", "detections": "seen.json", "names": "names.yaml"}
    (found,) = read(
        folder,
        taxonomy="classes.yaml",
        recordings=recording(camera=camera | {"clock_offset_s": 2}),
    ).recordings
    assert found.taxonomy.names[-1] == "Dog"
    assert found.sightings.camera == folder / "camera.yaml"
    assert found.sightings.detections == str(folder / "seen.json")
    assert found.sightings.names == folder / "names.yaml"
    assert found.sightings.matching.clock_offset_s == 2
    streamed = recording(camera=camera | {"detections": "stream:seen"})
    (found,) = read(folder, recordings=streamed).recordings
    assert found.sightings.detections == "stream:seen"
    assert found.taxonomy is None
    with pytest.raises(InvalidInputError, match=r"camera.detections: nothing is at .*none.json"):
        read(folder, recordings=recording(camera=camera | {"detections": "none.json"}))


def test_an_annotation_that_cannot_be_used_is_told_before_any_work(folder):
    (folder / "bad.json").write_text(
        (folder / "room.json").read_text().replace("Pillar", "Colum"), encoding="utf-8"
    )
    maps = {"room": {"map": "room.yaml", "annotation": "bad.json"}}
    with pytest.raises(InvalidInputError, match="bad.json: labels that are no class: 'Colum'"):
        read(folder, maps=maps)


def test_a_pose_file_is_relative_too(folder):
    (folder / "truth.tum").write_text("")
    (found,) = read(folder, recordings=recording(convert={"poses": "truth.tum"})).recordings
    assert found.convert.poses == str(folder / "truth.tum")


def test_recordings_are_chosen_by_name_or_id(folder):
    said = read_config(folder / "data.yaml")
    assert [each.name for each in said.select(())] == ["monday", "second"]
    assert [each.name for each in said.select(["second"])] == ["second"]
    assert [each.name for each in said.select(["room--monday"])] == ["monday"]
    with pytest.raises(InvalidInputError, match="no recording 'mondy'; did you mean 'monday'"):
        said.select(["mondy"])


WRONG = [
    ({"nam": 1}, "unknown key 'nam'; did you mean 'name'?"),
    ({"xyz": 1}, "unknown key 'xyz'; known are convert, license, maps"),
    ({"version": 1.0}, "version: expected text, found 1.0; quote it: '1.0'"),
    ({"version": "1"}, "data set version '1': expected one like 1.0.0"),
    ({"name": "My Data"}, "such as 'my-data'"),
    ({"maps": {}}, "maps: is empty"),
    ({"maps": {"room": {"map": "room.yaml"}}}, "expected the key 'annotation', which is missing"),
    ({"maps": {"room": "room.yaml"}}, "maps.room: expected a mapping, found 'room.yaml'"),
    (
        {"maps": {"room": {"map": "none.yaml", "annotation": "room.json"}}},
        "maps.room.map: nothing is at {folder}/none.yaml",
    ),
    (
        {"maps": {"room": {"map": "room.yaml", "annotation": "bags"}}},
        "maps.room.annotation: expected a file, found the folder {folder}/bags",
    ),
    (
        {"maps": {2024: {"map": "room.yaml", "annotation": "room.json"}}},
        "maps: expected text, found 2024; quote it: '2024'",
    ),
    ({"recordings": []}, "recordings: is empty"),
    ({"recordings": "monday.bag"}, "recordings: expected a list, found 'monday.bag'"),
    ({"recordings": recording(map="rom")}, "recordings[0].map: no map 'rom'; did you mean 'room'"),
    ({"recordings": [{"map": "room"}]}, "recordings[0]: expected either 'path'"),
    ({"recordings": recording(parts=["monday.bag"])}, "recordings[0]: expected either 'path'"),
    ({"recordings": [{"path": "monday.bag"}]}, "recordings[0]: expected the key 'map'"),
    ({"recordings": recording(path="none.bag")}, "recordings[0].path: nothing is at {folder}/none"),
    ({"recordings": recording(path="none*.bag")}, "recordings[0].path: nothing is at"),
    ({"recordings": recording(paths="x")}, "recordings[0]: unknown key 'paths'; did you mean 'pa"),
    ({"recordings": recording(drop="no.txt")}, "recordings[0].drop: nothing is at {folder}/no.txt"),
    ({"recordings": recording(environment="My Lab")}, "such as 'my-lab'; found 'My Lab'"),
    ({"recordings": recording(recording="a" * 60 + "B")}, "expected lower-case letters"),
    (
        {"recordings": recording(path="bags", recording="x")},
        "recordings[0].recording: 2 recordings cannot share the name 'x'",
    ),
    (
        {"recordings": recording() * 2},
        "{folder}/monday.bag and {folder}/monday.bag are both room--monday; give them names",
    ),
    (
        {"recordings": recording(convert={"pose": "tf"})},
        "recordings[0].convert: unknown option 'pose'; did you mean 'poses'?",
    ),
    ({"convert": {"poses": 3}}, "recordings[0].convert: poses: expected text, found 3"),
    ({"convert": {"stamps": "now"}}, "recordings[0].convert: stamps: expected one of auto, head"),
    ({"convert": {"license": "MIT"}}, "recordings[0].convert: 'license' does not belong here"),
    ({"salsa": {"acceptance": {"inlier": 1}}}, "recordings[0].salsa: "),
    ({"salsa": {"acceptance": {"inlier_m": -1}}}, "recordings[0].salsa: acceptance limits must"),
    ({"splits": {"random": {}}}, "splits: unknown key 'random'; known are block, environment, fr"),
    ({"splits": {"block": {"gap": 1}}}, "splits.block: unknown key 'gap'; did you mean 'gap_s'?"),
    ({"splits": {"block": {"gap_s": -1}}}, "splits.block.gap_s: -1 is less than the minimum of 0"),
    ({"splits": {"frame": {"seed": "a"}}}, "splits.frame.seed: expected a whole number, found 'a'"),
    (
        {"splits": {"environment": {"val": ["rom"]}}},
        "splits.environment.val: no environment 'rom'; did you mean 'room'?",
    ),
    (
        {"splits": {"lidar": {"tests": []}}},
        "splits.lidar: unknown key 'tests'; did you mean 'test'?",
    ),
    ({"splits": {"lidar": {"test": []}}}, "splits.lidar.test: is empty"),
    ({"splits": {"environment": {}}}, "splits.environment: needs 3 environments, found room"),
]


@pytest.mark.parametrize(("changes", "says"), WRONG, ids=[says[:40] for _, says in WRONG])
def test_what_is_wrong_is_told_by_its_key(changes, says, folder):
    with pytest.raises(InvalidInputError) as told:
        read(folder, **changes)
    assert str(told.value).startswith(f"{folder}/changed.yaml: ")
    assert says.format(folder=folder) in str(told.value)


def test_several_problems_are_told_at_once(folder):
    said = config() | {"nam": 1, "maps": 3}
    del said["version"]
    with pytest.raises(InvalidInputError) as told:
        read_config(write_config(folder, said, "changed.yaml"))
    first, *lines = str(told.value).splitlines()
    assert first.endswith("changed.yaml: 3 problems")
    assert len(lines) == 3
    assert "  - expected the key 'version', which is missing" in lines


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "expected a mapping, found None"),
        ("a: [", "not a YAML file"),
        ("\x00", "not a YAML file"),
        ("!!python/object/apply:os.getcwd []", "not a YAML file"),
        (yaml.safe_dump([1]), r"expected a mapping, found \[1\]"),
    ],
)
def test_what_is_no_configuration_is_told(text, says, tmp_path):
    (tmp_path / "data.yaml").write_text(text)
    with pytest.raises(InvalidInputError, match=says):
        read_config(tmp_path / "data.yaml")


def test_no_configuration_is_told(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_config(tmp_path / "none.yaml")
