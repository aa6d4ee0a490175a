"""From labelled sequences to a data set, which is the old one until the new one is whole."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.format.manifest import (
    Manifest,
    find_problems,
    read_manifest,
)
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.split_schemes import (
    make_block_scheme,
    make_environment_scheme,
    make_frame_scheme,
    make_lidar_scheme,
    schemes_of,
)
from semantic2d_dataset.format.splits import SplitScheme, read_scheme
from semantic2d_dataset.pipeline.config import Config
from semantic2d_dataset.pipeline.drops import without
from semantic2d_dataset.publishing.staging import stage, swap

WORK = "work"
_STAGED, _REMOVED = "staged", "removed"


def publish_sequences(
    config: Config, files: Sequence[Path], dropped: Mapping[str, NDArray[np.int64]]
) -> bool:
    """Make a data set of sequences that lie in its folder, or below ``work`` in it.

    Splits and manifest are made aside; then, in an instant, all is moved into its place, the
    manifest last. What the folder had and the data set has not is moved to ``work/removed``.

    Parameters
    ----------
    config
        What the data set is called and where it goes.
    files
        Its sequences.
    dropped
        Indices (n,) i8 of the scans that belong to no split, by sequence id.

    Returns
    -------
    bool
        Whether anything was changed.

    Raises
    ------
    Semantic2DError
        If a sequence or the choice of splits is not right: nothing is changed then.
    """
    stamps = {}
    for file in files:
        with SequenceReader(file) as reader:
            stamps[reader.header.sequence_id] = reader.read("scans/stamps_ns")
    schemes = [without(scheme, dropped) for scheme in _schemes(config, stamps)]
    if _is_published(config, files, schemes):
        return False
    staged, removed = config.out / WORK / _STAGED, config.out / WORK / _REMOVED
    said = {"name": config.name, "version": config.version, "license": config.license}
    stage(staged, files, schemes, **said)
    swap(config.out, staged, {file.name: file for file in files}, removed=removed)
    return True


def _schemes(config: Config, stamps_ns: Mapping[str, NDArray[np.int64]]) -> Sequence[SplitScheme]:
    if config.splits is None:
        return schemes_of(stamps_ns)
    lengths = {name: len(each) for name, each in stamps_ns.items()}
    schemes = []
    for name, said in config.splits.items():
        if name == "block":
            schemes.append(make_block_scheme(stamps_ns, **said))
        elif name == "frame":
            schemes.append(make_frame_scheme(lengths, **{"seed": 0, **said}))
        elif name == "lidar":
            schemes.append(make_lidar_scheme(stamps_ns, **said))
        else:
            schemes.append(make_environment_scheme(lengths, **said))
    return schemes


def _is_published(config: Config, files: Sequence[Path], schemes: Sequence[SplitScheme]) -> bool:
    try:
        manifest = read_manifest(config.out)
        wanted = (config.name, config.version, config.license)
        return (
            (manifest.name, manifest.version, manifest.license) == wanted
            and {config.out / entry.file for entry in manifest.sequences} == {*files}
            and not find_problems(config.out)
            and _told(config.out, manifest) == {each.name: _digest(each) for each in schemes}
        )
    except (Semantic2DError, OSError):
        return False


def _told(folder: Path, manifest: Manifest) -> dict[str, tuple[str, str]]:
    return {
        name: _digest(read_scheme(folder / entry.file, name, manifest.lengths))
        for name, entry in manifest.splits.items()
    }


def _digest(scheme: SplitScheme) -> tuple[str, str]:
    return scheme.made_by, scheme.digest
