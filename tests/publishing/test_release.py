import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from importlib import resources

import jsonschema
import numpy as np
import pytest

from semantic2d_dataset.errors import CorruptFileError, DatasetNotFoundError, InvalidInputError
from semantic2d_dataset.format.manifest import find_problems, publish, read_manifest
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import NONE, SplitScheme, read_scheme, write_scheme
from semantic2d_dataset.publishing.release import release
from tests.conftest import PROJECT
from tests.generators import make_sequence
from tests.pipeline.drives import files_of
from tests.publishing.rooms import ABOUT, add, make_rooms


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return make_rooms(tmp_path_factory.mktemp("made") / "rooms")


@pytest.fixture
def rooms(made, tmp_path):
    """Labelled sequences that nobody published."""
    return shutil.copytree(made, tmp_path / "rooms")


@pytest.fixture(scope="module")
def once(made, tmp_path_factory):
    folder = shutil.copytree(made, tmp_path_factory.mktemp("once") / "rooms")
    release(folder, version="1.0.0", name="rooms", license="CC-BY-4.0")
    return folder


@pytest.fixture
def released(once, tmp_path):
    """The same, released as 1.0.0."""
    return shutil.copytree(once, tmp_path / "rooms")


def counted_by_hand(folder):
    """Beams with a return by class, and scans, of all sequences."""
    counts, scans = np.zeros(10, int), 0
    for path in (folder / "sequences").glob("*.h5"):
        with SequenceReader(path) as reader:
            batch = reader.batch()
            seen = batch.labels[batch.valid & (batch.labels != 255)]
            counts += np.bincount(seen, minlength=10)
            scans += len(batch)
    return counts, scans


def test_a_release_has_everything_and_verifies(released):
    manifest = read_manifest(released)
    assert (manifest.name, manifest.version, manifest.license) == ("rooms", "1.0.0", "CC-BY-4.0")
    assert {entry.file for entry in manifest.documents} == {
        "DATASET_CARD.md",
        "croissant.json",
        "release.yaml",
        "sequences.csv",
        "statistics.json",
    }
    assert find_problems(released, full=True) == []
    assert not (released / ".release").exists()
    done = subprocess.run(
        ["sha256sum", "-c", "SHA256SUMS"], cwd=released, capture_output=True, text=True, check=True
    )
    files = {str(p.relative_to(released)) for p in released.rglob("*") if p.is_file()}
    assert {line.removesuffix(": OK") for line in done.stdout.splitlines()} == files - {
        "SHA256SUMS"
    }


def test_statistics_keep_to_their_schema_and_are_what_one_counts_by_hand(released):
    said = json.loads((released / "statistics.json").read_text())
    schema = resources.files("semantic2d_dataset.publishing") / "statistics.schema.json"
    jsonschema.validate(said, json.loads(schema.read_text("utf-8")))
    counts, scans = counted_by_hand(released)
    assert list(said["total"]["class_counts"].values()) == counts.tolist()
    assert said["total"]["scans"] == scans
    lidar = said["lidars"]["small"]
    for scheme in ("block", "frame", "environment"):
        sizes = read_scheme(
            released / "splits" / f"{scheme}.h5", scheme, read_manifest(released).lengths
        )
        train = sum((ids == 0).sum() for ids in sizes.membership.values())
        assert lidar["splits"][scheme]["train"]["scans"] == train
    assert lidar["channels"] == ["range", "intensity", "x", "y", "incidence"]


def test_the_table_has_a_row_for_each_sequence(released):
    rows = list(csv.DictReader((released / "sequences.csv").read_text().splitlines()))
    assert [row["id"] for row in rows] == [entry.id for entry in read_manifest(released).sequences]
    for row in rows:
        shares = [float(value) for key, value in row.items() if key.startswith("share_")]
        assert sum(shares) == pytest.approx(1, abs=1e-5)
        assert float(row["seconds"]) == pytest.approx((int(row["scans"]) - 1) / 20, abs=1e-3)


def test_croissant_is_valid_and_its_records_are_the_table(released):
    code = (
        "import json, sys, mlcroissant\n"
        "data = mlcroissant.Dataset(jsonld=sys.argv[1])\n"
        "issues = data.metadata.ctx.issues\n"
        "rows = [r['sequences/id'].decode() for r in data.records('sequences')]\n"
        "print(json.dumps([list(issues.errors), list(issues.warnings), rows]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, str(released / "croissant.json")],
        capture_output=True,
        text=True,
        check=True,
    )
    errors, warnings, rows = json.loads(done.stdout.splitlines()[-1])
    assert (errors, warnings) == ([], [])
    assert "not standard" not in done.stderr
    assert rows == [entry.id for entry in read_manifest(released).sequences]


