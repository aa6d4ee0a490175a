"""What the commands of the baselines have in common."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semantic2d_dataset.errors import InvalidInputError

if TYPE_CHECKING:
    from baselines.configs import TrainingConfig

Data = Annotated[str, typer.Option("--data", help="Name of a data set, or its folder.")]
Json = Annotated[bool, typer.Option("--json", help="Print what was done as JSON.")]
Device = Annotated[
    str | None, typer.Option(help="cpu or cuda; cuda where there is one, if not given.")
]


def check_free(path: Path, *, force: bool) -> None:
    """Raise InvalidInputError if a path is taken and may not be replaced."""
    if path.exists() and not force:
        raise InvalidInputError(f"{path}: exists already; choose another, or pass --force")


def config_of(preset: str, **changes: object) -> TrainingConfig:
    """Return the settings of a preset with those changes that are not None."""
    from dataclasses import replace

    from baselines.configs import PRESETS

    if preset not in PRESETS:
        raise InvalidInputError(f"unknown preset {preset!r}; known are {', '.join(PRESETS)}")
    given = {name: value for name, value in changes.items() if value is not None}
    if "epochs" in given:  # a number of epochs is kept, whatever time they take
        given.setdefault("time_limit_s", None)
    return replace(PRESETS[preset](), **given)  # type: ignore[arg-type]


def usable_device(name: str | None) -> str:
    """Return a device that can be used; a GPU is taken where there is one, never required."""
    import torch

    chosen = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.empty(0, device=chosen)
    except (RuntimeError, AssertionError) as err:
        raise InvalidInputError(f"device {chosen!r} cannot be used here: {err}") from err
    return chosen


def report(said: dict[str, object], text: str, *, as_json: bool) -> None:
    """Print what was done, for people or for a program."""
    typer.echo(json.dumps(said) if as_json else text)
