import gzip
import math

import numpy as np
import pytest

from conversion.carmen.lines import (
    LAYOUTS,
    angles_of,
    nanoseconds,
    range_max_of,
    read_lines,
    read_parameter,
    split_line,
)
from semantic2d_dataset.errors import RecordingError

FLASER = b"FLASER 3 1.5 2.25 81.83 0.1 0.2 0.3 1 2 3 12.5 host 13.25\n"
ROBOTLASER = (
    b"ROBOTLASER1 0 -1.5 3.0 0.75 30.0 0.01 0 5 1 2 3 4 5 2 70 80 "
    b"0.1 0.2 0.3 1 2 3 0.5 0.1 0.2 0.2 0 12.5 host 13.25\n"
)
RAWLASER = b"RAWLASER2 0 -1.5 3.0 0.0 30.0 0.01 0 4 1 2 3 4 0 12.5 host 13.25\n"


def flaser(beams, kind=b"FLASER"):
    return kind + b" %d " % beams + b"1 " * beams + b"0 0 0 0 0 0 1.0 host 1.0\n"


@pytest.fixture
def log(tmp_path):
    def write(content, name="x.log"):
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return write


def test_a_line_of_each_layout_is_split_where_its_counts_say(tmp_path):
    old = split_line(tmp_path, 1, FLASER)
    assert (old.kind, old.beams, old.stamp_ns) == ("FLASER", 3, 12_500_000_000)
    np.testing.assert_array_equal(old.values(old.ranges), np.float32([1.5, 2.25, 81.83]))
    assert old.values(old.remissions).size == 0
    assert old.poses() == ((0.1, 0.2, 0.3), (1, 2, 3))
    robot = split_line(tmp_path, 1, ROBOTLASER)
    np.testing.assert_array_equal(robot.values(robot.ranges), np.float32([1, 2, 3, 4, 5]))
    np.testing.assert_array_equal(robot.values(robot.remissions), np.float32([70, 80]))
    assert robot.poses() == ((0.1, 0.2, 0.3), (1, 2, 3))
    raw = split_line(tmp_path, 1, RAWLASER)
    assert (raw.beams, raw.stamp_ns) == (4, 12_500_000_000)


@pytest.mark.parametrize("kind", sorted(LAYOUTS))
def test_every_kind_of_line_can_be_split(tmp_path, kind):
    layout = LAYOUTS[kind]
    words = [kind, *([b"0"] * 7 if layout.described else []), b"2", b"5", b"6"]
    words += [b"1", b"9"] if layout.remissions else []
    words += [b"0"] * (6 * layout.posed + layout.extras) + [b"7.0", b"host", b"8.0"]
    line = split_line(tmp_path, 1, b" ".join(words) + b"\n")
    assert (line.beams, line.stamp_ns) == (2, 7 * 10**9)
    assert line.fields[line.tail - 1] == (b"9" if layout.remissions else b"6")


@pytest.mark.parametrize("line", [FLASER, ROBOTLASER, RAWLASER])
def test_a_line_that_lacks_any_of_its_words_is_refused(tmp_path, line):
    words = line.split()
    for kept in range(1, len(words)):
        with pytest.raises(RecordingError, match=r"line 7 .* is damaged: expected .*; mend it"):
            split_line(tmp_path, 7, b" ".join(words[:kept]) + b"\n")
        with pytest.raises(RecordingError, match="cut off within line 7: .* get the whole file"):
            split_line(tmp_path, 7, b" ".join(words[:kept]))


def test_an_absurd_count_is_refused_without_memory_for_it(tmp_path):
    with pytest.raises(RecordingError, match="expected 100000000001 words"):
        split_line(tmp_path, 1, b"FLASER 99999999990 1 2 3\n")


@pytest.mark.parametrize(
    ("beams", "first", "step"),
    [(180, -90, 1), (181, -90, 1), (360, -90, 0.5), (361, -90, 0.5), (401, -50, 0.25)],
)
def test_angles_follow_from_the_number_of_beams_of_a_sick(tmp_path, beams, first, step):
    angles = angles_of(split_line(tmp_path, 1, flaser(beams)), {})
    assert angles == (math.radians(first), math.radians(step), False)


