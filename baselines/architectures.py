"""The networks that have a name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from baselines.networks import SegmentationNetwork
from baselines.s3net import S3Net
from baselines.unet import UNet
from semantic2d_dataset.access.transforms import sees_all_around
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import LidarSpec

_Builder = Callable[[int, int, LidarSpec], SegmentationNetwork]

ARCHITECTURES: Mapping[str, _Builder] = {
    S3Net.name: lambda channels, classes, _: S3Net(channels, classes),
    UNet.name: lambda channels, classes, lidar: UNet(
        channels, classes, circular=sees_all_around(lidar)
    ),
}
"""Builders by name, from the number of channels, of classes, and the lidar of the scans."""


def check_model(name: str) -> None:
    """Raise InvalidInputError if there is no network of that name."""
    if name not in ARCHITECTURES:
        raise InvalidInputError(f"unknown model {name!r}; known are {', '.join(ARCHITECTURES)}")


def build_network(name: str, channels: int, classes: int, lidar: LidarSpec) -> SegmentationNetwork:
    """Build a network by its name, with weights drawn from torch's random state.

    Raises
    ------
    InvalidInputError
        If there is none of that name, or the lidar has too few beams for it.
    """
    check_model(name)
    network = ARCHITECTURES[name](channels, classes, lidar)
    if lidar.beams < network.least_beams:
        raise InvalidInputError(
            f"{name} needs at least {network.least_beams} beams, and {lidar.name} has {lidar.beams}"
        )
    return network
