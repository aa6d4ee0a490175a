"""Downloads from a host on this machine that does what hosts do on bad days."""

import email.utils
import json
import multiprocessing
import os
import resource
import shutil
import signal
import time
from types import SimpleNamespace

import pytest
from filelock import FileLock

from semantic2d_dataset.access import download as module
from semantic2d_dataset.access import web
from semantic2d_dataset.access.download import LIST_NAME, download, find_files
from semantic2d_dataset.access.known_datasets import (
    FileTable,
    KnownDataset,
    RemoteFile,
    find_known,
)
from semantic2d_dataset.access.places import OFFLINE_VARIABLE
from semantic2d_dataset.errors import (
    ChecksumError,
    DownloadError,
    InvalidInputError,
    OfflineError,
    WriteError,
)
from semantic2d_dataset.format import locks
from tests.access import hosts
from tests.access.hosts import make_bytes, md5

BIG = make_bytes(400_000)
SMALL = make_bytes(1000, 1)


@pytest.fixture
def waits(monkeypatch):
    """The waits between attempts, s, which take no time."""
    found = []
    monkeypatch.setattr(web, "time", SimpleNamespace(sleep=found.append, time=lambda: 1e9))
    monkeypatch.setattr(web, "TIMEOUTS_S", (2, 0.3))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv(OFFLINE_VARIABLE, raising=False)
    return found


@pytest.fixture
def make_host(waits):
    made = []

    def make(files):
        made.append(hosts.Host(files))
        return made[-1]

    yield make
    for host in made:
        host.close()


@pytest.fixture
def host(make_host):
    return make_host({"big.zip": BIG})


def left_in(folder):
    return sorted(p.name for p in folder.rglob("*") if p.is_file() and not p.name.endswith(".lock"))


def test_files_arrive_whole_and_only_once(make_host, tmp_path):
    host = make_host({"big.zip": BIG, "small.txt": SMALL, "empty": b""})
    got = download(host.dataset(), tmp_path / "new")
    assert [(f.name, f.size, f.fetched) for f in got] == [
        ("big.zip", 400_000, True),
        ("empty", 0, True),
        ("small.txt", 1000, True),
    ]
    assert (tmp_path / "new" / "big.zip").read_bytes() == BIG
    assert left_in(tmp_path) == [LIST_NAME, "big.zip", "empty", "small.txt"]
    asked = len(host.requests)
    assert [f.fetched for f in download(host.dataset(), tmp_path / "new")] == [False] * 3
    assert len(host.requests) == asked + 1  # the list


def test_server_is_told_who_asks(host, tmp_path):
    download(host.dataset(), tmp_path)
    assert all(h["User-Agent"].startswith("semantic2d-dataset/") for _, _, h in host.requests)
    assert all(h["Accept-Encoding"] == "identity" for _, _, h in host.requests)


def test_broken_connection_goes_on_where_it_broke(host, tmp_path, waits):
    host.moods = [hosts.cut_after(150_000), hosts.cut_after(150_000)]
    download(host.dataset(), tmp_path)
    first, second, third = host.offsets
    assert first == 0 < second < third
    assert second >= 150_000 - (1 << 16)
    assert (tmp_path / "big.zip").read_bytes() == BIG
    assert 1 <= waits[0] <= 2 <= waits[1] <= 4


def test_six_breaks_without_progress_are_the_end(host, tmp_path, waits):
    host.moods = [hosts.cut_after(0)] * 12
    with pytest.raises(DownloadError, match="big.zip: could not be had: .*broke off"):
        download(host.dataset(), tmp_path)
    assert len(waits) == 10  # five retries of each of the two addresses
    assert left_in(tmp_path) == [LIST_NAME]


def test_breaks_after_much_progress_do_not_count(host, tmp_path, waits, monkeypatch):
    monkeypatch.setattr(web, "ENOUGH_PROGRESS", 10_000)
    monkeypatch.setattr(module, "_CHUNK", 1 << 12)
    host.moods = [hosts.cut_after(30_000)] * 11
    download(host.dataset(), tmp_path)
    assert len(waits) == 11
    assert max(waits) <= 2


def test_stalled_connection_is_given_up_and_tried_again(host, tmp_path):
    host.moods = [hosts.stall]
    download(host.dataset(), tmp_path)
    assert (tmp_path / "big.zip").read_bytes() == BIG


