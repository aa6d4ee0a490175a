from dataclasses import replace

import h5py
import pytest

from semantic2d_dataset.errors import AlignmentError
from semantic2d_dataset.executors import Serial
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from semantic2d_dataset.pipeline.config import RecordingConfig
from semantic2d_dataset.pipeline.labelling import find_labelled, label
from semantic2d_dataset.pipeline.siblings import load_sibling
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy
from tests.salsa import rooms

SCANS = 12


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A recording's settings, its sequence, and the labelled copy made of it; change neither."""
    folder = tmp_path_factory.mktemp("room")
    truth = rooms.true_poses(SCANS)
    batch = rooms.batch_at(truth, rooms.rough_poses(truth))
    with SequenceWriter(folder / "a.h5", SequenceHeader("room", "a", rooms.LIDAR)) as writer:
        writer.append(
            {
                "scans/ranges": batch.ranges,
                "scans/stamps_ns": batch.stamps_ns,
                "poses/initial": batch.poses,
            }
        )
    settings = load_sibling("salsa", "sequences").Settings()
    recording = RecordingConfig(
        paths=(folder / "a.bag",),
        environment="room",
        name="a",
        map_yaml=folder / "room.yaml",
        annotation=folder / "room.json",
        convert=None,
        salsa=settings,
        sightings=None,
        taxonomy=None,
        drop=None,
    )
    rooms.write_room(folder)
    made = label(recording, folder / "a.h5", [folder / "none.h5", folder / "b.h5"], Serial())
    return recording, folder / "a.h5", made


def test_a_sequence_is_labelled_into_the_last_place(room):
    _, source, made = room
    assert made.file == source.with_name("b.h5")
    assert (made.sequence_id, made.scans, made.accepted) == ("room--a--test", SCANS, SCANS)
    assert made.labelled_share == 1.0
    assert not made.kept


def test_a_copy_that_is_there_is_kept_wherever_it_is(room, tmp_path):
    recording, source, made = room
    before = made.file.stat().st_mtime_ns
    again = label(recording, source, [made.file, tmp_path / "c.h5"], Serial())
    assert again == replace(made, kept=True)
    assert made.file.stat().st_mtime_ns == before
    assert not list(tmp_path.iterdir())


def test_other_classes_label_anew(room, tmp_path):
    recording, source, made = room
    names, colours = (*SEMANTIC2D.names, "Dog"), (*SEMANTIC2D.colours, (9, 9, 9))
    other = replace(recording, taxonomy=Taxonomy(names, colours))
    assert find_labelled(other, source, [made.file]) is None
    again = label(other, source, [tmp_path / "b.h5"], Serial())
    with SequenceReader(again.file) as reader:
        assert reader.header.taxonomy.names == names
    assert find_labelled(other, source, [again.file]) == replace(again, kept=True)


def test_a_copy_by_other_settings_or_of_another_map_or_damaged_is_not_it(room, tmp_path):
    recording, source, made = room
    assert find_labelled(recording, source, [made.file]) is not None
    salsa = load_sibling("salsa", "sequences")
    acceptance = replace(recording.salsa.acceptance, inlier_m=0.2)
    other = replace(recording, salsa=salsa.Settings(acceptance=acceptance))
    assert find_labelled(other, source, [made.file]) is None
    other = replace(recording, annotation=tmp_path / "room.json")
    rooms.write_labelme(other.annotation, rooms.room_shapes()[:-1])
    assert find_labelled(other, source, [made.file]) is None
    damaged = tmp_path / "damaged.h5"
    damaged.write_bytes(made.file.read_bytes()[:5000])
    assert find_labelled(recording, source, [damaged, source]) is None
    damaged.write_bytes(made.file.read_bytes())
    with h5py.File(made.file) as file:
        chunk = file["scans/labels"].id.get_chunk_info(0)
    with damaged.open("r+b") as stream:
        stream.seek(chunk.byte_offset + chunk.size // 2)
        stream.write(b"\xff\x00\xff")
    assert find_labelled(recording, source, [damaged]) is None
    assert find_labelled(recording, source, [damaged, made.file]).file == made.file


def test_what_does_not_fit_is_an_error_and_leaves_nothing(room, tmp_path):
    recording, source, _ = room
    acceptance = replace(recording.salsa.acceptance, max_residual_m=1e-6)
    strict = replace(recording, salsa=replace(recording.salsa, acceptance=acceptance))
    with pytest.raises(AlignmentError, match="do not fit the map"):
        label(strict, source, [tmp_path / "c.h5"], Serial())
    assert not list(tmp_path.iterdir())
