"""Scans of one lidar as another one would hold them: turned, and interpolated to its beams.

A network knows the beams of the lidar that it was trained on. Scans of another are turned by the
yaw of both mounts (mirrored where one of the two hangs upside down) and resampled at the
bearings of the first (paper, section on lidar types). The distance between the mounts is left
alone: it would hide some surfaces and uncover others, while a scan as it is seen from where the
lidar stood is a scan that the other could have taken from there.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.bearings import NO_BEAM, find_neighbours, find_positions, nearest_of
from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.access.scan_source import Fields, ScanSource
from semantic2d_dataset.access.torch_datasets import LidarDataset
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.scans import check_array
from semantic2d_dataset.scene.taxonomy import UNLABELLED

# Neighbours farther apart than both lie on two surfaces: a surface cannot be seen at more than
# 84 degrees of incidence (tangent 10), nor told from noise within 0.1 m.
_SMALLEST_JUMP_M = 0.1
_STEEPEST = 10.0


class Beams(NamedTuple):
    """Arrays of N scans: ranges (N, B) f4 m, intensities (N, B) f4 or None, labels (N, B) u1."""

    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32] | None
    labels: NDArray[np.uint8]


class Reprojection:
    """Resample scans of a lidar at the bearings of another, and bring labels back.

    Parameters
    ----------
    source
        The lidar that measured, B beams.
    target
        The lidar whose T beams are wanted.

    Attributes
    ----------
    in_view
        (B,) bool: the source's beams that look into the target's field of view.

    Raises
    ------
    InvalidInputError
        If one of them is not mounted level enough to have a yaw.
    """

    def __init__(self, source: LidarSpec, target: LidarSpec) -> None:
        self.source, self.target = source, target
        self._left, self._right, self._weight = find_neighbours(
            find_positions(target, source), source
        )
        self._nearest = nearest_of(source, target)
        self.in_view: NDArray[np.bool_] = self._nearest != NO_BEAM

    def apply(
        self,
        ranges: NDArray[np.float32],
        intensities: NDArray[np.float32] | None,
        labels: NDArray[np.uint8],
    ) -> Beams:
        """Resample scans at the target's beams.

        Between two returns of one surface, a range ends on the straight line between their
        endpoints, and the intensity is interpolated. Elsewhere both come from the nearest beam,
        as labels always do. Beams out of the source's field of view have range +inf, intensity 0
        and label 255.

        Parameters
        ----------
        ranges
            (N, B) f4, m.
        intensities
            (N, B) f4, sensor units, or None.
        labels
            (N, B) u1.

        Returns
        -------
        Beams
            (N, T) each.

        Raises
        ------
        InvalidInputError
            If an array does not fit the source.
        """
        check_array("ranges", ranges, np.float32, (None, self.source.beams))
        check_array("labels", labels, np.uint8, ranges.shape)
        if intensities is not None:
            check_array("intensities", intensities, np.float32, ranges.shape)
        shape = (len(ranges), self.target.beams)
        found = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint8)
        _resample(
            np.ascontiguousarray(ranges),
            np.ascontiguousarray(ranges if intensities is None else intensities),
            np.ascontiguousarray(labels),
            self.source.has_return(ranges),
            self._left,
            self._right,
            self._weight,
            np.float32(_STEEPEST * self.source.angle_increment),
            *found,
        )
        return Beams(found[0], None if intensities is None else found[1], found[2])

    def back(self, labels: NDArray[np.uint8], outside: int = UNLABELLED) -> NDArray[np.uint8]:
        """Give each of the source's beams the label of the target's beam nearest in bearing.

        Parameters
        ----------
        labels
            (N, T) u1, such as what a network predicts for reprojected scans.
        outside
            What beams get that are not `in_view`.

        Returns
        -------
        (N, B) u1
        """
        check_array("labels", labels, np.uint8, (None, self.target.beams))
        return np.where(self.in_view, labels[:, self._nearest], np.uint8(outside))


class ReprojectedSource(ScanSource):
    """Scans of one lidar that are fetched as scans of another; `lidar` is that other one.

    Parameters
    ----------
    data
        An open data set.
    lidar
        Id or short name of the lidar that measured.
    target
        The lidar whose beams are wanted.
    options
        As for `ScanSource`.
    """

    def __init__(self, data: OpenDataset, *, lidar: str, target: LidarSpec, **options: Any) -> None:
        super().__init__(data, lidar=lidar, **options)
        self.reprojection = Reprojection(self.lidar, target)
        self.lidar = target

    def fetch(
        self,
        wanted: NDArray[np.int64],
        names: Collection[str] | None = None,  # noqa: ARG002 - a beam is resampled as a whole
    ) -> tuple[Fields, NDArray[np.int64]]:
        """Return as `ScanSource.fetch` arrays and rows, the arrays with the target's beams."""
        fields, rows = super().fetch(wanted)
        measured = fields.get("intensities")
        beams = self.reprojection.apply(
            fields["ranges"][rows],
            None if measured is None else measured[rows],
            fields["labels"][rows],
        )
        found: dict[str, NDArray[Any]] = {
            "ranges": beams.ranges,
            "labels": beams.labels,
            "poses": fields["poses"][rows],
        }
        if beams.intensities is not None:
            found["intensities"] = beams.intensities
        return found, np.arange(len(rows))


class ReprojectedScans(LidarDataset):
    """A `LidarDataset` whose scans have the beams of another lidar.

    Statistics, where not given, are those of its own reprojected training split: the values of
    two sensors lie orders of magnitude apart (paper, figure on intensity values).

    Parameters
    ----------
    data
        An open data set.
    target
        The lidar whose beams are wanted.
    options
        As for `LidarDataset`; `lidar` names the one that measured.
    """

    source: ReprojectedSource

    def __init__(self, data: OpenDataset, *, target: LidarSpec, **options: Any) -> None:
        self._target = target
        super().__init__(data, **options)

    def open_source(self, data: OpenDataset, **options: Any) -> ReprojectedSource:
        """Open the scans of a split as scans of the target."""
        return ReprojectedSource(data, target=self._target, **options)


@numba.njit(cache=True, error_model="numpy", nogil=True)
def _resample(
    ranges: NDArray[np.float32],
    intensities: NDArray[np.float32],
    labels: NDArray[np.uint8],
    returned: NDArray[np.bool_],
    left: NDArray[np.int64],
    right: NDArray[np.int64],
    weight: NDArray[np.float64],
    steepest: np.float32,
    out_ranges: NDArray[np.float32],
    out_intensities: NDArray[np.float32],
    out_labels: NDArray[np.uint8],
) -> None:
    for n in range(len(ranges)):
        for k in range(len(left)):
            a, b, w = left[k], right[k], weight[k]
            if a == NO_BEAM:
                out_ranges[n, k], out_intensities[n, k] = np.inf, 0.0
                out_labels[n, k] = UNLABELLED
                continue
            nearest = a if w < 0.5 else b
            out_labels[n, k] = labels[n, nearest]
            r, q = ranges[n, a], ranges[n, b]
            jump = max(_SMALLEST_JUMP_M, steepest * min(r, q))
            if w > 0 and returned[n, a] and returned[n, b] and abs(q - r) <= jump:
                out_ranges[n, k] = 1 / ((1 - w) / r + w / q)  # on the chord, to second order
                out_intensities[n, k] = (1 - w) * intensities[n, a] + w * intensities[n, b]
            else:
                out_ranges[n, k] = ranges[n, nearest]
                out_intensities[n, k] = intensities[n, nearest]
