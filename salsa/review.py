"""One self-contained HTML page to judge a labelled sequence by, and to choose scans to drop."""

from __future__ import annotations

import base64
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from salsa.inspection import Inspection, check_labelled, coverage, inspect_sequence
from salsa.pictures import SLATE, Colours, Sheet
from semantic2d_dataset.format.drop_lists import format_ranges
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.scene.geometry import compose, invert, mount_in_plane
from semantic2d_dataset.scene.lidars import LidarSpec
from semantic2d_dataset.scene.maps import OCCUPIED, SemanticMap
from semantic2d_dataset.scene.taxonomy import UNLABELLED, Taxonomy

NO_RETURN = 0
"""Code of a beam without a return among the embedded ranges."""

_WORST = 12
_SHOWN = 300  # evenly spaced scans of the slider
_BEAM_BYTES = 3  # embedded: a range of two bytes and a label
_SCAN_BYTES = 4_500_000  # of all embedded scans, before base64 adds a third
_CODES = 65_534  # of ranges, besides NO_RETURN
_PICTURE_PIXELS = 1500
_MAP_PIXELS = 2400
_BINS = 1200
_PATH_POINTS = 20_000
_ACCEPTED, _REFUSED, _DROPPED, _LOST = range(4)
_ROUGH_RGB, _PATH_RGB, _REFUSED_RGB = "#7a7f87", "#1457c8", "#e3001b"


def write_review(path: Path, sequence: Path) -> None:
    """Write a page about a labelled sequence.

    It shows figures, coverage, the fit over time, all labelled points over the map, the worst
    scans, and a slider through the recording where scans to drop are chosen. Memory and page are
    bounded, however long the recording is: the slider holds some 300 scans of it.

    Parameters
    ----------
    path
        The HTML file to write; it refers to nothing outside itself.
    sequence
        A sequence that `salsa.sequences.label_sequence` wrote, or `salsa.dropping.drop_scans`.

    Raises
    ------
    FileNotFoundError, CorruptFileError, InvalidInputError
        If the sequence is missing, damaged or not labelled.
    WriteError
        If the page cannot be written.
    """
    with SequenceReader(sequence) as reader:
        scene = check_labelled(reader)
        taxonomy = reader.header.taxonomy
        sheet = Sheet.over(scene, pixels=3, max_pixels=_PICTURE_PIXELS)
        found = inspect_sequence(reader, scene, sheet)
        worst = found.worst(_WORST)
        page = _template().render(
            name=Path(sequence).name,
            sequence_id=reader.header.sequence_id,
            lidar=reader.lidar.model,
            figures=_figures(found),
            shares=_shares(found),
            classes=_classes(found, scene, taxonomy),
            scale=_scale(sheet),
            points=_embed(found.canvas),
            path=_embed(_draw_path(found, scene, sheet)),
            seen=_embed(_draw_coverage(found, scene, sheet, taxonomy)),
            slate=SLATE,
            worst=worst.tolist(),
            no_return=NO_RETURN,
            data={
                "id": reader.header.sequence_id,
                "name": Path(sequence).name,
                "total": len(reader),
                "dropped": format_ranges(np.flatnonzero(found.dropped)),
                "classes": _colours_by_label(taxonomy),
                "map": _map_data(scene),
                "lidar": _lidar_data(reader.lidar),
                "time": _over_time(found),
                "scans": _scan_data(reader, found, _choose(found, worst, reader.lidar)),
            },
        )
    write_text_atomically(path, page)


