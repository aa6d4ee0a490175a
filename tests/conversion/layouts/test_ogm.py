import io
import math
import zipfile

import numpy as np
import pytest

from conversion.layouts import ogm
from conversion.layouts.ogm import TURTLEBOT2, OgmSource, is_ogm
from conversion.options import Options
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from tests.conversion.layouts.test_trees import pack

BEAMS = 1080
SIZES = {"train": 7, "val": 3, "test": 4}


def ranges_of(split):
    rng = np.random.default_rng(len(split))
    return np.round(rng.uniform(0.2, 29, (SIZES[split], BEAMS)), 3)


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def layout(prefix="", splits=SIZES):
    """Files of a small stand-in for OGM-Turtlebot2."""
    files = {}
    for split in splits:
        scans = ranges_of(split)
        names = [f"{i:07d}.npy" for i in range(len(scans))]
        for name, i in zip(names, range(len(scans)), strict=True):
            arrays = {
                "scans": scans[i],
                "positions": np.array([i, 2.0 * i, 0.1 * i]),
                "velocities": np.array([0.5, -0.1 * i]),
            }
            for kind, array in arrays.items():
                files[f"{prefix}{split}/{kind}/{name}"] = npy(array)
        listed = "".join(f"{name}\n" for name in names).encode()
        for kind in ("scans", "positions", "velocities"):
            files[f"{prefix}{split}/{kind}/{split}.txt"] = listed
    return files


def convert(path, **options):
    with OgmSource(path) as source:
        plans = source.plans(Options(**options))
        blocks = [list(plan.blocks()) for plan in plans]
    arrays = [{n: np.concatenate([b[n] for b in some]) for n in some[0]} for some in blocks]
    return {p.header.recording: (p, a) for p, a in zip(plans, arrays, strict=True)}


@pytest.mark.parametrize("ending", ["", ".zip", ".tar.gz"])
def test_each_folder_of_a_split_becomes_a_sequence(tmp_path, ending):
    inside = "OGM-datasets/OGM-Turtlebot2/"
    files = layout(inside) | {"OGM-datasets/ReadMe.txt": b"hello"}
    found = convert(pack(tmp_path / f"download{ending}", files))
    assert sorted(found) == ["test", "train", "val"]
    for split, (plan, arrays) in found.items():
        assert plan.header.sequence_id == f"ogm-turtlebot2--{split}--turtlebot2-1080"
        np.testing.assert_array_equal(arrays["scans/ranges"], np.float32(ranges_of(split)))
        i = np.arange(SIZES[split])
        expected = np.column_stack((i, 2.0 * i, 0.1 * i))
        np.testing.assert_array_equal(arrays["poses/initial"], expected)
        np.testing.assert_allclose(arrays["commands/velocity"][:, 1], -0.1 * i)
        np.testing.assert_array_equal(arrays["scans/stamps_ns"], i * 50_000_000)
        assert plan.header.stamps_source == "synthetic"
        assert plan.scans_with_pose == plan.scans_in == len(i)


@pytest.mark.parametrize("below", ["", "OGM-Turtlebot2", "OGM-Turtlebot2/val"])
def test_any_folder_at_or_above_them_will_do(tmp_path, below):
    root = pack(tmp_path / "OGM-datasets", layout("OGM-Turtlebot2/"))
    found = convert(root / below)
    assert sorted(found) == (["val"] if below.endswith("val") else ["test", "train", "val"])
    plan, _ = found["val"]
    assert plan.header.environment == "ogm-turtlebot2"


def test_its_own_lists_are_kept_and_say_the_split(tmp_path):
    files = layout()
    found = convert(pack(tmp_path / "x", files))
    names = {"train": ("train", 0), "val": ("dev", 1), "test": ("test", 2)}
    for split, (name, code) in names.items():
        plan, _ = found[split]
        assert plan.lists == {name: files[f"{split}/scans/{split}.txt"]}
        np.testing.assert_array_equal(plan.members, np.full(SIZES[split], code))


def test_odd_lists_are_told(tmp_path):
    files = layout(splits=["train"])
    files["train/scans/train.txt"] = b"../scans/0000003.npy\r\n0000001.npy\n0000099.npy\n\n"
    plan, _arrays = convert(pack(tmp_path / "x", files))["train"]
    np.testing.assert_array_equal(plan.members, [255, 0, 255, 0, 255, 255, 255])
    assert plan.lists["train"] == files["train/scans/train.txt"]
    told = "; ".join(plan.notices)
    assert "train/scans/train.txt names 1 scans that are not there" in told
    assert "differs from the lists of positions or velocities" in told
    assert "5 scans are in no list" in told


def test_without_lists_there_is_no_split(tmp_path):
    files = {n: c for n, c in layout(splits=["test"]).items() if n.endswith(".npy")}
    plan, _ = convert(pack(tmp_path / "x", files))["test"]
    assert plan.lists == {}
    assert plan.members is None


def test_beams_cover_270_degrees_and_30_m_is_no_return(tmp_path):
    files = layout(splits=["val"])
    scan = ranges_of("val")[0]
    scan[:6] = [30.0, np.inf, np.nan, 0.0, -np.inf, 29.999]
    files["val/scans/0000000.npy"] = npy(scan)
    plan, arrays = convert(pack(tmp_path / "x", files))["val"]
    expected = np.float32([np.inf, np.inf, np.nan, 0.0, -np.inf, 29.999])
    np.testing.assert_array_equal(arrays["scans/ranges"][0, :6], expected)
    bearings = plan.header.lidar.bearings
    assert math.degrees(bearings[0]) == pytest.approx(-135)
    assert math.degrees(bearings[-1]) == pytest.approx(135)
    _, arrays = convert(tmp_path / "x", no_return=(0.0,))["val"]
    assert arrays["scans/ranges"][0, 3] == np.inf


