"""Data sets that are installed from a host on this machine, on good days and bad ones."""

import json
import multiprocessing
import os
import random
import shutil
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from conversion.jobs import convert_recordings
from semantic2d_dataset.access.download import download_folder
from semantic2d_dataset.access.installed import data_folder, is_complete
from semantic2d_dataset.access.known_datasets import find_known
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.errors import (
    ChecksumError,
    DatasetNotFoundError,
    DownloadError,
    InvalidInputError,
    OfflineError,
    RecordingError,
    WriteError,
)
from semantic2d_dataset.format import locks
from semantic2d_dataset.format.manifest import find_problems
from semantic2d_dataset.pipeline.archives import Converter
from semantic2d_dataset.pipeline.installation import full_version, install
from tests.access import hosts
from tests.conversion.releases import make_release, pack_zip
from tests.generators import SMALL_LIDAR, make_dataset
from tests.pipeline.published import (
    HOKUYO,
    WLR,
    archives_at,
    files_at,
    files_in,
    pack_archives,
    write_registry,
)


def lidars_of(data):
    return sorted({entry.lidar for entry in data.manifest.sequences})


def folders_in(home):
    return sorted(p.name for p in (home / "datasets").iterdir() if p.is_dir())


def digests_of(data):
    return {entry.id: entry.content_digest for entry in data.manifest.sequences}


def test_published_archives_become_the_data_set_that_conversion_makes(host, home, tmp_path):
    known = archives_at(host)
    done = install(known)
    data = open_dataset(data_folder(known))
    assert (data.manifest.name, data.manifest.version) == ("d", "1.0.0")
    assert data.manifest.license == "CC0-1.0"
    assert find_problems(data.root, full=True) == []
    direct = {}
    for name in ("lobby.zip", "hall.tar.gz"):
        list(convert_recordings([[done.archives / name]], tmp_path / name))
        made = open_dataset(tmp_path / name)
        direct |= digests_of(made)
        frame, found = made.scheme("frame"), data.scheme("frame")
        for sequence_id, members in frame.membership.items():
            assert np.array_equal(found.membership[sequence_id], members)
            lists = f"splits/frame/{sequence_id}/train.txt"
            assert (data.root / lists).read_bytes() == (made.root / lists).read_bytes()
    assert digests_of(data) == direct
    assert folders_in(home) == ["d-1"]
    assert sorted(p.name for p in data.root.iterdir()) == [
        ".installed.json",
        "dataset.json",
        "sequences",
        "splits",
    ]
    assert sorted(p.name for p in done.archives.glob("[!.]*")) == ["hall.tar.gz", "lobby.zip"]


def test_installed_data_set_needs_no_host(host, home):
    known = archives_at(host)
    assert install(known, remove_archives=True).changed
    assert not list(download_folder(known).glob("[!.]*"))
    asked = len(host.requests)
    assert not install(known).changed
    assert not install(known, lidars=["wlr716"], offline=True).changed
    assert len(host.requests) == asked


def test_lidars_are_chosen_and_others_added_later(host, home):
    known = archives_at(host)
    data = install(known, lidars=["hokuyo"]).data
    assert lidars_of(data) == [HOKUYO]
    assert [path for path, *_ in host.requests if "hall" in path] == []
    before = {p.name: p.stat().st_ino for p in data.root.glob("sequences/*")}
    lists = data.scheme("frame").membership
    data = install(known, lidars=["wlr716"]).data
    assert lidars_of(data) == [HOKUYO, WLR]
    assert {
        p.name: p.stat().st_ino for p in data.root.glob("sequences/*")
    }.items() >= before.items()
    assert find_problems(data.root, full=True) == []
    found = data.scheme("frame").membership
    assert all(np.array_equal(found[name], each) for name, each in lists.items())
    assert install(known).data == data
    assert folders_in(home) == ["d-1"]


def test_all_lidars_may_follow_some_of_them(host, home):
    known = replace(archives_at(host), lidars={})
    install(known, lidars=["hokuyo"])
    assert lidars_of(install(known).data) == [HOKUYO, WLR]
    assert not install(known).changed
    assert not install(archives_at(host)).changed


def test_data_set_of_chosen_files_is_gone_on_with(host, home):
    known = archives_at(host)
    assert lidars_of(install(known, only=["hall*"]).data) == [WLR]
    before = {p.name: p.stat().st_ino for p in data_folder(known).glob("sequences/*")}
    assert lidars_of(install(known).data) == [HOKUYO, WLR]
    after = {p.name: p.stat().st_ino for p in data_folder(known).glob("sequences/*")}
    assert after.items() > before.items()


