"""Classes: their ids, names and colours."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.documents import read_yaml

UNLABELLED = 255
"""The id of a beam or cell that has no label."""

# Spellings met in published files, in the normal form of `_plain`.
_ALIASES = {
    "people": "person",
    "pedestrian": "person",
    "background": "other",
    "trash can": "trash bin",
    "trashbin": "trash bin",
}


def _plain(name: str) -> str:
    words = " ".join(re.split(r"[\s_\-]+", name.strip().lower())).strip()
    return _ALIASES.get(words, words)


@dataclass(frozen=True)
class Taxonomy:
    """Class names by id, and their colours.

    Parameters
    ----------
    names
        Name of each class; its position is its id.
    colours
        One RGB triple 0..255 for each class.
    background_id
        The class that collects everything else; never part of a mean.
    """

    names: tuple[str, ...]
    colours: tuple[tuple[int, int, int], ...]
    background_id: int = 0

    def __post_init__(self) -> None:
        if not 2 <= len(self.names) <= UNLABELLED:
            raise InvalidInputError(f"expected 2 to 255 class names, found {len(self.names)}")
        if len(self.colours) != len(self.names):
            raise InvalidInputError(
                f"expected {len(self.names)} colours, one for each class, found {len(self.colours)}"
            )
        if not all(name.isprintable() and name.strip() for name in self.names):
            raise InvalidInputError(f"class names must be printable text, found {self.names!r}")
        if len({_plain(name) for name in self.names}) != len(self.names):
            raise InvalidInputError(f"class names must differ, found {self.names}")
        if not 0 <= self.background_id < len(self.names):
            raise InvalidInputError(f"no class has the id {self.background_id}")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def scored_ids(self) -> tuple[int, ...]:
        """Ids of the classes that enter a mean: all but the background."""
        return tuple(i for i in range(len(self.names)) if i != self.background_id)

    @property
    def digest(self) -> str:
        """SHA-256 of names, colours and background id, hex."""
        text = json.dumps([self.names, self.colours, self.background_id], ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def palette(self) -> NDArray[np.uint8]:
        """Colours as a look-up table (256, 3) u1 by label; unlabelled is light grey."""
        table = np.full((256, 3), 235, np.uint8)
        table[: len(self.names)] = self.colours
        return table

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, which `from_dict` reads."""
        return {
            "names": list(self.names),
            "colours": [list(colour) for colour in self.colours],
            "background_id": self.background_id,
        }

    @classmethod
    def from_dict(cls, said: Mapping[str, Any]) -> Taxonomy:
        """Return the classes that `as_dict` wrote.

        Raises
        ------
        InvalidInputError
            If they are none.
        """
        colours = tuple((r, g, b) for r, g, b in said["colours"])
        return cls(tuple(said["names"]), colours, said["background_id"])

    def id_of(self, name: str) -> int:
        """Return the id of a class by its name, whatever its case or published spelling.

        Raises
        ------
        InvalidInputError
            If no class has that name.
        """
        wanted = _plain(name)
        for i, known in enumerate(self.names):
            if _plain(known) == wanted:
                return i
        raise InvalidInputError(f"unknown class {name!r}; known are {', '.join(self.names)}")


def read_taxonomy(path: Path) -> Taxonomy:
    """Read classes from a YAML file.

    ``classes`` maps names to colours ``[red, green, blue]`` in the order of their ids; with
    ``extends: semantic2d`` they come after those of the release. ``background`` names the class
    that collects everything else, the first one where it is left out.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    InvalidInputError
        If it is not of that form.
    """
    found = read_yaml(path)
    keys = {"classes", "extends", "background"}
    if not isinstance(found, dict) or not set(found) <= keys or "classes" not in found:
        raise InvalidInputError(f"{path}: expected a mapping with `classes`, out of {sorted(keys)}")
    base = SEMANTIC2D if found.get("extends") == "semantic2d" else None
    if found.get("extends") is not None and base is None:
        raise InvalidInputError(f"{path}: extends: expected semantic2d, found {found['extends']!r}")
    classes = found["classes"]
    if not isinstance(classes, dict) or not all(map(_is_colour, classes.values())):
        raise InvalidInputError(
            f"{path}: classes: expected names with a colour [red, green, blue] of 0 to 255 each, "
            f"found {classes!r}"
        )
    names = (*(base.names if base else ()), *map(str, classes))
    colours = (*(base.colours if base else ()), *((r, g, b) for r, g, b in classes.values()))
    try:
        made = Taxonomy(names, colours)
        return replace(made, background_id=made.id_of(str(found.get("background", names[0]))))
    except InvalidInputError as err:
        raise InvalidInputError(f"{path}: {err}") from err


def _is_colour(value: object) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(type(part) is int and 0 <= part <= 255 for part in value)
    )


# Ids and colours as in the published release.
SEMANTIC2D = Taxonomy(
    names=(
        "Other",
        "Chair",
        "Door",
        "Elevator",
        "Person",
        "Pillar",
        "Sofa",
        "Table",
        "Trash bin",
        "Wall",
    ),
    colours=(
        (0, 0, 0),
        (109, 0, 156),
        (0, 46, 221),
        (0, 164, 187),
        (204, 204, 204),
        (0, 155, 18),
        (0, 225, 0),
        (203, 249, 0),
        (255, 173, 0),
        (227, 0, 0),
    ),
)
