from dataclasses import replace

import numpy as np
import pytest

from salsa.annotation import Annotation, read_annotation
from salsa.map_check import Cluster, Overlap, check_map
from semantic2d_dataset.scene.geometry import Pose2
from semantic2d_dataset.scene.maps import FREE, OCCUPIED, UNKNOWN, read_map
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED, Taxonomy
from tests.salsa import rooms

WALL = SEMANTIC2D.id_of("Wall")


def report_of(tmp_path, *shapes, scene=None):
    scene = scene or rooms.room_map()
    path = rooms.write_labelme(tmp_path / "a.json", list(shapes))
    return check_map(scene, read_annotation(path, scene.occupancy.shape))


def box_of(name, label=None):
    return rooms.shape(label or name, rooms.pixel_box(rooms.BOXES[name]))


def test_a_complete_annotation_has_nothing_to_look_at(tmp_path):
    report = report_of(tmp_path, *rooms.room_shapes())
    scene = rooms.room_map()
    assert report.warnings == ()
    assert report.clusters == ()
    assert (report.width, report.height, report.resolution_m) == (180, 140, 0.05)
    cells = {kind: int((scene.occupancy == kind).sum()) for kind in (OCCUPIED, FREE, UNKNOWN)}
    assert (report.occupied, report.free, report.unknown) == tuple(cells.values())
    assert report.unlabelled == 0
    assert sum(report.classes.values()) == report.occupied
    assert report.classes["Pillar"] == (scene.labels == SEMANTIC2D.id_of("Pillar")).sum()
    assert report.classes["Chair"] == 0
    assert set(report.classes) == set(SEMANTIC2D.names)


def test_a_forgotten_object_is_counted(tmp_path):
    report = report_of(tmp_path, box_of("Pillar"), box_of("Table"), box_of("Sofa"))
    wall = rooms.room_map().labels == WALL
    near_sofa = report.classes["Sofa"] - (rooms.room_map().labels == SEMANTIC2D.id_of("Sofa")).sum()
    assert report.classes["Wall"] == 0
    assert report.unlabelled == wall.sum() - near_sofa
    assert f"{report.unlabelled:,} occupied cells" in report.warnings[0]


def test_a_forgotten_object_is_placed_in_pixels_and_metres(tmp_path):
    scene = rooms.room_map(Pose2(1.0, 2.0, np.pi / 2))
    scene.occupancy[60:62, 100:105] = OCCUPIED
    regions = np.where(scene.labels == UNLABELLED, UNLABELLED, scene.labels)
    report = check_map(scene, Annotation(regions, ()))
    assert report.unlabelled == 10
    assert report.cluster_count == 1
    (cluster,) = report.clusters
    assert (cluster.cells, cluster.column) == (10, 102)
    assert cluster.row in (140 - 1 - 60, 140 - 1 - 61)
    row = 140 - 1 - cluster.row
    # the grid lies turned by 90 degrees: its columns run along y, its rows against x
    assert cluster.x_m == pytest.approx(1.0 - (row + 0.5) * 0.05, abs=1e-3)
    assert cluster.y_m == pytest.approx(2.0 + 102.5 * 0.05, abs=1e-3)
    assert cluster.size_m == 0.25
    assert "10 occupied cells (" in report.warnings[0]


def test_groups_touch_by_their_corners_and_the_largest_come_first():
    scene = rooms.room_map()
    regions = scene.labels.copy()
    for row, column in ((60, 100), (61, 101), (62, 102), (70, 100), (80, 50), (80, 51)):
        scene.occupancy[row, column] = OCCUPIED
    report = check_map(scene, Annotation(regions, ()))
    assert [cluster.cells for cluster in report.clusters] == [3, 2, 1]
    assert report.clusters[0] == Cluster(3, 101, 78, 5.075, 3.075, 0.15)


def test_only_the_largest_groups_are_listed_and_all_are_counted():
    scene = rooms.room_map()
    scene.occupancy[40:80:2, 100] = OCCUPIED
    report = check_map(scene, Annotation(scene.labels.copy(), ()))
    assert len(report.clusters) == 10
    assert report.cluster_count == 20


def test_shapes_beside_the_image_are_told(tmp_path):
    report = report_of(
        tmp_path,
        *rooms.room_shapes(),
        rooms.shape("Chair", [[-50, -50], [-20, -20]], "rectangle"),
        rooms.shape("Chair", [[150, 50], [200, 60]], "rectangle"),
        rooms.shape("Sofa", [[0, 0], [180, 140]], "line"),  # on the border: not outside
    )
    assert [shape.outside_px for shape in report.shapes] == [0, 0, 0, 0, 50, 20, 0]
    assert "shape 5 (Chair) lies outside the image" in report.warnings
    assert "shape 6 (Chair) reaches 20 pixels beyond the image" in report.warnings
    assert not any("shape 7" in warning for warning in report.warnings)


def test_a_shape_that_covers_no_occupied_cell_is_told_by_number_and_class(tmp_path):
    report = report_of(
        tmp_path, *rooms.room_shapes(), rooms.shape("chair", [[100, 60], [110, 70]], "rectangle")
    )
    assert report.warnings == ("shape 5 (Chair) covers no occupied cell",)
    assert report.shapes[4].pixels == 121
    assert report.shapes[4].occupied == 0


