"""How many scans of a test split have a scan of the train split right beside them in time."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.format.splits import TEST, TRAIN, SplitScheme

NEAR_S = 0.1
"""Two periods of the 20 Hz that the lidars of the release run at."""


def near_share(scheme: SplitScheme, stamps_ns: Mapping[str, NDArray[np.int64]]) -> float | None:
    """Return the share of test scans with a train scan of the same recording within `NEAR_S`.

    Parameters
    ----------
    scheme
        Which scans are for what.
    stamps_ns
        By sequence id, (N,) i8; sequences of a recording differ in the lidar only.

    Returns
    -------
    float or None
        None where the scheme has no test scan.
    """
    recordings: dict[str, list[str]] = {}
    for sequence_id in scheme.membership:
        recordings.setdefault(sequence_id.rsplit("--", 1)[0], []).append(sequence_id)
    near = total = 0
    for ids in recordings.values():
        train, test = (
            np.concatenate([stamps_ns[i][scheme.membership[i] == split] for i in ids])
            for split in (TRAIN, TEST)
        )
        total += len(test)
        near += int((_nearest_s(np.sort(train), test) <= NEAR_S).sum()) if len(train) else 0
    return near / total if total else None


def _nearest_s(sorted_ns: NDArray[np.int64], wanted_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    after = np.searchsorted(sorted_ns, wanted_ns)
    around = sorted_ns[np.clip(np.stack((after - 1, after)), 0, len(sorted_ns) - 1)]
    nearest: NDArray[np.float64] = np.abs((around - wanted_ns) / 1e9).min(axis=0)
    return nearest
