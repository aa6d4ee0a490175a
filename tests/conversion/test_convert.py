from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from conversion.convert import Kept, convert_recording, find_kept
from conversion.messages.source import MessageSource
from conversion.options import Options
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from conversion.summary import Summary
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import SequenceReader
from tests.conversion.recordings import BEAMS, KINDS, START_NS, Recording, straight_drive
from tests.conversion.releases import make_release


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def two_lidars(folder: Path) -> Path:
    drive = Recording("db3")
    for n in range(3):
        drive.add_scan(START_NS + n, [1.0] * BEAMS, topic="/front/scan")
        drive.add_scan(START_NS + n, [2.0] * 5, topic="/rear/scan")
    return drive.write(folder)


def test_provenance_names_sources_topic_options_and_versions(tmp_path):
    path = straight_drive("ros1").write(tmp_path)
    convert_recording(path, tmp_path / "out.h5", Options(license="CC-BY-4.0"))
    with SequenceReader(tmp_path / "out.h5") as sequence:
        header = sequence.header
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert header.provenance["sources"] == [
        {"name": "drive.bag", "bytes": path.stat().st_size, "sha256": digest}
    ]
    assert header.provenance["topic"] == "/scan"
    assert header.provenance["options"]["license"] == header.license == "CC-BY-4.0"
    assert set(header.provenance["versions"]) == {"semantic2d-dataset", "rosbags"}


def test_sequences_are_named_by_their_ids_in_a_folder(tmp_path):
    summaries = convert_recording(two_lidars(tmp_path), tmp_path / "a" / "b")
    ids = [summary.sequence_id for summary in summaries]
    assert names_in(tmp_path / "a" / "b") == sorted(f"{each}.h5" for each in ids)
    for summary in summaries:
        with SequenceReader(Path(summary.file)) as sequence:
            assert sequence.header.sequence_id == summary.sequence_id
            assert len(sequence) == 3


def test_one_file_takes_one_sequence_only(tmp_path):
    path = two_lidars(tmp_path)
    with pytest.raises(InvalidInputError, match="becomes 2 sequences .*give a folder as --out"):
        convert_recording(path, tmp_path / "out.h5")
    convert_recording(path, tmp_path / "out.h5", Options(scan_topics=("/rear/scan",)))
    assert not names_in(tmp_path / "drive")[2:]


@pytest.mark.parametrize("out", ["out.h5", "out"])
def test_what_is_complete_is_kept_and_not_read_again(out, tmp_path, monkeypatch):
    path = straight_drive("mcap").write(tmp_path)
    (first,) = convert_recording(path, tmp_path / out)
    before = Path(first.file).stat().st_mtime_ns
    monkeypatch.setattr(MessageSource, "plans", lambda *_: pytest.fail("was read again"))
    (again,) = convert_recording(path, tmp_path / out)
    assert again == Kept(first.file, first.sequence_id, 12)
    assert Path(first.file).stat().st_mtime_ns == before


def test_what_is_missing_of_a_recording_is_made_again(tmp_path):
    path = two_lidars(tmp_path)
    front, rear = convert_recording(path, tmp_path / "out")
    Path(rear.file).unlink()
    with pytest.raises(InvalidInputError, match="pass --force"):
        convert_recording(path, tmp_path / "out", Options(license="MIT"))
    front, rear = convert_recording(path, tmp_path / "out")
    assert isinstance(rear, Summary)
    assert isinstance(front, Kept)
    assert len(names_in(tmp_path / "out")) == 2


@pytest.mark.parametrize("change", ["options", "source"])
def test_a_file_of_other_options_or_another_source_is_replaced_only_by_force(change, tmp_path):
    path = straight_drive("ros1").write(tmp_path)
    convert_recording(path, tmp_path / "out.h5")
    options = Options(environment="elsewhere") if change == "options" else Options()
    if change == "source":
        straight_drive("ros1", scans=5).write(tmp_path, "other")
        (tmp_path / "other.bag").replace(path)
    with pytest.raises(InvalidInputError, match="of another source, version or options"):
        convert_recording(path, tmp_path / "out.h5", options)
    (summary,) = convert_recording(path, tmp_path / "out.h5", options, force=True)
    assert isinstance(summary, Summary)


