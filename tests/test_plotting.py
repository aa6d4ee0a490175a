import numpy as np
import pytest
from matplotlib.image import imread

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.plotting import (
    plot_labelled_scan_on_map,
    plot_map,
    plot_prediction_beside_truth,
    plot_scan,
    save,
)
from semantic2d_dataset.scene.geometry import Pose2, compose, to_base, to_points, transform
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW as HOKUYO
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, UNKNOWN, SemanticMap
from semantic2d_dataset.scene.scans import Scan
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D

# (x, y, width, height) in m and class, in a room of 12 by 8 m
FURNITURE = (
    ((2.0, 7.9, 1.0, 0.1), "Door"),
    ((7.0, 7.9, 1.4, 0.1), "Elevator"),
    ((4.0, 4.5, 0.5, 0.5), "Pillar"),
    ((0.3, 1.0, 0.8, 2.2), "Sofa"),
    ((8.5, 2.0, 1.6, 0.8), "Table"),
    ((9.0, 3.0, 0.45, 0.45), "Chair"),
    ((9.0, 1.3, 0.45, 0.45), "Chair"),
    ((11.4, 7.3, 0.4, 0.4), "Trash bin"),
    ((5.8, 1.2, 0.4, 0.3), "Other"),
)
POSE = Pose2(5.4, 3.2, 0.5)


def draw_room(yaw=0.2):
    """A room with all classes but Person, in a larger unknown space; 5 cm cells."""
    occupancy = np.full((240, 320), UNKNOWN, np.uint8)
    labels = np.full(occupancy.shape, 255, np.uint8)
    occupancy[38:202, 38:282], labels[38:202, 38:282] = OCCUPIED, SEMANTIC2D.id_of("Wall")
    occupancy[40:200, 40:280], labels[40:200, 40:280] = FREE, 255
    for (x, y, width, height), name in FURNITURE:
        rows = slice(40 + round(y / 0.05), 40 + round((y + height) / 0.05))
        columns = slice(40 + round(x / 0.05), 40 + round((x + width) / 0.05))
        occupancy[rows, columns], labels[rows, columns] = OCCUPIED, SEMANTIC2D.id_of(name)
    occupancy[120:124, 80:84], labels[120:124, 80:84] = OCCUPIED, 255
    corner = transform((0.0, 0.0, yaw), [[-2.0, -2.0]])[0]
    return SemanticMap(occupancy, labels, 0.05, Pose2(*corner, yaw))


def measure(scene, seed=0):
    """March the beams of a Hokuyo through the room, with two people in it."""
    rng = np.random.default_rng(seed)
    yaw = scene.origin.yaw
    base = compose((0.0, 0.0, yaw), POSE.as_array())
    steps = np.arange(0.1, 15, 0.02)
    grid = to_points(steps[:, None], HOKUYO.bearings)  # (S, B, 2)
    at = transform(base, to_base(grid, HOKUYO.base_T_lidar))
    rows, columns = np.moveaxis(scene.cells_of(at), -1, 0)
    inside = (rows >= 0) & (rows < 240) & (columns >= 0) & (columns < 320)
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    hit = scene.occupancy[rows, columns] == OCCUPIED
    labels = scene.labels[rows, columns]
    for person in ((3.2, 3.0), (3.6, 2.6), (7.4, 5.0)):
        legs = transform((0.0, 0.0, yaw), [person, (person[0] + 0.3, person[1])])
        near = np.min([np.hypot(*(at - leg).T).T for leg in legs], axis=0) < 0.09
        hit, labels = hit | near, np.where(near, SEMANTIC2D.id_of("Person"), labels)
    first = hit.argmax(axis=0)
    beams = np.arange(HOKUYO.beams)
    ranges = np.where(hit.any(axis=0), steps[first] + rng.normal(0, 0.01, beams.size), np.inf)
    ranges[rng.random(beams.size) < 0.02] = np.inf
    found = labels[first, beams].astype(np.uint8)
    return Scan(HOKUYO, ranges.astype(np.float32), None, found, base, 0)


def guess(labels, seed=1):
    rng = np.random.default_rng(seed)
    wrong = rng.random(labels.size) < 0.12
    return np.where(wrong, rng.choice([1, 4, 7, 9], labels.size), labels).astype(np.uint8)


@pytest.fixture(scope="module")
def scene():
    return draw_room()


@pytest.fixture(scope="module")
def scan(scene):
    return measure(scene)


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def drawn_points(ax):
    rims, points = ax.collections[-2:]
    assert (rims.get_offsets() == points.get_offsets()).all()
    return np.asarray(points.get_offsets())


def test_scan_is_drawn_in_the_base_frame_without_beams_that_have_no_return(scan):
    figure = plot_scan(scan)
    found = drawn_points(figure.axes[0])
    assert len(found) == scan.valid.sum() < HOKUYO.beams
    first = np.flatnonzero(scan.valid)[0]
    bearing, distance = HOKUYO.bearings[first], scan.ranges[first]
    expected = distance * np.array((np.cos(bearing), np.sin(bearing))) + HOKUYO.base_T_lidar[:2]
    assert found[0] == pytest.approx(expected)
    assert figure.axes[0].get_aspect() == 1