def test_scans_are_in_the_order_of_their_numbers(tmp_path):
    files = {}
    for i in (2, 10, 1):
        files[f"a/scans/{i}.npy"] = npy(np.full(BEAMS, float(i)))
        files[f"a/positions/{i}.npy"] = npy(np.zeros(3))
    _, arrays = convert(pack(tmp_path / "x", files))["a"]
    np.testing.assert_array_equal(arrays["scans/ranges"][:, 0], [1, 2, 10])


@pytest.mark.parametrize("block", [1, 3, 512])
def test_missing_positions_leave_a_pose_unknown(tmp_path, monkeypatch, block):
    monkeypatch.setattr(ogm, "BLOCK", block)
    files = layout(splits=["train"])
    del files["train/positions/0000002.npy"]
    files["train/positions/0000004.npy"] = npy(np.array([1.0, np.nan, 0.0]))
    path = pack(tmp_path / "x", files)
    plan, arrays = convert(path)["train"]
    lost = np.isnan(arrays["poses/initial"]).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(lost), [2, 4])
    assert "1 scans have no positions: NaN" in plan.notices
    plan, arrays = convert(path, drop_without_pose=True)["train"]
    kept = ranges_of("train")[[0, 1, 3, 5, 6]]
    np.testing.assert_array_equal(arrays["scans/ranges"], np.float32(kept))
    assert len(plan.members) == plan.scans_out == 5


def test_other_robots_need_their_lidar_named(tmp_path):
    files = {}
    for i in range(3):
        files[f"OGM-Jackal/test_library2pond/scans/{i}.npy"] = npy(np.full(5, 1.0 + i))
        files[f"OGM-Jackal/test_library2pond/positions/{i}.npy"] = npy(np.zeros(3))
    path = pack(tmp_path / "x", files)
    with pytest.raises(RecordingError, match="expected the 1080 beams .*found 5; pass --lidar"):
        convert(path)
    lidar = tmp_path / "five.yaml"
    lidar.write_text(
        "name: five\nmodel: m\nbeams: 5\nangle_min: -1\nangle_increment: 0.5\nrange_min: 0\n"
        "range_max: 9\n"
    )
    plan, arrays = convert(path, lidar=str(lidar), mount=(1, 0, 0, 0, 0, 0))["test-library2pond"]
    assert plan.header.sequence_id == "ogm-jackal--test-library2pond--five"
    assert plan.header.lidar.base_T_lidar[0] == 1
    assert "commands/velocity" not in arrays


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("train/scans/0000003.npy", npy(np.ones(9)), "expected 1080 numbers, found (9,)"),
        ("train/scans/0000003.npy", npy(np.ones(BEAMS))[:-8], "truncated"),
        ("train/scans/0000003.npy", npy(np.array([None])), "pickled"),
        ("train/scans/0000003.npy", npy(np.full(BEAMS, "a")), "expected 1080 numbers"),
        ("train/positions/0000003.npy", npy(np.ones(2)), "expected 3 numbers, found (2,)"),
        ("train/velocities/0000003.npy", b"", "empty"),
    ],
)
def test_a_damaged_array_is_refused_with_its_name(tmp_path, name, content, problem):
    path = pack(tmp_path / "x", layout(splits=["train"]) | {name: content})
    with pytest.raises(RecordingError) as told:
        convert(path)
    assert name in str(told.value)
    assert problem in str(told.value)


def test_options_name_the_sequences(tmp_path):
    path = pack(tmp_path / "x", layout())
    found = convert(path, environment="lobby", recording="run", license="MIT", velocity="none")
    assert sorted(found) == ["run-test", "run-train", "run-val"]
    plan, arrays = found["run-train"]
    assert plan.header.environment == "lobby"
    assert plan.header.license == "MIT"
    assert "commands/velocity" not in arrays
    assert sorted(convert(path / "train", recording="run")) == ["run"]


def test_options_that_need_stamps_or_intensities_are_refused(tmp_path):
    path = pack(tmp_path / "x", layout(splits=["val"]))
    with pytest.raises(InvalidInputError, match="--reverse-intensities: has no meaning"):
        convert(path, reverse_intensities=True)
    with pytest.raises(RecordingError, match="no stamps to find poses by"):
        convert(path, poses="truth.txt")
    plan, _ = convert(path, poses="none")["val"]
    assert (plan.scans_with_pose, plan.pose_source) == (0, "none")


def test_another_tree_is_no_ogm(tmp_path):
    assert is_ogm(layout())
    assert is_ogm(["scans/1.npy", "positions/1.npy"])
    assert not is_ogm(["a/scans/1.npy", "b/positions/1.npy"])
    assert not is_ogm(["a/scans_lidar/1.npy", "a/positions/1.npy"])
    path = pack(tmp_path / "x", {"a/b.txt": b""})
    with pytest.raises(RecordingError, match=r"expected folders such as train/.*found a/b.txt"):
        OgmSource(path)


def test_an_archive_needs_no_folder_above(tmp_path):
    path = tmp_path / "My OGM.v2.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in layout(splits=["val"]).items():
            archive.writestr(name.removeprefix("val/"), content)
    ((recording, (plan, _)),) = convert(path).items()
    assert recording == "my-ogm"
    assert plan.header.lidar == TURTLEBOT2
    with OgmSource(path) as source:
        assert list(source.files()) == [path]
