"""The pages of the board: files for a browser, with or without a server."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from jinja2 import Environment, PackageLoader, StrictUndefined
from markdown_it import MarkdownIt
from markupsafe import Markup
from tqdm import tqdm

from leaderboard import charts
from leaderboard.at_hand import AtHand
from leaderboard.checking import VERIFIED, WRONG, Checked, check_entries, format_check
from leaderboard.entries import PUBLISHED
from leaderboard.rows import (
    METRICS,
    TITLES,
    UNRANKED_SCHEMES,
    doubts,
    entry_of,
    facts_of,
    make_tables,
    page_of,
    runs_of,
    scores_of,
    shown_scores,
)
from leaderboard.samples import draw_samples
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.writing import make_folder
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D

MARK = "semantic2d leaderboard build"
"""What the start page says of its generator: only such a folder is ever replaced."""

_LEVELS = 10
_LIGHT = ((255, 255, 255), (11, 61, 112))  # of the confusion matrix, from none to all
_DARK = ((16, 21, 27), (140, 194, 247))


def build_site(out: Path, entries: Path, at_hand: AtHand) -> int:
    """Check every entry, and write the pages of the board into a folder.

    The same entries, data and predictions give the same bytes.

    Parameters
    ----------
    out
        The folder; one that an earlier build left is replaced when the new one is whole.
    entries
        The folder of entries.
    at_hand
        What entries are checked against, and sample scans are drawn from.

    Returns
    -------
    int
        How many entries are shown.

    Raises
    ------
    InvalidInputError
        If an entry is wrong, there is none, or something else is where the pages would go.
    """
    out = Path(out).resolve()
    _check_out(out, Path(entries))
    checked = check_entries(entries, at_hand)
    wrong = [each for each in checked if each.status == WRONG]
    if wrong:
        raise InvalidInputError(f"{entries}: a board shows no wrong entries\n{format_check(wrong)}")
    if not checked:
        raise InvalidInputError(f"{entries}: no entries (*.json) to show")
    make_folder(out, lambda folder: _write(folder, checked), lambda: False)
    return len(checked)


def _check_out(out: Path, entries: Path) -> None:
    if out.exists() and not out.is_dir():
        raise InvalidInputError(f"{out}: is a file; give the name of a folder")
    start = out / "index.html"
    made = start.is_file() and MARK in start.read_text("utf-8", errors="replace")[:1000]
    if out.is_dir() and any(out.iterdir()) and not made:
        raise InvalidInputError(f"{out}: holds something else; choose a new folder")
    if entries.resolve().is_relative_to(out):
        raise InvalidInputError(f"{out}: holds the entries themselves; choose a new folder")


def _write(folder: Path, checked: Sequence[Checked]) -> None:
    environment = _environment()
    tables = make_tables(checked)
    places = {(row.page, table.id): row.place for table in tables for row in table.rows}
    start: dict[str, Mapping[str, Any]] = {
        "index.html": {"tables": tables},
        "submit.html": {"rules": _rules()},
    }
    for name, values in start.items():
        text = environment.get_template(name).render(root="", **values)
        (folder / name).write_text(text, "utf-8")
    (folder / "methods").mkdir()
    template = environment.get_template("method.html")
    for each in tqdm(checked, "writing pages", unit="page", disable=None, leave=False):
        page = page_of(each)
        ranks = [
            (table.title, table.id, places[page, table.id])
            for table in tables
            if (page, table.id) in places
        ]
        text = template.render(root="../", ranks=ranks, **_method(each))
        (folder / page).write_text(text, "utf-8")


def _method(checked: Checked) -> dict[str, Any]:
    """Return what the page of a method shows."""
    entry = entry_of(checked)
    taxonomy = SEMANTIC2D if entry.kind == PUBLISHED else entry.taxonomy
    names = [name for name in taxonomy.names if name != taxonomy.names[taxonomy.background_id]]
    result = entry.said.get("result", {})
    lidars = [
        {
            "lidar": track.lidar,
            "scores": scores_of(entry, track.lidar),
            "shown": shown_scores(entry, track.lidar) if entry.runs else None,
            "said": result.get("per_lidar", {}).get(track.lidar),
            "bars": charts.class_bars(scores_of(entry, track.lidar), names),
            "samples": _samples(checked, track.lidar),
        }
        for track in entry.tracks()
    ]
    return {
        "checked": checked,
        "entry": entry,
        "facts": facts_of(entry),
        "doubts": doubts(entry),
        "runs": runs_of(entry),
        "taxonomy": taxonomy,
        "lidars": lidars,
        "result": result,
        "conditions": charts.conditions_of(result, names),
        "reliability": charts.reliability_of(result),
    }


def _samples(checked: Checked, lidar: str) -> list[Any]:
    if checked.status != VERIFIED or checked.predictions is None or checked.dataset is None:
        return []
    return list(draw_samples(checked.predictions, checked.dataset, lidar))


def _environment() -> Environment:
    """Return templates that escape what they are given, and know their style and script."""
    environment = Environment(
        loader=PackageLoader("leaderboard", "pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style, script = (_resource(name) for name in ("board.css", "board.js"))
    style += _heat_style(*_LIGHT)
    style += f"@media screen and (prefers-color-scheme: dark) {{{_heat_style(*_DARK)}}}\n"
    environment.globals |= {
        "style": Markup(style),  # noqa: S704 - files of this package
        "script": Markup(script),  # noqa: S704 - files of this package
        "policy": "; ".join(
            (
                "default-src 'none'",
                f"style-src '{_hash(style)}'",
                f"script-src '{_hash(script)}'",
                "base-uri 'none'",
                "form-action 'none'",
            )
        ),
        "mark": MARK,
        "metrics": METRICS,
        "unranked": UNRANKED_SCHEMES,
        "titles": TITLES,
        "levels": _LEVELS,
        "grid": charts.grid(),
        "chart_size": (charts.WIDTH, charts.HEIGHT),
    }
    environment.filters |= {"percent": _percent, "web": _web, "shares": _shares}
    return environment


def _resource(name: str) -> str:
    return resources.files("leaderboard").joinpath("pages", name).read_text("utf-8")


def _rules() -> Markup:
    """Return the rules as HTML; they are a file of this package, and hold none themselves."""
    text = resources.files("leaderboard").joinpath("RULES.md").read_text("utf-8")
    return Markup(MarkdownIt("commonmark", {"html": False}).enable("table").render(text))  # noqa: S704


def _hash(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"sha256-{base64.b64encode(digest).decode()}"


def _percent(fraction: float | None, places: int = 1) -> str:
    return "–" if fraction is None else f"{100 * fraction:.{places}f}"  # noqa: RUF001


def _web(text: str) -> bool:
    """Tell whether a text is the address of a web page, and nothing else that a browser runs."""
    try:
        parts = urlsplit(text)
    except ValueError:
        return False
    return parts.scheme in ("https", "http") and bool(parts.netloc) and text.isprintable()


def _shares(row: Sequence[int]) -> list[tuple[int, float, int]]:
    """Return each count of a row with its share of the row and a level of colour."""
    total = sum(row)
    return [
        (n, n / total if total else 0.0, round(_LEVELS * n / total) if total else 0) for n in row
    ]


def _heat_style(paper: Sequence[int], ink: Sequence[int]) -> str:
    """Return the colours of the confusion matrix: ink on paper, whichever text reads better."""
    rules = []
    for level in range(_LEVELS + 1):
        part = level / _LEVELS
        mixed = [round(p + part * (i - p)) for p, i in zip(paper, ink, strict=True)]
        light = _luminance(mixed)
        text = "#000" if (light + 0.05) / 0.05 >= 1.05 / (light + 0.05) else "#fff"
        rules.append(f"td.h{level}{{background:rgb({','.join(map(str, mixed))});color:{text}}}")
    return "\n" + "\n".join(rules) + "\n"


def _luminance(rgb: Sequence[int]) -> float:
    """Relative luminance, 0 to 1 (WCAG 2.2)."""
    parts = [v / 255 for v in rgb]
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
