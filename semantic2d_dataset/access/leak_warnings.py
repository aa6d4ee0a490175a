"""The warning about schemes whose test scans lie next to their train scans."""

from __future__ import annotations

import warnings

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import LeakageWarning

_LEAKING = 0.5
"""Share of test scans next to a train scan: 0.91 where single scans are drawn, 0 for blocks."""

_warned: set[tuple[str, str]] = set()


def warn_of_leaks(data: OpenDataset, scheme: str) -> None:
    """Warn, once in a process, who is about to train on a scheme that leaks.

    Parameters
    ----------
    data
        An open data set.
    scheme
        How it is divided.

    Warns
    -----
    LeakageWarning
        If most test scans have a train scan before or after them; what a scheme is called does
        not matter.
    """
    this = (str(data.root), scheme)
    if this in _warned:
        return
    share = data.scheme(scheme).neighbour_share("test")
    if share < _LEAKING:
        return
    _warned.add(this)
    warnings.warn(
        f"{data.manifest.name}: {share:.0%} of the test scans of the scheme {scheme!r} lie next to "
        f"a train scan, so its scores say little about new scans; train a new model on 'block', "
        "and use this scheme to compare with published figures only",
        LeakageWarning,
        stacklevel=3,
    )
