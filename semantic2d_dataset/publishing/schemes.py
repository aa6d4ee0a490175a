"""Split schemes of a release: those that exist stay, and sequences that are new join them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import CorruptFileError
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.manifest import Manifest
from semantic2d_dataset.format.schema import SPLITS
from semantic2d_dataset.format.split_schemes import schemes_of
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, SplitScheme

Members = NDArray[np.uint8]
Stamps = Mapping[str, NDArray[np.int64]]

_ADDED = "; sequences that came later were added by the same rule"
_BY_RULE = {"block": "blocks of", "frame": "single scans"}
"""How `made_by` starts where a scheme was made by this package's rule, not from lists."""


def read_schemes(folder: Path) -> dict[str, SplitScheme]:
    """Read every scheme in a folder as it is, whatever sequences it is of.

    Raises
    ------
    CorruptFileError, UnsafeFileError, FormatVersionError
        If a file is no scheme.
    """
    found = {}
    for path in sorted(Path(folder).glob("*.h5")):
        with ContainerReader(path, SPLITS) as reader:
            said = reader.attributes()
            members = {name.removeprefix("membership/"): reader.read(name) for name in reader.names}
        if said.get("scheme") != path.stem:
            raise CorruptFileError(
                f"{path}: expected the scheme {path.stem}, found {said.get('scheme')}; give the "
                "file the name of its scheme"
            )
        found[path.stem] = SplitScheme(path.stem, members, str(said.get("made_by", "")))
    return found


def schemes_for(
    stamps_ns: Stamps, existing: Mapping[str, SplitScheme], before: Manifest | None
) -> list[SplitScheme]:
    """Return the schemes of a data set: those that exist, and the standard ones that are missing.

    Scans keep their split. A sequence that a scheme should know and does not joins it: in
    ``block`` as the other lidars of its recording, at the same times; in ``environment`` as the
    other sequences of its environment, else as train; in ``lidar`` as its lidar is used, in no
    split where that is new; by the rule that the scheme was made by, where it is a standard one;
    else in no split. Missing standard schemes
    are made where the sequences are others than before, or the scheme was there before.

    Parameters
    ----------
    stamps_ns
        By sequence id, (N,) i8.
    existing
        By name; may be of other sequences besides.
    before
        The data set before: where a scheme leaves one of its sequences out, that stays so.
    """
    standard = {scheme.name: scheme for scheme in schemes_of(stamps_ns)}
    known = {*before.lengths} if before else set()
    fresh = {*stamps_ns} - known
    block = standard["block"]
    if "block" in existing:
        block = _extend(existing["block"], stamps_ns, fresh, block, block)
    kept = [
        block if name == "block" else _extend(scheme, stamps_ns, fresh, standard.get(name), block)
        for name, scheme in existing.items()
    ]
    is_same = before is not None and {*stamps_ns} == known
    wanted = before.splits if before is not None and is_same else standard
    missing = {*standard} & {*wanted} - {*existing}
    return [*kept, *(each for name, each in standard.items() if name in missing)]


def _extend(
    scheme: SplitScheme,
    stamps_ns: Stamps,
    fresh: Collection[str],
    rule: SplitScheme | None,
    block: SplitScheme,
) -> SplitScheme:
    old = {
        i: ids
        for i, ids in scheme.membership.items()
        if i in stamps_ns and len(ids) == len(stamps_ns[i])
    }
    lost = {i for i in scheme.membership if i in stamps_ns and i not in old}
    new = sorted(({*fresh} - old.keys()) | lost)
    if not new:
        return replace(scheme, membership=old)
    joined = {i: _members(scheme, old, i, stamps_ns, rule, block) for i in new}
    made_by = scheme.made_by.removesuffix(_ADDED) + _ADDED
    return SplitScheme(scheme.name, old | joined, made_by)


def _members(
    scheme: SplitScheme,
    old: Mapping[str, Members],
    sequence_id: str,
    stamps_ns: Stamps,
    rule: SplitScheme | None,
    block: SplitScheme,
) -> Members:
    scans = len(stamps_ns[sequence_id])
    environment, recording, lidar = _parts(sequence_id)
    if scheme.name == "environment":
        alike = [ids for i, ids in old.items() if _parts(i)[0] == environment]
        return np.full(scans, _common(alike), np.uint8)
    if scheme.name == "lidar":
        alike = [ids for i, ids in old.items() if _parts(i)[2] == lidar]
        trains = any((ids == TRAIN).any() for ids in alike)
        return (
            _trained(block.membership[sequence_id])
            if trains
            else np.full(scans, _common(alike, NONE), np.uint8)
        )
    if scheme.name == "block":
        together = [i for i in sorted(old) if _parts(i)[:2] == (environment, recording)]
        if together and len(stamps_ns[together[0]]):
            return _at_the_same_times(
                stamps_ns[sequence_id], stamps_ns[together[0]], old[together[0]]
            )
    if rule is not None and scheme.made_by.startswith(_BY_RULE.get(scheme.name, "\0")):
        return rule.membership[sequence_id]
    return np.full(scans, NONE, np.uint8)


def _parts(sequence_id: str) -> tuple[str, str, str]:
    environment, recording, lidar = sequence_id.split("--")
    return environment, recording, lidar


def _common(alike: list[Members], otherwise: int = TRAIN) -> int:
    """Return the split that all of these belong to, if any; `otherwise` where there are none."""
    found = {int(split) for ids in alike for split in np.unique(ids)}
    return found.pop() if len(found) == 1 else (NONE if found else otherwise)


def _trained(block: Members) -> Members:
    """Return what the scheme ``lidar`` makes of a block scheme's members for a train lidar."""
    return np.where(block == TEST, np.uint8(NONE), block)


def _at_the_same_times(
    stamps_ns: NDArray[np.int64], others_ns: NDArray[np.int64], others: Members
) -> Members:
    """Return the split of the scan that is nearest in time."""
    after = np.clip(np.searchsorted(others_ns, stamps_ns), 1, max(1, len(others_ns) - 1))
    before = after - 1
    after = np.minimum(after, len(others_ns) - 1)
    is_later = others_ns[after] - stamps_ns < stamps_ns - others_ns[before]
    return others[np.where(is_later, after, before)]