def test_croissant_knows_size_and_digest_of_every_file(released):
    said = json.loads((released / "croissant.json").read_text())
    manifest = read_manifest(released)
    found = {f["@id"]: f for f in said["distribution"] if f["@type"] == "cr:FileObject"}
    for entry in manifest.files:
        if entry.file != "croissant.json":
            assert found[entry.file]["sha256"] == entry.sha256
            assert found[entry.file]["contentSize"] == f"{entry.bytes} B"
    assert said["license"] == "https://spdx.org/licenses/CC-BY-4.0.html"
    assert said["creator"][0]["name"] == "Ann Author"


def test_the_same_release_again_touches_nothing(released):
    before = files_of(released)
    again = release(released, version="1.0.0")
    assert not again.changed
    assert files_of(released) == before


def test_a_damaged_release_is_made_whole_by_the_same_one(released):
    (released / "DATASET_CARD.md").unlink()
    (released / "SHA256SUMS").write_text("nonsense")
    assert release(released, version="1.0.0").changed
    assert find_problems(released, full=True) == []


def test_words_call_for_a_patch_which_keeps_every_split_byte_for_byte(released):
    before = files_of(released / "splits")
    (released / "release.yaml").write_text(ABOUT.replace("Rooms that", "Rooms which"))
    with pytest.raises(InvalidInputError, match=r"expected version 1.0.1 or later, found 1.0.0"):
        release(released, version="1.0.0")
    done = release(released, version="1.0.1")
    assert done.changed
    assert {each.change.name for each in done.differences} == {"PATCH"}
    assert files_of(released / "splits") == before
    assert "Rooms which" in (released / "DATASET_CARD.md").read_text()


def test_added_sequences_call_for_a_minor_version_and_move_no_scan(released):
    lengths = read_manifest(released).lengths
    old = {
        name: read_scheme(released / "splits" / f"{name}.h5", name, lengths)
        for name in read_manifest(released).splits
    }
    add(released, "attic", seed=9)
    with pytest.raises(InvalidInputError, match=r"expected version 1.1.0 or later"):
        release(released, version="1.0.1")
    assert read_manifest(released).version == "1.0.0"
    release(released, version="1.1.0")
    manifest = read_manifest(released)
    for name, scheme in old.items():
        new = read_scheme(released / "splits" / f"{name}.h5", name, manifest.lengths)
        for sequence_id, ids in scheme.membership.items():
            assert np.array_equal(new.membership[sequence_id], ids)
        assert "attic--first--small" in new.membership
    assert find_problems(released, full=True) == []


@pytest.mark.parametrize(
    "how", ["removed", pytest.param("relabelled", marks=pytest.mark.long), "split"]
)
def test_what_is_removed_or_changed_calls_for_a_major_version(how, released):
    path = released / "sequences" / "lobby--first--small.h5"
    if how == "removed":
        path.unlink()
    elif how == "relabelled":
        add(released, "lobby", seed=99)
    else:
        manifest = read_manifest(released)
        file = released / "splits" / "frame.h5"
        frame = read_scheme(file, "frame", manifest.lengths)
        moved = {i: np.roll(ids, 1) for i, ids in frame.membership.items()}
        write_scheme(file, SplitScheme("frame", moved, frame.made_by))
    with pytest.raises(InvalidInputError, match=r"expected version 2.0.0 or later, found 1.9.9"):
        release(released, version="1.9.9")
    assert release(released, version="2.0.0").differences[0].change.name == "MAJOR"
    assert find_problems(released, full=True) == []


def test_a_version_does_not_go_backward(released):
    with pytest.raises(InvalidInputError, match="older than 1.0.0"):
        release(released, version="0.9.0")


def test_another_folder_can_be_the_version_before(released, made, tmp_path):
    rooms = shutil.copytree(made, tmp_path / "new")
    (rooms / "sequences" / "lobby--first--small.h5").unlink()
    with pytest.raises(InvalidInputError, match=r"2\.0\.0"):
        release(rooms, version="1.0.1", name="rooms", previous=released)


def test_lists_of_a_source_and_its_scheme_are_kept(rooms):
    paths = sorted((rooms / "sequences").glob("*.h5"))
    members = {path.stem: np.array([0, 1, 2] * 20, np.uint8) for path in paths}
    (rooms / "splits" / "frame" / paths[0].stem).mkdir(parents=True)
    (rooms / "splits" / "frame" / paths[0].stem / "train.txt").write_text("0000000.npy\n")
    write_scheme(rooms / "splits" / "frame.h5", SplitScheme("frame", members, "the lists"))
    done = release(rooms, version="1.0.0", name="rooms", license="MIT")
    frame = read_scheme(rooms / "splits" / "frame.h5", "frame", done.manifest.lengths)
    assert frame.made_by == "the lists"
    assert all(np.array_equal(frame.membership[i], ids) for i, ids in members.items())
    assert f"splits/frame/{paths[0].stem}/train.txt" in {e.file for e in done.manifest.documents}
    add(rooms, "attic")
    done = release(rooms, version="1.1.0")
    frame = read_scheme(rooms / "splits" / "frame.h5", "frame", done.manifest.lengths)
    assert (frame.membership["attic--first--small"] == NONE).all()


