import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from salsa import blocks
from salsa.alignment import Acceptance
from salsa.sequences import label_sequence
from salsa.settings import Settings
from salsa.sightings import Sightings
from salsa.things import Persistence
from semantic2d_dataset.errors import AlignmentError, InvalidInputError, WriteError
from semantic2d_dataset.executors import Processes, Serial
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy
from tests.salsa import rooms

SCANS = 70


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Map, annotation and a sequence of scans with rough poses, one of them unknown."""
    folder = tmp_path_factory.mktemp("room")
    truth = rooms.true_poses(SCANS)
    rough = rooms.rough_poses(truth)
    rough[5] = np.nan
    write_source(folder / "source.h5", rooms.batch_at(truth, rough))
    return folder, *rooms.write_room(folder)


def write_source(path, batch):
    header = SequenceHeader("room", "test", rooms.LIDAR, provenance={"made": "here"})
    intensities = np.abs(batch.ranges, dtype=np.float32)
    with SequenceWriter(path, header) as writer:
        writer.append(
            {
                "scans/ranges": batch.ranges,
                "scans/intensities": intensities,
                "scans/stamps_ns": batch.stamps_ns,
                "poses/initial": batch.poses,
                "commands/velocity": np.zeros((len(batch), 2)),
                "streams/imu/stamps_ns": np.arange(900),
                "streams/imu/data": np.arange(1800.0).reshape(900, 2),
            }
        )


@pytest.fixture(scope="module")
def labelled(room):
    folder, map_yaml, annotation = room
    out = folder / "labelled.h5"
    return out, label_sequence(folder / "source.h5", map_yaml, annotation, out)


def test_a_labelled_sequence_holds_every_step_and_its_map(labelled):
    out, summary = labelled
    with SequenceReader(out) as reader:
        truth = rooms.true_poses(SCANS)
        metres, _ = rooms.errors(reader.read("poses/refined"), truth)
        labels, accepted = reader.read("scans/labels"), reader.read("alignment/accepted")
        assert np.nanmedian(metres) < 0.02
        assert accepted.sum() == SCANS - 1 == summary.scans_accepted
        assert (labels[5] == UNLABELLED).all()
        assert (np.delete(labels, 5, axis=0) != UNLABELLED).all()
        assert reader.read("alignment/covariance").shape == (SCANS, 3, 3)
        offsets, segments = reader.read("lines/offsets"), reader.read("lines/segments")
        assert (np.diff(offsets) >= 4).all()
        assert offsets[-1] == len(segments)
        np.testing.assert_array_equal(reader.read_map().occupancy, rooms.room_map().occupancy)
        valid = rooms.LIDAR.has_return(reader.read("scans/ranges"))
    assert summary.near_after > 0.95 > summary.near_before
    assert summary.points["Wall"] > 1000
    assert summary.points["unlabelled"] == valid[5].sum()
    assert sum(summary.points.values()) == valid.sum()


def test_what_the_source_held_is_kept(room, labelled):
    folder, *_ = room
    with SequenceReader(folder / "source.h5") as source, SequenceReader(labelled[0]) as copy:
        for name in set(source.names) - {"provenance"}:
            np.testing.assert_array_equal(copy.read(name), source.read(name))
        assert copy.header.sequence_id == source.header.sequence_id


def test_the_provenance_names_inputs_by_their_digest(room, labelled):
    folder, map_yaml, annotation = room
    with SequenceReader(labelled[0]) as reader:
        provenance = reader.header.provenance
    said = provenance["salsa"]["inputs"]
    files = {"sequence": folder / "source.h5", "map": map_yaml, "annotation": annotation}
    for role, path in files.items():
        assert said[role]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert said["map_image"]["name"] == "room.pgm"
    assert provenance["made"] == "here"
    assert provenance["salsa"]["parameters"]["lines"]["min_line_points"] == 15


def test_blocks_change_no_line_and_no_label(room, labelled, monkeypatch):
    folder, map_yaml, annotation = room
    monkeypatch.setattr(blocks, "BLOCK_SCANS", 64)
    out = folder / "blocks.h5"
    label_sequence(folder / "source.h5", map_yaml, annotation, out)
    with SequenceReader(out) as divided, SequenceReader(labelled[0]) as whole:
        assert divided.content_digest() == whole.content_digest()


def test_labelling_twice_gives_the_same(room, labelled):
    folder, map_yaml, annotation = room
    out = folder / "again.h5"
    label_sequence(labelled[0], map_yaml, annotation, out)
    with SequenceReader(out) as again, SequenceReader(labelled[0]) as first:
        assert again.content_digest() == first.content_digest()


def test_an_existing_file_is_replaced_only_by_force(room, tmp_path):
    folder, map_yaml, annotation = room
    out = tmp_path / "out.h5"
    out.write_bytes(b"mine")
    with pytest.raises(
        InvalidInputError, match="exists already; choose another name or use --force"
    ):
        label_sequence(folder / "none.h5", map_yaml, annotation, out)
    assert out.read_bytes() == b"mine"
    label_sequence(folder / "source.h5", map_yaml, annotation, out, force=True)
    with SequenceReader(out) as reader:
        assert "scans/labels" in reader
    with pytest.raises(InvalidInputError, match="is an input itself"):
        label_sequence(out, map_yaml, annotation, out, force=True)
    with pytest.raises(WriteError, match="the folder .* does not exist"):
        label_sequence(out, map_yaml, annotation, tmp_path / "none" / "out.h5")


def test_scans_of_another_place_are_an_error_and_leave_nothing(room, tmp_path):
    _, map_yaml, annotation = room
    batch = rooms.batch_at(rooms.true_poses(8), rooms.true_poses(8))
    batch.ranges[:] = np.random.default_rng(0).uniform(0.3, 3.0, batch.ranges.shape)
    write_source(tmp_path / "source.h5", batch)
    with pytest.raises(AlignmentError, match="do not fit the map: 0 of 8 scans accepted"):
        label_sequence(tmp_path / "source.h5", map_yaml, annotation, tmp_path / "out.h5")
    assert [path.name for path in tmp_path.iterdir()] == ["source.h5"]


@pytest.mark.parametrize("scans", [0, 3])
def test_a_sequence_without_poses_is_an_error(room, scans, tmp_path):
    _, map_yaml, annotation = room
    batch = rooms.batch_at(rooms.true_poses(3), np.full((3, 3), np.nan))
    rows = slice(0, scans)
    kept = {name: getattr(batch, name)[rows] for name in ("ranges", "poses", "stamps_ns")}
    write_source(tmp_path / "source.h5", replace(batch, **kept))
    with pytest.raises(AlignmentError, match="no scan has a pose"):
        label_sequence(tmp_path / "source.h5", map_yaml, annotation, tmp_path / "out.h5")


def test_no_input_and_no_folder_is_ever_replaced(room, tmp_path):
    folder, map_yaml, annotation = room
    source = folder / "source.h5"
    inputs = (source, map_yaml, folder / "room.pgm", annotation)
    before = [path.read_bytes() for path in inputs]
    for out in inputs:
        with pytest.raises(InvalidInputError, match="is an input itself"):
            label_sequence(source, map_yaml, annotation, out, force=True)
    with pytest.raises(InvalidInputError, match="is a folder"):
        label_sequence(source, map_yaml, annotation, tmp_path, force=True)
    assert [path.read_bytes() for path in inputs] == before


def test_blocks_outside_the_map_are_left_unlabelled_but_not_all_may_be(room, tmp_path, monkeypatch):
    _, map_yaml, annotation = room
    truth = rooms.true_poses(8)
    rough = truth + np.where(np.arange(8) < 4, 0.0, 500.0)[:, None] * (1, 0, 0)
    write_source(tmp_path / "half.h5", rooms.batch_at(truth, rough))
    monkeypatch.setattr(blocks, "BLOCK_SCANS", 4)
    summary = label_sequence(tmp_path / "half.h5", map_yaml, annotation, tmp_path / "out.h5")
    assert (summary.scans_with_pose, summary.scans_accepted) == (8, 4)
    write_source(tmp_path / "none.h5", rooms.batch_at(truth, truth + 500.0))
    with pytest.raises(AlignmentError, match="all 8 poses lie outside the map"):
        label_sequence(tmp_path / "none.h5", map_yaml, annotation, tmp_path / "no.h5")


def test_without_persistence_nothing_is_gathered(room, tmp_path, monkeypatch):
    folder, map_yaml, annotation = room
    monkeypatch.setattr(blocks, "gather", None)
    settings = Settings(persistence=None)
    label_sequence(
        folder / "source.h5", map_yaml, annotation, tmp_path / "out.h5", settings=settings
    )
    with pytest.raises(TypeError):
        label_sequence(folder / "source.h5", map_yaml, annotation, tmp_path / "more.h5")


def test_a_class_that_cannot_be_moved_is_named_before_any_work(room, tmp_path):
    folder, map_yaml, annotation = room
    words = folder / "source.h5", map_yaml, annotation, tmp_path / "out.h5"
    settings = Settings(persistence=Persistence(movable=("Chiar",)))
    with pytest.raises(InvalidInputError, match="persistence: movable: unknown class 'Chiar'"):
        label_sequence(*words, settings=settings)
    few = Taxonomy(("Other", "Person", *rooms.BOXES), ((0, 0, 0),) * (2 + len(rooms.BOXES)))
    assert label_sequence(*words, taxonomy=few).scans_accepted == SCANS - 1  # no bins to move


def test_a_drift_is_followed_from_block_to_block(room, tmp_path, monkeypatch):
    _, map_yaml, annotation = room
    monkeypatch.setattr(blocks, "BLOCK_SCANS", 16)
    truth = rooms.true_poses(80)
    drift = np.linspace(0, 1, 80)[:, None] * np.array((1.6, -1.2, 0.6))
    write_source(tmp_path / "in.h5", rooms.batch_at(truth, truth + drift))
    settings = Settings(acceptance=Acceptance(max_correction_m=2.1))
    summary = label_sequence(
        tmp_path / "in.h5", map_yaml, annotation, tmp_path / "out.h5", settings=settings
    )
    assert summary.scans_accepted == 80
    with SequenceReader(tmp_path / "out.h5") as reader:
        assert rooms.errors(reader.read("poses/refined"), truth)[0].max() < 0.05


def test_processes_label_as_one_does(room, labelled, tmp_path):
    folder, map_yaml, annotation = room
    out = tmp_path / "out.h5"
    with Processes(2) as executor:
        label_sequence(folder / "source.h5", map_yaml, annotation, out, executor=executor)
    with SequenceReader(out) as one, SequenceReader(labelled[0]) as other:
        assert one.content_digest() == other.content_digest()


def test_a_file_that_changed_is_read_anew(room, labelled, tmp_path):
    """What is kept between blocks is kept by what the files hold, not by their names."""
    _, map_yaml, annotation = room
    truth = rooms.true_poses(6)
    for poses in (truth, truth[::-1]):
        (tmp_path / "in.h5").unlink(missing_ok=True)
        write_source(tmp_path / "in.h5", rooms.batch_at(poses, poses))
        label_sequence(tmp_path / "in.h5", map_yaml, annotation, tmp_path / "out.h5", force=True)
        with SequenceReader(tmp_path / "out.h5") as reader:
            assert rooms.errors(reader.read("poses/refined"), poses)[0].max() < 0.05


def write_camera(folder, stamps_ns, names=("dog",)):
    """A camera that looks ahead, and one box over its whole image for each stamp."""
    camera = {"width": 640, "height": 480, "fx": 200.0, "fy": 200.0, "cx": 320.0, "cy": 240.0}
    camera["base_T_camera"] = [0.0, 0.0, 0.0, -np.pi / 2, 0.0, -np.pi / 2]
    boxes = [{"box": [0, 0, 640, 480], "class": name} for name in names]
    frames = [{"stamp_ns": int(stamp), "detections": boxes} for stamp in stamps_ns]
    (folder / "camera.yaml").write_text(json.dumps(camera), encoding="utf-8")
    (folder / "seen.json").write_text(json.dumps({"frames": frames}), encoding="utf-8")
    return Sightings(folder / "camera.yaml", str(folder / "seen.json"))


class Elsewhere(Serial):
    """Works in another folder, as the workers of a cluster do."""

    def __init__(self, folder):
        self.folder = folder

    def map(self, function, items, **options):
        blocks.prepare.cache_clear()
        os.chdir(self.folder)
        return super().map(function, items, **options)


def test_relative_names_are_found_by_workers_in_other_folders(room, tmp_path, monkeypatch):
    _, map_yaml, annotation = room
    batch = rooms.batch_at(rooms.true_poses(4), rooms.true_poses(4))
    write_source(tmp_path / "in.h5", batch)
    write_camera(tmp_path, batch.stamps_ns, names=["person"])
    monkeypatch.chdir(tmp_path)  # back at the end
    (tmp_path / "elsewhere").mkdir()
    label_sequence(
        "in.h5",
        os.path.relpath(map_yaml),
        os.path.relpath(annotation),
        tmp_path / "out.h5",
        sightings=Sightings(Path("camera.yaml"), "seen.json"),
        executor=Elsewhere(tmp_path / "elsewhere"),
    )
    assert (tmp_path / "out.h5").exists()


def test_what_a_camera_saw_takes_its_class(room, tmp_path):
    _, map_yaml, annotation = room
    poses = np.repeat(np.array(((4.5, 3.5, -0.9),)), 10, axis=0)
    batch = rooms.batch_at(poses, poses, extra=[(5.3, 2.4, 5.5, 2.6)])
    write_source(tmp_path / "in.h5", batch)
    taxonomy = Taxonomy((*SEMANTIC2D.names, "Dog"), (*SEMANTIC2D.colours, (120, 80, 20)))
    words = (tmp_path / "in.h5", map_yaml, annotation)
    plain = label_sequence(*words, tmp_path / "plain.h5", taxonomy=taxonomy)
    sightings = write_camera(tmp_path, batch.stamps_ns)
    seen = label_sequence(*words, tmp_path / "seen.h5", taxonomy=taxonomy, sightings=sightings)
    assert plain.points["Person"] > 50
    assert (plain.scans_with_image, seen.scans_with_image) == (None, 10)
    assert (plain.points["Dog"], seen.points["Person"]) == (0, 0)
    assert seen.points["Dog"] == plain.points["Person"]
    with SequenceReader(tmp_path / "seen.h5") as reader:
        assert reader.header.taxonomy == taxonomy
        said = reader.header.provenance["salsa"]
    assert {"camera", "detections"} <= set(said["inputs"])
    assert str(tmp_path) not in json.dumps(said)
    with pytest.raises(InvalidInputError, match="detected classes 'dog' are not known"):
        label_sequence(*words, tmp_path / "no.h5", sightings=sightings)
    late = write_camera(tmp_path, batch.stamps_ns + 10**12)
    with pytest.raises(InvalidInputError, match=r"no image lies within 0\.1 s of a scan"):
        label_sequence(*words, tmp_path / "no.h5", sightings=late, taxonomy=taxonomy)