@pytest.mark.parametrize(
    ("mood", "message"),
    [
        (hosts.other_length, "expected 400000 bytes, found 400004"),
        (hosts.endless, "sends more than 400000 bytes"),
        (hosts.web_page, "a web page came"),
        (hosts.packed, "packs"),
        (hosts.status(404), "answers 404 Not Found"),
        (hosts.status(403), "answers 403 Forbidden"),
        (hosts.status(500), "answers 500"),
        (hosts.status(416), "answers 416"),
        (hosts.status(204), "answers 204"),
        (hosts.status(503, Retry_After="3600"), "asks to wait 3600 s"),
        (hosts.redirect_to(None), "more than 10 redirects"),
        (hosts.redirect_to("ftp://127.0.0.1/x"), "leads to ftp://127.0.0.1/x, which is not http"),
        (hosts.redirect_to("http://[oops"), "leads to no URL"),
    ],
)
def test_what_is_not_the_file_is_refused(mood, message, host, tmp_path):
    host.moods = [mood] * 40
    with pytest.raises(DownloadError, match=message):
        download(host.dataset(), tmp_path)
    assert "big.zip" not in left_in(tmp_path)


def test_after_a_refusal_the_next_address_is_tried(host, tmp_path, waits):
    host.moods = [hosts.other_length]
    download(host.dataset(), tmp_path)
    assert waits == []
    assert [path.startswith("/api") for path, _, _ in host.requests] == [True, False, True]


def test_whole_file_in_answer_to_a_range_is_used_from_there_on(host, tmp_path):
    host.moods = [hosts.cut_after(200_000), hosts.whole]
    download(host.dataset(), tmp_path)
    assert host.offsets[1] > 0
    assert len(host.offsets) == 2
    assert (tmp_path / "big.zip").read_bytes() == BIG


def test_range_at_another_offset_is_refused(host, tmp_path):
    host.moods = [hosts.cut_after(200_000), *[hosts.wrong_offset] * 2]
    with pytest.raises(DownloadError, match=r"expected bytes \d+-399999/400000, found"):
        download(host.dataset(), tmp_path)
    download(host.dataset(), tmp_path)
    assert (tmp_path / "big.zip").read_bytes() == BIG


@pytest.mark.parametrize("code", [429, 503])
def test_server_s_wish_to_wait_is_honoured(code, host, tmp_path, waits):
    date = email.utils.formatdate(1e9 + 60, usegmt=True)
    moods = [hosts.status(code, Retry_After=text) for text in ("7", "120", date, "soon")]
    host.moods = moods
    download(host.dataset(), tmp_path)
    assert waits[:3] == [7, 120, 60]
    assert 8 <= waits[3] <= 16


def test_wrong_content_is_thrown_away(host, tmp_path):
    host.moods = [hosts.other_bytes] * 4
    with pytest.raises(ChecksumError, match="other content than md5"):
        download(host.dataset(), tmp_path)
    assert left_in(tmp_path) == [LIST_NAME]
    host.moods = [hosts.other_bytes]
    download(host.dataset(), tmp_path)
    assert (tmp_path / "big.zip").read_bytes() == BIG


def test_digest_of_the_registry_counts_more_than_the_host_s(host, tmp_path):
    dataset = host.dataset(checksums={"big.zip": f"sha256:{'0' * 64}"})
    with pytest.raises(ChecksumError, match="other content than sha256:000"):
        download(dataset, tmp_path)


def test_next_run_goes_on_where_the_last_one_gave_up(host, tmp_path):
    host.moods = [hosts.cut_after(200_000), *[hosts.status(404)] * 2]
    with pytest.raises(DownloadError):
        download(host.dataset(), tmp_path)
    download(host.dataset(), tmp_path)
    assert host.offsets[-1] > 0
    assert left_in(tmp_path) == [LIST_NAME, "big.zip"]


def test_part_that_was_damaged_is_fetched_again(host, tmp_path):
    host.moods = [hosts.cut_after(200_000), *[hosts.status(404)] * 2]
    with pytest.raises(DownloadError):
        download(host.dataset(), tmp_path)
    (part,) = tmp_path.glob("*.resume")
    part.write_bytes(bytes(part.stat().st_size))
    download(host.dataset(), tmp_path)
    assert host.offsets[-1] == 0
    assert (tmp_path / "big.zip").read_bytes() == BIG


