"""Sequences back in the published layout."""

import json

import numpy as np
import pytest

from conversion.exports.npy import export_npy
from conversion.options import Options
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, WriteError
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from tests.conversion.releases import (
    contents,
    make_release,
    make_session,
    pack_tar,
    pack_zip,
    save,
    small_lidar,
    write_sequences,
)
from tests.generators import make_sequence

BEAMS = 7


@pytest.fixture
def options(tmp_path):
    return Options(lidar=small_lidar(tmp_path / "small.yaml", BEAMS))


def come_back(folder, tmp_path, options):
    """Convert a session and export it again; returns what the export says."""
    (file,) = write_sequences(folder, tmp_path, options)
    done = export_npy(file, tmp_path / "back")
    before, after = contents(folder), contents(tmp_path / "back")
    assert after.keys() == before.keys()
    assert [name for name in before if before[name] != after[name]] == []
    return done


def rewrite(source, target, change):
    """Write a sequence anew with some arrays changed."""
    with SequenceReader(source) as reader:
        arrays = {n: reader.read(n) for n in reader.names if n != "provenance"}
        arrays = {n: rows for n, rows in (arrays | change).items() if rows is not None}
        with SequenceWriter(target, reader.header) as writer:
            writer.append(arrays)
    return target


@pytest.mark.parametrize("dtype", ["<f4", "<f8", "<f2", ">f4", "<i8"])
def test_a_session_comes_back_byte_for_byte(tmp_path, options, dtype):
    folder = make_session(tmp_path / "s", scans=12, beams=BEAMS, dtype=dtype, more=True)
    done = come_back(folder, tmp_path, options)
    assert (
        set(done.identical) == set(done.fields) == {p.name for p in folder.iterdir() if p.is_dir()}
    )
    assert (done.scans, done.folder) == (12, tmp_path / "back")


def test_sessions_of_the_release_s_lidar_come_back_from_archives_too(tmp_path):
    release = make_release(tmp_path / "lobby", scans=3)
    for path in (pack_zip(release, tmp_path / "a.zip"), pack_tar(release, tmp_path / "a.tar.xz")):
        out = tmp_path / f"of-{path.name}"
        out.mkdir()
        for file in write_sequences(path, out):
            session = file.stem.split("--")[1]
            export_npy(file, out / "back" / session)
            assert contents(out / "back" / session) == contents(release / session)


def test_a_session_of_every_defect_comes_back_byte_for_byte(tmp_path, options):
    folder = make_session(tmp_path / "s", scans=12, beams=BEAMS, more=True)
    odd = np.array([np.nan, np.inf, -np.inf, -0.0, 1e39, 1e-310, 60.0])
    save(folder / "scans_lidar" / "0000000.npy", odd)
    save(folder / "intensities_lidar" / "0000001.npy", odd)
    save(folder / "semantic_label" / "0000002.npy", np.array([-1, 10, 2.5, np.nan, 255, -0.0, 9]))
    save(folder / "positions" / "0000003.npy", np.full(3, np.nan))
    save(folder / "velocities" / "0000004.npy", np.float32([1, 2]))
    save(folder / "line_segments" / "0000005.npy", np.asfortranarray(np.arange(12.0).reshape(3, 4)))
    save(folder / "line_segments" / "0000006.npy", np.arange(7.0))
    save(folder / "scans_lidar" / "0000007.npy", np.ones((1, BEAMS)))
    save(folder / "scans_lidar" / "0000008.npy", np.ones(BEAMS + 2))
    save(folder / "semantic_label" / "0000009.npy", np.array(["Wall"] * BEAMS))
    save(folder / "sub_goals_local" / "0000010.npy", np.arange(5.0))
    with (folder / "positions" / "0000011.npy").open("ab") as file:
        file.write(b"more")
    for name in ("semantic_label/0000000", "positions/0000001", "line_segments/0000002"):
        (folder / f"{name}.npy").unlink()
    (folder / "scans_lidar" / "0000003.npy").unlink()
    (folder / "train.txt").write_bytes(b"0000000.npy\r\n\r\n\xff")
    (folder / "notes").mkdir()
    (folder / "notes" / "weather.txt").write_text("rainy")
    come_back(folder, tmp_path, options)


def test_file_names_come_back_with_their_gaps(tmp_path, options):
    folder = make_session(tmp_path / "s", scans=4, beams=BEAMS)
    for field in [path for path in folder.iterdir() if path.is_dir()]:
        (field / "0000001.npy").rename(field / "frame 12.npy")
        (field / "0000003.npy").rename(field / "7.npy")
    come_back(folder, tmp_path, options)