def test_a_shape_that_later_ones_hide_is_told(tmp_path):
    report = report_of(tmp_path, box_of("Pillar"), *[box_of(n) for n in ("Wall", "Table", "Sofa")])
    assert any(w.startswith("shape 1 (Pillar) is hidden by later shapes") for w in report.warnings)
    pillar = report.shapes[0]
    assert pillar.kept == 0 < pillar.occupied


def test_a_shape_twice_in_one_class_is_not_hidden(tmp_path):
    report = report_of(tmp_path, *rooms.room_shapes(), box_of("Pillar"))
    assert report.warnings == ()


def test_overlaps_say_which_class_has_the_cells(tmp_path):
    report = report_of(tmp_path, *rooms.room_shapes())
    scene = rooms.room_map()
    inside = {
        name: int((scene.labels == SEMANTIC2D.id_of(name)).sum()) for name in ("Pillar", "Table")
    }
    found = {(overlap.earlier, overlap.later): overlap.cells for overlap in report.overlaps}
    assert found["Wall", "Pillar"] == inside["Pillar"]
    assert found["Wall", "Table"] == inside["Table"]
    assert ("Pillar", "Table") not in found
    assert Overlap("Wall", "Wall", 0) not in report.overlaps


def test_people_count_as_free_and_that_is_said(tmp_path):
    pillar = int((rooms.room_map().labels == SEMANTIC2D.id_of("Pillar")).sum())
    report = report_of(tmp_path, box_of("Wall"), box_of("Pillar", "people"))
    assert report.people_occupied == pillar
    assert report.people > pillar
    assert report.classes["Person"] == 0
    (warning,) = report.warnings
    assert f"cells are called Person, {pillar:,} of them occupied: they count as free" in warning


def test_a_person_in_free_space_is_no_shape_over_nothing(tmp_path):
    report = report_of(
        tmp_path, *rooms.room_shapes(), rooms.shape("Person", [[100, 60], [104, 64]], "rectangle")
    )
    assert not any("covers no occupied" in warning for warning in report.warnings)
    assert (report.people, report.people_occupied) == (25, 0)


def test_an_inverted_map_and_one_without_unknown_space_are_told():
    scene = rooms.room_map()
    swapped = np.select(
        [scene.occupancy == FREE, scene.occupancy == OCCUPIED], [OCCUPIED, FREE], FREE
    ).astype(np.uint8)
    said = Annotation(np.full_like(scene.labels, WALL), ())
    warnings = check_map(replace(scene, occupancy=swapped), said).warnings
    full = np.full_like(swapped, OCCUPIED)
    full[0, :50], full[1, 0] = FREE, UNKNOWN
    assert any("free_thresh" in warning for warning in warnings)
    (told,) = check_map(replace(scene, occupancy=full), said).warnings
    assert "more cells are occupied" in told
    assert "`negate`" in told


def test_the_share_of_generous_pixels_is_exact():
    scene = rooms.room_map()
    regions = np.full_like(scene.labels, UNLABELLED)
    regions[10, 10:20] = WALL  # occupied
    regions[11, 12:42] = WALL  # free
    assert check_map(scene, Annotation(regions, ())).not_occupied_share == 0.75


def test_an_empty_annotation_is_reported_without_shares_of_nothing():
    scene = rooms.room_map()
    report = check_map(scene, Annotation(np.full_like(scene.labels, UNLABELLED), ()))
    assert report.not_occupied_share == 0
    assert report.unlabelled == report.occupied


def test_classes_of_any_taxonomy_are_named():
    own = Taxonomy(("nothing", "Shelf", "People"), ((0, 0, 0), (1, 2, 3), (4, 5, 6)))
    scene = rooms.room_map()
    regions = np.where(scene.occupancy == OCCUPIED, 1, UNLABELLED).astype(np.uint8)
    report = check_map(scene, Annotation(regions, ()), own)
    assert report.classes == {"nothing": 0, "Shelf": report.occupied, "People": 0}


def test_real_maps_are_checked(shared_data):
    lobby, cart = shared_data / "temple_lobby", shared_data / "thesis_cart" / "map"
    if not (lobby.is_dir() and cart.is_dir()):
        pytest.skip(f"{lobby} or {cart} is not present")
    scene = read_map(lobby / "map.yaml")
    report = check_map(scene, read_annotation(lobby / "label.png", scene.occupancy.shape))
    assert (report.people, report.people_occupied, report.unlabelled) == (4536, 0, 8)
    assert any("4,536 cells are called Person" in warning for warning in report.warnings)
    assert report.classes["Wall"] > report.classes["Door"] > report.classes["Elevator"] > 0
    scene = read_map(cart / "processed.yaml")
    report = check_map(scene, read_annotation(cart / "processed.json", scene.occupancy.shape))
    assert len(report.shapes) == 17
    assert report.unlabelled == 0
    assert any("free_thresh" in warning for warning in report.warnings)  # ROS 2 writes 0.25
