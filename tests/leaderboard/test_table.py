import json

import pytest

from leaderboard.table import rank, read_result, to_json, to_markdown, to_text
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scoring.metrics import Evaluator
from semantic2d_dataset.scoring.submission import result_to_json

TRUTH = [1, 1, 4, 4, 9, 9, 9, 9]


def result_of(method, prediction, **changes):
    submission = {
        "dataset": "toy",
        "dataset_version": "1.0.0",
        "scheme": "block",
        "split": "test",
        "lidars": ["near"],
        "scans": 1,
        "metadata": {"method": method},
        "digests": {"predictions": method, "split": "s", "taxonomy": "t"},
        "evaluator_version": "1.0",
    }
    result = Evaluator().update(TRUTH, prediction).compute()
    return result | {"per_lidar": {}, "submission": submission | changes}


@pytest.fixture
def write(tmp_path):
    def write_result(method, prediction, **changes):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.json"
        path.write_text(result_to_json(result_of(method, prediction, **changes)))
        return path

    return write_result


@pytest.fixture
def three(write):
    return [
        write("walls", [9] * 8),
        write("perfect", TRUTH),
        write("fair", [1, 9, 4, 4, 9, 9, 9, 4]),
    ]


def test_rows_are_sorted_by_miou_whatever_the_order_of_files(three):
    rows = rank(three)
    assert [row.method for row in rows] == ["perfect", "fair", "walls"]
    assert rank(reversed(three)) == rows
    assert rows[0].mIoU == rows[0].mCA == 1.0
    assert rows[2].iou["Wall"] == 0.5
    assert rows[2].iou["Door"] is None


def test_a_result_without_a_mean_comes_last(write, three):
    silent = write("a silent one", [0] * 8)
    content = json.loads(silent.read_text()) | {"mIoU": None, "mCA": None}
    silent.write_text(json.dumps(content))
    assert rank([silent, *three])[-1].method == "a silent one"


def test_text_table_has_percent_in_aligned_columns(three):
    lines = to_text(rank(three)).splitlines()
    assert lines[0].split()[:4] == ["#", "Method", "mIoU", "mCA"]
    assert lines[1].split()[:4] == ["1", "perfect", "100.00", "100.00"]
    assert len({len(line) for line in lines}) == 1


def test_markdown_table_has_one_row_for_each_method(three):
    lines = to_markdown(rank(three)).splitlines()
    assert len(lines) == 5
    assert lines[2].startswith("| 1 | perfect | 100.00 | 100.00 |")
    assert len({line.count("|") for line in lines}) == 1


def test_names_cannot_break_out_of_a_table(write):
    rows = rank([write("a|b\n<script>\x1b[31m", TRUTH)])
    assert rows[0].method == "a|b <script>[31m"
    assert r"| a\|b \<script\>\[31m |" in to_markdown(rows)


def test_json_gives_fractions_for_programs(three):
    first = json.loads(to_json(rank(three)))[0]
    assert (first["method"], first["mIoU"], first["iou"]["Chair"]) == ("perfect", 1.0, 1.0)


def test_no_result_gives_an_empty_table():
    assert rank([]) == []
    assert to_text([]) == "#  Method  mIoU  mCA"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dataset": "other"}, "dataset is 'other', but 'toy' in"),
        ({"dataset_version": "2.0.0"}, "dataset_version is '2.0.0'"),
        ({"scheme": "frame"}, "scheme is 'frame'"),
        ({"split": "val"}, "split is 'val'"),
        ({"lidars": ["near", "far"]}, "lidars is"),
        ({"evaluator_version": "2.0"}, "evaluator_version is '2.0'"),
        ({"digests": {"split": "x", "taxonomy": "t"}}, "digest of the split is 'x'"),
        ({"digests": {"split": "s", "taxonomy": "x"}}, "digest of the taxonomy is 'x'"),
    ],
)
def test_results_that_were_not_scored_alike_are_not_mixed(write, changes, message):
    paths = [write("one", TRUTH), write("two", TRUTH, **changes)]
    with pytest.raises(InvalidInputError, match=message) as caught:
        rank(paths)
    assert str(paths[0]) in str(caught.value)
    assert str(paths[1]) in str(caught.value)


def test_truncated_results_are_refused_at_any_length(write):
    path = write("one", TRUTH)
    whole = path.read_text().strip()
    for size in range(0, len(whole), 37):
        path.write_text(whole[:size])
        with pytest.raises(InvalidInputError, match="not a whole JSON file"):
            read_result(path)


@pytest.mark.parametrize("key", ["mIoU", "mCA", "submission"])
def test_results_that_lack_a_part_are_refused(write, key):
    path = write("one", TRUTH)
    content = json.loads(path.read_text())
    del content[key]
    path.write_text(json.dumps(content))
    with pytest.raises(InvalidInputError, match=key):
        read_result(path)


@pytest.mark.parametrize(
    "text",
    ["[]", "3", "null", "{}", '"text"', "NaN", '{"mIoU": NaN}', "[" * 100_000, "\ufeff{}"],
)
def test_other_json_is_no_result(tmp_path, text):
    path = tmp_path / "r.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInputError, match=str(path)) as caught:
        read_result(path)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("key", "value"),
    [("mIoU", 1.5), ("mIoU", "1"), ("mCA", -0.1), ("Chair", {"iou": "x"}), ("submission", [])],
)
def test_results_with_values_of_the_wrong_kind_are_refused(write, key, value):
    path = write("one", TRUTH)
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(InvalidInputError, match="not a result of semantic2d score"):
        read_result(path)


def test_files_that_hold_no_text_are_refused(tmp_path):
    (tmp_path / "r.json").write_bytes(b"\x89HDF\r\n\x1a\n\xff")
    with pytest.raises(InvalidInputError, match=r"r\.json: not a whole JSON file"):
        read_result(tmp_path / "r.json")
    with pytest.raises(InvalidInputError, match="found a folder"):
        read_result(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_result(tmp_path / "none.json")