def test_labels_made_anew_are_written_and_the_rest_stays_identical(tmp_path, options):
    folder = make_session(tmp_path / "s", scans=4, beams=BEAMS)
    save(folder / "semantic_label" / "0000001.npy", np.full(BEAMS, 77.0))
    (folder / "semantic_label" / "0000002.npy").unlink()
    (file,) = write_sequences(folder, tmp_path, options)
    labels = np.full((4, BEAMS), 3, np.uint8)
    poses = np.arange(12.0).reshape(4, 3)
    change = {"scans/labels": labels, "poses/refined": poses}
    done = export_npy(rewrite(file, tmp_path / "new.h5", change), tmp_path / "back")
    assert set(done.fields) - set(done.identical) == {"semantic_label", "positions"}
    before, after = contents(folder), contents(tmp_path / "back")
    for name in before:
        if name.partition("/")[0] not in ("semantic_label", "positions"):
            assert after[name] == before[name]
    for n in range(4):
        found = np.load(tmp_path / "back" / "semantic_label" / f"{n:07d}.npy", allow_pickle=False)
        assert (found.dtype, found.tolist()) == (np.dtype("<f4"), [3.0] * BEAMS)
        found = np.load(tmp_path / "back" / "positions" / f"{n:07d}.npy", allow_pickle=False)
        np.testing.assert_array_equal(found, poses[n])


def test_a_sequence_from_elsewhere_is_written_as_far_as_the_layout_goes(tmp_path):
    arrays = make_sequence(tmp_path / "a.h5", 5)
    members = np.array([0, 1, 2, 0, 255], np.uint8)
    done = export_npy(tmp_path / "a.h5", tmp_path / "out", members=members)
    assert done.identical == ()
    out = tmp_path / "out"

    def read(field):
        files = sorted((out / field).iterdir())
        assert [file.name for file in files] == [f"{n:07d}.npy" for n in range(5)]
        return np.array([np.load(file, allow_pickle=False) for file in files])

    ranges = arrays["scans/ranges"]
    np.testing.assert_array_equal(read("scans_lidar"), np.where(np.isfinite(ranges), ranges, 0))
    np.testing.assert_array_equal(read("intensities_lidar"), arrays["scans/intensities"])
    np.testing.assert_array_equal(read("semantic_label"), arrays["scans/labels"])
    assert read("semantic_label").dtype == np.float32
    np.testing.assert_array_equal(read("positions"), arrays["poses/refined"])
    np.testing.assert_array_equal(read("velocities"), arrays["commands/velocity"])
    assert (out / "train.txt").read_text() == "0000000.npy\n0000003.npy\n"
    assert (out / "dev.txt").read_text() == "0000001.npy\n"
    assert (out / "test.txt").read_text() == "0000002.npy\n"


def test_what_is_exported_converts_to_the_same_arrays(tmp_path, options):
    make_sequence(tmp_path / "a.h5", 6, drop=("poses/refined",))
    export_npy(tmp_path / "a.h5", tmp_path / "lobby" / "first")
    lidar = small_lidar(tmp_path / "37.yaml", 37)
    (file,) = write_sequences(tmp_path / "lobby" / "first", tmp_path, Options(lidar=lidar))
    with SequenceReader(tmp_path / "a.h5") as before, SequenceReader(file) as after:
        for name in ("scans/intensities", "scans/labels", "poses/initial", "commands/velocity"):
            np.testing.assert_array_equal(before.read(name), after.read(name))
        ranges = before.read("scans/ranges")
        np.testing.assert_array_equal(
            after.read("scans/ranges"), np.where(np.isfinite(ranges), ranges, np.inf)
        )


def test_lists_that_are_given_replace_those_that_were_kept(tmp_path, options):
    folder = make_session(tmp_path / "s", scans=3, beams=BEAMS)
    (file,) = write_sequences(folder, tmp_path, options)
    export_npy(file, tmp_path / "back", members=np.array([2, 2, 0], np.uint8))
    assert (tmp_path / "back" / "test.txt").read_text() == "0000000.npy\n0000001.npy\n"
    assert (tmp_path / "back" / "dev.txt").read_text() == ""
    with pytest.raises(InvalidInputError, match=r"one for each of 3 scans, found \(2,\)"):
        export_npy(file, tmp_path / "other", members=np.zeros(2, np.uint8))
    assert not (tmp_path / "other").exists()


