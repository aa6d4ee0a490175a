"""Pictures of scans and maps in the colours of the classes.

Every function takes data and returns a matplotlib `Figure` that no window knows; `save` writes
it. Lengths are in m and both axes have one scale. Points lie on a thin dark rim, because some
class colours (Person, Table) are close to white paper.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.path import Path as MarkerPath
from matplotlib.transforms import Affine2D
from numpy.typing import ArrayLike, NDArray

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.writing import write_bytes_atomically
from semantic2d_dataset.scene.geometry import Pose2, to_base, to_points
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, SemanticMap
from semantic2d_dataset.scene.scans import Scan, check_array
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy

_EDGE = "0.25"
_FREE_RGB = (255, 255, 255)
_UNKNOWN_RGB = (232, 238, 244)  # no class is bluish grey
_OCCUPIED_RGB = (125, 125, 125)  # occupied without a class; Other is black
_ROBOT = "#d6007f"  # no class is pink


def plot_scan(
    scan: Scan,
    labels: NDArray[np.uint8] | None = None,
    *,
    ax: Axes | None = None,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> Figure:
    """Draw the returns of a scan in the base frame, in class colours.

    Parameters
    ----------
    scan
        The scan.
    labels
        (B,) u1 class ids, 255 not labelled; the scan's own where None.
    ax
        Where to draw, without a legend; a new figure with one where None.
    taxonomy
        Names and colours.

    Raises
    ------
    InvalidInputError
        If `labels` do not fit the scan.
    """
    shown = _labels_of(scan, labels)
    figure, axes = (_figure_of(ax), ax) if ax is not None else _new_figure(7.0, 6.5)
    points = to_base(to_points(scan.ranges, scan.lidar.bearings), scan.lidar.base_T_lidar)
    _draw_points(axes, points[scan.valid], shown[scan.valid], taxonomy)
    _draw_robot(axes, Pose2(0.0, 0.0, 0.0))
    _in_metres(axes)
    if ax is None:
        _add_legend(figure, shown[scan.valid], taxonomy)
    return figure


def plot_prediction_beside_truth(
    scan: Scan,
    prediction: NDArray[np.uint8],
    truth: NDArray[np.uint8] | None = None,
    *,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> Figure:
    """Draw a scan twice, with its true labels and with predicted ones.

    Parameters
    ----------
    scan
        The scan.
    prediction
        (B,) u1 class ids.
    truth
        (B,) u1 class ids, 255 not labelled; the scan's own where None.
    taxonomy
        Names and colours.

    Raises
    ------
    InvalidInputError
        If labels do not fit the scan.
    """
    both = {"Truth": _labels_of(scan, truth), "Prediction": _labels_of(scan, prediction)}
    figure = new_empty_figure(11.0, 6.0)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, (title, labels) in zip(axes, both.items(), strict=True):
        plot_scan(scan, labels, ax=ax, taxonomy=taxonomy)
        ax.set_title(title)
        ax.set_anchor("S")  # beside the legend, however flat the scan is
    axes[1].set_ylabel("")
    _add_legend(figure, np.concatenate([ids[scan.valid] for ids in both.values()]), taxonomy)
    return figure


def plot_map(
    scene: SemanticMap, *, ax: Axes | None = None, taxonomy: Taxonomy = SEMANTIC2D
) -> Figure:
    """Draw a map: free space white, unknown space bluish, occupied cells in class colours.

    Parameters
    ----------
    scene
        The map; a cell that is free or unknown is drawn as such whatever class it carries.
    ax
        Where to draw, without a legend; a new figure with one where None.
    taxonomy
        Names and colours.
    """
    figure, axes = (_figure_of(ax), ax) if ax is not None else _new_figure(8.0, 7.0)
    _draw_map(axes, scene, taxonomy)
    _in_metres(axes)
    if ax is None:
        _add_legend(figure, _mapped_ids(scene), taxonomy, _map_patches())
    return figure


def plot_labelled_scan_on_map(
    scene: SemanticMap,
    points: ArrayLike,
    labels: NDArray[np.uint8],
    *,
    pose: Pose2 | None = None,
    taxonomy: Taxonomy = SEMANTIC2D,
) -> Figure:
    """Draw labelled points over a pale map.

    Parameters
    ----------
    scene
        The map.
    points
        (P, 2) m, map frame; points that are not finite are left out.
    labels
        (P,) u1 class ids, 255 not labelled.
    pose
        Where the robot stood, drawn as an arrow head.
    taxonomy
        Names and colours.

    Raises
    ------
    InvalidInputError
        If points and labels do not fit.
    """
    p = np.asarray(points, np.float64)
    check_array("points", p, np.float64, (None, 2))
    check_array("labels", labels, np.uint8, (len(p),))
    figure, ax = _new_figure(8.0, 7.0)
    _draw_map(ax, scene, taxonomy, opacity=0.45)
    finite = np.isfinite(p).all(axis=1)
    _draw_points(ax, p[finite], labels[finite], taxonomy)
    if pose is not None:
        _draw_robot(ax, pose)
    _in_metres(ax)
    shown = np.concatenate((labels[finite], _mapped_ids(scene)))
    _add_legend(figure, shown, taxonomy, _map_patches())
    return figure


_PICTURES = ("jpeg", "jpg", "pdf", "png", "svg", "tif", "tiff", "webp")


def check_picture_name(path: Path) -> None:
    """Check that a picture can be written under a name, before work is spent on it.

    Raises
    ------
    InvalidInputError
        If the folder does not exist, or no picture can have that ending.
    """
    path = Path(path)
    if path.suffix.removeprefix(".").lower() not in _PICTURES:
        raise InvalidInputError(
            f"{path}: expected a name that ends in one of .{', .'.join(_PICTURES)}"
        )
    if not path.parent.is_dir():
        raise InvalidInputError(f"{path}: the folder {path.parent} does not exist")


def save(figure: Figure, path: Path, *, dpi: int = 150) -> None:
    """Write a figure in one step; the ending of the name chooses the format.

    Raises
    ------
    InvalidInputError
        As `check_picture_name` does.
    WriteError
        If it cannot be written; what was there stays.
    """
    path = Path(path)
    check_picture_name(path)
    content = io.BytesIO()
    figure.savefig(content, dpi=dpi, format=path.suffix.removeprefix(".").lower())
    write_bytes_atomically(path, content.getvalue())


def new_empty_figure(width: float, height: float) -> Figure:
    """Make a figure of a size in inches, which pyplot, and so any window, never sees."""
    padding = ConstrainedLayoutEngine(h_pad=0.1, w_pad=0.1)  # inches
    figure = Figure((width, height), layout=padding)
    FigureCanvasAgg(figure)
    return figure


def _new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = new_empty_figure(width, height)
    return figure, figure.subplots()


def _figure_of(ax: Axes) -> Figure:
    return cast("Figure", ax.get_figure(root=True))


def _labels_of(scan: Scan, labels: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    if labels is not None:
        check_array("labels", labels, np.uint8, (scan.lidar.beams,))
        return labels
    if scan.labels is None:
        return np.full(scan.lidar.beams, UNLABELLED, np.uint8)
    return scan.labels


def _draw_points(
    ax: Axes, points: NDArray[np.float64], labels: NDArray[np.uint8], taxonomy: Taxonomy
) -> None:
    colours = taxonomy.palette[labels] / 255
    x, y = points.T
    # one rim below all points: rims of their own would darken rows of close points
    ax.scatter(x, y, s=19, color=_EDGE, linewidths=0, zorder=3)
    ax.scatter(x, y, s=11, c=colours, linewidths=0, zorder=4)


def _draw_robot(ax: Axes, pose: Pose2) -> None:
    head = Affine2D().rotate(pose.yaw).transform(((1, 0), (-0.7, 0.65), (-0.35, 0), (-0.7, -0.65)))
    marker = MarkerPath(np.vstack((head, head[:1])), closed=True)
    style: dict[str, Any] = {"color": _ROBOT, "markeredgecolor": "white", "zorder": 5}
    ax.plot(pose.x, pose.y, marker=marker, markersize=17, **style)


def _draw_map(ax: Axes, scene: SemanticMap, taxonomy: Taxonomy, *, opacity: float = 1.0) -> None:
    rows, columns = scene.occupancy.shape
    to_map = Affine2D().rotate(scene.origin.yaw).translate(scene.origin.x, scene.origin.y)
    colours = _faded(cell_colours(scene, taxonomy), opacity)
    ax.imshow(
        colours,
        origin="lower",
        extent=(0, columns * scene.resolution, 0, rows * scene.resolution),
        interpolation="nearest",
        transform=to_map + ax.transData,
    )
    # a wall one cell wide must not fall between the pixels of the picture
    occupied = np.argwhere(scene.occupancy == OCCUPIED)
    x, y = scene.centres_of(occupied).T
    ax.scatter(x, y, s=1, marker="s", c=colours[tuple(occupied.T)] / 255, linewidths=0, zorder=2)
    ax.set_facecolor(_rgb(_faded(_UNKNOWN_RGB, opacity).tolist()))
    low, high = _known_box(scene)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])


def _faded(rgb: ArrayLike, opacity: float) -> NDArray[np.uint8]:
    """Mix colours 0..255 with white."""
    mixed: NDArray[np.float64] = 255 - opacity * (255 - np.asarray(rgb, np.float64))
    return mixed.astype(np.uint8)


def cell_colours(scene: SemanticMap, taxonomy: Taxonomy) -> NDArray[np.uint8]:
    """Colours (H, W, 3) u1 of cells: what they are, and their class where they are occupied."""
    palette = taxonomy.palette
    palette[len(taxonomy) :] = _OCCUPIED_RGB
    colours: NDArray[np.uint8] = palette[scene.labels]
    colours[scene.occupancy != OCCUPIED] = _UNKNOWN_RGB
    colours[scene.occupancy == FREE] = _FREE_RGB
    return colours


def _known_box(scene: SemanticMap) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners in m of the box around all that is known, with a margin."""
    known = np.argwhere(np.isin(scene.occupancy, (FREE, OCCUPIED)))
    if not known.size:
        known = np.array(((0, 0), np.subtract(scene.occupancy.shape, 1)))
    corners = scene.centres_of(_hull(known))
    margin = 0.02 * np.ptp(corners, axis=0).max() + scene.resolution
    return corners.min(axis=0) - margin, corners.max(axis=0) + margin


