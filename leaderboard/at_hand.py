"""What entries can be checked against: the data sets and predictions of this machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from leaderboard.entries import file_digest, name_of
from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.scoring.predictions import PredictionsReader


@dataclass
class AtHand:
    """Data sets and predictions that entries can be checked against.

    Parameters
    ----------
    data
        Names or folders of data sets; known ones on this machine are found by themselves.
    predictions
        Folder of predictions files, whatever their names, or None.
    """

    data: Sequence[str] = ()
    predictions: Path | None = None
    _opened: dict[tuple[str, str], OpenDataset | None] = field(default_factory=dict)
    _files: dict[str, Path] | None = None
    _identities: dict[str, tuple[Any, ...] | None] | None = None

    def __post_init__(self) -> None:
        for name in self.data:
            found = open_dataset(name)
            self._opened[found.manifest.name, found.manifest.version] = found

    def dataset(self, name: str, version: str) -> OpenDataset | None:
        """Return a data set of that name and version, None where it is not at hand."""
        if (name, version) not in self._opened:
            try:
                found = open_dataset(name)
            except (Semantic2DError, OSError):
                self._opened[name, version] = None
            else:
                same = (found.manifest.name, found.manifest.version) == (name, version)
                self._opened[name, version] = found if same else None
        return self._opened[name, version]

    def file(self, digest: str) -> Path | None:
        """Return the predictions file of that SHA-256, None where it is not at hand."""
        return self._by_digest().get(digest)

    def namesakes(self, said: Mapping[str, Any], seeds: Any) -> dict[str, Path]:
        """Return, by digest, files that say they are of an entry's method, track and seeds."""
        wanted = _identity(said["track"], name_of(said["metadata"]), seeds)
        there = self._by_digest()
        if self._identities is None:
            self._identities = {digest: _identity_of(path) for digest, path in there.items()}
        return {d: path for d, path in there.items() if self._identities[d] == wanted}

    def _by_digest(self) -> dict[str, Path]:
        if self._files is None:
            found = sorted(self.predictions.rglob("*.h5")) if self.predictions else []
            found = [path for path in found if path.is_file()]  # a pipe would be read for ever
            bar = tqdm(found, desc="hashing predictions", unit="file", disable=None, leave=False)
            self._files = {file_digest(path): path for path in bar}
        return self._files


def _identity(track: Mapping[str, Any], method: str, seeds: Any) -> tuple[Any, ...]:
    names = ("dataset", "dataset_version", "scheme", "split")
    return (*(track[name] for name in names), {*track["lidars"]}, method, seeds)


def _identity_of(path: Path) -> tuple[Any, ...] | None:
    """Read what a file says it is, None where it is no predictions file that says it."""
    try:
        with PredictionsReader(path) as reader:
            track = {
                "dataset": reader.dataset,
                "dataset_version": reader.dataset_version,
                "scheme": reader.scheme,
                "split": "val" if reader.split == "dev" else reader.split,
                "lidars": [name.rsplit("--", 1)[-1] for name in reader.sequence_ids],
            }
            return _identity(track, name_of(reader.metadata), reader.metadata.get("seeds"))
    except (Semantic2DError, OSError, KeyError, TypeError):
        return None