def test_a_folder_that_holds_anything_is_never_touched(tmp_path):
    make_sequence(tmp_path / "a.h5", 2)
    (tmp_path / "out").mkdir()
    export_npy(tmp_path / "a.h5", tmp_path / "out")
    before = contents(tmp_path / "out")
    with pytest.raises(InvalidInputError, match="exists, and is no empty folder"):
        export_npy(tmp_path / "a.h5", tmp_path / "out")
    with pytest.raises(InvalidInputError, match="exists, and is no empty folder"):
        export_npy(tmp_path / "a.h5", tmp_path / "a.h5")
    assert contents(tmp_path / "out") == before


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_nothing_is_left_of_an_export_that_fails(tmp_path, monkeypatch, failure):
    make_sequence(tmp_path / "a.h5", 5)
    written = []

    def fail(path, content):
        written.append(path)
        if len(written) == 7:
            raise failure

    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    expected = WriteError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        export_npy(tmp_path / "a.h5", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path, monkeypatch):
    make_sequence(tmp_path / "a.h5", 2)

    def appear(self, members):
        save(tmp_path / "out" / "mine.npy", 1)

    monkeypatch.setattr(
        "conversion.exports.npy._Session._write_kept", lambda *_, **__: appear(0, 0)
    )
    with pytest.raises(InvalidInputError, match="exists, and is no empty folder"):
        export_npy(tmp_path / "a.h5", tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "out"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.npy"]


@pytest.fixture
def converted(tmp_path, options):
    folder = make_session(tmp_path / "s", scans=4, beams=BEAMS, more=True)
    (file,) = write_sequences(folder, tmp_path, options)
    return file


def text(value):
    return np.frombuffer(value.encode() if isinstance(value, str) else value, np.uint8)


def layout_of(file):
    with SequenceReader(file) as reader:
        return json.loads(reader.read("original/layout.json").tobytes())


@pytest.mark.parametrize("name", ["../evil.npy", "/evil.npy", "a/../../evil.npy", ""])
def test_kept_names_that_lead_outside_are_refused(tmp_path, converted, name):
    change = {
        "original/kept.names": text(f"{name}\0"),
        "original/kept.sizes": np.array([4]),
        "original/kept.bytes": text("evil"),
    }
    bad = rewrite(converted, tmp_path / "bad.h5", change)
    with pytest.raises(CorruptFileError, match="is no name of a file"):
        export_npy(bad, tmp_path / "out" / "deep")
    assert not list(tmp_path.rglob("evil*"))
    assert not (tmp_path / "out" / "deep").exists()


@pytest.mark.parametrize(
    "names", ["../a\0b\0c\0d\0", "a/b\0b\0c\0d\0", "a\0a\0c\0d\0", "a\0b\0", "..\0b\0c\0d\0"]
)
def test_scan_names_that_lead_outside_or_do_not_fit_are_refused(tmp_path, converted, names):
    bad = rewrite(converted, tmp_path / "bad.h5", {"original/scans.names": text(names)})
    with pytest.raises(CorruptFileError, match="/original is not valid"):
        export_npy(bad, tmp_path / "out")


def damage(said, how):
    forms = said["fields"]["scans_lidar"]["forms"]
    if how == "field":
        said["fields"]["../evil"] = said["fields"]["sub_goals_local"]
    elif how == "length":
        forms[0]["length"] = 10**15
    elif how == "head":
        forms[0]["head"] = "no header"
    elif how == "width":
        forms[0]["head"] = forms[0]["head"].replace("(7,)", "(8,)")
    elif how == "fields":
        said["fields"] = [1, 2]
    elif how == "forms":
        said["fields"]["scans_lidar"] = 7
    return said


@pytest.mark.parametrize("how", ["field", "length", "head", "width", "fields", "forms"])
def test_a_layout_that_was_tampered_with_is_refused(tmp_path, converted, how):
    said = damage(layout_of(converted), how)
    change = {"original/layout.json": text(json.dumps(said))}
    bad = rewrite(converted, tmp_path / "bad.h5", change)
    with pytest.raises(CorruptFileError, match="original"):
        export_npy(bad, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_newer_layout_is_refused_with_advice(tmp_path, converted):
    said = layout_of(converted) | {"version": 2}
    change = {"original/layout.json": text(json.dumps(said))}
    bad = rewrite(converted, tmp_path / "bad.h5", change)
    with pytest.raises(InvalidInputError, match="is of version 2, .* update it"):
        export_npy(bad, tmp_path / "out")


def test_a_sequence_that_lost_scans_is_written_as_it_is_now(tmp_path, converted):
    with SequenceReader(converted) as reader:
        scans = ("scans/", "poses/", "commands/")
        change = {n: reader.read(n)[:3] for n in reader.names if n.startswith(scans)}
        change["lines/offsets"] = reader.read("lines/offsets")[:4]
        change["lines/segments"] = reader.read("lines/segments")[: change["lines/offsets"][-1]]
    fewer = rewrite(converted, tmp_path / "fewer.h5", change)
    done = export_npy(fewer, tmp_path / "out")
    assert (done.scans, done.identical) == (3, ())
    assert len(list((tmp_path / "out" / "scans_lidar").iterdir())) == 3
    assert not (tmp_path / "out" / "sub_goals_local").exists()