def _hull(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the four corners of the box of cells, row and column."""
    (top, left), (bottom, right) = cells.min(axis=0), cells.max(axis=0)
    return np.array(((top, left), (top, right), (bottom, left), (bottom, right)))


def _mapped_ids(scene: SemanticMap) -> NDArray[np.uint8]:
    ids: NDArray[np.uint8] = scene.labels[
        (scene.occupancy == OCCUPIED) & (scene.labels != UNLABELLED)
    ]
    return ids


def _in_metres(ax: Axes) -> None:
    ax.set_aspect("equal")
    ax.set_xlabel("x (m)")
    ax.set_ylabel("y (m)")


def _map_patches() -> list[Patch]:
    kinds = {"Free": _FREE_RGB, "Unknown": _UNKNOWN_RGB, "Occupied, no class": _OCCUPIED_RGB}
    return [_patch(name, rgb) for name, rgb in kinds.items()]


def _patch(name: str, rgb: Sequence[int]) -> Patch:
    return Patch(facecolor=_rgb(rgb), edgecolor=_EDGE, linewidth=0.5, label=name)


def _dot(name: str, rgb: Sequence[int]) -> Line2D:
    return Line2D(
        [],
        [],
        color=_rgb(rgb),
        label=name,
        linestyle="",
        marker="o",
        markersize=7,
        markeredgecolor=_EDGE,
    )


def _rgb(rgb: Sequence[int]) -> tuple[float, float, float]:
    red, green, blue = rgb
    return red / 255, green / 255, blue / 255


def _add_legend(
    figure: Figure, labels: NDArray[np.uint8], taxonomy: Taxonomy, more: Iterable[Patch] = ()
) -> None:
    """Name the classes that occur, below the axes, where no point can lie."""
    names = dict(enumerate(taxonomy.names)) | {UNLABELLED: "Not labelled"}
    present = [int(c) for c in np.unique(labels)]
    unknown = [c for c in present if c not in names]
    if unknown:
        raise InvalidInputError(f"labels: no class has the id {unknown[0]}")
    dots = [_dot(names[c], taxonomy.palette[c].tolist()) for c in present]
    figure.legend(handles=[*dots, *more], loc="outside lower center", ncols=5, frameon=False)