def test_one_archive_of_several_lidars_gives_those_that_are_wanted(make_host, home, tmp_path):
    folder = tmp_path / "both"
    make_release(folder / "one", scans=4, sessions=("2024-04-04-12-16-41",))
    make_release(folder / "two", scans=4, sessions=("2024-04-04-12-16-41",), beams=811)
    host = make_host({"all.zip": pack_zip(folder, tmp_path / "all.zip").read_bytes()})
    known = replace(archives_at(host), lidars={})
    assert lidars_of(install(known, lidars=["hokuyo"]).data) == [HOKUYO]
    assert lidars_of(install(known, lidars=["wlr716"]).data) == [HOKUYO, WLR]
    assert not install(known, lidars=["wlr716", "hokuyo"]).changed
    with pytest.raises(DatasetNotFoundError, match="nothing in all.zip was measured by rplidar-s2"):
        install(replace(known, version="2"), lidars=["rplidar"])


def test_archives_go_as_soon_as_what_they_gave_is_complete(host, home, monkeypatch):
    known = archives_at(host)
    seen = []
    original = Converter._convert

    def note(self, file, lidars):
        seen.append(sorted(p.name for p in self.archives.glob("[!.]*")))
        return original(self, file, lidars)

    monkeypatch.setattr(Converter, "_convert", note)
    done = install(known, remove_archives=True)
    assert seen == [["hall.tar.gz"], ["lobby.zip"]]
    assert done.archives is None


def test_folder_of_ones_own_has_its_archives_beside_it(host, home, tmp_path):
    known = archives_at(host)
    done = install(known, tmp_path / "big" / "scans")
    assert done.data.root == tmp_path / "big" / "scans"
    assert done.archives == tmp_path / "big" / "scans-archives"
    assert not (home / "datasets").exists()
    assert not install(known, tmp_path / "big" / "scans").changed


@pytest.mark.parametrize("what", ["files", "data set", "other", "file"])
def test_folder_of_something_else_is_left_alone(what, host, home, tmp_path):
    folder = tmp_path / "mine"
    if what == "file":
        folder.write_text("mine")
    elif what == "files":
        folder.mkdir()
        (folder / "mine.txt").write_text("mine")
    elif what == "data set":
        make_dataset(folder, scans=20)
    else:
        install(archives_at(host, version="2"), folder)
    before = files_in(folder)
    with pytest.raises(InvalidInputError, match=r"choose (a new|another) folder"):
        install(archives_at(host), folder)
    assert files_in(folder) == before


def test_data_set_in_this_format_is_got_as_it_is(make_host, home, tmp_path):
    make_dataset(tmp_path / "there", scans=20)
    known = files_at(make_host(files_in(tmp_path / "there")))
    data = install(known).data
    found = files_in(data.root)
    assert found.pop(".installed.json")
    assert found == files_in(tmp_path / "there")
    assert not download_folder(known).exists()
    assert folders_in(home) == ["d-1"]


def test_lidars_of_a_data_set_in_this_format_are_chosen(make_host, home, tmp_path):
    other = replace(SMALL_LIDAR, name="other")
    make_dataset(tmp_path / "there", scans=20, lidars=(SMALL_LIDAR, other))
    whole = open_dataset(tmp_path / "there")
    host = make_host(files_in(tmp_path / "there"))
    known = files_at(host)
    data = install(known, lidars=["other"]).data
    assert lidars_of(data) == ["other"]
    assert find_problems(data.root, full=True) == []
    assert not any("--small" in path for path, *_ in host.requests)
    block = data.scheme("block").membership
    assert all(np.array_equal(whole.scheme("block").membership[n], m) for n, m in block.items())
    asked = len(host.requests)
    data = install(known, lidars=["small"]).data
    assert lidars_of(data) == ["other", "small"]
    assert not any("--other" in path for path, *_ in host.requests[asked:])
    assert files_in(data.root / "splits") == files_in(tmp_path / "there" / "splits")
    with pytest.raises(DatasetNotFoundError, match="no sequence of third; it has other, small"):
        install(replace(known, version="2"), lidars=["third"])
    with pytest.raises(InvalidInputError, match="of which --only takes no part"):
        install(replace(known, version="2"), only=["dataset.json"])


def test_what_is_no_recording_is_left_as_it_is(make_host, archives, home, tmp_path, capsys):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "a.pth").write_text("weights")
    other = pack_zip(tmp_path / "models", tmp_path / "models.zip").read_bytes()
    lobby = {"lobby.zip": archives["lobby.zip"]}
    host = make_host({"models.zip": other, "README.md": b"# Read me"} | lobby)
    done = install(replace(archives_at(host), lidars={}))
    assert lidars_of(done.data) == [HOKUYO]
    said = capsys.readouterr().err
    assert "left as it is: " in said
    assert "models.zip: holds no recording that is known" in said
    assert (done.archives / "README.md").is_file()


