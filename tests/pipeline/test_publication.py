import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, Semantic2DError
from semantic2d_dataset.format.manifest import find_problems, read_manifest
from semantic2d_dataset.pipeline.config import Config
from semantic2d_dataset.pipeline.publication import publish_sequences
from tests.generators import SMALL_LIDAR, make_sequence
from tests.pipeline.drives import files_of

PLACES = ("lobby", "hall", "office")


def make_config(folder: Path, **changes: object) -> Config:
    config = Config(folder / "c.yaml", "rooms", "1.0.0", "MIT", folder / "data", (), None)
    return replace(config, **changes)


@pytest.fixture
def made(tmp_path):
    """Sequences of three environments, published; their paths as they are now."""
    (tmp_path / "data" / "work" / "labelled").mkdir(parents=True)
    config = make_config(tmp_path)
    assert publish_sequences(config, [write(tmp_path, place) for place in PLACES], {})
    return config, [config.out / "sequences" / f"{place}--a--small.h5" for place in PLACES]


def write(folder: Path, place: str, seed: int = 0) -> Path:
    path = folder / "data" / "work" / "labelled" / f"{place}--a--small.h5"
    make_sequence(path, 40, environment=place, recording="a", seed=seed)
    return path


def test_sequences_move_into_the_data_set_and_are_described(made):
    config, files = made
    assert all(file.is_file() and not file.is_symlink() for file in files)
    assert not find_problems(config.out, full=True)
    manifest = read_manifest(config.out)
    assert (manifest.name, manifest.license) == ("rooms", "MIT")
    assert sorted(manifest.splits) == ["block", "environment", "frame"]
    assert [path.name for path in (config.out / "work").iterdir()] == ["labelled"]


def test_what_is_published_already_is_not_touched(made):
    config, files = made
    before = files_of(config.out)
    assert not publish_sequences(config, files, {})
    assert files_of(config.out) == before


@pytest.mark.parametrize(
    "change",
    [
        {"version": "1.0.1"},
        {"license": "CC0-1.0"},
        {"splits": {"frame": {"seed": 1}}},
        {"splits": {"block": {"gap_s": 0.1}}},
        {"splits": {"environment": {"val": ["hall"], "test": ["lobby"]}}},
    ],
)
def test_what_is_said_otherwise_is_published_again(change, made):
    config, files = made
    assert publish_sequences(replace(config, **change), files, {})
    manifest = read_manifest(config.out)
    assert sorted(manifest.splits) == sorted(
        change.get("splits", ["block", "environment", "frame"])
    )
    assert not find_problems(config.out, full=True)
    assert not publish_sequences(replace(config, **change), files, {})


def test_lidars_are_divided_as_said(tmp_path):
    folder = tmp_path / "data" / "work" / "labelled"
    folder.mkdir(parents=True)
    lidars = [replace(SMALL_LIDAR, name=name) for name in ("small", "other")]
    files = [folder / f"hall--a--{lidar.name}.h5" for lidar in lidars]
    for file, lidar in zip(files, lidars, strict=True):
        make_sequence(file, 100, environment="hall", recording="a", lidar=lidar)
    config = make_config(tmp_path, splits={"lidar": {"test": ["other"], "gap_s": 0.2}})
    assert publish_sequences(config, files, {})
    scheme = OpenDataset(config.out, read_manifest(config.out)).scheme("lidar")
    assert scheme.made_by.startswith("train small; test other; ")
    assert len(scheme.scans_of("hall--a--other", "test")) == 100
    assert not len(scheme.scans_of("hall--a--small", "test"))
    unknown = replace(config, splits={"lidar": {"test": ["othr"]}})
    with pytest.raises(InvalidInputError, match="lidar 'othr'; did you mean 'other'?"):
        publish_sequences(unknown, sorted((config.out / "sequences").glob("*.h5")), {})


def test_dropped_scans_belong_to_no_split(made):
    config, files = made
    dropped = {"hall--a--small": np.array([1, 2])}
    assert publish_sequences(config, files, dropped)
    assert not publish_sequences(config, files, dropped)
    assert publish_sequences(config, files, {})


def test_what_is_damaged_or_gone_is_made_again(made):
    config, files = made
    (config.out / "splits" / "frame.h5").unlink()
    assert publish_sequences(config, files, {})
    (config.out / "dataset.json").write_text("{")
    assert publish_sequences(config, files, {})
    assert not find_problems(config.out, full=True)


def damage(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2 :] = bytes(len(content) - len(content) // 2)
    file.write_bytes(content)


@pytest.mark.parametrize("wrong", ["sequence", "splits"])
def test_where_it_cannot_be_published_the_old_one_stays(wrong, made, tmp_path):
    config, files = made
    before = files_of(config.out)
    new = write(tmp_path, "hall", seed=1)
    if wrong == "sequence":
        damage(new)
    else:
        config = replace(config, splits={"environment": {"val": ["moon"]}})
    with pytest.raises(CorruptFileError if wrong == "sequence" else InvalidInputError):
        publish_sequences(config, [files[0], new, files[2]], {})
    assert files_of(config.out) == before
    assert not find_problems(config.out, full=True)


def test_a_stage_that_was_left_behind_is_in_nobodys_way(made, tmp_path):
    config, files = made
    (config.out / "work" / "staged" / "sequences").mkdir(parents=True)
    shutil.copy(files[0], config.out / "work" / "staged" / "sequences" / "other.h5")
    new = write(tmp_path, "hall", seed=1)
    assert publish_sequences(config, [files[0], new, files[2]], {})
    assert not find_problems(config.out, full=True)
    assert not list((config.out / "work").rglob("*.h5"))


def test_no_sequence_at_all_is_an_error(tmp_path):
    with pytest.raises(Semantic2DError):
        publish_sequences(make_config(tmp_path), [], {})
