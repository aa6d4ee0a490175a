import math

import pytest
import yaml

from conversion.tables.layout import example_description, read_layout
from semantic2d_dataset.errors import InvalidInputError, RecordingError


@pytest.fixture
def layout(tmp_path):
    def read(text):
        path = tmp_path / "layout.yaml"
        path.write_text(text, encoding="utf-8")
        return read_layout(path)

    return read


def test_the_example_is_a_description_that_names_every_key(layout, tmp_path):
    said = layout(example_description())
    assert said.data == tmp_path / "run.npz"
    assert said.velocities == ("vx", "wz")
    assert said.classes == {0: 0, 3: 9, 12: 4, 255: 255}
    lidar = said.lidar_of(1081, None)
    assert lidar.name == "my-lidar"
    assert math.degrees(lidar.bearings[-1]) == pytest.approx(135)
    assert lidar.base_T_lidar == (0.1, 0, 0.2, 0, 0, 0)
    with pytest.raises(RecordingError) as told:
        layout("nothing: 1")
    known = str(told.value).split("known are ")[1].split(", ")
    assert set(known) == set(yaml.safe_load(example_description()))


def test_units_and_columns_are_understood(layout):
    said = layout(
        "data: a.csv\nranges: r0..r9\nrange_unit: mm\nstamps: 0\nstamp_unit: us\n"
        "poses: [x, y, 3]\nyaw_unit: deg"
    )
    assert (said.metres, said.per_second, said.radians) == (0.001, 10**6, math.pi / 180)
    assert (said.stamps, said.poses) == ("0", ("x", "y", "3"))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "expected a description of arrays, such as:\n\n# What the arrays"),
        ("- 1", "expected a description"),
        ("a: [", "not a YAML file"),
        ("data: x\nrangs: y", "unknown key 'rangs'; known are data, ranges"),
        ("data: x", "expected ranges too; an example"),
        ("data: x\nranges: y\nrange_unit: km", "range_unit: 'km' is not one of"),
        ("data: x\nranges: y\nclockwise: perhaps", "clockwise: 'perhaps' is not of type"),
        ("data: x\nranges: y\nno_return: 0", "no_return: 0 is not of type 'array'"),
        ("data: x\nranges: y\nlidar: {angle: 1}", "lidar: unknown key 'angle'; known are name"),
        ("data: x\nranges: y\nlidar: {angle_min: 1}", "lidar: expected range_min, range_max too"),
        ("data: x\nranges: y\nclasses: {a: 1}", "classes: expected ids as keys, found 'a'"),
        ("data: x\nranges: y\nclasses: {1: Cat}", "classes: unknown class 'Cat'"),
        ("data: x\nranges: y\nclasses: {1: 77}", "classes: expected a class by name .*found 77"),
    ],
)
def test_a_wrong_description_is_refused_with_what_may_be_there(layout, text, problem):
    with pytest.raises(RecordingError, match=problem):
        layout(text)


def test_a_description_is_never_executed_or_endless(layout, tmp_path):
    with pytest.raises(RecordingError, match="not a YAML file"):
        layout("data: !!python/object/apply:os.system ['true']\nranges: y")
    big = tmp_path / "big.yaml"
    big.write_bytes(b"#" * (2 << 20))
    with pytest.raises(RecordingError, match="no description"):
        read_layout(big)


def test_a_lidar_may_be_one_of_the_release_or_a_file(layout, tmp_path):
    assert layout("data: x\nranges: y\nlidar: hokuyo").lidar_of(1081, None).beams == 1081
    (tmp_path / "mine.yaml").write_text(
        "name: mine\nmodel: m\nbeams: 5\nangle_min: -1\nangle_increment: 0.5\nrange_min: 0\n"
        "range_max: 9\n"
    )
    said = layout("data: x\nranges: y\nlidar: mine.yaml")
    assert said.lidar_of(5, None).name == "mine"
    assert said.lidar_of(811, "wlr716").name == "wlr-716"
    with pytest.raises(RecordingError, match="mine has 5 beams, but the ranges 6"):
        said.lidar_of(6, None)
    with pytest.raises(InvalidInputError, match="unknown lidar"):
        said.lidar_of(6, "nothing")


def test_a_described_lidar_takes_steps_or_a_last_angle(layout):
    text = "data: x\nranges: y\nlidar: {angle_min: -1.0, range_min: 0, range_max: 9, %s}"
    by_step = layout(text % "angle_increment: 0.5").lidar_of(5, None)
    by_end = layout(text % "angle_max: 1.0").lidar_of(5, None)
    assert by_step == by_end
    assert by_step.name == "lidar-5"
    with pytest.raises(RecordingError, match="lidar: .*counter-clockwise"):
        layout(text % "angle_increment: -0.5").lidar_of(5, None)
    with pytest.raises(RecordingError, match="lidar: .*finite"):
        layout(text % "angle_max: .nan").lidar_of(5, None)


def test_without_a_lidar_an_example_is_shown(layout):
    with pytest.raises(RecordingError, match=r"(?s)expected lidar: .* 7 beams.*angle_min: -135"):
        layout("data: x\nranges: y").lidar_of(7, None)


def test_a_map_is_told_from_a_description(tmp_path):
    path = tmp_path / "map.yaml"
    path.write_text("{image: map.pgm, resolution: 0.05, origin: [0, 0, 0]}")
    with pytest.raises(RecordingError, match="is a map, not a recording"):
        read_layout(path)
