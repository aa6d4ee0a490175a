import numpy as np
import pytest

from conversion.tables.csv_rows import CsvRows
from semantic2d_dataset.errors import RecordingError

TEXT = "t,x,y,yaw,r0,r1,r2\n1.5,1,2,0.5,3,4,\n1.75,1,2,0.5,6,7,inf\n"


@pytest.fixture
def rows(tmp_path):
    def write(text, name="a.csv"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return CsvRows(path)

    return write


def ranges_of(rows, selector="r0..r2", size=512):
    return np.concatenate([b["ranges"] for b in rows.blocks({"ranges": selector}, size)])


def test_named_columns_are_read(rows):
    found = rows(TEXT).contents("r0..r2", "t", 1, {"poses": ("x", "y", "yaw")})
    assert (found.rows, found.beams) == (2, 3)
    assert found.stamps_ns.tolist() == [1_500_000_000, 1_750_000_000]
    np.testing.assert_array_equal(found.others["poses"], [[1, 2, 0.5]] * 2)
    np.testing.assert_array_equal(ranges_of(rows(TEXT)), [[3, 4, np.nan], [6, 7, np.inf]])


@pytest.mark.parametrize("separator", [",", ";", "\t", "  "])
def test_any_usual_separator_will_do(rows, separator):
    text = TEXT.replace("4,\n", "4,nan\n").replace(",", separator)
    np.testing.assert_array_equal(ranges_of(rows(text)), [[3, 4, np.nan], [6, 7, np.inf]])


@pytest.mark.parametrize(
    "text",
    [
        "1.5,1,2,0.5,3,4,5\n1.75,1,2,0.5,6,7,8\n",
        "0,1,2,3,4,5,6\n1.5,1,2,0.5,3,4,5\n1.75,1,2,0.5,6,7,8\n",
        "\ufeff# t,x,y,yaw,a,b,c\n\n1.5,1,2,0.5,3,4,5\n1.75,1,2,0.5,6,7,8\n\n",
    ],
)
def test_columns_may_be_numbered_from_0(rows, text):
    found = rows(text)
    assert found.contents("4..6", "0", 1, {}).stamps_ns.tolist() == [1_500_000_000, 1_750_000_000]
    np.testing.assert_array_equal(ranges_of(found, "4..6"), [[3, 4, 5], [6, 7, 8]])


def test_a_row_of_numbers_that_count_is_data_only_where_it_does_not_count_columns(rows):
    assert rows("0,1,3\n0,1,2\n").contents("0..2", None, 1, {}).rows == 2


def test_stamps_keep_every_nanosecond(rows):
    stamp = 1_700_000_000_123_456_789
    text = f"t,r0,r1\n{stamp},1,2\n{stamp / 1e9:.9f},1,2\n"
    assert rows(text).contents("r0..r1", "t", 10**9, {}).stamps_ns[0] == stamp
    text = f"t,r0,r1\n{stamp // 10**9}.123456789,1,2\n"
    assert rows(text).contents("r0..r1", "t", 1, {}).stamps_ns[0] == stamp


def test_blocks_are_no_larger_than_asked_for(rows):
    text = "r0,r1\n" + "".join(f"{i},{i + 1}\n" for i in range(10))
    sizes = [len(b["ranges"]) for b in rows(text).blocks({"ranges": "r0..r1"}, 4)]
    assert sizes == [4, 4, 2]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (TEXT + "1,2\n", "line 4: expected 7 columns, found 2"),
        (TEXT + "1,2,3,4,5,6,seven\n", "line 4: could not convert"),
        (TEXT + "soon,2,3,4,5,6,7\n", "line 4: 'soon' is no time"),
        (TEXT + "1,2,3,4,5,6,7" + "0" * (5 << 20), "longer than"),
        (TEXT + '1,2,3,4,5,6,"' + "0" * (1 << 18) + "\n", "no CSV file"),
        ("\n\n", "its first line is empty"),
    ],
)
def test_a_damaged_line_is_refused_with_its_number(rows, text, problem):
    with pytest.raises(RecordingError, match=problem):
        opened = rows(text)
        opened.contents("r0..r2", "t", 1, {})
        list(opened.blocks({"ranges": "r0..r2"}, 512))


def test_a_column_that_is_not_there_is_refused_with_those_that_are(rows):
    with pytest.raises(RecordingError, match="no column 'q' among 7; its first line names t, x"):
        rows(TEXT).contents("r0..q", None, 1, {})
    with pytest.raises(RecordingError, match="no column '7' among 7"):
        rows(TEXT).contents("4..7", None, 1, {})
    with pytest.raises(RecordingError, match="r0 comes before r2"):
        rows(TEXT).contents("r2..r0", None, 1, {})
    with pytest.raises(RecordingError, match="intensities: expected 3 columns, found 2"):
        list(rows(TEXT).blocks({"ranges": "r0..r2", "intensities": "r0..r1"}, 512))
