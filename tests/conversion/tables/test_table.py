import math
import tracemalloc

import numpy as np
import pytest

from conversion.options import Options
from conversion.tables import table as tables
from conversion.tables.table import TableSource, example_description, is_table
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter
from tests.conftest import PROJECT

N, B = 40, 6
LIDAR = "lidar: {name: six, angle_min: -50, angle_max: 50, angle_unit: deg, range_min: 0.1, "
LIDAR += "range_max: 30}\n"


def scene():
    rng = np.random.default_rng(5)
    return {
        "ranges": np.round(rng.uniform(0.2, 20, (N, B)), 3),
        "intensity": rng.integers(0, 4000, (N, B)).astype(np.float64),
        "label": rng.integers(0, 10, (N, B)),
        "t": 1000.5 + 0.1 * np.arange(N),
        "pose": np.column_stack((np.arange(N) * 0.1, np.ones(N), np.arange(N) * 2.0)),
        "cmd": rng.normal(size=(N, 2)),
    }


NAMES = (
    "ranges: ranges\nintensities: intensity\nlabels: label\nstamps: t\nposes: pose\n"
    "velocities: cmd\nyaw_unit: deg\n"
)


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "Lab 1"
    path.mkdir()
    return path


def describe(folder, text):
    path = folder / "layout.yaml"
    path.write_text(text + LIDAR, encoding="utf-8")
    return path


def save(folder, kind, arrays):
    """The same arrays in one of three forms, and the description of them."""
    if kind == "folder":
        (folder / "arrays").mkdir()
        for name, array in arrays.items():
            np.save(folder / "arrays" / f"{name}.npy", array)
        return describe(folder, "data: arrays\n" + NAMES)
    if kind == "npz":
        np.savez_compressed(folder / "run.npz", **arrays)
        return describe(folder, "data: run.npz\n" + NAMES)
    heads = {"ranges": "r", "intensity": "i", "label": "l", "pose": "p", "cmd": "c"}
    columns = ["t", *(f"{h}{k}" for n, h in heads.items() for k in range(arrays[n].shape[1]))]
    rows = np.hstack((arrays["t"][:, None], *(arrays[name] for name in heads)))
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (folder / "run.csv").write_text("\n".join([",".join(columns), *lines]) + "\n")
    return describe(
        folder,
        "data: run.csv\nranges: r0..r5\nintensities: i0..i5\nlabels: l0..l5\nstamps: t\n"
        "poses: [p0, p1, p2]\nvelocities: [c0, c1]\nyaw_unit: deg\n",
    )


def convert(path, **options):
    with TableSource(path) as source:
        plans = source.plans(Options(**options))
        blocks = [list(plan.blocks()) for plan in plans]
    arrays = [{n: np.concatenate([b[n] for b in some]) for n in some[0]} for some in blocks]
    return list(zip(plans, arrays, strict=True))


@pytest.mark.parametrize("kind", ["folder", "npz", "csv"])
def test_arrays_and_columns_become_a_sequence(folder, kind):
    arrays = scene()
    ((plan, found),) = convert(save(folder, kind, arrays))
    np.testing.assert_array_equal(found["scans/ranges"], arrays["ranges"].astype(np.float32))
    np.testing.assert_array_equal(found["scans/intensities"], np.float32(arrays["intensity"]))
    np.testing.assert_array_equal(found["scans/labels"], arrays["label"])
    np.testing.assert_array_equal(found["commands/velocity"], arrays["cmd"])
    expected = arrays["pose"] * (1, 1, math.pi / 180)
    np.testing.assert_allclose(found["poses/initial"], expected)
    np.testing.assert_allclose(found["scans/stamps_ns"], arrays["t"] * 1e9, atol=200)
    assert plan.header.sequence_id == "lab-1--layout--six"
    assert plan.header.stamps_source == "header"
    assert (plan.scans_in, plan.scans_out, plan.scans_with_pose) == (N, N, N)
    assert plan.duration_s == pytest.approx(3.9)


@pytest.mark.parametrize("kind", ["folder", "npz", "csv"])
def test_what_was_converted_can_be_written_and_read(folder, tmp_path, kind):
    source = TableSource(save(folder, kind, scene()))
    (plan,) = source.plans(Options(environment="hall", license="MIT"))
    with SequenceWriter(tmp_path / "x.h5", plan.header) as writer:
        for block in plan.blocks():
            writer.append(block)
    with SequenceReader(tmp_path / "x.h5") as reader:
        assert len(reader) == N
        assert reader.header.license == "MIT"
        np.testing.assert_array_equal(reader.read("scans/labels"), scene()["label"])
    assert source.files()[0].name == "layout.yaml"
    assert len(source.files()) == (7 if kind == "folder" else 2)


