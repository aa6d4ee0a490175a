import os

import pytest

from semantic2d_dataset.access.partials import Partial

DIGEST = f"md5:{'a' * 32}"
OTHER = f"md5:{'b' * 32}"


def leave(target, content, digest=DIGEST):
    with Partial(target, digest) as partial:
        partial.path.write_bytes(content)


def names(folder):
    return [p.name for p in folder.iterdir()]


def test_what_is_not_published_is_taken_over(tmp_path):
    leave(tmp_path / "a", b"123")
    with Partial(tmp_path / "a", DIGEST) as partial:
        assert partial.path.read_bytes() == b"123"
        partial.publish()
    assert names(tmp_path) == ["a"]


def test_nothing_is_kept_of_nothing(tmp_path):
    leave(tmp_path / "a", b"")
    assert names(tmp_path) == []


def test_part_of_other_content_is_not_taken_over(tmp_path):
    leave(tmp_path / "a", b"123")
    with Partial(tmp_path / "a", OTHER) as partial:
        assert (partial.size, partial.kept_bytes()) == (0, 0)
    assert Partial(tmp_path / "a", DIGEST).kept_bytes() == 3


def test_part_of_a_running_process_is_left_alone(tmp_path):
    with Partial(tmp_path / "a", DIGEST) as first:
        first.path.write_bytes(b"1")
        with Partial(tmp_path / "a", DIGEST) as second:
            assert (first.size, second.size) == (1, 0)


@pytest.mark.parametrize(("idle_s", "taken"), [(10, 0), (3600, 3)])
def test_part_of_another_machine_is_copied_once_it_rests(idle_s, taken, tmp_path):
    left = tmp_path / f".a.{'a' * 12}.elsewhere-1-00000000.partial"
    left.write_bytes(b"123")
    os.utime(left, (left.stat().st_atime - idle_s, left.stat().st_mtime - idle_s))
    with left.open("ab") as stream, Partial(tmp_path / "a", DIGEST) as partial:
        stream.write(b"late")
        stream.flush()
        assert partial.size == taken
        assert left.exists() == (taken == 0)
    assert Partial(tmp_path / "a", DIGEST).kept_bytes() == taken


def test_longest_part_wins_and_the_others_go(tmp_path):
    leave(tmp_path / "a", b"12")
    dead = tmp_path / f".a.{'a' * 12}.{os.uname().nodename}-999999999-00000000.partial"
    dead.write_bytes(b"1234")
    with Partial(tmp_path / "a", DIGEST) as partial:
        assert partial.size == 4
        assert names(tmp_path) == [partial.path.name]
