"""From exact hits to what a lidar reports: noise, dropouts, mixed pixels, intensity, steps.

The signal that comes back is ``shade * (rho * cos + gloss * cos^16) * 1 / (1 + r / r0)``: a
matt part that fades with incidence and range, as painted drywall does, and for metal and
lacquer a bright part close to the normal only (paper, section on the angle of incidence). All
of it is sums, products and quotients, which every machine rounds alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, RPLIDAR_S2, WLR_716, LidarSpec
from semantic2d_dataset.simulation.raycast import Hits

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Material:
    """How a surface sends light back: matt share, bright share near the normal, texture.

    `texture` is the standard deviation of the reflectance from spot to spot, relative.
    """

    name: str
    reflectance: float
    gloss: float
    texture: float


# Relative to a white surface at 1. Chosen by hand, not measured: they follow the paper in that
# drywall fades gradually and metal is dark except near the normal, and keep classes apart.
MATERIALS = (
    Material("drywall", 0.82, 0.00, 0.03),
    Material("concrete", 0.58, 0.00, 0.05),
    Material("wood", 0.40, 0.12, 0.05),
    Material("metal", 0.10, 1.10, 0.08),
    Material("fabric", 0.27, 0.00, 0.06),
    Material("laminate", 0.66, 0.20, 0.04),
    Material("plastic", 0.16, 0.10, 0.06),
    Material("sheet steel", 0.95, 0.30, 0.05),
    Material("cloth", 0.36, 0.00, 0.12),
    Material("cardboard", 0.50, 0.00, 0.05),
    Material("foliage", 0.45, 0.00, 0.25),
)
(
    DRYWALL,
    CONCRETE,
    WOOD,
    METAL,
    FABRIC,
    LAMINATE,
    PLASTIC,
    SHEET_STEEL,
    CLOTH,
    CARDBOARD,
    FOLIAGE,
) = range(len(MATERIALS))
_TABLE = np.array([(m.reflectance, m.gloss, m.texture) for m in MATERIALS])


@dataclass(frozen=True)
class SensorModel:
    """Errors and scales of one lidar.

    Parameters
    ----------
    range_std_m
        Standard deviation of a range at full signal; it grows as the signal fades.
    range_step_m, intensity_step
        Steps in which the sensor reports.
    intensity_scale
        Reported intensity of a white surface at zero range.
    half_range_m
        Range r0 at which the signal has halved.
    weakest_signal
        Signals below it are no return.
    dropout
        Share of beams that give no return for no visible reason.
    mixed_share
        Share of the beams at a depth edge whose footprint lies on both surfaces.
    mixed_gap_m
        Largest step between two surfaces whose echoes still merge.
    """

    range_std_m: float
    range_step_m: float
    intensity_scale: float
    intensity_step: float
    half_range_m: float
    weakest_signal: float
    dropout: float
    mixed_share: float
    mixed_gap_m: float


# The intensity scales lie orders of magnitude apart (paper, figure on intensity values); the
# Hokuyo's is fitted to its training mean of 3082. Range noise, steps, dropouts and mixed pixels
# are plausible choices, not taken from data sheets.
SENSORS = {
    HOKUYO_UTM_30LX_EW.name: SensorModel(
        range_std_m=0.008, range_step_m=0.001, intensity_scale=7600.0, intensity_step=1.0,
        half_range_m=14.0, weakest_signal=0.012, dropout=0.002, mixed_share=0.10, mixed_gap_m=1.5,
    ),
    WLR_716.name: SensorModel(
        range_std_m=0.012, range_step_m=0.001, intensity_scale=900.0, intensity_step=1.0,
        half_range_m=9.0, weakest_signal=0.015, dropout=0.004, mixed_share=0.15, mixed_gap_m=1.0,
    ),
    RPLIDAR_S2.name: SensorModel(
        range_std_m=0.015, range_step_m=0.00025, intensity_scale=75.0, intensity_step=1.0,
        half_range_m=11.0, weakest_signal=0.018, dropout=0.006, mixed_share=0.15, mixed_gap_m=1.0,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Surfaces:
    """Class, material and brightness of every primitive, in the order of `Hits.primitives`.

    `labels` and `materials` are (P,) u1; `shades` (P,) f8 multiplies the reflectance: no two
    sofas are of one cloth.
    """

    labels: NDArray[np.uint8]
    materials: NDArray[np.uint8]
    shades: Float


@dataclass(frozen=True)
class Measurement:
    """Ranges and intensities (N, B) f4 as a sensor reports them, and true labels (N, B) u1."""

    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32]
    labels: NDArray[np.uint8]


@dataclass(frozen=True)
class Noise:
    """The chance in one recording.

    Every scan takes the same number of values from each generator, one scan after another, so
    that a recording does not depend on how many scans are measured at a time. There are two
    generators because they take turns within a call to `measure`.

    Parameters
    ----------
    normal, uniform
        Where normal and uniform values come from.
    """

    normal: np.random.Generator
    uniform: np.random.Generator

    @classmethod
    def from_seed(cls, *seed: int) -> Self:
        """Start anew; whole numbers from 0 on."""
        normal, uniform = np.random.SeedSequence(seed).spawn(2)
        return cls(
            np.random.Generator(np.random.PCG64(normal)),
            np.random.Generator(np.random.PCG64(uniform)),
        )

    def draw(self, scans: int, beams: int) -> tuple[Float, Float]:
        """Return the normal (scans, 2, beams) and uniform (scans, 3, beams) values to come."""
        return (
            self.normal.standard_normal((scans, 2, beams)),
            self.uniform.random((scans, 3, beams)),
        )


def measure(
    hits: Hits, surfaces: Surfaces, lidar: LidarSpec, model: SensorModel, noise: Noise
) -> Measurement:
    """Turn exact hits of the next scans into a measurement.

    A mixed pixel lies between two surfaces and keeps the label of the nearer one, which did
    send back a part of its light. A beam without a return is Other (0), has range +inf (-inf
    where the surface is closer than `range_min`) and intensity 0.
    """
    normal, uniform = noise.draw(*hits.distances.shape)
    signal = _signal(hits, surfaces, model, normal[:, 0])
    distances, signal = _mix_edges(hits.distances, signal, model, uniform[:, 0], uniform[:, 1])
    errors = model.range_std_m * normal[:, 1]
    measured = _quantise(distances + errors * (1 + 0.02 / np.maximum(signal, 0.02)), model)
    lost = (signal < model.weakest_signal) | (uniform[:, 2] < model.dropout)
    ranges = _censor(measured, lost | ~np.isfinite(distances), lidar).astype(np.float32)
    seen = lidar.has_return(ranges)
    steps = np.rint(signal * (model.intensity_scale / model.intensity_step))
    intensities = np.where(seen, np.maximum(steps, 1.0) * model.intensity_step, 0.0)
    labels = np.where(seen, surfaces.labels[hits.primitives], 0)
    return Measurement(ranges, intensities.astype(np.float32), labels.astype(np.uint8))


def _signal(hits: Hits, surfaces: Surfaces, model: SensorModel, spots: Float) -> Float:
    """Share of a white surface's signal that comes back, (N, B); 0 where nothing is met."""
    matt, gloss, texture = _TABLE[surfaces.materials[hits.primitives]].transpose(2, 0, 1)
    cos = hits.cosines
    bright = cos * cos
    for _ in range(3):
        bright = bright * bright  # cos^16
    spot = np.maximum(0.2, 1 + texture * spots)
    distances = np.where(np.isfinite(hits.distances), hits.distances, 0.0)
    fade = 1 / (1 + distances / model.half_range_m)
    found: Float = surfaces.shades[hits.primitives] * spot * (matt * cos + gloss * bright) * fade
    return found


