"""What a trained model says of itself, whether torch runs it or ONNX Runtime."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from semantic2d_dataset.access.features import Statistics, channel_count, normalise_features
from semantic2d_dataset.errors import CorruptFileError, FormatVersionError, InvalidInputError
from semantic2d_dataset.format.schema import FORMAT_MAJOR
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.taxonomy import Taxonomy


@dataclass(frozen=True)
class Description:
    """What is needed to use a network on scans.

    Parameters
    ----------
    features
        Letters of its input channels, in the order R, I, P, A.
    statistics
        What standardises them.
    lidar
        The sensor of the scans that it was trained on.
    taxonomy
        Its classes.
    dataset
        Where the scans came from: name, version, scheme; empty where not known.
    training
        The settings of the training, and what it reached.

    Raises
    ------
    InvalidInputError
        If the statistics are of another number of channels.
    """

    features: str
    statistics: Statistics
    lidar: LidarSpec
    taxonomy: Taxonomy
    dataset: Mapping[str, str] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.statistics.mean) != channel_count(self.features):
            raise InvalidInputError(
                f"features {self.features} are {channel_count(self.features)} channels, and the "
                f"statistics {len(self.statistics.mean)}"
            )

    def as_json(self) -> dict[str, Any]:
        """Return it as values that JSON can hold."""
        return {
            "features": self.features,
            "statistics": asdict(self.statistics),
            "lidar": asdict(self.lidar),
            "taxonomy": asdict(self.taxonomy),
            "dataset": dict(self.dataset),
            "training": dict(self.training),
        }

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> Self:
        """Understand what `as_json` returned.

        Raises
        ------
        KeyError, TypeError, ValueError, AttributeError
            If it is something else.
        """
        lidar, taxonomy = said["lidar"], said["taxonomy"]
        colours = tuple(tuple(colour) for colour in taxonomy["colours"])
        return cls(
            normalise_features(said["features"]),
            Statistics(**{key: tuple(values) for key, values in said["statistics"].items()}),
            LidarSpec(**lidar | {"base_T_lidar": tuple(lidar["base_T_lidar"])}),
            Taxonomy(tuple(taxonomy["names"]), colours, taxonomy["background_id"]),
            dict(said["dataset"]),
            dict(said["training"]),
        )


def check_format(path: Path, said: object, kind: str) -> dict[str, Any]:
    """Return what a file says of itself, if this package can read files of that kind.

    Raises
    ------
    CorruptFileError
        If it is no such file.
    FormatVersionError
        If it was written in a newer major format.
    """
    if not isinstance(said, dict) or said.get("format") != kind:
        raise CorruptFileError(f"{path}: expected a JSON object with format {kind!r}")
    version = str(said.get("format_version", ""))
    major = version.split(".", maxsplit=1)[0]
    if not major.isdigit():
        raise CorruptFileError(f"{path}: expected a format version, found {version!r}")
    if int(major) > FORMAT_MAJOR:
        raise FormatVersionError(
            f"{path}: written in format {version}, and this package reads up to "
            f"{FORMAT_MAJOR}.x; install semantic2d-dataset {major}.0 or later"
        )
    return said
