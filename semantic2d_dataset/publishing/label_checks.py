"""Which labels of a sequence are not to be trusted.

Limits were measured on semantic2d-mini, whose labels are true, on 13 of its sequences labelled by
SALSA, on a recording of a cart with an RPLIDAR labelled by SALSA, and on truth that was spoilt on
purpose (six sequences of the Hokuyo). Shares in percent, least to most:

==========================  ==========  ==========  ==========  ==========
labels                      flicker     islands     against     nowhere
==========================  ==========  ==========  ==========  ==========
true                        0.3 to 0.9  0.0         0.1 to 0.6  0.0
by SALSA                    0.3 to 0.8  0.0         0.0         0.0
by SALSA, of a real cart    0.7         0.0         0.0         0.0
1 % of beams at random      2.1 to 2.4  0.9         1.0 to 1.4  0.0 to 0.2
5 % of beams at random      9.0 to 9.4  4.5         4.6 to 5.0  0.2 to 0.9
of the next beam            2.8 to 6.0  0.0         3.2 to 7.4  0.3 to 1.4
of the next scan            8.3 to 16   0.2 to 0.4  12 to 26    1.2 to 7.3
of another scan             72 to 80    0.2 to 0.5  70 to 78    4.5 to 17
poses that are 0.24 m off   0.3 to 0.6  0.0         2.0 to 11   0.0
poses that are 0.5 m off    0.3 to 0.6  0.0         6.0 to 16   0.3 to 0.7
==========================  ==========  ==========  ==========  ==========

A warning starts where no true label was, with room for real sensors; an error where only labels
of other scans were.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.publishing.findings import ERROR, NOTE, WARNING, Finding
from semantic2d_dataset.publishing.label_measures import (
    FAR_FROM_OBJECTS_M,
    ON_OBJECT_M,
    SAME_RANGE_M,
    LabelMeasures,
    measure_labels,
)

_LABELS = "scans/labels"


@dataclass(frozen=True)
class _Limit:
    """A share that labels should stay below.

    Parameters
    ----------
    part, whole
        Names of the measures.
    warning, error
        Shares from which it is one.
    what, advice
        What such beams are, and what to do about them.
    """

    part: str
    whole: str
    warning: float
    error: float
    what: str
    advice: str


_LIMITS = (
    _Limit(
        "flickering",
        "steady",
        0.02,
        0.5,
        f"of the beams whose range stays within {SAME_RANGE_M} m from one scan to the next change "
        "their class",
        "look whether labels belong to their scans, and at noise: semantic2d salsa review",
    ),
    _Limit(
        "islands",
        "inner",
        0.005,
        0.2,
        "of the beams on a surface differ from both neighbours, which agree",
        "smooth the labels; no thing is one beam wide",
    ),
    _Limit(
        "against_map",
        "on_object",
        0.02,
        0.5,
        f"of the beams within {ON_OBJECT_M} m of a mapped object have another class than it",
        "look at poses, mount, and the order of scans, beams and class ids",
    ),
    _Limit(
        "nowhere",
        "of_object",
        0.01,
        0.2,
        f"of the beams labelled as mapped objects end more than {FAR_FROM_OBJECTS_M} m from any",
        "look at poses and mount, or annotate what the map lacks",
    ),
)
_FEW_LABELLED = 0.5
_FEW_ACCEPTED = 0.5
_MANY_PLAIN = 0.2
_PHANTOMS = 0.05


def check_labels(reader: SequenceReader) -> list[Finding]:
    """Check the labels of a sequence.

    Raises
    ------
    CorruptFileError
        If a checksum does not fit.
    """
    where = f"{reader.path}: {_LABELS}"
    if _LABELS not in reader:
        return [
            Finding(
                ERROR,
                where,
                "there are none",
                "a class for every beam",
                "label it with: semantic2d salsa label",
            )
        ]
    measures = measure_labels(reader)
    findings = [*_amount(where, measures), *_phantoms(where, measures)]
    if measures.labelled:
        findings += [*_shares(where, measures), *_classes(where, measures, reader)]
    return [*findings, *_acceptance(reader)]


def _amount(where: str, measures: LabelMeasures) -> Iterator[Finding]:
    share = _share(measures.labelled, measures.returns)
    if not measures.labelled:
        yield Finding(
            ERROR,
            where,
            "every beam is unlabelled",
            "labels",
            "look why no scan was accepted: semantic2d salsa review",
        )
    elif share < _FEW_LABELLED:
        yield Finding(
            WARNING,
            where,
            f"{share:.1%} of the beams with a return are labelled",
            f"{_FEW_LABELLED:.0%} or more",
            "look why scans were not accepted, or drop the part that has no labels",
        )
    plain = _share(measures.plain_scans, measures.labelled_scans)
    if plain > _MANY_PLAIN:
        yield Finding(
            ERROR if plain > 0.99 else WARNING,
            where,
            f"{plain:.1%} of the labelled scans have one class only",
            f"{_MANY_PLAIN:.0%} at most",
            "look whether the labels are those of the scans",
        )


def _phantoms(where: str, measures: LabelMeasures) -> Iterator[Finding]:
    share = _share(measures.phantom, measures.beams - measures.returns)
    if measures.phantom:
        yield Finding(
            ERROR if share > _PHANTOMS else WARNING,
            where,
            f"{measures.phantom:,} beams ({share:.1%} of those without a return) have a class",
            "background or 255 where nothing was measured",
            "label again with beams and labels in the same order, or set these to 255",
        )


def _shares(where: str, measures: LabelMeasures) -> Iterator[Finding]:
    for limit in _LIMITS:
        part, whole = getattr(measures, limit.part), getattr(measures, limit.whole)
        share = _share(part, whole)
        if share > limit.warning:
            yield Finding(
                ERROR if share > limit.error else WARNING,
                where,
                f"{share:.1%} {limit.what}",
                f"{limit.warning:.1%} at most",
                limit.advice,
            )


def _classes(where: str, measures: LabelMeasures, reader: SequenceReader) -> Iterator[Finding]:
    names = reader.header.taxonomy.names
    if measures.counts is None:
        return
    absent = [name for name, n in zip(names, measures.counts, strict=False) if not n]
    if np.count_nonzero(measures.counts) == 1:
        yield Finding(
            ERROR,
            where,
            f"all labels are {names[int(measures.counts.argmax())]}",
            "several classes",
            "label it from an annotated map",
        )
    elif absent:
        yield Finding(
            NOTE,
            where,
            f"no beam is {', '.join(absent)}",
            "any classes",
            "nothing, where the place has none of these",
        )
    if not measures.on_object:
        yield Finding(
            NOTE,
            where,
            "not compared with a map",
            "poses and an annotated map beside the scans",
            "keep what the labeller writes, so that labels can be checked",
        )


def _acceptance(reader: SequenceReader) -> Iterator[Finding]:
    if "alignment/accepted" not in reader:
        return
    share = float((reader.read("alignment/accepted") != 0).mean())
    if share < _FEW_ACCEPTED:
        yield Finding(
            WARNING,
            f"{reader.path}: alignment/accepted",
            f"{share:.1%} of the scans fit their map",
            f"{_FEW_ACCEPTED:.0%} or more",
            "give better poses, or annotate the map that belongs to it",
        )


def _share(part: int, whole: int) -> float:
    return part / max(1, whole)
