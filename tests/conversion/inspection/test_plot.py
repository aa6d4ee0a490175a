"""The picture of an inspection."""

from itertools import combinations

import matplotlib.image
import numpy as np
import pytest

from conversion.inspection.findings import Inspection, Pictures
from conversion.inspection.plot import draw_inspection, plot_inspection
from semantic2d_dataset.errors import InvalidInputError
from tests.conversion.inspection.test_inspection import TENTH, inspect, office
from tests.conversion.recordings import START_NS, Recording, straight_drive


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """An inspection of two lidars, tf and amcl."""
    drive = office(scans=80)
    for n in range(0, 80, 2):
        ns = START_NS + n * TENTH
        drive.add_tf(ns, "map", "odom", (0.2, 0.1 * n, 0.0))
        drive.add_tf(ns, "odom", "base_link", (0.1 * n, 0.0, 0.0))
        drive.add_scan(ns, np.linspace(1, 5, 20), topic="/rear_scan", frame="base_link")
    return inspect(drive.write(tmp_path_factory.mktemp("plot")))


@pytest.fixture(scope="module")
def figure(found):
    figure = plot_inspection(found)
    figure.canvas.draw()
    return figure


@pytest.fixture(scope="module")
def boxes(figure):
    """The drawn box of each of the axes by its title, labels and legends included."""
    shown = [ax for ax in figure.get_axes() if ax.axison]
    return [(ax.get_title(), ax.get_tightbbox(figure.canvas.get_renderer())) for ax in shown]


def overlap(one, other):
    width = min(one.x1, other.x1) - max(one.x0, other.x0)
    height = min(one.y1, other.y1) - max(one.y0, other.y0)
    return max(width, 0) * max(height, 0)


def test_a_picture_is_written(found, tmp_path):
    draw_inspection(found, tmp_path / "look.png")
    pixels = matplotlib.image.imread(tmp_path / "look.png")
    assert pixels.shape[1] > 1500
    assert len(np.unique(pixels[::4, ::4, 0])) > 20


def test_nothing_lies_over_anything_else(boxes):
    pairs = combinations(boxes, 2)
    assert [(a, b) for (a, one), (b, other) in pairs if overlap(one, other) > 4] == []


def test_everything_lies_within_the_picture(figure, boxes):
    width, height = figure.canvas.get_width_height()
    assert len(boxes) == 12
    for _, box in boxes:
        assert box.x0 > -1
        assert box.y0 > -1
        assert box.x1 < width + 1
        assert box.y1 < height + 1


def test_ways_and_scans_have_one_scale_in_both_directions(figure):
    axes = {ax.get_title(): ax for ax in figure.get_axes()}
    equal = [title for title, ax in axes.items() if ax.get_aspect() == 1]
    assert [title for title in equal if title.startswith("Way")]
    assert [title for title in equal if title.startswith("scan at")]


def test_sources_and_topics_are_named(found, figure):
    way, lanes, *_ = figure.get_axes()
    names = [text.get_text() for text in way.get_legend().get_texts()]
    assert names == [
        "tf map -> odom -> base_link",
        "/amcl_pose in map",
        "tf odom -> base_link",
        "/odom in odom",
    ]
    labels = [text.get_text() for text in lanes.get_yticklabels()]
    assert labels[0] == "/amcl_pose  (1 Hz)"
    assert len(labels) == len(found.topics)


def test_a_source_in_another_frame_is_dashed(figure):
    way = figure.get_axes()[0]
    styles = {line.get_label(): line.get_linestyle() for line in way.get_lines()}
    assert styles["/amcl_pose in map"] == "-"
    assert styles["/odom in odom"] == "--"


def test_a_gap_leaves_its_lane_white(tmp_path):
    drive = Recording("ros1")
    for n in [*range(100), *range(300, 400)]:
        drive.add_scan(START_NS + n * TENTH, np.linspace(1, 5, 8))
    lanes = plot_inspection(inspect(drive.write(tmp_path))).get_axes()[1]
    (picture,) = lanes.get_images()
    shares = picture.get_array()[0]
    middle = slice(3 * len(shares) // 10, 7 * len(shares) // 10)
    assert shares.mask[middle].all()
    assert not shares.mask[: len(shares) // 5].any()
    assert shares[: len(shares) // 5].min() > 0.9


def test_a_recording_without_scans_poses_or_times_is_drawn_empty(tmp_path):
    nothing = Inspection(
        *("nothing.bag", "ROS 1 bag", 1, 13, {}, (), None, None),
        *((), (), (), (), (), (), (), (), "semantic2d convert nothing.bag"),
        pictures=Pictures(),
    )
    draw_inspection(nothing, tmp_path / "look.png")
    texts = [ax.texts[0].get_text() for ax in plot_inspection(nothing).get_axes()]
    assert texts == ["no poses", "no times"]


def test_scans_without_any_return_are_drawn(tmp_path):
    drive = Recording("ros1")
    for n in range(3):
        drive.add_scan(START_NS + n * TENTH, np.full(8, np.nan))
    figure = plot_inspection(inspect(drive.write(tmp_path)))
    figure.canvas.draw()
    assert "no returns" in [text.get_text() for ax in figure.get_axes() for text in ax.texts]


def test_codes_for_no_return_are_no_points_of_a_scan(tmp_path):
    figure = plot_inspection(inspect(office(missing=25.5).write(tmp_path)))
    scans = [ax for ax in figure.get_axes() if ax.get_title().startswith("scan at")]
    assert len(scans) == 3
    for ax in scans:
        points = ax.collections[0].get_offsets().filled(np.nan)
        assert np.nanmax(np.hypot(*points.T)) < 10
        assert ax.get_xlim()[1] < 10


def test_more_lidars_than_can_be_shown_are_not(tmp_path):
    drive = straight_drive("mcap")
    for n in range(6):
        drive.add_scan(START_NS, np.linspace(1, 5, 8), topic=f"/lidar_{n}/scan")
    figure = plot_inspection(inspect(drive.write(tmp_path)))
    assert len(figure.subfigs) == 5


def test_a_name_that_is_no_picture_is_refused(found, tmp_path):
    with pytest.raises(InvalidInputError, match=r"\.png"):
        draw_inspection(found, tmp_path / "look.txt")