def test_points_have_the_colours_of_their_classes_on_a_dark_rim(scan):
    rims, points = plot_scan(scan).axes[0].collections
    expected = SEMANTIC2D.palette[scan.labels[scan.valid]] / 255
    assert points.get_facecolors()[:, :3] == pytest.approx(expected)
    assert rims.get_facecolors()[:, :3].max() < 0.5
    assert rims.get_sizes()[0] > points.get_sizes()[0]


def test_legend_names_the_classes_that_occur_and_no_others(scan):
    labels = np.full(HOKUYO.beams, 9, np.uint8)
    labels[:600] = 4
    assert legend_of(plot_scan(scan, labels)) == ["Person", "Wall"]


def test_scan_without_labels_is_drawn_as_not_labelled(scan):
    bare = Scan(HOKUYO, scan.ranges, None, None, scan.pose, 0)
    assert legend_of(plot_scan(bare)) == ["Not labelled"]


def test_scan_without_any_return_gives_an_empty_picture(tmp_path):
    ranges = np.full(HOKUYO.beams, np.inf, np.float32)
    figure = plot_scan(Scan(HOKUYO, ranges, None, None, np.zeros(3), 0))
    save(figure, tmp_path / "empty.png")
    assert len(drawn_points(figure.axes[0])) == 0


@pytest.mark.parametrize("wrong", [np.zeros(5, np.uint8), np.zeros(1081)])
def test_labels_that_do_not_fit_the_scan_are_refused(scan, wrong):
    with pytest.raises(InvalidInputError, match="labels"):
        plot_scan(scan, wrong)


def test_labels_without_a_class_are_refused(scan):
    with pytest.raises(InvalidInputError, match="no class has the id 77"):
        plot_scan(scan, np.full(HOKUYO.beams, 77, np.uint8))


def test_prediction_and_truth_share_axes_and_legend(scan):
    figure = plot_prediction_beside_truth(scan, guess(scan.labels))
    left, right = figure.axes
    assert (left.get_title(), right.get_title()) == ("Truth", "Prediction")
    assert (left.get_xlim(), left.get_ylim()) == (right.get_xlim(), right.get_ylim())
    assert (drawn_points(left) == drawn_points(right)).all()
    assert len(figure.legends) == 1


def test_map_shows_all_known_cells_where_they_are(scene):
    figure = plot_map(scene)
    (low_x, high_x), (low_y, high_y) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    corners = transform((0.0, 0.0, 0.2), [[0, 0], [12, 0], [0, 8], [12, 8]])
    assert low_x < corners[:, 0].min() < corners[:, 0].max() < high_x
    assert low_y < corners[:, 1].min() < corners[:, 1].max() < high_y
    assert high_x - low_x < 16  # the unknown space around is cut off
    assert legend_of(figure)[-3:] == ["Free", "Unknown", "Occupied, no class"]
    assert "Person" not in legend_of(figure)


def test_map_picture_has_class_colours_only_on_occupied_cells(scene):
    mislabelled = SemanticMap(
        scene.occupancy,
        np.where(scene.occupancy == FREE, 4, scene.labels).astype(np.uint8),
        scene.resolution,
        scene.origin,
    )
    picture = np.asarray(plot_map(mislabelled).axes[0].images[0].get_array())
    assert (picture[100, 100] == 255).all()
    assert (picture[38, 100] == SEMANTIC2D.colours[9]).all()
    assert not (picture == SEMANTIC2D.colours[4]).all(axis=-1).any()


def test_unknown_map_can_be_drawn(tmp_path):
    cells = np.full((4, 5), UNKNOWN, np.uint8)
    save(plot_map(SemanticMap(cells, cells, 1.0, Pose2(0, 0, 0))), tmp_path / "map.png")


def test_labelled_points_lie_on_the_map_where_they_were_measured(scene, scan):
    local = to_base(to_points(scan.ranges, HOKUYO.bearings), HOKUYO.base_T_lidar)
    points = transform(scan.pose, local)
    figure = plot_labelled_scan_on_map(scene, points, scan.labels, pose=Pose2(*scan.pose))
    finite = np.isfinite(points).all(axis=1)
    assert (drawn_points(figure.axes[0]) == points[finite]).all()
    assert {"Person", "Wall", "Free"} <= set(legend_of(figure))


def test_points_that_do_not_fit_their_labels_are_refused(scene):
    with pytest.raises(InvalidInputError, match="points"):
        plot_labelled_scan_on_map(scene, np.zeros((3, 3)), np.zeros(3, np.uint8))
    with pytest.raises(InvalidInputError, match="labels"):
        plot_labelled_scan_on_map(scene, np.zeros((3, 2)), np.zeros(2, np.uint8))


def test_saved_picture_has_the_size_of_its_figure(scan, tmp_path):
    save(plot_scan(scan), tmp_path / "scan.png", dpi=50)
    assert imread(tmp_path / "scan.png").shape[:2] == (325, 350)
