import hashlib
import re
import socket
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from semantic2d_dataset import cli, cli_corruption
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.corruption import (
    GENERATOR_VERSION,
    KINDS,
    SEVERITIES,
    corrupt_dataset,
    corrupt_into,
    corruption,
    remove_partials,
    set_name,
)
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.executors import Processes
from semantic2d_dataset.format.manifest import find_problems
from semantic2d_dataset.scoring.robustness import _SET
from semantic2d_dataset.simulation.mini import combined_digest
from tests.conftest import PROJECT
from tests.generators import SMALL_LIDAR, make_arrays

PINNED = {
    "range-noise": "b213b68f39aff7b9",
    "dropout": "e1d5b0d045dbfd34",
    "dimming": "2cbfa43026980b49",
    "coarse": "a45c57cbcdbe599a",
    "short-range": "c61925d9feaa6edc",
    "rain": "6475a746b6de9cb8",
}
RAIN_3 = "ebaf8142023ad351931e03a515931b77da289152350edeb51b0746a4618c384e"


def make_fields(scans=400):
    arrays = make_arrays(scans)
    return {name: arrays[f"scans/{name}"] for name in ("ranges", "intensities", "labels")}


def apply(kind, severity, fields, seed=0):
    return corruption(kind, severity)(fields, SMALL_LIDAR, np.random.default_rng(seed))


def damage(kind, severity):
    """How much a corruption changes."""
    before = make_fields()
    after = apply(kind, severity, before)
    name = "intensities" if kind == "dimming" else "ranges"
    one, other = (np.nan_to_num(f[name], posinf=50, neginf=0) for f in (before, after))
    return np.abs(one - other).mean()


@pytest.mark.parametrize("kind", KINDS)
def test_a_higher_severity_changes_more(kind):
    changes = [damage(kind, severity) for severity in SEVERITIES]
    assert changes[0] > 0
    assert changes == sorted(changes)


@pytest.mark.parametrize("kind", KINDS)
def test_the_given_arrays_stay_and_shapes_and_dtypes_are_kept(kind):
    fields = make_fields()
    kept = {name: values.copy() for name, values in fields.items()}
    after = apply(kind, 5, fields)
    for name, values in kept.items():
        np.testing.assert_array_equal(fields[name], values)
        assert (after[name].shape, after[name].dtype) == (values.shape, values.dtype)


def measured_level(kind, before, after):
    """What a corruption did, in the unit of its parameter."""
    there, still = (SMALL_LIDAR.has_return(fields["ranges"]) for fields in (before, after))
    ranges, changed = before["ranges"], after["ranges"]
    if kind == "range-noise":
        inner = there & (ranges > 3)  # not cut at the limits of the lidar
        return (changed[inner] - ranges[inner]).std()
    if kind == "dropout":
        return (there & ~still).sum() / there.sum()
    if kind == "dimming":
        ratio = after["intensities"] / before["intensities"]
        assert np.ptp(ratio) < 1e-6
        return ratio.mean()
    if kind == "coarse":
        borders = (np.diff(after["labels"], axis=1) != 0).any(axis=0)
        return np.diff(np.flatnonzero(borders)).max()
    if kind == "short-range":
        return (ranges[there & ~still].min() + changed[still].max()) / 2
    hit = (changed < ranges) & ~np.isneginf(changed)
    return hit.sum() / (there | np.isposinf(ranges)).sum()


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_does_what_the_table_of_the_guide_says(kind):
    (row,) = re.findall(rf"\| `{kind}` \| (.*?) \|", (PROJECT / "docs/scoring.md").read_text())
    unit = 100 if "%" in row else 1
    promised = [float(number) / unit for number in re.findall(r"[0-9.]+", row)[:5]]
    assert list(KINDS[kind][0]) == promised
    before = make_fields()
    for severity, level in zip(SEVERITIES, promised, strict=True):
        after = apply(kind, severity, before)
        close = 0.01 if kind in {"dropout", "rain"} else 0
        assert measured_level(kind, before, after) == pytest.approx(level, rel=0.03, abs=close)


@pytest.mark.parametrize("at", [6.0, np.nextafter(np.float32(6), np.float32(0))])
def test_what_lies_exactly_at_the_shortened_range_gives_no_return(at):
    ranges = np.full((1, SMALL_LIDAR.beams), at, np.float32)
    assert (np.isposinf(apply("short-range", 3, {"ranges": ranges})["ranges"]) == (at == 6)).all()


