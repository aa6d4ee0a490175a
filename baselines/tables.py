"""Tables of segmentation results in the layout of the paper: as text, Markdown and LaTeX.

Every method has a line for CA and one for IoU, in percent, mean and standard deviation. The best
of what may be compared is marked; published rows carry a dagger and never are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass

from semantic2d_dataset.scoring.metrics import percent
from semantic2d_dataset.scoring.published import ALL, METRICS, ClassFigures

_DAGGER = "†"
_HEAD = ("Method", "FPS", "Metric", "All classes")
_LEFT = (0, 2)  # columns of words


@dataclass(frozen=True)
class Row:
    """A method and its figures.

    Parameters
    ----------
    method
        Its name.
    frames_per_second
        Scans a second, None where not measured.
    figures
        Fractions by metric and class, as in `published.PublishedRow`.
    published
        Whether they are as published, and so from other data.
    ranked
        Whether they may be the best of a column: not what is published, nor what is scored on
        some classes only.
    """

    method: str
    frames_per_second: float | None
    figures: Mapping[str, ClassFigures]
    _: KW_ONLY
    published: bool = False
    ranked: bool = True


@dataclass(frozen=True)
class Table:
    """Rows under a title, the classes of their columns, and what has to be said below."""

    title: str
    classes: tuple[str, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Cell:
    text: str
    best: bool = False


@dataclass(frozen=True)
class _Line:
    cells: tuple[_Cell, ...]
    published: bool
    begins: bool  # a method and its published row


def to_text(table: Table) -> str:
    """Lay a table out in columns; a star follows the best."""
    body = [[f"{c.text}{'*' if c.best else ''}" for c in line.cells] for line in _lines(table)]
    lines = [_header(table), *body]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    laid = [
        "  ".join(
            cell.ljust(width) if n in _LEFT else cell.rjust(width)
            for n, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ).rstrip()
        for cells in lines
    ]
    rule = "-" * max(map(len, laid))
    notes = (*table.notes, "* best of the rows that are ranked.")
    return "\n".join((f"{table.title} (%)", rule, laid[0], rule, *laid[1:], rule, *notes)) + "\n"


def to_markdown(table: Table) -> str:
    """Write a table as Markdown; the best is bold, what is published italic."""
    header = _header(table)
    marks = [":--" if n in _LEFT else "--:" for n in range(len(header))]
    body = [[_in_markdown(cell, line) for cell in line.cells] for line in _lines(table)]
    lines = [f"| {' | '.join(cells)} |" for cells in (header, marks, *body)]
    notes = [f"- {note}" for note in (*table.notes, "Bold: best of the rows that are ranked.")]
    return "\n".join((f"## {table.title} (%)", "", *lines, "", *notes)) + "\n"


def to_latex(table: Table) -> str:
    """Write a table for a document that loads booktabs, graphicx and xcolor.

    The best is bold, what is published grey.
    """
    header = _header(table)
    columns = "".join("l" if n in _LEFT else "r" for n in range(len(header)))
    lines: list[str] = []
    for line in _lines(table):
        if line.begins and lines:
            lines.append(r"\addlinespace")
        lines.append(_latex_row(_in_latex(cell, line) for cell in line.cells))
    notes = (*table.notes, "Bold: best of the rows that are ranked.")
    return "\n".join(
        (
            "% needs the packages booktabs, graphicx and xcolor",
            r"\begin{table*}[t]",
            r"\centering",
            rf"\caption{{{_latex(table.title)} (\%)}}",
            r"\resizebox{\textwidth}{!}{%",
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            _latex_row(map(_latex, header)),
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}}",
            r"\par\smallskip\footnotesize\raggedright",
            *(rf"{_latex(note)}\par" for note in notes),
            r"\end{table*}",
            "",
        )
    )


def _header(table: Table) -> list[str]:
    return [*_HEAD, *table.classes]


def _lines(table: Table) -> list[_Line]:
    names = (ALL, *table.classes)
    best = {(metric, name): _best(table, metric, name) for metric in METRICS for name in names}
    lines = []
    for row in table.rows:
        titles = (f"{row.method}{f' {_DAGGER}' if row.published else ''}", _speed(row))
        for metric in METRICS:
            begins = metric == METRICS[0]
            cells = [_Cell(text) for text in (*(titles if begins else ("", "")), metric)]
            for name in names:
                figure = row.figures[metric].get(name)
                wins = row.ranked and figure is not None and figure[0] == best[metric, name]
                cells.append(_Cell(_figure(figure), wins))
            lines.append(_Line(tuple(cells), row.published, begins and not row.published))
    return lines


def _best(table: Table, metric: str, name: str) -> float | None:
    ranked = (row.figures[metric] for row in table.rows if row.ranked)
    return max((figures[name][0] for figures in ranked if name in figures), default=None)


def _figure(figure: tuple[float, float | None] | None) -> str:
    if figure is None:
        return "-"
    mean, std = figure
    return percent(mean) if std is None else f"{percent(mean)}±{percent(std)}"


def _speed(row: Row) -> str:
    return "-" if row.frames_per_second is None else f"{row.frames_per_second:.2f}"


def _in_markdown(cell: _Cell, line: _Line) -> str:
    text = cell.text.replace("|", r"\|")
    mark = "**" if cell.best else "*" if line.published and text else ""
    return f"{mark}{text}{mark}"


def _in_latex(cell: _Cell, line: _Line) -> str:
    text = _latex(cell.text)
    if line.published and text:
        return rf"\textcolor{{gray}}{{{text}}}"
    return rf"\textbf{{{text}}}" if cell.best else text


def _latex_row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


_LATEX = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"±": r"$\pm$", _DAGGER: r"$^\dagger$"}
)


def _latex(text: str) -> str:
    return text.translate(_LATEX)
