"""Where to find what a camera saw beside a recording, and reading it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from salsa.cameras import Camera, camera_files, read_camera
from salsa.detections import STREAM, Detections, read_detections, read_names
from salsa.projection import DEFAULT_MATCHING, Matching, check_detections
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.taxonomy import Taxonomy


@dataclass(frozen=True)
class Sightings:
    """What a camera saw: its calibration, and the detections in its images.

    Parameters
    ----------
    camera
        A file as `salsa.cameras.read_camera` takes it.
    detections
        A file of detections, or ``stream:NAME`` for a stream of the sequence.
    names
        A file that says what classes of the detector are called here.
    matching
        How boxes and points come together.
    """

    camera: Path
    detections: str
    names: Path | None = None
    matching: Matching = DEFAULT_MATCHING

    def resolved(self) -> Sightings:
        """Return it with whole paths, for processes that work in other folders."""
        source = self.detections
        return replace(
            self,
            camera=self.camera.resolve(),
            detections=source if source.startswith(STREAM) else str(Path(source).resolve()),
            names=None if self.names is None else self.names.resolve(),
        )


def sightings_of(
    camera: Path, detections: str, names: Path | None = None, *, clock_offset_s: float = 0.0
) -> Sightings:
    """Return sightings whose images were stamped by a clock of that offset, s."""
    return Sightings(camera, detections, names, Matching(clock_offset_s=clock_offset_s))


class Seen(NamedTuple):
    """A camera, what was detected in its images, and how many scans have an image."""

    camera: Camera
    detections: Detections
    matching: Matching
    scans: int


def sighting_files(sightings: Sightings | None) -> dict[str, Path]:
    """Return every file that is read, by its role."""
    if sightings is None:
        return {}
    files = camera_files(sightings.camera)
    if not sightings.detections.startswith(STREAM):
        files["detections"] = Path(sightings.detections)
    if sightings.names is not None:
        files["detection_names"] = sightings.names
    return files


def read_sightings(
    sightings: Sightings | None, reader: SequenceReader, taxonomy: Taxonomy
) -> Seen | None:
    """Read what a camera saw, and check that it belongs to the recording.

    Raises
    ------
    FileNotFoundError, InvalidInputError
        If a file is missing or cannot be understood, a class is unknown, or no image was taken
        within reach of a scan.
    """
    if sightings is None:
        return None
    camera = read_camera(sightings.camera)
    names = None if sightings.names is None else read_names(sightings.names)
    at = sightings.detections
    source = at if at.startswith(STREAM) else Path(at)
    detections = read_detections(source, reader, taxonomy, names=names)
    matching, stamps_ns = sightings.matching, reader.read("scans/stamps_ns")
    scans = check_detections(stamps_ns, camera, detections, matching=matching, taxonomy=taxonomy)
    return Seen(camera, detections, matching, scans)