BAD_DAYS = {
    "cut": [hosts.cut_after(100), hosts.cut_after(3000)],
    "stalled": [hosts.stall],
    "busy": [hosts.status(503, Retry_After="7"), hosts.status(429)],
    "wrong bytes": [hosts.other_bytes],
    "web page": [hosts.web_page],
    "other length": [hosts.other_length],
}


@pytest.mark.parametrize("mood", BAD_DAYS)
def test_host_that_misbehaves_for_a_while_does_no_harm(mood, host, home):
    host.moods = list(BAD_DAYS[mood])
    data = install(archives_at(host)).data
    assert lidars_of(data) == [HOKUYO, WLR]
    assert find_problems(data.root, full=True) == []
    assert not list(home.rglob("*.partial"))
    assert not list(home.rglob("*.resume"))


def test_host_that_serves_other_bytes_installs_nothing(host, home):
    host.checksums["lobby.zip"] = hosts.md5(b"another file")
    with pytest.raises(ChecksumError, match=r"lobby.zip: could not be had: .*other content than"):
        install(archives_at(host))
    assert folders_in(home) == []
    host.checksums["lobby.zip"] = hosts.md5(host.files["lobby.zip"])
    install(archives_at(host))
    assert folders_in(home) == ["d-1"]


def test_unreachable_host_and_offline_each_say_so(host, home):
    known = archives_at(host)
    with pytest.raises(OfflineError, match="d@1: offline, and its list of files is not here"):
        install(known, offline=True)
    host.list_moods = [hosts.status(404)]
    with pytest.raises(DownloadError, match="no host lists its files: .* answers 404"):
        install(known)
    install(known, lidars=["hokuyo"])
    with pytest.raises(OfflineError, match=r"offline, and hall.tar.gz is missing; put them into"):
        install(known, offline=True)


def test_archives_that_are_here_are_installed_offline(host, home):
    known = archives_at(host)
    install(known)
    shutil.rmtree(data_folder(known))
    asked = len(host.requests)
    assert install(known, offline=True).changed
    assert len(host.requests) == asked


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"", "a.zip: "),
        (b"PK\x05\x06" + bytes(18), "holds no recording that is known: .* found nothing"),
        (b"PK\x03\x04" + bytes(100), "a.zip: "),
    ],
)
def test_archive_that_holds_nothing_is_one_clear_error(body, message, make_host, home):
    host = make_host({"a.zip": body})
    with pytest.raises(RecordingError, match=message):
        install(replace(archives_at(host), lidars={}))
    assert folders_in(home) == []


def test_two_archives_of_one_sequence_are_refused(make_host, archives, home, tmp_path):
    make_release(tmp_path / "Lobby", sessions=("2024-04-04-12-16-41",), scans=4)
    body = pack_zip(tmp_path / "Lobby", tmp_path / "x.zip").read_bytes()
    host = make_host({"lobby.zip": archives["lobby.zip"], "lobby.tar.zip": body})
    with pytest.raises(RecordingError, match=r"holds lobby--.*, and so does lobby"):
        install(replace(archives_at(host), lidars={}), only=["lobby*"])


