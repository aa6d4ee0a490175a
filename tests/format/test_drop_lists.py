import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.drop_lists import format_ranges, parse_range, read_lines


def test_lines_are_read_without_comments_and_say_where_they_are(tmp_path):
    path = tmp_path / "scans.txt"
    path.write_text("\ufeff# seen\n\n 7 # blurred\n3-5\r\n", encoding="utf-8")
    assert list(read_lines(path)) == [(f"{path}, line 3", "7"), (f"{path}, line 4", "3-5")]


def test_a_list_that_is_no_text_or_not_there_is_refused(tmp_path):
    (tmp_path / "scans.txt").write_bytes(b"\xff\xfe1")
    with pytest.raises(InvalidInputError, match="UTF-8"):
        list(read_lines(tmp_path / "scans.txt"))
    with pytest.raises(FileNotFoundError):
        list(read_lines(tmp_path / "none.txt"))


@pytest.mark.parametrize("text", ["4", "4-4", "4 -  4"])
def test_an_index_is_a_range_of_one(text):
    assert parse_range(text, 5, "here") == (4, 4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("many", "here: expected the index of a scan, such as 12, .* found 'many'"),
        ("-3", "expected the index"),
        ("1,2", "expected the index"),
        ("1.0", "expected the index"),
        ("\u0663", "expected the index"),
        ("9" * 5000, "expected the index"),
        ("5-3", "expected a range from low to high, found '5-3'"),
        ("3-10", "the sequence has 10 scans, from 0 to 9; found '3-10'"),
        ("0-999999999999999999", "the sequence has 10 scans"),
    ],
)
def test_what_is_no_range_of_the_sequence_is_refused(text, message):
    with pytest.raises(InvalidInputError, match=message):
        parse_range(text, 10, "here")


def test_ranges_are_written_as_they_are_read():
    lines = format_ranges([4, 0, 3, 5, 7, 6])
    assert lines == ["0", "3-7"]
    assert [parse_range(line, 8, "here") for line in lines] == [(0, 0), (3, 7)]
    assert format_ranges([]) == []