def test_mirror_goes_on_where_the_first_host_died(host, make_host, tmp_path):
    mirror = make_host({"big.zip": BIG})
    host.moods = [hosts.cut_after(200_000), *[hosts.status(404)] * 2]
    download(host.dataset(*mirror.dataset().sources), tmp_path)
    assert mirror.offsets[0] > 0
    assert (tmp_path / "big.zip").read_bytes() == BIG


def test_mirror_with_another_file_of_that_name_is_not_used(host, make_host, tmp_path):
    mirror = make_host({"big.zip": SMALL})
    host.moods = [hosts.status(404)] * 2
    with pytest.raises(DownloadError, match="404"):
        download(host.dataset(*mirror.dataset().sources), tmp_path)
    assert mirror.offsets == []


def test_mirror_lists_the_files_where_the_first_host_does_not(host, make_host, tmp_path):
    mirror = make_host({"other.zip": SMALL})
    host.list_moods = [hosts.status(404)]
    download(host.dataset(*mirror.dataset().sources), tmp_path)
    assert left_in(tmp_path) == [LIST_NAME, "other.zip"]


def test_what_is_here_needs_no_host(host, tmp_path):
    download(host.dataset(), tmp_path)
    host.list_moods = [hosts.status(404)] * 2
    assert [f.fetched for f in download(host.dataset(), tmp_path)] == [False]
    (tmp_path / LIST_NAME).write_text("{")
    with pytest.raises(DownloadError, match="d@1: no host lists its files"):
        download(host.dataset(), tmp_path)


def test_nothing_is_written_where_all_is_here(host, tmp_path):
    download(host.dataset(), tmp_path)
    before = {p.name: p.stat().st_mtime_ns for p in [tmp_path, *tmp_path.iterdir()]}
    download(host.dataset(), tmp_path)
    assert {p.name: p.stat().st_mtime_ns for p in [tmp_path, *tmp_path.iterdir()]} == before


def test_patterns_choose_files(make_host, tmp_path):
    host = make_host({"raw/a.bag": SMALL, "raw/b.bag": SMALL, "data.zip": BIG})
    download(host.dataset(), tmp_path, only=["raw/*"])
    assert left_in(tmp_path) == [LIST_NAME, "a.bag", "b.bag"]
    assert [f.name for f in find_files(host.dataset(), tmp_path, only=["*.zip", "*/a.*"])] == [
        "data.zip",
        "raw/a.bag",
    ]
    with pytest.raises(InvalidInputError, match=r"no file fits '\*.tar'; the 3 there are: data"):
        download(host.dataset(), tmp_path, only=["*.tar"])


def test_file_with_other_content_is_not_replaced(host, tmp_path):
    (tmp_path / "big.zip").write_bytes(SMALL)
    with pytest.raises(ChecksumError, match="move it away"):
        download(host.dataset(), tmp_path)
    assert (tmp_path / "big.zip").read_bytes() == SMALL


def test_room_is_looked_for_before_anything_is_fetched(host, tmp_path, monkeypatch):
    def leave(free):
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))

    leave((1 << 26) + 399_999)
    with pytest.raises(WriteError, match="67,508,863 bytes are free, and 67,508,864 are needed"):
        download(host.dataset(), tmp_path)
    assert host.offsets == []
    leave((1 << 26) + 400_000)
    download(host.dataset(), tmp_path)