def test_full_disk_is_said_before_anything_is_fetched(host, home, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(WriteError, match="1,000 bytes are free"):
        install(archives_at(host))
    assert host.offsets == []
    assert folders_in(home) == []


def test_raw_recordings_alone_are_not_installed(host, home):
    with pytest.raises(InvalidInputError, match=r"rosbags.zip; get them as they are with --arch"):
        install(archives_at(host, parts={"raw": ("*",)}))


@pytest.mark.parametrize(
    ("said", "full"), [("2", "2.0.0"), ("2.1", "2.1.0"), ("2.1.3", "2.1.3"), ("beta", "beta")]
)
def test_version_is_completed(said, full):
    assert full_version(replace(find_known("semantic2d"), version=said)) == full


def test_version_that_no_manifest_can_hold_is_refused_before_work(host, home):
    with pytest.raises(InvalidInputError, match="version 'beta': expected one like 1.0.0"):
        install(archives_at(host, version="beta"))
    assert host.requests == []


def test_error_in_the_second_archive_keeps_what_the_first_gave(make_host, archives, home):
    damaged = archives["lobby.zip"][:-2000]
    host = make_host({"hall.tar.gz": archives["hall.tar.gz"], "lobby.zip": damaged})
    known = replace(archives_at(host), lidars={})
    with pytest.raises(RecordingError, match="lobby.zip"):
        install(known)
    (left,) = (home / "datasets").glob(".d-1.resume")
    kept = {p.name: p.stat().st_mtime_ns for p in left.rglob("*--wlr-716.h5")}
    assert len(kept) == 1
    host.files["lobby.zip"] = archives["lobby.zip"]
    host.checksums["lobby.zip"] = hosts.md5(archives["lobby.zip"])
    (download_folder(known) / "lobby.zip").unlink()
    data = install(known).data
    again = {p.name: p.stat().st_mtime_ns for p in data.root.rglob("*--wlr-716.h5")}
    assert again == kept
    assert not left.exists()


def run_install(registry, home, folder, options):
    os.environ |= {"NO_PROXY": "127.0.0.1", "SEMANTIC2D_HOME": str(home)}
    os.environ.pop("SEMANTIC2D_OFFLINE", None)
    install(find_known("d", registry), folder, **options)


def run_without_locks(registry, home, options):
    class NoLock:
        def __init__(self, path):
            pass

        def acquire(self, **_):
            raise NotImplementedError

    locks.FileLock = NoLock
    run_install(registry, home, None, options)


@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.long)])
def test_processes_without_locks_install_one_good_data_set(count, host, home, tmp_path):
    registry = write_registry(tmp_path / "registry.json", host)
    host.moods = [hosts.drip] * 2 * count
    context = multiprocessing.get_context("spawn")
    workers = [
        context.Process(target=run_without_locks, args=(registry, home, {}), daemon=True)
        for _ in range(count)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    assert [worker.exitcode for worker in workers] == [0] * count
    data = open_dataset(home / "datasets" / "d-1")
    assert lidars_of(data) == [HOKUYO, WLR]
    assert find_problems(data.root, full=True) == []
    assert folders_in(home) == ["d-1"]


def test_other_process_is_waited_for(host, home, tmp_path):
    registry = write_registry(tmp_path / "registry.json", host)
    context = multiprocessing.get_context("spawn")
    workers = [
        context.Process(target=run_install, args=(registry, home, None, {"lidars": [lidar]}))
        for lidar in ("hokuyo", "wlr716")
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert lidars_of(open_dataset(home / "datasets" / "d-1")) == [HOKUYO, WLR]
    assert folders_in(home) == ["d-1"]


@pytest.mark.parametrize("kills", [5, pytest.param(200, marks=pytest.mark.long)])
def test_kill_at_any_point_leaves_what_the_next_run_uses(kills, make_host, home, tmp_path):
    """A data set that is installed is whole whenever it is there, while another lidar is added."""
    host = make_host(pack_archives(tmp_path / "packed", scans=30))
    registry = write_registry(tmp_path / "registry.json", host)
    context = multiprocessing.get_context("fork")
    rng = random.Random(kills)
    known = find_known("d", registry)
    target, options, whole = data_folder(known), {"lidars": ["hokuyo"]}, 0
    began = time.monotonic()
    install(known, **options)
    longest_s = 1.5 * (time.monotonic() - began)
    shutil.rmtree(home)
    for number in range(kills):
        args = (registry, home, None, options | {"remove_archives": number % 3 == 0})
        worker = context.Process(target=run_install, args=args, daemon=True)
        worker.start()
        time.sleep(rng.uniform(0, longest_s))
        os.kill(worker.pid, signal.SIGKILL)
        worker.join()
        if target.exists():
            whole += 1
            assert is_complete(target)
            assert find_problems(target) == []
            both = len(lidars_of(open_dataset(target))) == 2
            options = {"lidars": ["hokuyo"] if both else ["wlr716"]}
            if both:
                shutil.rmtree(target)
    print(f"{whole} of {kills} kills found a data set in its place")
    data = install(known).data
    assert lidars_of(data) == [HOKUYO, WLR]
    assert find_problems(data.root, full=True) == []
    assert folders_in(home) == ["d-1"]
    left = [p.name for p in home.rglob("*") if p.name.endswith((".partial", ".resume"))]
    assert left == []


def test_published_folder_is_tidied_of_what_a_killed_run_left(host, home):
    known = archives_at(host)
    install(known)
    left = home / "datasets" / ".d-1.resume"
    (left / "work").mkdir(parents=True)
    (left / "work" / "big").write_text("done")
    assert not install(known).changed
    assert folders_in(home) == ["d-1"]


def test_record_says_what_was_made_of_what(host, home):
    data = install(archives_at(host), lidars=["hokuyo"]).data
    said = json.loads((data.root / ".installed.json").read_text())
    assert said["dataset"] == "d@1"
    assert said["lidars"] == [HOKUYO]
    assert [part["file"] for part in said["parts"]] == ["lobby.zip"]
    assert said["parts"][0]["sequences"] == [f"lobby--2024-04-04-12-16-41--{HOKUYO}"]
