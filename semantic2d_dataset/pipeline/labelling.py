"""One sequence to its labelled copy: made by the package salsa, or kept where it is as new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.executors import Executor
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.pipeline.config import RecordingConfig
from semantic2d_dataset.pipeline.siblings import load_sibling
from semantic2d_dataset.scene.taxonomy import UNLABELLED

_ROWS = 4096


@dataclass(frozen=True)
class Labelled:
    """A labelled sequence.

    Parameters
    ----------
    file
        Where it is.
    sequence_id
        Its id.
    scans, accepted
        How many scans it has, and how many of these fit the map.
    labelled_share
        Share of the beams that have a label.
    kept
        Whether it was there already.
    """

    file: Path
    sequence_id: str
    scans: int
    accepted: int
    labelled_share: float
    kept: bool


def find_labelled(
    recording: RecordingConfig, source: Path, places: Sequence[Path]
) -> Labelled | None:
    """Return the labelled copy of a sequence that is as labelling would make it now, if any.

    Parameters
    ----------
    recording
        Says map, annotation and settings.
    source
        The sequence.
    places
        Files that may be it.
    """
    present = [place for place in places if place.is_file()]
    if not present:
        return None
    salsa = load_sibling("salsa", "sequences")
    facts = salsa.salsa_facts(
        source,
        recording.map_yaml,
        recording.annotation,
        recording.salsa,
        recording.sightings,
        recording.taxonomy,
    )
    for place in present:
        with suppress(Semantic2DError, OSError):  # one that is damaged is made anew
            if _provenance(place).get("salsa") == facts:
                return _describe(place, kept=True)
    return None


def label(
    recording: RecordingConfig, source: Path, places: Sequence[Path], executor: Executor
) -> Labelled:
    """Return the labelled copy of a sequence, made where it is not there already.

    Parameters
    ----------
    recording
        Says map, annotation and settings.
    source
        The sequence.
    places
        Files that may be it already; a new one becomes the last.
    executor
        Where blocks of scans are worked on.

    Raises
    ------
    Semantic2DError, OSError
        What `salsa.sequences.label_sequence` raises.
    """
    found = find_labelled(recording, source, places)
    if found is not None:
        return found
    load_sibling("salsa", "sequences").label_sequence(
        source,
        recording.map_yaml,
        recording.annotation,
        places[-1],
        settings=recording.salsa,
        sightings=recording.sightings,
        taxonomy=recording.taxonomy,
        force=True,
        executor=executor,
    )
    return _describe(places[-1], kept=False)


def _provenance(file: Path) -> Mapping[str, Any]:
    with SequenceReader(file) as reader:
        return reader.header.provenance


def _describe(file: Path, *, kept: bool) -> Labelled:
    with SequenceReader(file) as reader:
        scans, accepted = len(reader), reader.read("alignment/accepted")
        labelled = sum(
            int(np.count_nonzero(reader.read("scans/labels", start, start + _ROWS) != UNLABELLED))
            for start in range(0, scans, _ROWS)
        )
        return Labelled(
            file=file,
            sequence_id=reader.header.sequence_id,
            scans=scans,
            accepted=int(np.count_nonzero(accepted)),
            labelled_share=labelled / max(1, scans * reader.lidar.beams),
            kept=kept,
        )
