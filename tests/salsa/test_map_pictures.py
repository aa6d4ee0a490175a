import numpy as np
import pytest
from PIL import Image

from salsa.annotation import read_annotation
from salsa.map_check import check_map
from salsa.map_pictures import FORGOTTEN_RGB, plot_annotated_map
from semantic2d_dataset import plotting
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from tests.salsa import rooms
from tests.salsa.test_shapes import bitmap


def drawn(tmp_path, shapes, scene=None):
    scene = scene or rooms.room_map()
    path = rooms.write_labelme(tmp_path / "a.json", shapes)
    said = read_annotation(path, scene.occupancy.shape)
    return plot_annotated_map(scene, said, check_map(scene, said))


def colours_of(figure, tmp_path):
    plotting.save(figure, tmp_path / "a.png", dpi=60)
    with Image.open(tmp_path / "a.png") as image:
        return {
            tuple(c) for c in np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)
        }


def test_classes_have_their_colours_and_forgotten_cells_another(tmp_path):
    found = colours_of(drawn(tmp_path, rooms.room_shapes()[:-1]), tmp_path)
    assert {SEMANTIC2D.colours[SEMANTIC2D.id_of(n)] for n in ("Wall", "Pillar", "Table")} <= found
    assert FORGOTTEN_RGB not in SEMANTIC2D.colours
    far = [np.abs(np.subtract(FORGOTTEN_RGB, c)).sum() for c in SEMANTIC2D.colours]
    assert min(far) > 150


def test_forgotten_cells_are_seen(tmp_path):
    scene = rooms.room_map()
    shapes = [s for s in rooms.room_shapes() if s["label"] in ("Pillar", "Table")]
    figure = drawn(tmp_path, shapes, scene)
    (ax,) = figure.axes
    pink = [c for c in ax.collections if (c.get_facecolor() == (1, 0, 190 / 255, 1)).all()]
    (marks,) = [c for c in pink if len(c.get_offsets())]
    assert len(marks.get_offsets()) > 500
    colours_of(figure, tmp_path)
    with Image.open(tmp_path / "a.png") as image:
        pixels = np.asarray(image.convert("RGB"))
    pink_pixels = (pixels == FORGOTTEN_RGB).all(axis=-1).sum()
    grey_pixels = (pixels == (125, 125, 125)).all(axis=-1).sum()  # so plot_map draws such cells
    assert pink_pixels > 1000
    assert grey_pixels < 0.01 * pink_pixels


def test_the_legend_counts_cells(tmp_path):
    shapes = [*rooms.room_shapes(), rooms.shape("Person", [[100, 60], [104, 64]], "rectangle")]
    (legend,) = drawn(tmp_path, shapes).legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert any(text.startswith("Wall ") and text.endswith("%)") for text in texts)
    assert "no class 0 (0.0 %)" in texts
    assert "Person 25, counts as free" in texts
    assert not any(text.startswith("Chair") for text in texts)


def test_outlines_lie_where_their_shapes_do_on_a_turned_map(tmp_path):
    scene = rooms.room_map(Pose2(1.0, 2.0, np.pi / 2))
    box = rooms.shape("Pillar", [[60, 90], [70, 100]], "rectangle")
    (ax,) = drawn(tmp_path, [box], scene).axes
    x, y = ax.lines[-1].get_data()
    # pixel (60, 90) is 3 m along the grid's columns and 2.5 m up its rows
    assert (x[0], y[0]) == pytest.approx((1.0 - 2.5, 2.0 + 3.0))
    assert (x[2], y[2]) == pytest.approx((1.0 - 2.0, 2.0 + 3.5))
    assert ax.get_aspect() == 1


@pytest.mark.parametrize(
    ("kind", "points", "count"),
    [
        ("polygon", [[2, 2], [8, 2], [8, 8]], 4),
        ("oriented_rectangle", [[5, 2], [11, 5], [8, 11], [2, 8]], 5),
        ("circle", [[10, 10], [15, 10]], 73),
        ("linestrip", [[2, 5], [20, 5], [20, 15]], 3),
        ("points", [[5, 5], [15, 5]], 2),
        ("mask", [[3, 3], [8, 6]], 5),
    ],
)
def test_every_shape_type_has_an_outline(tmp_path, kind, points, count):
    item = rooms.shape("Wall", points, kind, mask=bitmap())
    (ax,) = drawn(tmp_path, [item]).axes
    x, _ = ax.lines[-1].get_data()
    assert len(x) == count
    assert [text.get_text() for text in ax.texts] == ["1"]


def test_the_figure_has_the_aspect_of_the_map(tmp_path):
    scene = rooms.room_map()
    flat = np.full_like(scene.occupancy, 255)
    flat[60:70] = scene.occupancy[20:30]
    wide = rooms.SemanticMap(flat, scene.labels, scene.resolution, scene.origin)
    width, height = drawn(tmp_path, rooms.room_shapes(), wide).get_size_inches()
    assert width > 2 * height
    width, height = drawn(tmp_path, rooms.room_shapes()).get_size_inches()
    assert height < width < 1.4 * height
