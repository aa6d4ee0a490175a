import json
import shutil

import numpy as np
import pytest

from semantic2d_dataset import cli
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import ChecksumError, DatasetNotFoundError
from semantic2d_dataset.format.manifest import publish, read_manifest
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from semantic2d_dataset.format.split_schemes import make_frame_scheme, schemes_of
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.publishing.dataset_diff import diff_datasets
from tests.publishing.rooms import add, make_rooms

LOBBY = "lobby--first--small"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = make_rooms(tmp_path_factory.mktemp("made") / "rooms")
    publish(folder, name="rooms", version="1.2.3", license="MIT")
    return folder


@pytest.fixture
def pair(made, tmp_path):
    """A data set twice."""
    return tuple(shutil.copytree(made, tmp_path / which) for which in ("old", "new"))


def rewrite(folder, **changes):
    """Write the lobby again with other arrays, and publish."""
    path = folder / "sequences" / f"{LOBBY}.h5"
    with SequenceReader(path) as reader:
        arrays = {n: reader.read(n) for n in reader.names if "/" in n and "map" not in n}
        header, scene = reader.header, reader.read_map()
    with SequenceWriter(path, header) as writer:
        writer.append(arrays | {name.replace("__", "/"): a for name, a in changes.items()})
        writer.set_map(scene)
    publish(folder, name="rooms", version="1.2.4", license="MIT")


def arrays_of(folder, name):
    with SequenceReader(folder / "sequences" / f"{LOBBY}.h5") as reader:
        return reader.read(name)


def diff(pair):
    return diff_datasets(*map(open_dataset, pair))


def test_equal_data_sets_need_no_version_and_no_sequence_is_read(pair):
    for path in (pair[0] / "sequences").glob("*.h5"):
        path.write_bytes(bytes(path.stat().st_size))
    found = diff(pair)
    assert (found.differences, found.sequences, found.version) == ((), (), "1.2.3")
    assert str(found).endswith("nothing differs: no new version is needed")


@pytest.mark.parametrize("which", [0, 1])
def test_files_that_are_not_those_of_the_manifest_are_never_said_to_be_equal(which, pair):
    path = pair[which] / "sequences" / f"{LOBBY}.h5"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ChecksumError, match=r"found 100; .* publish the data set again"):
        diff(pair)
    path.unlink()
    with pytest.raises(DatasetNotFoundError, match="lobby.*missing.* publish the data set again"):
        diff(pair)


def test_relabelled_beams_are_counted_by_old_and_new_class(pair):
    labels = arrays_of(pair[1], "scans/labels")
    was_chair = labels == 1
    changed = np.where(was_chair, np.uint8(7), labels)
    changed[0, :5] = 255
    rewrite(pair[1], scans__labels=changed)
    found = diff(pair)
    (lobby,) = found.sequences
    assert lobby.texts == ()
    assert lobby.beams == labels.size
    assert sum(lobby.relabelled.values()) == (labels != changed).sum()
    assert lobby.relabelled["Chair", "Table"] == ((labels == 1) & (changed == 7)).sum()
    assert found.classes_after["Chair"] == 0
    assert found.version == "2.0.0"
    assert "Chair -> Table" in str(found)


def test_poses_ranges_and_stamps_that_differ_are_told_with_how_much(pair):
    poses = arrays_of(pair[1], "poses/refined")
    poses[3:6, 0] += 0.5
    ranges = arrays_of(pair[1], "scans/ranges")
    ranges[7, 0] = 1.25
    rewrite(pair[1], poses__refined=poses, scans__ranges=ranges)
    texts = " | ".join(diff(pair).sequences[0].texts)
    assert "poses/refined: 3 of 60 rows (5.0%) differ, by up to 0.5 m" in texts
    assert "scans/ranges: 1 of 60 rows" in texts
    assert "intensities" not in texts  # NaN equals NaN


def test_another_length_is_told_and_compared_no_further(pair):
    add(pair[1], "lobby", seed=0, scans=50)
    publish(pair[1], name="rooms", version="2.0.0")
    (lobby,) = diff(pair).sequences
    assert any("scans/ranges: was (60, 37), and is (50, 37)" in text for text in lobby.texts)


def test_added_and_removed_sequences_are_told(pair):
    add(pair[1], "attic")
    (pair[1] / "sequences" / f"{LOBBY}.h5").unlink()
    publish(pair[1], name="rooms", version="2.0.0", license="MIT")
    texts = [str(each) for each in diff(pair).differences]
    assert f"MAJOR: sequence {LOBBY} was removed" in texts
    assert "MINOR: sequence attic--first--small was added" in texts


def test_scans_that_moved_between_splits_are_counted(pair):
    lengths = read_manifest(pair[1]).lengths
    stamps = {i: np.arange(n) * 50_000_000 for i, n in lengths.items()}
    block = next(each for each in schemes_of(stamps) if each.name == "block")
    moved = {i: ids.copy() for i, ids in make_frame_scheme(lengths, seed=0).membership.items()}
    train = np.flatnonzero(moved[LOBBY] == 0)[:4]
    moved[LOBBY][train] = 2
    publish(
        pair[1],
        name="rooms",
        version="2.0.0",
        schemes=[block, SplitScheme("frame", moved, "by hand")],
    )
    found = diff(pair)
    assert found.moved["frame"] == {("train", "test"): 4}
    assert "MAJOR: scheme environment was removed" in map(str, found.differences)


def test_the_command_exits_0_whatever_differs(pair, monkeypatch, capsys):
    add(pair[1], "attic")
    publish(pair[1], name="rooms", version="1.3.0", license="MIT")
    monkeypatch.setattr("sys.argv", ["semantic2d", "diff", *map(str, pair), "--json"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code
    said = json.loads(capsys.readouterr().out)
    assert (said["change"], said["calls_for_version"]) == ("MAJOR", "2.0.0")