def test_a_manifest_that_was_never_released_binds_no_version(rooms):
    publish(rooms, name="converted", version="1.0.0", license="MIT")
    assert release(rooms, version="0.1.0", name="rooms").changed


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("titel: x", "unknown key 'titel'; did you mean 'title'?"),
        ("title: 3", "expected text, found 3; quote it"),
        ("authors: []", "authors: is empty"),
        ("authors: [{nam: A}]", "expected the key 'name'"),
        ("- a", "expected a mapping"),
        ("a: b: c", "not a YAML file"),
    ],
)
def test_what_is_wrong_in_release_yaml_is_told_before_any_work(text, says, rooms):
    (rooms / "release.yaml").write_text(text)
    with pytest.raises(InvalidInputError) as raised:
        release(rooms, version="1.0.0", name="rooms")
    assert says in str(raised.value)
    assert not (rooms / "dataset.json").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"name": None}, "--name"),
        ({"version": "1.0"}, "one like 1.0.0"),
        ({"license": "Somebody's"}, "SPDX"),
    ],
)
def test_wrong_options_are_told_and_leave_the_folder_alone(options, says, rooms):
    before = files_of(rooms)
    with pytest.raises(InvalidInputError, match=says):
        release(rooms, **({"version": "1.0.0", "name": "rooms"} | options))
    assert files_of(rooms) == before


def test_unlabelled_sequences_are_released_on_request_only(rooms):
    make_sequence(
        rooms / "sequences" / "attic--first--small.h5",
        60,
        environment="attic",
        drop=("scans/labels",),
    )
    with pytest.raises(InvalidInputError, match="attic.*has no label.*semantic2d salsa label"):
        release(rooms, version="1.0.0", name="rooms")
    assert release(rooms, version="1.0.0", name="rooms", allow_unlabelled=True).changed


def test_a_folder_without_sequences_cannot_be_released(tmp_path):
    with pytest.raises(DatasetNotFoundError, match="no sequences"):
        release(tmp_path, version="1.0.0", name="rooms")


def test_a_sequence_that_was_lost_since_it_was_published_is_said_to_be_left_out(rooms):
    publish(rooms, name="rooms", version="1.0.0")
    lost = sorted((rooms / "sequences").glob("*.h5"))[0]
    lost.unlink()
    made = release(rooms, version="1.0.0")
    assert any(f"are left out (first: {lost.stem})" in each for each in made.notices)


def test_what_is_no_folder_cannot_be_released_and_is_said_to_be_none(tmp_path):
    (tmp_path / "scans.h5").touch()
    for name, found in (("scans.h5", "a file"), ("nowhere", "nothing")):
        with pytest.raises(DatasetNotFoundError, match=f"{name}: expected a folder .* {found}$"):
            release(tmp_path / name, version="1.0.0", name="rooms")


def test_a_damaged_sequence_leaves_the_old_release(released):
    before = files_of(released / "splits")
    path = released / "sequences" / "lobby--first--small.h5"
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(CorruptFileError):
        release(released, version="2.0.0")
    path.write_bytes(content)
    assert files_of(released / "splits") == before
    assert find_problems(released, full=True) == []


@pytest.mark.long
def test_killed_while_swapping_the_next_run_goes_on(released):
    add(released, "attic")
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from semantic2d_dataset.publishing import release, staging\n"
        "def kill(*_): os.kill(os.getpid(), signal.SIGKILL)\n"
        "staging._set_aside = kill\n"
        "release.release(Path(sys.argv[1]), version='1.1.0')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(released)],
        check=False,
        env=os.environ | {"PYTHONPATH": str(PROJECT)},
    )
    assert done.returncode == -signal.SIGKILL
    assert not (released / "dataset.json").exists()
    with pytest.raises(InvalidInputError, match=r"1\.1\.0"):
        release(released, version="1.0.1")
    assert release(released, version="1.1.0").changed
    assert not (released / ".release").exists()
    assert find_problems(released, full=True) == []


def test_a_release_that_was_stopped_while_swapping_is_still_compared_with(released):
    staged = released / ".release" / "staged"
    staged.mkdir(parents=True)
    (released / "dataset.json").replace(staged / "previous.json")
    add(released, "attic")
    with pytest.raises(InvalidInputError, match=r"1\.1\.0"):
        release(released, version="1.0.1")
    assert read_manifest(released).version == "1.0.0"
    assert release(released, version="1.1.0").changed
