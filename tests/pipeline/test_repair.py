"""Repair of data sets of every origin: converted, published as they are, generated, one's own."""

import shutil
from dataclasses import replace

import pytest

from semantic2d_dataset.access.download import download_folder
from semantic2d_dataset.access.installed import data_folder
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import (
    ChecksumError,
    DatasetNotFoundError,
    DownloadError,
    OfflineError,
    Semantic2DError,
)
from semantic2d_dataset.format.manifest import find_problems, publish
from semantic2d_dataset.pipeline.installation import install
from semantic2d_dataset.pipeline.repair import repair
from semantic2d_dataset.publishing.release import release
from tests.access import hosts
from tests.generators import make_dataset, make_sequence
from tests.pipeline.published import archives_at, files_at, files_in, write_registry


def flip(path):
    body = bytearray(path.read_bytes())
    body[len(body) // 2] ^= 0xFF
    path.write_bytes(body)


def truncate(path):
    path.write_bytes(path.read_bytes()[:-1000])


def remove(path):
    path.unlink()


HARM = {"flipped": flip, "truncated": truncate, "missing": remove}


@pytest.fixture
def registry(host, tmp_path):
    return write_registry(tmp_path / "registry.json", host)


def states_of(data):
    """What tells a file from one that took its place, which may get its inode's number."""
    states = {e.file: (data.root / e.file).stat() for e in data.manifest.files}
    return {name: (state.st_ino, state.st_mtime_ns) for name, state in states.items()}


@pytest.mark.parametrize("harm", HARM)
def test_converted_sequence_is_converted_again_and_no_other(harm, installed, host, registry):
    before, victim = states_of(installed), installed.manifest.sequences[0].file
    HARM[harm](installed.root / victim)
    asked = len(host.offsets)
    assert repair(installed.root, registry=registry) == [victim]
    again = open_dataset(installed.root)
    assert find_problems(installed.root, full=True) == []
    assert (
        again.manifest.sequences[0].content_digest == installed.manifest.sequences[0].content_digest
    )
    assert again.manifest.sequences[1:] == installed.manifest.sequences[1:]
    assert again.manifest.splits == installed.manifest.splits
    after = states_of(again)
    assert {name for name in after if after[name] != before[name]} == {victim}
    assert len(host.offsets) == asked  # the archive was kept
    assert sorted(p.name for p in installed.root.parent.iterdir()) == [".d-1.lock", "d-1"]


def test_archive_that_was_not_kept_is_fetched_for_repair_and_not_kept_again(host, home, registry):
    known = archives_at(host)
    data = install(known, remove_archives=True).data
    flip(data.root / data.manifest.sequences[0].file)
    asked = len(host.requests)
    repair(data.root, registry=registry)
    assert find_problems(data.root, full=True) == []
    fetched = [path for path, *_ in host.requests[asked:] if "/files/" in path]
    assert [path.rpartition("/")[2] for path in fetched] == ["hall.tar.gz"]
    assert not list(download_folder(known).glob("[!.]*"))


def test_archive_that_is_damaged_too_is_fetched_again(installed, host, registry):
    known = archives_at(host)
    flip(installed.root / installed.manifest.sequences[0].file)
    flip(download_folder(known) / "hall.tar.gz")
    repair(installed.root, registry=registry)
    assert find_problems(installed.root, full=True) == []


@pytest.mark.parametrize("scheme", ["block", "frame"])
@pytest.mark.parametrize("harm", ["flipped", "missing"])
def test_split_is_made_again_as_it_was(scheme, harm, installed, host, registry):
    before = installed.scheme(scheme).digest
    HARM[harm](installed.root / f"splits/{scheme}.h5")
    assert repair(installed.root, registry=registry) == [f"splits/{scheme}.h5"]
    again = open_dataset(installed.root)
    assert again.scheme(scheme).digest == before
    assert again.manifest.sequences == installed.manifest.sequences
    assert find_problems(installed.root, full=True) == []


@pytest.mark.parametrize("harm", [*HARM, "edited"])
def test_manifest_is_had_again_from_its_copy(harm, installed, host, registry):
    path = installed.root / "dataset.json"
    before = path.read_bytes()
    if harm == "edited":
        path.write_bytes(before.replace(b"CC0-1.0", b"CC1-1.0"))
    else:
        HARM[harm](path)
    assert repair(installed.root, registry=registry) == ["dataset.json"]
    assert path.read_bytes() == before


def test_everything_may_be_damaged_at_once(installed, host, registry):
    for entry in installed.manifest.files:
        flip(installed.root / entry.file)
    (installed.root / "dataset.json").write_text("{")
    assert len(repair(installed.root, registry=registry)) == len(installed.manifest.files) + 1
    again = open_dataset(installed.root)
    assert [e.content_digest for e in again.manifest.sequences] == [
        e.content_digest for e in installed.manifest.sequences
    ]
    assert find_problems(installed.root, full=True) == []


def test_whole_data_set_is_left_as_it_is(installed, host, registry):
    before = {p: p.stat().st_mtime_ns for p in installed.root.rglob("*")}
    assert repair(installed.root, registry=registry) == []
    assert {p: p.stat().st_mtime_ns for p in installed.root.rglob("*")} == before


@pytest.mark.parametrize("harm", HARM)
def test_file_of_a_published_data_set_is_fetched_again_and_no_other(
    harm, make_host, home, tmp_path, monkeypatch
):
    make_dataset(tmp_path / "there", scans=20)
    host = make_host(files_in(tmp_path / "there"))
    known = files_at(host)
    monkeypatch.setattr("semantic2d_dataset.pipeline.repair.find_known", lambda *_: known)
    data = install(known).data
    victims = [data.manifest.sequences[1].file, "splits/block.h5"]
    for victim in victims:
        HARM[harm](data.root / victim)
    asked = len(host.requests)
    assert repair(data.root) == victims
    assert open_dataset(data.root) == data
    fetched = [path.removeprefix("/files/") for path, *_ in host.requests[asked:]]
    assert sorted(fetched) == victims


@pytest.mark.parametrize(
    "victims", [["DATASET_CARD.md"], ["splits/block.h5"], ["SHA256SUMS"], ["dataset.json"]]
)
def test_released_data_set_is_repaired_to_the_byte(victims, make_host, home, tmp_path, monkeypatch):
    make_dataset(tmp_path / "there", scans=20)
    release(tmp_path / "there", version="1.0.0", license="CC0-1.0")
    published = files_in(tmp_path / "there")
    known = files_at(make_host(published))
    monkeypatch.setattr("semantic2d_dataset.pipeline.repair.find_known", lambda *_: known)
    data = install(known).data
    for victim in victims:
        flip(data.root / victim)
    assert repair(data.root) == victims
    assert find_problems(data.root, full=True) == []
    now = files_in(data.root)
    assert {name: now[name] for name in published} == published


@pytest.fixture
def small_mini(home, monkeypatch):
    """An embedded data set that is quick to make."""
    monkeypatch.setattr("semantic2d_dataset.simulation.mini.make_mini", make_small)
    return open_dataset("semantic2d-mini")


def make_small(folder):
    return make_dataset(folder, scans=20)


@pytest.mark.parametrize("harm", HARM)
def test_generated_data_set_is_generated_again_where_it_is_damaged(harm, small_mini):
    data, before = small_mini, states_of(small_mini)
    victims = [data.manifest.sequences[0].file, "splits/frame.h5"]
    for victim in victims:
        HARM[harm](data.root / victim)
    assert repair(data.root) == victims
    again = open_dataset(data.root)
    assert find_problems(data.root, full=True) == []
    after = states_of(again)
    assert sorted(name for name in after if after[name] != before[name]) == victims
    assert again.manifest.sequences[1:] == data.manifest.sequences[1:]
    assert again.scheme("frame").digest == publish_again(data).scheme("frame").digest


def publish_again(data):
    publish(data.root, name="generated", version="1.0.0", license="CC0-1.0")
    return open_dataset(data.root)


def test_generator_that_draws_other_data_repairs_nothing(small_mini, monkeypatch):
    def make_other(folder):
        make_dataset(folder, scans=20)
        make_sequence(folder / "sequences" / "lobby--first--small.h5", 20, seed=9)
        return publish(folder, name="generated", version="1.0.0")

    monkeypatch.setattr("semantic2d_dataset.simulation.mini.make_mini", make_other)
    victim = small_mini.root / "sequences" / "lobby--first--small.h5"
    flip(victim)
    before = files_in(small_mini.root)
    with pytest.raises(ChecksumError, match="holds other data than it did"):
        repair(small_mini.root)
    assert files_in(small_mini.root) == before


def test_data_set_of_ones_own_says_what_cannot_be_repaired(home, tmp_path):
    make_dataset(tmp_path / "mine", scans=20)
    data = open_dataset(tmp_path / "mine")
    assert repair(data.root) == []
    flip(data.root / data.manifest.sequences[0].file)
    with pytest.raises(DatasetNotFoundError, match=r"cannot be repaired, .* get seq"):
        repair(data.root)
    (data.root / "dataset.json").write_text("{")
    with pytest.raises(DatasetNotFoundError, match=r"no copy is here: publish the sequences again"):
        repair(data.root)


def test_repair_that_fails_changes_nothing(host, home, registry):
    data = install(archives_at(host), remove_archives=True).data
    flip(data.root / data.manifest.sequences[0].file)
    before = files_in(data.root)
    with pytest.raises(OfflineError):
        repair(data.root, registry=registry, offline=True)
    host.moods = [hosts.status(404)] * 2
    with pytest.raises(DownloadError):
        repair(data.root, registry=registry)
    assert files_in(data.root) == before
    repair(data.root, registry=registry)
    assert find_problems(data.root, full=True) == []


def test_repair_of_a_data_set_that_no_registry_knows_says_so(installed):
    flip(installed.root / installed.manifest.sequences[0].file)
    with pytest.raises(Semantic2DError, match="d@1: not a known data set"):
        repair(installed.root)


def test_data_set_in_a_chosen_folder_is_repaired_there(host, home, registry, tmp_path):
    data = install(archives_at(host), tmp_path / "mine").data
    truncate(data.root / data.manifest.sequences[0].file)
    repair(data.root, registry=registry)
    assert find_problems(tmp_path / "mine", full=True) == []
    assert not data_folder(archives_at(host)).exists()


def test_record_that_is_damaged_is_no_help(installed, host, registry):
    (installed.root / ".installed.json").write_text("{")
    assert repair(installed.root, registry=registry) == []
    flip(installed.root / installed.manifest.sequences[0].file)
    with pytest.raises(DatasetNotFoundError, match="not installed from a registry"):
        repair(installed.root, registry=registry)


def test_lidars_that_were_not_chosen_are_not_added_by_repair(host, home, registry):
    known = replace(archives_at(host), lidars={})
    data = install(known, lidars=["hokuyo"]).data
    flip(data.root / data.manifest.sequences[0].file)
    shutil.rmtree(download_folder(known))
    repair(data.root, registry=registry)
    assert len(open_dataset(data.root).manifest.sequences) == 1
