"""Scans of several lidars as one PyTorch Dataset, on one grid of bearings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from semantic2d_dataset.access.angular_grids import AngularGrid, GridSource, common_grid
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.access.torch_batches import Batch, BatchedDataset
from semantic2d_dataset.access.torch_datasets import LidarDataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy


class GridScans(LidarDataset):
    """A `LidarDataset` whose scans have the beams of a grid.

    Parameters
    ----------
    data
        An open data set.
    grid
        The bearings, such as `common_grid` of several lidars.
    options
        As for `LidarDataset`.
    """

    def __init__(self, data: OpenDataset, *, grid: AngularGrid, **options: Any) -> None:
        self._grid = grid
        super().__init__(data, **options)

    def open_source(self, data: OpenDataset, **options: Any) -> GridSource:
        """Open the scans of a split at the bearings of the grid."""
        return GridSource(data, grid=self._grid, **options)


class CombinedLidars(BatchedDataset):
    """Scans of several lidars, one lidar after the other, on one grid of bearings.

    Items are those of `LidarDataset`, whose fields are there that every lidar has, with
    ``lidar``, i64, the place in `parts`. Beams that a lidar does not have are not `valid`, and
    their label is 255. Features are standardised by the train split of their own lidar: sensor
    units differ between lidars by orders of magnitude, and the same value would mean bright to
    one and dark to another.

    Parameters
    ----------
    data
        An open data set.
    lidars
        Ids or short names; all that it has where not given.
    grid
        The bearings; those that each of the lidars sees (``intersection``), or any (``union``).
    options
        As for `LidarDataset`, but statistics.

    Attributes
    ----------
    grid : AngularGrid
        The bearings.
    parts : tuple of GridScans
        The scans of each lidar, with their statistics.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError, CorruptFileError
        As from `LidarDataset`, or if the lidars' classes differ or no bearing is common to them.
    """

    def __init__(
        self,
        data: OpenDataset,
        *,
        lidars: Sequence[str] | None = None,
        grid: AngularGrid | Literal["intersection", "union"] = "intersection",
        **options: Any,
    ) -> None:
        names = lidars or sorted({entry.lidar for entry in data.sequences()})
        specs = [data.reader(data.sequences(name)[0].id).lidar for name in names]
        self.grid = grid if isinstance(grid, AngularGrid) else common_grid(specs, grid)
        self.parts = tuple(GridScans(data, grid=self.grid, lidar=name, **options) for name in names)
        for part in self.parts:
            if part.taxonomy != self.taxonomy:
                raise InvalidInputError(
                    f"{data.manifest.name}: the classes of {part.lidar.name} are not those of "
                    f"{self.parts[0].lidar.name}"
                )
        self.chunks_in_run = self.parts[0].chunks_in_run
        self._starts = np.cumsum([0, *map(len, self.parts)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    @property
    def lidars(self) -> tuple[LidarSpec, ...]:
        """The sensors, as if they had the grid's beams."""
        return tuple(part.lidar for part in self.parts)

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes that labels refer to."""
        return self.parts[0].taxonomy

    @property
    def in_memory(self) -> bool:
        """Whether the splits of all lidars are kept in memory."""
        return all(part.in_memory for part in self.parts)

    @cached_property
    def class_counts(self) -> NDArray[np.int64]:
        """Number of labelled beams with a return by class id, (C,) i8, over all lidars."""
        total: NDArray[np.int64] = sum(part.class_counts for part in self.parts)  # type: ignore[assignment]
        return total

    @property
    def scan_class_counts(self) -> NDArray[np.int32]:
        """Labelled beams with a return of each scan by class id, (N, K) i4."""
        return np.concatenate([part.scan_class_counts for part in self.parts])

    def chunk_runs(self) -> list[range]:
        """Return runs of items that are read together."""
        return [
            range(int(start) + run.start, int(start) + run.stop)
            for start, part in zip(self._starts[:-1], self.parts, strict=True)
            for run in part.chunk_runs()
        ]

    def fetch_batch(self, wanted: NDArray[np.int64]) -> Batch:
        """Return a collated batch of the items of numbers from 0 on."""
        lidar = np.searchsorted(self._starts, wanted, side="right") - 1
        order = np.argsort(lidar, kind="stable")
        back = np.argsort(order)
        batches = [
            self.parts[i].fetch_batch(wanted[lidar == i] - self._starts[i])
            for i in np.unique(lidar)
        ]
        everywhere = all(part.source.has_intensities for part in self.parts)
        batch: Batch = {}
        for key in batches[0]:
            if key.endswith("intensities") and not everywhere:
                continue
            if key == "scan_id":
                ids = [scan_id for each in batches for scan_id in each[key]]
                batch[key] = [ids[i] for i in back]
            else:
                batch[key] = torch.cat([each[key] for each in batches])[torch.from_numpy(back)]
        return batch | {"lidar": torch.from_numpy(lidar)}