def test_dropped_and_far_beams_have_no_return_and_others_are_as_they_were():
    before = make_fields()
    for kind in ("dropout", "short-range"):
        after = apply(kind, 4, before)
        same = (after["ranges"] == before["ranges"]) | np.isnan(before["ranges"])
        assert (same | np.isposinf(after["ranges"])).all()
        assert (after["labels"] == before["labels"]).all()
    there = SMALL_LIDAR.has_return(after["ranges"])
    assert after["ranges"][there].max() < 4.0


@pytest.mark.parametrize(("severity", "step"), [(3, 4), (5, 8)])
def test_coarse_beams_are_those_of_their_nearest_kept_one_with_its_label(severity, step):
    before = make_fields()
    after = apply("coarse", severity, before)
    kept = np.arange(0, SMALL_LIDAR.beams, step)
    for name, values in after.items():
        np.testing.assert_array_equal(values[:, kept], before[name][:, kept])
        for k, near in enumerate(values.T):  # halfway between two, either may stand for it
            close = [c for c in kept if abs(c - k) == np.abs(kept - k).min()]
            assert any(
                np.array_equal(near, before[name][:, c], equal_nan=name != "labels") for c in close
            )


def test_rain_falls_before_what_a_beam_hits_and_is_background():
    before = make_fields()
    after = apply("rain", 5, before)
    changed = (after["ranges"] != before["ranges"]) & ~np.isnan(before["ranges"])
    hits = np.where(SMALL_LIDAR.has_return(before["ranges"]), before["ranges"], np.inf)
    assert 0.2 < changed.mean() < 0.26
    assert (after["ranges"][changed] <= np.minimum(hits[changed], 10.0)).all()
    assert SMALL_LIDAR.has_return(after["ranges"][changed]).all()
    assert (after["labels"][changed] == 0).all()
    shine = after["intensities"] / before["intensities"]
    assert shine[changed] == pytest.approx(0.3)
    assert (shine[~changed] == 1).all()
    assert (after["labels"][~changed] == before["labels"][~changed]).all()
    too_close = np.isneginf(before["ranges"])
    assert np.isneginf(after["ranges"][too_close]).all()


def test_a_lidar_without_intensities_can_be_corrupted():
    fields = make_fields()
    del fields["intensities"]
    for kind in KINDS:
        assert set(apply(kind, 2, fields)) == {"ranges", "labels"}


@pytest.mark.parametrize(("kind", "severity"), [("hail", 1), ("rain", 0), ("rain", 6)])
def test_unknown_corruptions_are_refused(kind, severity, dataset_folder, tmp_path):
    with pytest.raises(InvalidInputError, match="hail|expected 1 to 5"):
        corrupt_dataset(open_dataset(dataset_folder), tmp_path / "x", kind, severity)


def test_a_corrupted_set_holds_the_scans_of_the_split_and_says_what_was_done(
    dataset_folder, tmp_path
):
    data = open_dataset(dataset_folder)
    name = corrupt_dataset(data, tmp_path / "x", "rain", 2, scheme="frame")
    made = open_dataset(tmp_path / "x")
    assert name == made.manifest.name == "generated-1.0.0-rain-2"
    assert made.manifest.version == GENERATOR_VERSION
    assert find_problems(tmp_path / "x", full=True) == []
    for entry in data.manifest.sequences:
        rows = data.scheme("frame").scans_of(entry.id, "test")
        before, after = data.reader(entry.id), made.reader(entry.id)
        assert (made.scheme("frame").scans_of(entry.id, "test") == np.arange(len(rows))).all()
        for part in ("scans/stamps_ns", "poses/refined", "poses/initial"):
            assert (after.read(part) == before.read(part)[rows]).all()
        assert (after.read_map().labels == before.read_map().labels).all()
        said = after.header.provenance["corruption"]
        assert (said["kind"], said["severity"], said["seed"]) == ("rain", 2, 0)
        assert said["source"]["content_digest"] == entry.content_digest


def test_the_same_seed_gives_the_same_set_and_another_another(dataset_folder, tmp_path):
    data = open_dataset(dataset_folder)
    digests = []
    for n, seed in enumerate((0, 0, 1)):
        corrupt_dataset(data, tmp_path / str(n), "range-noise", 1, seed=seed)
        digests.append(combined_digest(open_dataset(tmp_path / str(n)).manifest))
    assert digests[0] == digests[1] != digests[2]
    assert open_dataset(tmp_path / "2").manifest.name.endswith("-range-noise-1-seed1")


