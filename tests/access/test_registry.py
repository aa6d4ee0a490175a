import multiprocessing
import shutil
from pathlib import Path

import pytest

from semantic2d_dataset.access.places import HOME_VARIABLE, home
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import (
    ChecksumError,
    DatasetNotFoundError,
    InvalidInputError,
    Semantic2DError,
)
from semantic2d_dataset.format import locks
from semantic2d_dataset.format.writing import make_folder
from tests.generators import SMALL_LIDAR, make_dataset, make_sequence


@pytest.fixture
def small_home(tmp_path, monkeypatch):
    """A home in which the embedded data set is a small generated one."""
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "home"))
    monkeypatch.setattr("semantic2d_dataset.simulation.mini.make_mini", make_small)
    return tmp_path / "home"


def folders_in(home):
    return sorted(p.name for p in (home / "datasets").iterdir() if p.is_dir())


def make_small(folder):
    make_dataset(folder, environments=("a", "b", "c"), scans=20)


def test_home_is_where_the_variable_says(monkeypatch, tmp_path):
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path))
    assert home() == tmp_path
    monkeypatch.delenv(HOME_VARIABLE)
    assert "semantic2d" in str(home())


def test_mini_is_made_once(small_home, monkeypatch):
    first = open_dataset("semantic2d-mini")
    monkeypatch.setattr("semantic2d_dataset.simulation.mini.make_mini", None)
    second = open_dataset("semantic2d-mini")
    assert first == second
    assert len(first.sequences()) == 3


@pytest.mark.parametrize("damage", ["missing", "truncated", "no manifest"])
def test_damaged_mini_is_made_again(damage, small_home):
    data = open_dataset("semantic2d-mini")
    victim = data.root / data.manifest.sequences[0].file
    if damage == "missing":
        victim.unlink()
    elif damage == "truncated":
        victim.write_bytes(victim.read_bytes()[:-100])
    else:
        (data.root / "dataset.json").unlink()
    again = open_dataset("semantic2d-mini")
    assert victim.stat().st_size == again.manifest.sequences[0].bytes
    assert sorted(p.name for p in (small_home / "datasets").iterdir() if p.is_dir()) == [
        data.root.name
    ]


def test_interrupted_making_leaves_nothing(small_home, monkeypatch):
    def interrupted(folder):
        (folder / "half").write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr("semantic2d_dataset.simulation.mini.make_mini", interrupted)
    with pytest.raises(KeyboardInterrupt):
        open_dataset("semantic2d-mini")
    assert folders_in(small_home) == []


def open_in_child(queue):
    locks.FileLock = NoLock  # as on file systems where locks do nothing
    from semantic2d_dataset.simulation import mini

    mini.make_mini = make_small
    queue.put(len(open_dataset("semantic2d-mini").sequences()))


class NoLock:
    def __init__(self, path: Path) -> None:
        pass

    def acquire(self, **_: object) -> None:
        raise NotImplementedError


@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.long)])
def test_processes_without_locks_make_one_good_data_set(count, small_home):
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    workers = [context.Process(target=open_in_child, args=(queue,)) for _ in range(count)]
    for worker in workers:
        worker.start()
    assert [queue.get(timeout=120) for _ in workers] == [3] * count
    for worker in workers:
        worker.join()
    (folder,) = folders_in(small_home)
    assert len(open_dataset(small_home / "datasets" / folder).sequences()) == 3


@pytest.mark.parametrize("name", ["semantic2d-maxi", "/nowhere"])
def test_unknown_data_set_lists_the_known(name):
    with pytest.raises(DatasetNotFoundError, match="neither a folder .* nor .*known data set"):
        open_dataset(name)


def test_sequences_are_found_by_lidar(dataset_folder):
    data = open_dataset(dataset_folder)
    assert len(data.sequences("small")) == 3
    with pytest.raises(DatasetNotFoundError, match="it has small"):
        data.sequences("wlr716")


def test_file_changed_since_publishing_is_refused(dataset_folder, tmp_path):
    data = open_dataset(shutil.copytree(dataset_folder, tmp_path / "copy"))
    make_sequence(data.root / "sequences" / "lobby--first--small.h5", 20)
    with pytest.raises(ChecksumError, match="publish the data set again"):
        data.reader("lobby--first--small")
    shutil.copy(data.root / "splits" / "frame.h5", data.root / "splits" / "block.h5")
    with pytest.raises(Semantic2DError, match="block"):
        data.scheme("block")


def test_a_path_is_a_folder_even_if_named_like_a_known_data_set(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DatasetNotFoundError, match="semantic2d-mini: neither a folder"):
        open_dataset(Path("semantic2d-mini"))


def test_faster_process_s_data_set_is_kept(small_home):
    data = open_dataset("semantic2d-mini")
    before = (data.root / "dataset.json").stat().st_ino
    make_folder(data.root, make_small, lambda: True)
    assert (data.root / "dataset.json").stat().st_ino == before
    assert sorted(p.name for p in (small_home / "datasets").iterdir() if p.is_dir()) == [
        data.root.name
    ]


def test_reader_and_scheme_name_what_is_missing(dataset_folder, tmp_path):
    data = open_dataset(shutil.copytree(dataset_folder, tmp_path / "copy"))
    assert data.reader("lobby--first--small").lidar == SMALL_LIDAR
    with pytest.raises(DatasetNotFoundError, match="has no sequence 'x'"):
        data.reader("x")
    with pytest.raises(InvalidInputError, match="unknown scheme 'x'; known are block"):
        data.scheme("x")
    (data.root / data.manifest.sequences[0].file).unlink()
    with pytest.raises(DatasetNotFoundError, match="missing"):
        data.reader(data.manifest.sequences[0].id)
