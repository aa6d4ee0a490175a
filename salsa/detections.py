"""What a detector saw in the images of a camera: boxes with class and score, by stamp."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from salsa.detection_files import Entry, read_json, read_stream
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.documents import read_yaml
from semantic2d_dataset.scene.scans import check_array
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy

MIN_SCORE = 0.5
"""Detections below it are left out: the usual trade between missed and invented things."""

STREAM = "stream:"
"""What the name of a stream is given after, in place of a file."""


@dataclass(frozen=True)
class Detections:
    """Boxes in F images of one camera, M in all.

    Parameters
    ----------
    stamps_ns
        (F,) i8 stamps of the images, increasing; images without a box are among them.
    offsets
        (F + 1,) i8: image i has boxes offsets[i] to offsets[i + 1].
    boxes
        (M, 4) f8 left, top, right, bottom, pixels.
    class_ids
        (M,) u1 ids of the taxonomy.
    scores
        (M,) f8, 0 to 1.

    Raises
    ------
    InvalidInputError
        If an array is not of that form, or a box has no area.
    """

    stamps_ns: NDArray[np.int64]
    offsets: NDArray[np.int64]
    boxes: NDArray[np.float64]
    class_ids: NDArray[np.uint8]
    scores: NDArray[np.float64]

    def __post_init__(self) -> None:
        check_array("stamps_ns", self.stamps_ns, np.int64, (None,))
        check_array("offsets", self.offsets, np.int64, (len(self.stamps_ns) + 1,))
        check_array("boxes", self.boxes, np.float64, (None, 4))
        check_array("class_ids", self.class_ids, np.uint8, (len(self.boxes),))
        check_array("scores", self.scores, np.float64, (len(self.boxes),))
        if (self.stamps_ns[1:] <= self.stamps_ns[:-1]).any():
            raise InvalidInputError("stamps_ns of images must increase")
        ends = self.offsets[0], self.offsets[-1]
        if ends != (0, len(self.boxes)) or (np.diff(self.offsets) < 0).any():
            raise InvalidInputError(f"offsets do not divide the {len(self.boxes)} boxes")
        if not (np.isfinite(self.boxes).all() and (self.boxes[:, :2] < self.boxes[:, 2:]).all()):
            raise InvalidInputError("boxes: expected left < right and top < bottom, all finite")
        if not ((self.scores >= 0) & (self.scores <= 1)).all():
            raise InvalidInputError("scores: expected 0 to 1")

    def __len__(self) -> int:
        return len(self.boxes)


def read_detections(
    source: Path | str,
    reader: SequenceReader,
    taxonomy: Taxonomy = SEMANTIC2D,
    *,
    names: Mapping[str, str | None] | None = None,
    min_score: float = MIN_SCORE,
) -> Detections:
    """Read the detections that belong to a sequence.

    Parameters
    ----------
    source
        A JSON file (docs/camera.md), or ``stream:`` and the name of a stream of the sequence.
    reader
        The sequence.
    taxonomy
        Classes that points can take.
    names
        What classes of the detector (names, or numbers as text) are in the taxonomy; None means
        to leave such detections out. Names that it lacks are looked up as they are.
    min_score
        Detections with a lower score are left out.

    Raises
    ------
    FileNotFoundError
        If the file is missing.
    InvalidInputError
        If the source is not of that form, or classes are not known; all of them are listed.
    """
    if not 0 <= min_score <= 1:
        raise InvalidInputError(f"min_score: expected 0 to 1, found {min_score}")
    if str(source).startswith(STREAM):
        where = f"{reader.path}: {source}"
        stamps, entries = read_stream(reader, str(source).removeprefix(STREAM), where)
    else:
        where = str(source)
        stamps, entries = read_json(Path(source))
    if not stamps:
        raise InvalidInputError(f"{where}: holds no image, so nothing can be told from it")
    sure = [entry for entry in entries if entry.score >= min_score]
    ids = _ids_of(where, {entry.name for entry in sure}, taxonomy, names or {})
    kept = [entry for entry in sure if ids[entry.name] is not None]
    return _gathered(stamps, kept, [ids[entry.name] for entry in kept])


def read_names(path: Path) -> dict[str, str | None]:
    """Read what classes of a detector are in the taxonomy, from a YAML or JSON mapping.

    Raises
    ------
    FileNotFoundError
        If the file is missing.
    InvalidInputError
        If it is no mapping of names or numbers to names or null.
    """
    found = read_yaml(path, kind="a YAML or JSON file")
    if not isinstance(found, dict):
        raise InvalidInputError(f"{path}: expected a mapping, such as `dog: Other`")
    for key, value in found.items():
        if type(key) not in (str, int) or not (value is None or isinstance(value, str)):
            raise InvalidInputError(
                f"{path}: {key!r}: expected a class of the detector, and the class of points or "
                f"null for none, found {value!r}"
            )
    return {str(key): value for key, value in found.items()}


def _ids_of(
    where: str,
    found: Collection[str],
    taxonomy: Taxonomy,
    names: Mapping[str, str | None],
) -> dict[str, int | None]:
    """Return the class of each name; None for what is left out."""
    ids: dict[str, int | None] = {}
    strange = []
    for name in sorted(found):
        known = names.get(name, name)
        try:
            ids[name] = None if known is None else taxonomy.id_of(known)
        except InvalidInputError as err:
            if name in names:
                raise InvalidInputError(f"the class named for {name!r}: {err}") from err
            strange.append(repr(name))
    if strange:
        raise InvalidInputError(
            f"{where}: detected classes {', '.join(strange)} are not known; known are "
            f"{', '.join(taxonomy.names)}; name a class for each of them, or null to leave it out"
        )
    return ids


def _gathered(stamps: Iterable[int], entries: list[Entry], ids: list[int | None]) -> Detections:
    """Sort by stamp; messages or images of one stamp become one."""
    images = np.unique(np.array(list(stamps), np.int64))
    taken = np.array([entry.stamp_ns for entry in entries], np.int64)
    order = np.argsort(taken, kind="stable")
    offsets = np.append(np.searchsorted(taken[order], images), len(entries))
    boxes = np.array([entry.box for entry in entries], np.float64).reshape(-1, 4)
    scores = np.array([entry.score for entry in entries], np.float64)
    class_ids = np.array(ids, np.uint8)
    return Detections(
        images, offsets.astype(np.int64), boxes[order], class_ids[order], scores[order]
    )
