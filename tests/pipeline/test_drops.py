import numpy as np
import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.split_schemes import make_frame_scheme
from semantic2d_dataset.pipeline.drops import read_drops, without

ONE = {"lab--a--hokuyo": 100}
TWO = ONE | {"lab--a--wlr": 50}


def write(folder, text):
    (folder / "drop.txt").write_text(text)
    return folder / "drop.txt"


def test_single_scans_and_ranges_are_read_and_comments_are_not(tmp_path):
    path = write(tmp_path, "# bad ones\n3\n\n10 - 12 # a door opens\n  11\n")
    found = read_drops(path, ONE)
    np.testing.assert_array_equal(found.pop("lab--a--hokuyo"), [3, 10, 11, 12])
    assert not found


def test_of_several_sequences_one_is_named(tmp_path):
    found = read_drops(write(tmp_path, "lab--a--wlr 0-1\nlab--a--hokuyo 99"), TWO)
    np.testing.assert_array_equal(found["lab--a--wlr"], [0, 1])
    np.testing.assert_array_equal(found["lab--a--hokuyo"], [99])


@pytest.mark.parametrize(
    ("text", "lengths", "says"),
    [
        ("1\nx", ONE, r"drop.txt, line 2: expected the index of a scan, .* found 'x'"),
        ("lab--a--hokuyo 100", TWO, "has 100 scans, from 0 to 99; found '100'"),
        ("3", {}, "expected the sequence before the scan"),
        ("lab--b--wlr 3", TWO, "no sequence lab--b--wlr of this recording; it has lab--a--hok"),
        ("3", TWO, "expected the sequence before the scan, one of lab--a--hokuyo, lab--a--wlr"),
    ],
)
def test_a_line_that_means_nothing_is_told(text, lengths, says, tmp_path):
    with pytest.raises(InvalidInputError, match=says):
        read_drops(write(tmp_path, text), lengths)


def test_dropped_scans_belong_to_no_split_and_the_scheme_says_so():
    scheme = make_frame_scheme(ONE, seed=0)
    assert without(scheme, {}) is scheme
    fewer = without(scheme, {"lab--a--hokuyo": np.array([3, 4])})
    assert fewer.made_by.endswith("; 2 scans dropped")
    before, after = scheme.membership["lab--a--hokuyo"], fewer.membership["lab--a--hokuyo"]
    np.testing.assert_array_equal(after[[3, 4]], 255)
    np.testing.assert_array_equal(np.delete(after, [3, 4]), np.delete(before, [3, 4]))
    assert before[3] != 255