def test_memory_is_bounded_by_blocks(folder, monkeypatch):
    monkeypatch.setattr(tables, "BLOCK", 16)
    count = 20_000
    np.savez(folder / "a.npz", ranges=np.zeros((count, 100), np.float32))
    path = describe(folder, "data: a.npz\nranges: ranges\n")
    (plan,) = TableSource(path).plans(Options())
    tracemalloc.start()
    assert sum(len(block["scans/ranges"]) for block in plan.blocks()) == count
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20  # the array has 8 MB


def test_without_stamps_scans_are_20_a_second(folder):
    np.savez(folder / "a.npz", ranges=scene()["ranges"])
    ((plan, found),) = convert(describe(folder, "data: a.npz\nranges: ranges\n"))
    assert plan.header.stamps_source == "synthetic"
    np.testing.assert_array_equal(found["scans/stamps_ns"], np.arange(N) * 50_000_000)
    assert plan.pose_source == "none"
    assert np.isnan(found["poses/initial"]).all()


def test_clockwise_beams_are_reversed_with_all_that_belongs_to_them(folder):
    arrays = scene()
    path = save(folder, "npz", arrays)
    path.write_text(path.read_text() + "clockwise: true\n")
    ((_, found),) = convert(path)
    np.testing.assert_array_equal(found["scans/ranges"], np.float32(arrays["ranges"][:, ::-1]))
    np.testing.assert_array_equal(found["scans/labels"], arrays["label"][:, ::-1])
    np.testing.assert_array_equal(found["scans/intensities"], arrays["intensity"][:, ::-1])
    ((plan, found),) = convert(path, reverse_intensities=True)
    np.testing.assert_array_equal(found["scans/intensities"], arrays["intensity"])
    assert plan.reverse_intensities


def test_units_and_no_return_of_a_driver_in_millimetres(folder):
    ranges = np.array([[0, 1500, 65533], [2000, 65534, 0]], np.uint16)
    np.savez(folder / "a.npz", ranges=ranges)
    path = describe(folder, "data: a.npz\nranges: ranges\nrange_unit: mm\nno_return: [65.533]\n")
    ((_, found),) = convert(path, no_return=(65.534,))
    expected = np.float32([[0, 1.5, np.inf], [2.0, np.inf, 0]])
    np.testing.assert_array_equal(found["scans/ranges"], expected)


def test_labels_are_translated_by_the_classes(folder):
    labels = np.array([[40, 7, 7], [41, 40, -1]], np.float32)
    np.savez(folder / "a.npz", ranges=np.ones((2, 3)), label=labels)
    text = "data: a.npz\nranges: ranges\nlabels: label\n"
    classes = "classes: {40: wall, 41: People, 7: 0, -1: 255}\n"
    ((_, found),) = convert(describe(folder, text + classes))
    np.testing.assert_array_equal(found["scans/labels"], [[9, 0, 0], [4, 9, 255]])
    with pytest.raises(RecordingError, match=r"labels: .*found -1, 40, 41; .*'classes: \{-1:"):
        convert(describe(folder, text))
    with pytest.raises(RecordingError, match="found 41"):
        convert(describe(folder, text + "classes: {40: wall, 7: 0, -1: 255}\n"))