def _mix_edges(
    distances: Float, signal: Float, model: SensorModel, choice: Float, share: Float
) -> tuple[Float, Float]:
    """Let some beams at depth edges report a place between the nearer and the farther surface."""
    finite = np.where(np.isfinite(distances), distances, 1e3)
    gaps = np.zeros_like(finite)
    step = np.diff(finite, axis=-1)
    gaps[:, :-1] = step
    gaps[:, 1:] = np.maximum(gaps[:, 1:], -step)
    at_edge = (gaps > 0.1) & (gaps < model.mixed_gap_m)
    chosen = at_edge & (choice < model.mixed_share)
    weight = np.where(chosen, 0.7 * share, 0.0)
    return distances + weight * np.where(chosen, gaps, 0.0), signal * (1 - 0.5 * weight)


def _quantise(ranges: Float, model: SensorModel) -> Float:
    with np.errstate(invalid="ignore"):
        steps: Float = np.rint(ranges / model.range_step_m)
    return steps * model.range_step_m


def _censor(ranges: Float, lost: NDArray[np.bool_], lidar: LidarSpec) -> Float:
    """REP 117: +inf for no return, -inf for a surface that is too close."""
    too_far = lost | (ranges >= lidar.range_max)
    return np.where(too_far, np.inf, np.where(ranges < lidar.range_min, -np.inf, ranges))