def test_another_number_of_beams_takes_the_resolution_of_the_log(tmp_path):
    line = split_line(tmp_path, 1, flaser(541))
    angles = angles_of(line, {"laser_front_laser_resolution": 0.5})
    assert (math.degrees(angles.first), math.degrees(angles.step)) == pytest.approx((-135, 0.5))
    rear = split_line(tmp_path, 1, flaser(541, b"RLASER"))
    assert angles_of(rear, {"laser_front_laser_resolution": 0.5}).assumed
    guessed = angles_of(line, {})
    assert guessed.assumed
    assert guessed.first == -math.pi / 2
    assert guessed.step * 540 == pytest.approx(math.pi)


def test_a_line_that_describes_its_laser_is_believed(tmp_path):
    robot = split_line(tmp_path, 1, ROBOTLASER)
    assert angles_of(robot, {}) == (-1.5, 0.75, False)
    assert range_max_of(robot, {"robot_front_laser_max": 80.99}) == 30.0
    without_step = split_line(tmp_path, 1, RAWLASER)
    assert angles_of(without_step, {}) == (-1.5, 1.0, False)


def test_the_longest_range_comes_from_the_log_else_from_carmen(tmp_path):
    line = split_line(tmp_path, 1, FLASER)
    assert range_max_of(line, {"robot_front_laser_max": 80.99}) == 80.99
    assert range_max_of(line, {"robot_front_laser_max": -1.0}) == 80.0


def test_only_parameters_that_are_numbers_are_read():
    assert read_parameter(b"PARAM robot_front_laser_max 80.99 1.0 merci 1.0\n") == (
        "robot_front_laser_max",
        80.99,
    )
    assert read_parameter(b"PARAM robot_use_laser on 1.0 merci 1.0\n") is None
    assert read_parameter(b"PARAM\n") is None


def test_stamps_are_exact_to_the_microsecond():
    assert nanoseconds(b"976053557.767368") == 976_053_557_767_368_000
    assert nanoseconds(b"-0.000001") == -1000
    for wrong in (b"nan", b"inf", b"1e12", b"x"):
        with pytest.raises(ValueError, match=r"no time|convert"):
            nanoseconds(wrong)


def test_plain_and_gzip_logs_have_the_same_lines(log):
    text = b"# a\n\n" + FLASER * 3 + b"no newline"
    plain, packed = log(text), log(gzip.compress(text), "x.gz")
    assert list(read_lines(plain)) == list(read_lines(packed))
    assert list(read_lines(plain))[-1] == (6, b"no newline")


def test_cut_and_damaged_gzip_name_the_line_that_was_reached(log):
    rng = np.random.default_rng(0)
    lines = [b"FLASER 2 %.6f %.6f\n" % tuple(rng.random(2)) for _ in range(20_000)]
    packed = gzip.compress(b"".join(lines))
    with pytest.raises(RecordingError, match=r"cut off within line \d{4}.*zcat cut.gz > part.log"):
        list(read_lines(log(packed[: len(packed) // 2], "cut.gz")))
    middle = len(packed) // 2
    hurt = packed[:middle] + bytes(64) + packed[middle + 64 :]
    with pytest.raises(RecordingError, match=r"damaged after line \d{4}"):
        list(read_lines(log(hurt, "hurt.gz")))
    with pytest.raises(RecordingError, match="damaged after line 20000"):
        list(read_lines(log(packed + b"rubbish", "more.gz")))


def test_a_line_without_end_is_refused(log):
    with pytest.raises(RecordingError, match="line 2 is longer than"):
        list(read_lines(log(b"ODOM\n" + b"1 " * 600_000)))
    bomb = gzip.compress(bytes(8 << 20))
    with pytest.raises(RecordingError, match="line 1 is longer than"):
        list(read_lines(log(bomb, "bomb.gz")))