def test_disk_that_runs_full_is_said_and_the_part_kept(host, tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(WriteError, match=r"big\.zip\..*: file too large"):
            download(host.dataset(), tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    download(host.dataset(), tmp_path)
    assert host.offsets == [0, 200_000]
    assert (tmp_path / "big.zip").read_bytes() == BIG


def test_offline_says_what_is_missing_and_where_it_belongs(make_host, tmp_path, monkeypatch):
    host = make_host({"a.zip": SMALL, "b.zip": BIG})
    with pytest.raises(OfflineError, match=f"its list of files is not here; .* to {tmp_path}"):
        download(host.dataset(), tmp_path, offline=True)
    download(host.dataset(), tmp_path, only=["a.zip"])
    asked = len(host.requests)
    monkeypatch.setenv(OFFLINE_VARIABLE, "1")
    with pytest.raises(OfflineError, match=f"b.zip is missing; put them into {tmp_path}"):
        download(host.dataset(), tmp_path)
    (tmp_path / "b.zip").write_bytes(BIG)
    assert [f.fetched for f in download(host.dataset(), tmp_path)] == [False, False]
    assert len(find_files(host.dataset(), tmp_path)) == 2
    assert len(host.requests) == asked


def test_files_that_the_registry_lists_are_checked_offline_too(tmp_path):
    file = RemoteFile("a.zip", 1000, md5(SMALL), ("https://nowhere.invalid/a.zip",))
    dataset = KnownDataset("d", "1", "D", "unknown", (FileTable((file,)),))
    with pytest.raises(OfflineError, match=r"a.zip is missing"):
        download(dataset, tmp_path, offline=True)
    (tmp_path / "a.zip").write_bytes(SMALL)
    assert len(download(dataset, tmp_path, offline=True)) == 1


def test_generated_data_set_is_not_downloaded(tmp_path):
    with pytest.raises(InvalidInputError, match="made on this machine"):
        download(find_known("semantic2d-mini"), tmp_path)


def get(host_url, folder):
    from semantic2d_dataset.access.known_datasets import ZenodoRecord

    class NoLock:
        def __init__(self, path):
            pass

        def acquire(self, **_):
            raise NotImplementedError

    os.environ["NO_PROXY"] = "127.0.0.1"
    locks.FileLock = NoLock  # as on file systems that have none
    source = ZenodoRecord("7", host_url)
    download(KnownDataset("d", "1", "D", "unknown", (source,)), folder)


@pytest.mark.parametrize("count", [2, pytest.param(8, marks=pytest.mark.long)])
def test_processes_without_locks_leave_one_good_file(count, host, tmp_path):
    host.moods = [hosts.drip] * count
    context = multiprocessing.get_context("spawn")
    workers = [
        context.Process(target=get, args=(host.url, tmp_path), daemon=True) for _ in range(count)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0] * count
    assert left_in(tmp_path) == [LIST_NAME, "big.zip"]
    assert (tmp_path / "big.zip").read_bytes() == BIG


@pytest.mark.parametrize("kills", [2, pytest.param(200, marks=pytest.mark.long)])
def test_killed_processes_are_gone_on_from(kills, make_host, tmp_path):
    body = make_bytes(400_000 * (kills + 1))
    host = make_host({"big.zip": body})
    context = multiprocessing.get_context("spawn")
    for number in range(1, kills + 1):
        host.moods = [hosts.drip]
        worker = context.Process(target=get, args=(host.url, tmp_path), daemon=True)
        worker.start()
        deadline = time.monotonic() + 30
        while part_size(tmp_path) < 200_000 * number and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(worker.pid, signal.SIGKILL)
        worker.join()
        assert not (tmp_path / "big.zip").exists()
    download(host.dataset(), tmp_path)
    assert host.offsets == sorted(host.offsets)
    assert host.offsets[-1] >= 200_000 * kills
    assert left_in(tmp_path) == [LIST_NAME, "big.zip"]
    assert (tmp_path / "big.zip").read_bytes() == body


def part_size(folder):
    sizes = [0]
    for part in folder.glob(".big.zip.*.partial"):
        try:
            sizes.append(part.stat().st_size)
        except FileNotFoundError:
            continue
    return max(sizes)


def test_lock_of_another_process_is_waited_for(host, tmp_path):
    context = multiprocessing.get_context("spawn")
    with FileLock(tmp_path / ".big.zip.lock"):
        arguments = (host.dataset(), tmp_path)
        worker = context.Process(target=download, args=arguments, daemon=True)
        worker.start()
        deadline = time.monotonic() + 30
        while not (tmp_path / LIST_NAME).exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        worker.join(0.2)
        assert worker.is_alive()
        (tmp_path / "big.zip").write_bytes(BIG)
    worker.join(30)
    assert worker.exitcode == 0
    assert host.offsets == []


def test_list_is_kept_as_plain_json(host, tmp_path):
    download(host.dataset(), tmp_path)
    said = json.loads((tmp_path / LIST_NAME).read_text())
    assert said["dataset"] == "d@1"
    assert [file["checksum"] for file in said["files"]] == [md5(BIG)]
