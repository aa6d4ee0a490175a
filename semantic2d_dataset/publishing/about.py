"""``release.yaml``: what nobody but the people who made a data set can say of it."""

from __future__ import annotations

import datetime
import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.schema_check import check_document
from semantic2d_dataset.scene.documents import read_yaml
from semantic2d_dataset.simulation.mini import MINI_NAME

ABOUT_NAME = "release.yaml"


@dataclass(frozen=True)
class Author:
    """Somebody who made the data."""

    name: str
    affiliation: str | None = None
    url: str | None = None


@dataclass(frozen=True)
class About:
    """What is said of a data set; None where nothing is.

    Parameters
    ----------
    title, description
        What it is, in a few words and in some sentences.
    authors
        Who made it, in order.
    contact, url, funding
        Whom to ask, where it lies, who paid.
    date
        Of publication, such as 2026-11-25.
    tags
        Words to find it by, beside those that fit every such data set.
    how_it_was_made, intended_use, limits, known_label_errors, citation
        Sections of the card, Markdown.
    """

    title: str | None = None
    description: str | None = None
    authors: tuple[Author, ...] = ()
    contact: str | None = None
    url: str | None = None
    funding: str | None = None
    date: str | None = None
    tags: tuple[str, ...] = ()
    how_it_was_made: str | None = None
    intended_use: str | None = None
    limits: str | None = None
    known_label_errors: str | None = None
    citation: str | None = None


def read_about(folder: Path, name: str = "") -> About:
    """Read what is said of the data set in a folder; nothing where there is no ``release.yaml``.

    Parameters
    ----------
    folder
        The data set's folder.
    name
        Its name; what is said of `semantic2d-mini` belongs to this package.

    Raises
    ------
    InvalidInputError
        If the file is not valid; all problems are told at once.
    """
    path = Path(folder) / ABOUT_NAME
    if path.is_file():
        return _parse(path)
    if name == MINI_NAME:
        with resources.as_file(resources.files(__package__) / "mini.yaml") as own:
            return _parse(own)
    return About()


def _parse(path: Path) -> About:
    said = read_yaml(path) or {}
    if isinstance(said, dict):
        said = {key: _plain(value) for key, value in said.items()}
        if not all(isinstance(key, str) for key in said):
            raise InvalidInputError(f"{path}: expected words as keys, found {[*said]}")
    check_document(path, said, _schema())
    authors = tuple(Author(**author) for author in said.pop("authors", ()))
    tags = tuple(said.pop("tags", ()))
    texts = {key: value.strip() for key, value in said.items()}
    return About(authors=authors, tags=tags, **texts)


def _plain(value: Any) -> Any:
    """YAML reads a date that is not quoted as one."""
    return value.isoformat() if isinstance(value, datetime.date) else value


@cache
def _schema() -> Any:
    text = resources.files(__package__).joinpath("about.schema.json").read_text("utf-8")
    return json.loads(text)
