"""Layouts that bring split lists: their sequences as a data set with those splits."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from conversion.plan import SequencePlan
from semantic2d_dataset.errors import WriteError
from semantic2d_dataset.format.manifest import publish
from semantic2d_dataset.format.sequence import SequenceReader, slug
from semantic2d_dataset.format.split_schemes import schemes_of
from semantic2d_dataset.format.splits import BY_LISTS, NONE, SplitScheme, read_scheme
from semantic2d_dataset.format.writing import write_bytes_atomically

FRAME = "frame"
SEQUENCES = "sequences"
_VERSION = "1.0.0"


def publish_with_lists(folder: Path, plans: Sequence[SequencePlan]) -> None:
    """Turn ``folder/sequences`` into a data set whose `frame` scheme is that of the lists.

    The lists are kept byte for byte in ``splits/frame/<sequence id>/``. Sequences that were
    there before keep their members.

    Parameters
    ----------
    folder
        The data set's folder.
    plans
        The sequences that bring lists.

    Raises
    ------
    CorruptFileError, UnsafeFileError
        If a sequence cannot be read whole.
    WriteError
        If a file cannot be written.
    """
    stamps = {}
    for path in sorted((folder / SEQUENCES).glob("*.h5")):
        with SequenceReader(path) as reader:
            stamps[reader.header.sequence_id] = reader.read("scans/stamps_ns")
    lengths = {name: len(each) for name, each in stamps.items()}
    file = folder / "splits" / f"{FRAME}.h5"
    members = {name: np.full(length, NONE, np.uint8) for name, length in lengths.items()}
    if file.is_file():
        members |= dict(read_scheme(file, FRAME, lengths).membership)
    for plan in plans:
        if plan.members is not None:
            members[plan.header.sequence_id] = plan.members
        _keep_lists(folder / "splits" / FRAME / plan.header.sequence_id, plan)
    standard = [scheme for scheme in schemes_of(stamps) if scheme.name != FRAME]
    publish(
        folder,
        name=slug(folder.resolve().name),
        version=_VERSION,
        license=plans[0].header.license,
        schemes=[*standard, SplitScheme(FRAME, members, BY_LISTS)],
    )


def _keep_lists(folder: Path, plan: SequencePlan) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise WriteError(f"{folder}: cannot be made: {err}") from err
    for name, content in plan.lists.items():
        write_bytes_atomically(folder / f"{name}.txt", content)