def _template() -> Any:
    environment = Environment(
        loader=PackageLoader("salsa", ""), autoescape=True, undefined=StrictUndefined
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment.get_template("review.html")


def _figures(found: Inspection) -> list[tuple[str, str]]:
    """Return what the head of the page says, by name."""
    known, good = found.known, found.accepted
    returns = int(found.counts.sum())
    labelled = 100 * (returns - int(found.counts[UNLABELLED])) / max(returns, 1)
    figures = [
        ("scans", f"{len(found):,}"),
        ("accepted", f"{good.sum():,}"),
        ("not accepted", f"{(known & ~good & ~found.dropped).sum():,}"),
        ("without pose", f"{(~known & ~found.dropped).sum():,}"),
        ("dropped", f"{found.dropped.sum():,}"),
        ("beams labelled", f"{labelled:.1f} %"),
        ("median residual", _median(100 * found.residual_m[good], "cm")),
        ("within 10 cm, rough", _median(100 * found.near_before[known], "%")),
        ("within 10 cm, refined", _median(100 * found.inlier_ratio[known], "%")),
    ]
    return [each for each in figures if each != ("dropped", "0")]


def _median(values: NDArray[Any], unit: str) -> str:
    finite = values[np.isfinite(values)]
    return f"{np.median(finite):.1f} {unit}" if finite.size else "none"


def _shares(found: Inspection) -> list[tuple[str, float]]:
    """Percent of the scans by what became of them, for a bar."""
    kinds = np.bincount(_kinds(found), minlength=4) * 100 / len(found)
    return list(zip(("accepted", "refused", "dropped", "lost"), kinds.tolist(), strict=True))


def _kinds(found: Inspection) -> NDArray[np.int64]:
    """Tell what became of each scan, (N,)."""
    return np.select(
        [found.dropped, ~found.known, ~found.accepted], [_DROPPED, _LOST, _REFUSED], _ACCEPTED
    )


def _classes(found: Inspection, scene: SemanticMap, taxonomy: Taxonomy) -> list[dict[str, Any]]:
    """Per class: its share of the labelled beams, its cells in the map and how many were met."""
    counts = found.counts[: len(taxonomy)]
    met = coverage(found, scene)
    total = max(int(counts.sum()), 1)
    return [
        {
            "name": name,
            "colour": "rgb({}, {}, {})".format(*colour),
            "beams": int(counts[i]),
            "share": round(100 * int(counts[i]) / total, 2),
            "cells": met[i][0] if i in met else 0,
            "met": round(100 * met[i][1], 1) if i in met else None,
        }
        for i, (name, colour) in enumerate(zip(taxonomy.names, taxonomy.colours, strict=True))
        if counts[i] or i in met
    ]


def _scale(sheet: Sheet) -> tuple[str, float]:
    """Return a round length, and the percent of the pictures' width that it takes."""
    width_m = sheet.shape[1] / sheet.pixels_per_m
    power = 10.0 ** math.floor(math.log10(width_m / 4))
    length = max(step for step in (1, 2, 5) if step * power <= width_m / 4) * power
    return f"{length:g} m", round(100 * length / width_m, 3)


def _draw_path(found: Inspection, scene: SemanticMap, sheet: Sheet) -> Colours:
    """Draw over the map where the scans were taken: roughly, refined, and not accepted."""
    canvas = sheet.background(scene)
    height, width = canvas.shape[:2]
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_axis_off()
    ax.imshow(canvas, origin="lower", extent=(0, width, 0, height), interpolation="nearest")
    step = -(-len(found) // _PATH_POINTS)
    size = max(width, height) / 500  # points
    rough = _on_sheet(found.rough[::step], scene, sheet)
    trusted = np.where(found.accepted[:, None], found.refined, np.nan)  # NaN leaves gaps
    refined = _on_sheet(trusted[::step], scene, sheet)
    refused = _on_sheet(found.refined[found.known & ~found.accepted], scene, sheet)
    ax.plot(*rough.T, color=_ROUGH_RGB, lw=0.5 * size, ls=(0, (4, 2)))
    ax.plot(*refined.T, color=_PATH_RGB, lw=0.7 * size)
    ax.plot(*refused.T, color=_REFUSED_RGB, ls="", marker="o", ms=1.8 * size)
    ax.set(xlim=(0, width), ylim=(0, height))
    figure.canvas.draw()
    drawn = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
    return np.ascontiguousarray(drawn[::-1, :, :3])


def _on_sheet(poses: NDArray[np.float64], scene: SemanticMap, sheet: Sheet) -> NDArray[np.float64]:
    """Return where poses (N, 3) stand on the canvas, (N, 2) pixels."""
    in_grid = compose(invert(scene.origin.as_array()), poses)[:, :2]
    return (in_grid - sheet.corner_m) * sheet.pixels_per_m


def _draw_coverage(
    found: Inspection, scene: SemanticMap, sheet: Sheet, taxonomy: Taxonomy
) -> Colours:
    """Draw mapped objects in the colours of their classes, those never met in slate."""
    canvas = sheet.background(scene)
    for label in np.unique(scene.labels[scene.labels < len(taxonomy)]).tolist():
        met = (scene.labels == label) & (scene.occupancy == OCCUPIED) & found.hit
        canvas[sheet.any_of(met)] = taxonomy.colours[label]
    return canvas


def _embed(canvas: Colours) -> str:
    """Turn a canvas, whose row 0 is the smallest y, into a data URL."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(canvas[::-1])).save(stream, format="png", optimize=True)
    return f"data:image/png;base64,{_base64(stream.getvalue())}"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def _colours_by_label(taxonomy: Taxonomy) -> dict[str, tuple[str, str]]:
    """Name and colour by label."""
    known = {
        str(i): (name, "rgb({}, {}, {})".format(*colour))
        for i, (name, colour) in enumerate(zip(taxonomy.names, taxonomy.colours, strict=True))
    }
    return known | {str(UNLABELLED): ("Not labelled", "rgb(255, 255, 255)")}


def _map_data(scene: SemanticMap) -> dict[str, Any]:
    """Describe the picture that the slider draws on."""
    sheet = Sheet.over(scene, max_pixels=_MAP_PIXELS)
    return {
        "image": _embed(sheet.background(scene)),
        "pixels_per_m": sheet.pixels_per_m,
        "corner": sheet.corner_m,
        "size": [sheet.shape[1] / sheet.pixels_per_m, sheet.shape[0] / sheet.pixels_per_m],
        "origin": scene.origin.as_array().tolist(),
    }


def _lidar_data(lidar: LidarSpec) -> dict[str, Any]:
    rotation, translation = mount_in_plane(lidar.base_T_lidar)
    return {
        "beams": lidar.beams,
        "angle_min": lidar.angle_min,
        "angle_increment": lidar.angle_increment,
        "step_m": _step_m(lidar),
        "rotation": rotation.tolist(),
        "translation": translation.tolist(),
    }


def _step_m(lidar: LidarSpec) -> float:
    return lidar.range_max / _CODES


def _choose(found: Inspection, worst: NDArray[np.int64], lidar: LidarSpec) -> NDArray[np.int64]:
    """Choose the scans of the slider: the worst ones, and evenly spaced others."""
    room = max(_SCAN_BYTES // (_BEAM_BYTES * lidar.beams), 2)
    even = np.linspace(0, len(found) - 1, min(_SHOWN, len(found), max(room - len(worst), 2)))
    return np.unique(np.concatenate((np.rint(even).astype(np.int64), worst)))


def _scan_data(
    reader: SequenceReader, found: Inspection, chosen: NDArray[np.int64]
) -> dict[str, Any]:
    """Describe the scans of the slider, one row each, ranges and labels in base64."""
    ranges, labels = [], []
    for index in chosen.tolist():
        scan = reader.batch(index, index + 1)[0]
        codes = np.full(reader.lidar.beams, NO_RETURN, "<u2")
        codes[scan.valid] = 1 + np.rint(scan.ranges[scan.valid] / _step_m(reader.lidar))
        ranges.append(codes.tobytes())
        labels.append(reader.read("scans/labels", index, index + 1).tobytes())
    return {
        "ranges": _base64(b"".join(ranges)),
        "labels": _base64(b"".join(labels)),
        "index": chosen.tolist(),
        "kind": _kinds(found)[chosen].tolist(),
        "seconds": _numbers(found.seconds[chosen], 2),
        "rough": [_numbers(pose, 4) for pose in found.rough[chosen]],
        "refined": [_numbers(pose, 4) for pose in found.refined[chosen]],
        "residual_cm": _numbers(100 * found.residual_m[chosen], 2),
        "inliers": _numbers(100 * found.inlier_ratio[chosen], 1),
        "moved_m": _numbers(found.correction_m[chosen], 3),
        "jump_m": _numbers(found.jump_m[chosen], 3),
        "confidence": _numbers(100 * found.confidence[chosen], 1),
        "badness": _numbers(found.badness[chosen], 2),
    }


def _over_time(found: Inspection) -> dict[str, Any]:
    """Least, mean and largest value of each series in at most `_BINS` runs of scans."""
    starts = np.unique(np.linspace(0, len(found), min(_BINS, len(found)) + 1).astype(int)[:-1])
    series = {
        "residual_cm": 100.0 * found.residual_m,
        "inliers": 100.0 * found.inlier_ratio,
        "moved_m": found.correction_m,
    }
    kinds = _kinds(found)
    return {
        "seconds": _numbers(found.seconds[starts], 2),
        "end_s": round(float(found.seconds[-1]), 2),
        "refused": np.logical_or.reduceat(kinds == _REFUSED, starts).tolist(),
        "dropped": np.logical_or.reduceat(kinds == _DROPPED, starts).tolist(),
        "series": {name: _binned(values, starts) for name, values in series.items()},
    }


def _binned(values: NDArray[Any], starts: NDArray[np.int64]) -> dict[str, list[float | None]]:
    finite = np.isfinite(values)
    count = np.add.reduceat(finite.astype(np.int64), starts)
    total = np.add.reduceat(np.where(finite, values, 0.0), starts)
    mean = np.divide(total, count, out=np.full(len(starts), np.nan), where=count > 0)
    return {
        "low": _numbers(np.fmin.reduceat(values, starts), 3),
        "mean": _numbers(mean, 3),
        "high": _numbers(np.fmax.reduceat(values, starts), 3),
    }


def _numbers(values: NDArray[Any], digits: int) -> list[float | None]:
    """Round for JSON, which has no NaN."""
    rounded = np.round(np.asarray(values, np.float64), digits)
    return [value if math.isfinite(value) else None for value in rounded.tolist()]
