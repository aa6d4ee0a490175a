"""Labelled sequences of some rooms, and what is said of them."""

from pathlib import Path

from tests.generators import make_sequence

PLACES = ("lobby", "corridor", "office")
ABOUT = """\
title: Some rooms
description: Rooms that nobody has seen.
authors:
  - name: Ann Author
    affiliation: A university
date: 2026-11-25
url: https://data.example.org/rooms
intended_use: To be tested with.
limits: Labels are drawn at random.
known_label_errors: All of them.
citation: Author, A. (2026). Some rooms.
"""


def add(folder: Path, place: str, *, seed: int = 5, scans: int = 60, **options: object) -> Path:
    """Write a sequence of a place into a data set's folder."""
    lidar = options.get("lidar")
    path = folder / "sequences" / f"{place}--first--{lidar.name if lidar else 'small'}.h5"
    make_sequence(path, scans, environment=place, seed=seed, **options)
    return path


def make_rooms(folder: Path) -> Path:
    """Make a folder of labelled sequences with a ``release.yaml``, unpublished."""
    (folder / "sequences").mkdir(parents=True)
    for number, place in enumerate(PLACES):
        add(folder, place, seed=number)
    (folder / "release.yaml").write_text(ABOUT)
    return folder