def test_a_sequence_ends_where_stamps_go_backward(folder):
    arrays = scene()
    arrays["t"][17:] -= 1000
    arrays["t"][30:] -= 1
    first, second, third = convert(save(folder, "npz", arrays))
    assert [p.header.recording for p, _ in (first, second, third)] == [
        "layout-part-1", "layout-part-2", "layout-part-3"
    ]  # fmt: skip
    joined = np.concatenate([found["scans/ranges"] for _, found in (first, second, third)])
    np.testing.assert_array_equal(joined, np.float32(arrays["ranges"]))
    assert [len(found["poses/initial"]) for _, found in (first, second, third)] == [17, 13, 10]
    arrays["t"] = np.tile([1.0, 0.0], N // 2)
    monstrous = {name: np.repeat(array, 6, axis=0) for name, array in arrays.items()}
    monstrous["t"] = np.tile([1.0, 0.0], 3 * N)
    np.savez(folder / "run.npz", **monstrous)
    with pytest.raises(RecordingError, match="go backward 120 times, first at scan 1"):
        convert(folder / "layout.yaml")


@pytest.mark.parametrize("block", [1, 7, 512])
def test_scans_without_pose_are_kept_or_dropped_by_choice(folder, monkeypatch, block):
    monkeypatch.setattr(tables, "BLOCK", block)
    arrays = scene()
    lost = np.arange(N) % 3 == 1
    arrays["pose"][lost, 2] = np.inf
    path = save(folder, "npz", arrays)
    ((plan, found),) = convert(path)
    np.testing.assert_array_equal(np.isnan(found["poses/initial"]).all(axis=1), lost)
    assert plan.scans_with_pose == int((~lost).sum())
    ((plan, found),) = convert(path, drop_without_pose=True)
    np.testing.assert_array_equal(found["scans/ranges"], np.float32(arrays["ranges"][~lost]))
    np.testing.assert_array_equal(found["commands/velocity"], arrays["cmd"][~lost])
    assert plan.scans_out == len(found["scans/ranges"])
    with pytest.raises(RecordingError, match="no scan has a pose"):
        convert(path, drop_without_pose=True, poses="none")


def test_poses_may_come_from_a_pose_file(folder):
    arrays = scene()
    (folder / "truth.txt").write_text("1000.0 0 0 0 0 0 0 1\n1010.0 10 0 0 0 0 0 1\n")
    path = save(folder, "csv", arrays)
    ((plan, found),) = convert(path, poses=str(folder / "truth.txt"))
    np.testing.assert_allclose(found["poses/initial"][:, 0], arrays["t"] - 1000, atol=1e-6)
    assert plan.pose_source == "TUM trajectory truth.txt"
    np.savez(folder / "a.npz", ranges=arrays["ranges"])
    without = describe(folder, "data: a.npz\nranges: ranges\n")
    with pytest.raises(InvalidInputError, match="needs the stamps of the scans"):
        convert(without, poses=str(folder / "truth.txt"))


def test_options_win_over_the_description(folder):
    path = save(folder, "npz", scene())
    path.write_text(path.read_text() + "environment: a\nrecording: b\nlicense: CC0\n")
    ((plan, found),) = convert(path)
    header = plan.header
    assert (header.sequence_id, header.license) == ("a--b--six", "CC0")
    mount = (1.0, 2.0, 0.0, 0.0, 0.0, 0.5)
    ((plan, found),) = convert(
        path, environment="c", recording="d", license="MIT", mount=mount, velocity="none"
    )
    header = plan.header
    assert (header.sequence_id, header.license) == ("c--d--six", "MIT")
    assert header.lidar.base_T_lidar == mount
    assert "commands/velocity" not in found
    with pytest.raises(InvalidInputError, match="--stamps: has no meaning for a table"):
        convert(path, stamps="record")
    with pytest.raises(RecordingError, match="hokuyo-utm-30lx-ew has 1081 beams, but the ranges 6"):
        convert(path, lidar="hokuyo")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"pose": np.ones((N, 2))}, "poses: expected 3 numbers a scan, found 2"),
        ({"label": np.ones((N, B - 1))}, r"labels: expected \(40, 6\) as the ranges"),
        ({"ranges": np.ones((0, B)), "t": np.ones(0), "pose": np.ones((0, 3)),
          "cmd": np.ones((0, 2))}, "expected scans, found none"),
    ],
)  # fmt: skip
def test_data_that_do_not_fit_their_description_are_refused(folder, change, problem):
    with pytest.raises(RecordingError, match=problem):
        convert(save(folder, "npz", scene() | change))


def test_data_that_are_not_there_are_refused(folder):
    with pytest.raises(RecordingError, match="data: expected a file or folder, found none"):
        TableSource(describe(folder, "data: nowhere.npz\nranges: r\n"))
    with pytest.raises(RecordingError, match="expected a folder of .npy, a .npz or a .csv"):
        TableSource(describe(folder, "data: layout.yaml\nranges: r\n"))
    with pytest.raises(FileNotFoundError):
        TableSource(folder / "absent.yaml")


def test_arrays_without_a_description_are_answered_with_an_example(folder):
    np.savez(folder / "run.npz", ranges=np.ones((2, 3)))
    with pytest.raises(
        RecordingError, match="need a description; save this as layout.yaml"
    ) as told:
        TableSource(folder / "run.npz")
    assert example_description() in str(told.value)
    assert is_table(folder / "run.npz")
    assert not is_table(folder)
    assert not is_table(describe(folder, "data: run.npz\n"))


def test_the_page_on_tables_shows_the_example():
    page = (PROJECT / "docs" / "converting" / "tables.md").read_text(encoding="utf-8")
    shown = page.split("```yaml\n")[1].split("```")[0]
    assert shown in example_description()


def test_a_file_that_changes_while_it_is_read_is_noticed(folder):
    path = save(folder, "csv", scene())
    (plan,) = TableSource(path).plans(Options())
    with (folder / "run.csv").open("a") as stream:
        stream.write((folder / "run.csv").read_text().splitlines()[1] + "\n")
    with pytest.raises(RecordingError, match="expected 40 scans, found 41: the data changed"):
        list(plan.blocks())
