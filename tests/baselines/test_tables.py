from __future__ import annotations

import re

import pytest

from baselines.tables import Row, Table, to_latex, to_markdown, to_text
from semantic2d_dataset.scoring.published import METRICS, published_segmentation

CLASSES = ("Chair", "Trash bin")
WRITERS = {"text": to_text, "markdown": to_markdown, "latex": to_latex}
BEST = {
    "text": r"([\d.±]+)\*",
    "markdown": r"\*\*([\d.±]+)\*\*",
    "latex": r"\\textbf\{([\d.]+(?:\$\\pm\$[\d.]+)?)\}",
}


def make_row(method: str, mean: float, **options) -> Row:
    figures = {"All": (mean, 0.0123), "Chair": (mean / 2, None)}
    return Row(method, 12.345, dict.fromkeys(METRICS, figures), **options)


def make_table(*rows: Row) -> Table:
    return Table("Results", CLASSES, rows, ("Data: 100 % & all_of it",))


TABLE = make_table(
    make_row("Net (R)", 0.25),
    make_row("Net (R)", 0.75, published=True, ranked=False),
    make_row("Net (R+I)", 0.5),
    make_row("Lines", 0.9, ranked=False),
)


def cells_of(text: str, kind: str) -> list[list[str]]:
    """The cells of a table as a reader of that format finds them, without header and marks."""
    if kind == "latex":
        body = text[text.index(r"\midrule") + 8 : text.index(r"\bottomrule")]
        rows = [row for row in re.split(r"\\\\\n", body) if row.strip()]
        lines = [re.split(r"(?<!\\)&", row.replace(r"\addlinespace", "")) for row in rows]
        plain = [[c.replace(r"$\pm$", "±").replace(r"$^\dagger$", "†") for c in r] for r in lines]
        return [[re.sub(r"\\text\w+(\{gray\})?|[{}]", "", c).strip() for c in r] for r in plain]
    if kind == "markdown":
        rows = [line for line in text.splitlines() if line.startswith("|")][2:]
        return [[c.strip().strip("*") for c in row.strip("|").split("|")] for row in rows]
    rows = [line for line in text.splitlines() if re.search(r"  (CA|IoU)  ", line)]
    return [[c.strip().strip("*") for c in re.split(r" {2,}", row.strip())] for row in rows]


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_holds_the_same_cells(kind: str):
    means = {"Net (R)": 25, "Net (R) †": 75, "Net (R+I)": 50, "Lines": 90}
    expected = [
        [*head, metric, f"{mean}.00±1.23", f"{mean / 2:.2f}", "-"]
        for method, mean in means.items()
        for metric, head in (("CA", (method, "12.35")), ("IoU", ("", "")))
    ]
    if kind == "text":  # where an empty cell is only space
        expected = [[cell for cell in cells if cell] for cells in expected]
    assert cells_of(WRITERS[kind](TABLE), kind) == expected


def best_of(text: str, kind: str) -> list[str]:
    """The cells that are marked as the best."""
    return [cell.replace(r"$\pm$", "±") for cell in re.findall(BEST[kind], text)]


@pytest.mark.parametrize("kind", WRITERS)
def test_only_the_best_of_the_ranked_rows_is_marked(kind: str):
    assert best_of(WRITERS[kind](TABLE), kind) == ["50.00±1.23", "25.00"] * 2


def test_published_rows_are_italic_in_markdown_and_grey_in_latex():
    for line in to_markdown(TABLE).splitlines():
        assert ("*75.00±1.23*" in line) == ("75.00" in line)
    for line in to_latex(TABLE).splitlines():
        assert (r"\textcolor{gray}{75.00$\pm$1.23}" in line) == ("75.00" in line)


def test_latex_is_balanced_and_escaped():
    text = to_latex(TABLE)
    assert re.findall(r"\\begin\{(.*?)\}", text) == ["table*", "tabular"]
    assert re.findall(r"\\end\{(.*?)\}", text) == ["tabular", "table*"]
    assert r"100 \% \& all\_of it" in text
    unescaped = re.sub(r"\\[{}]", "", text)
    assert unescaped.count("{") == unescaped.count("}")
    columns = re.search(r"\\begin\{tabular\}\{(\w+)\}", text)[1]
    assert {len(row) for row in cells_of(text, "latex")} == {len(columns)}
    assert text.isascii()


@pytest.mark.parametrize("kind", WRITERS)
def test_a_table_without_ranked_rows_has_no_best(kind: str):
    rows = [
        Row(row.method, row.frames_per_second, row.figures, published=True, ranked=False)
        for row in published_segmentation().rows
    ]
    classes = tuple(rows[-1].figures["CA"])[1:]
    text = WRITERS[kind](Table("Published", classes, tuple(rows), ()))
    assert "39.44" in text
    assert not best_of(text.replace("| *", "| ").replace("* |", " |"), kind)