def test_a_file_where_a_folder_should_be_is_told(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(InvalidInputError, match="a file is in the way"):
        convert_recording(straight_drive("db3").write(tmp_path), tmp_path / "out")


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_that_breaks_off_leaves_nothing_behind(kind, tmp_path, monkeypatch):
    path = straight_drive(kind).write(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    messages, passes = Bag.messages, []

    def broken(bag, topics, start_ns=0):
        passes.append(topics)
        for count, message in enumerate(messages(bag, topics, start_ns)):
            if len(passes) == 2 and count == 7:
                raise RecordingError(bag.path, "is damaged")
            yield message

    monkeypatch.setattr(Bag, "messages", broken)
    with pytest.raises(RecordingError, match="is damaged"):
        convert_recording(path, out / "drive.h5")
    assert len(passes) == 2
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("scans", [11, 13])
def test_a_recording_that_changes_between_the_passes_is_refused(scans, tmp_path, monkeypatch):
    path = straight_drive("ros1").write(tmp_path)
    other = straight_drive("ros1", scans=scans).write(tmp_path, "other")
    with Bag(other) as changed, MessageSource(RosRecording(Bag(path))) as source:
        (plan,) = source.plans(Options())
        monkeypatch.setattr(source.recording, "messages", changed.messages)
        if scans < 12:
            with pytest.raises(RecordingError, match="changed while it was read"):
                list(plan.blocks())
        else:
            assert len(next(iter(plan.blocks()))["scans/ranges"]) == 12


COMMAND = "import sys; from semantic2d_dataset.cli import main; sys.argv[0] = 'semantic2d'; main()"


def start(*words: object, stderr: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        text=True,
    )


def long_drive(folder: Path) -> Path:
    """A recording that takes a second or more to write."""
    drive, random = Recording("mcap"), np.random.default_rng(0)
    for n in range(6000):
        ranges = random.uniform(0.2, 20, 400).astype(np.float32)
        drive.add_scan(START_NS + n * 10_000_000, ranges, intensities=ranges, increment=0.01)
    return drive.write(folder)


def kill_while_writing(path: Path, out: Path, sign: int, delay: float) -> tuple[int, str]:
    """Start a conversion and send it a signal soon after it began to write."""
    with start("convert", path, "--out", out, stderr=subprocess.PIPE) as process:
        until = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < until:
            if list(out.glob(".*.partial")):
                time.sleep(delay)
                break
            time.sleep(0.005)
        process.send_signal(sign)
        return process.wait(timeout=60), str(process.stderr.read())


def convert_again(path: Path, out: Path) -> None:
    """What the user does next; then the one file is there and right."""
    with start("convert", path, "--out", out) as process:
        assert process.wait(timeout=120) == 0
    (file,) = out.iterdir()
    with SequenceReader(file) as sequence:
        sequence.check_values()
        assert len(sequence) == 6000


def test_an_interrupted_conversion_leaves_nothing_and_runs_again(tmp_path):
    path, out = long_drive(tmp_path), tmp_path / "out"
    status, said = kill_while_writing(path, out, signal.SIGINT, 0.1)
    assert status == 130
    assert said.splitlines()[-1].startswith("interrupted")
    assert not list(out.iterdir())
    convert_again(path, out)


@pytest.mark.parametrize("delay", [0.1, pytest.param(0.3, marks=pytest.mark.long)])
def test_a_killed_conversion_runs_again(delay, tmp_path):
    path, out = long_drive(tmp_path), tmp_path / "out"
    kill_while_writing(path, out, signal.SIGKILL, delay)
    convert_again(path, out)


@pytest.mark.long
def test_a_conversion_killed_at_any_point_leaves_a_right_file_or_none(tmp_path):
    path = long_drive(tmp_path)
    for run in range(40):
        out = tmp_path / f"out{run}"
        kill_while_writing(path, out, signal.SIGKILL, run * 0.04)
        for file in out.glob("*.h5"):
            with SequenceReader(file) as sequence:
                sequence.check_values()
                assert len(sequence) == 6000
    convert_again(path, tmp_path / "out7")


def test_only_what_is_outdated_is_replaced_where_that_is_asked_for(tmp_path):
    path, out = two_lidars(tmp_path), tmp_path / "out"
    convert_recording(path, out)
    assert all(
        isinstance(result, Kept) for result in convert_recording(path, out, replace_outdated=True)
    )
    options = Options(license="MIT")
    results = convert_recording(path, out, options, replace_outdated=True)
    assert all(isinstance(result, Summary) for result in results)
    with SequenceReader(Path(results[0].file)) as sequence:
        assert sequence.header.license == "MIT"


def test_what_would_be_kept_is_told_and_nothing_is_made(tmp_path):
    path, out = two_lidars(tmp_path), tmp_path / "out"
    assert find_kept([path], out) == ()
    assert not out.exists()
    results = convert_recording(path, out)
    assert [kept.file for kept in find_kept([path], out)] == [each.file for each in results]
    assert find_kept([path], out, Options(license="MIT")) == ()
    Path(results[0].file).unlink()
    assert find_kept([path], out) == ()


def test_sequences_of_other_lidars_are_left_out_and_may_come_later(tmp_path):
    both = tmp_path / "both"
    make_release(both / "one", sessions=("2024-04-04-12-16-41",), scans=3)
    make_release(both / "two", sessions=("2024-04-04-12-16-41",), scans=3, beams=811)
    out = tmp_path / "out"
    (only,) = convert_recording(both, out, Options(only_lidars=("wlr-716",)))
    assert only.sequence_id == "two--2024-04-04-12-16-41--wlr-716"
    assert convert_recording(both, out, Options(only_lidars=("rplidar-s2",))) == ()
    both_of_them = convert_recording(both, out, replace_outdated=True)
    assert [each.sequence_id for each in both_of_them] == [
        "one--2024-04-04-12-16-41--hokuyo-utm-30lx-ew",
        only.sequence_id,
    ]