def test_workers_write_what_one_process_writes_and_keep_what_is_there(dataset_folder, tmp_path):
    data = open_dataset(dataset_folder)
    items = [("dropout", 1), ("coarse", 2)]
    (tmp_path / "alone").mkdir()
    with Processes(2) as executor:
        folders = list(executor.map(partial(corrupt_into, data, tmp_path), items))
    for item, folder in zip(items, folders, strict=True):
        corrupt_dataset(data, tmp_path / "alone" / folder.name, *item)
        one, other = open_dataset(folder), open_dataset(tmp_path / "alone" / folder.name)
        assert combined_digest(one.manifest) == combined_digest(other.manifest)
        before = (folder / "dataset.json").stat().st_mtime_ns
        assert corrupt_into(data, tmp_path, item) == folder
        assert (folder / "dataset.json").stat().st_mtime_ns == before
    other = tmp_path / "dropout-1"
    with pytest.raises(InvalidInputError, match="exists already"):
        corrupt_dataset(data, other, "dropout", 1)


def test_a_set_of_other_scans_is_never_taken_for_the_one_that_is_asked_for(
    dataset_folder, tmp_path
):
    data = open_dataset(dataset_folder)
    corrupt_into(data, tmp_path, ("rain", 1), scheme="frame")
    assert corrupt_into(data, tmp_path, ("rain", 1), scheme="frame").name == "rain-1"
    (tmp_path / "rain-2").mkdir()
    cases = [(1, "frame", "val"), (1, "block", "test"), (2, "frame", "test")]
    for severity, scheme, split in cases:
        with pytest.raises(InvalidInputError, match=f"with {split} of {scheme}; choose another"):
            corrupt_into(data, tmp_path, ("rain", severity), scheme=scheme, split=split)
    with pytest.raises(InvalidInputError, match="unknown split 'tset'"):
        corrupt_into(data, tmp_path, ("rain", 1), scheme="frame", split="tset")


def test_what_processes_that_are_gone_left_half_written_is_removed(tmp_path):
    words = [sys.executable, "-c", "import os; print(os.getpid())"]
    child = subprocess.run(words, check=True, capture_output=True)
    owner = f"{socket.gethostname()}-{int(child.stdout)}-00"
    gone, other = tmp_path / f".rain-1.{owner}.partial", tmp_path / f".rain-2.{owner}.partial"
    for folder in (gone, other):
        (folder / "sequences").mkdir(parents=True)
    remove_partials(tmp_path, [("rain", 1)])
    assert [*tmp_path.iterdir()] == [other]


def test_every_kind_can_be_told_from_the_name_of_its_set():
    for kind in KINDS:
        parts = _SET.fullmatch(f"-{set_name(kind, 3)}")
        assert (parts["kind"], parts["severity"]) == (kind, "3")
        assert _SET.fullmatch(f"-{set_name(kind, 3, 7)}")["kind"] == kind


def digest_of(mini, kind):
    """SHA-256 of what a kind makes, in severity 3, of the first 200 Hokuyo scans of mini."""
    name = next(e.id for e in mini.manifest.sequences if e.lidar.startswith("hokuyo"))
    batch = mini.reader(name).batch(0, 200)
    fields = {n: getattr(batch, n) for n in ("ranges", "intensities", "labels")}
    found = corruption(kind, 3)(fields, batch.lidar, np.random.default_rng(0))
    digest = hashlib.sha256()
    for part in sorted(found):
        digest.update(found[part].tobytes())
    return digest.hexdigest()[:16]


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_seed_gives_never_changes_without_a_new_version(kind, mini):
    assert (GENERATOR_VERSION, digest_of(mini, kind)) == ("1.0.0", PINNED[kind])


def test_the_corrupted_set_of_mini_is_pinned(mini, tmp_path):
    corrupt_dataset(mini, tmp_path / "rain", "rain", 3)
    assert combined_digest(open_dataset(tmp_path / "rain").manifest) == RAIN_3


def test_the_command_says_all_kinds_and_refuses_a_file_or_a_place_that_is_not_there(
    dataset_folder, tmp_path, monkeypatch, capsys
):
    assert cli_corruption._KINDS.startswith(", ".join([*KINDS][:-1]) + f" or {[*KINDS][-1]};")
    (tmp_path / "file").touch()
    cases = {"file": "is a file", "no/where": "does not exist"}
    for out, message in cases.items():
        words = ["semantic2d", "corrupt", str(dataset_folder), str(tmp_path / out)]
        monkeypatch.setattr("sys.argv", words)
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert (end.value.code, message in capsys.readouterr().err) == (1, True)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_command_makes_sets(dataset_folder, tmp_path, monkeypatch, capsys):
    words = ["corrupt", dataset_folder, tmp_path / "out", "--kind", "dimming", "--severity", "5"]
    monkeypatch.setattr("sys.argv", ["semantic2d", *map(str, words)])
    for _ in range(2):
        with pytest.raises(SystemExit) as end:
            cli.main()
        assert end.value.code in (0, None)
        assert capsys.readouterr().out == f"{tmp_path / 'out' / 'dimming-5'}\n"
