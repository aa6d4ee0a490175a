from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from conversion.messages.recordings import TransformSample
from conversion.messages.transforms import Transforms
from conversion.ros.wire import transforms_cdr
from semantic2d_dataset.scene.geometry import rotation_matrix
from tests.conversion.recordings import START_NS, Recording

SECOND = 10**9


def tree(*edges) -> Transforms:
    """Edges are (topic, second, parent, child, xyz, rpy); recorded as stamped."""
    recording = Recording("db3")
    for topic, second, *rest in edges:
        recording.add_tf(START_NS + int(second * SECOND), *rest, topic=topic)
    return transforms_of(recording)


def transforms_of(recording: Recording) -> Transforms:
    transforms = Transforms()
    for topic, type_, record_ns, message in recording.messages:
        raw = bytes(recording.store.serialize_cdr(message, type_))
        for sample in transforms_cdr(raw, static=topic == "/tf_static"):
            transforms.add(sample, record_ns)
    return transforms


def at(*seconds: float) -> np.ndarray:
    return START_NS + (np.array(seconds) * SECOND).astype(np.int64)


def test_mount_is_the_product_of_the_static_chain():
    plate, upside_down = (0.1, 0.0, 0.2), (math.pi, 0.0, 0.4)
    found = tree(
        ("/tf_static", 0, "base_link", "plate", plate, (0.0, 0.0, math.pi / 2)),
        ("/tf_static", 0, "plate", "laser", (0.3, 0.0, 0.1), upside_down),
    ).mount("base_link", "laser")
    np.testing.assert_allclose(found[:3], (0.1, 0.3, 0.3), atol=1e-12)
    turn = rotation_matrix(0, 0, math.pi / 2) @ rotation_matrix(*upside_down)
    np.testing.assert_allclose(rotation_matrix(*found[3:]), turn, atol=1e-12)


def test_mount_is_found_against_the_direction_of_an_edge():
    found = tree(
        ("/tf_static", 0, "laser", "base_link", (0.2, 0.1, 0.0), (0.0, 0.0, math.pi / 2))
    ).mount("base_link", "laser")
    np.testing.assert_allclose(found, (-0.1, 0.2, 0, 0, 0, -math.pi / 2), atol=1e-12)


def test_mount_published_again_and_again_on_tf_is_a_mount():
    edges = [("/tf", n, "/base_link", "/laser", (0.1, 0.0, 0.2)) for n in range(3)]
    assert tree(*edges).mount("base_link", "laser") == (0.1, 0.0, 0.2, 0.0, 0.0, 0.0)


def test_a_lidar_that_moves_on_its_base_has_no_mount():
    edges = [("/tf", n, "base_link", "laser", (0.1 * n, 0.0, 0.2)) for n in range(3)]
    assert tree(*edges).mount("base_link", "laser") is None


def test_frames_that_nothing_connects_have_no_chain():
    found = tree(("/tf", 0, "a", "b", (0, 0, 0)), ("/tf", 0, "c", "d", (0, 0, 0)))
    assert found.chain("a", "d") is None
    assert found.chain("a", "nowhere") is None
    assert found.chain("nowhere", "nowhere") is None
    assert found.chain("b", "a") == ("b", "a")


def test_a_cycle_of_frames_ends():
    found = tree(*(("/tf", 0, a, b, (0.0, 0.0, 0.0)) for a, b in ("ab", "bc", "ca")))
    assert found.chain("a", "c") == ("a", "c")
    assert found.chain("a", "x") is None


def test_base_is_the_named_frame_that_carries_the_lidar():
    edges = [
        ("/tf_static", 0, "one/base_link", "one/laser", (0, 0, 0)),
        ("/tf_static", 0, "two/base_footprint", "two/laser", (0, 0, 0)),
        ("/tf_static", 0, "two/base_footprint", "two/base_link", (0, 0, 0)),
    ]
    found = tree(*edges)
    assert found.base_of("two/laser") == "two/base_link"
    assert found.base_of("one/laser") == "one/base_link"
    assert tree(("/tf", 0, "odom", "base_footprint", (0, 0, 0))).base_of("x") == "base_footprint"
    assert tree(("/tf", 0, "odom", "robot", (0, 0, 0))).base_of("robot") is None


def test_poses_along_an_inverted_edge_are_those_of_the_edge():
    forward = [("/tf", n, "map", "base", (1.0 * n, 2.0, 0.0), (0.0, 0.0, 0.2)) for n in range(3)]
    there, _, _ = tree(*forward).poses(("map", "base"), at(0, 0.5, 2), "header", 1.0)
    np.testing.assert_allclose(there, [[0, 2, 0.2], [0.5, 2, 0.2], [2, 2, 0.2]], atol=1e-9)
    turned = [
        ("/tf", n, "base", "map", (0.0, -1.0 * n, 0.0), (0, 0, -math.pi / 2)) for n in range(3)
    ]
    found, _, _ = tree(*turned).poses(("map", "base"), at(0, 0.5, 2), "header", 1.0)
    expected = [[0, 0, math.pi / 2], [-0.5, 0, math.pi / 2], [-2, 0, math.pi / 2]]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_corrections_hold_beyond_their_samples_and_odometry_does_not():
    edges = [("/tf", n / 10, "odom", "base", (n / 10, 0.0, 0.0)) for n in range(11)]
    edges += [("/tf", n / 10, "map", "odom", (5.0, n / 10, 0.0)) for n in range(3, 8)]
    found, gap, _ = tree(*edges).poses(("map", "odom", "base"), at(-0.1, 0, 1, 1.1), "header", None)
    assert gap == 0.5
    assert np.isfinite(found).all(axis=1).tolist() == [False, True, True, False]
    np.testing.assert_allclose(found[1:3], [[5, 0.3, 0], [6, 0.7, 0]], atol=1e-9)


def test_a_constant_correction_holds_for_ever():
    edges = [("/tf", n, "odom", "base", (1.0 * n, 0.0, 0.0)) for n in range(9)]
    edges += [("/tf", 0, "map", "odom", (5.0, 0.0, 0.0))]
    found, _, _ = tree(*edges).poses(("map", "odom", "base"), at(7.5), "header", None)
    np.testing.assert_allclose(found, [[12.5, 0, 0]], atol=1e-9)


def test_a_robot_at_rest_has_poses_only_while_tf_says_so():
    edges = [("/tf", n / 10, "map", "base", (3.0, 4.0, 0.0), (0, 0, 1.0)) for n in range(5)]
    found, _, _ = tree(*edges).poses(("map", "base"), at(0.2, 3), "header", None)
    np.testing.assert_allclose(found[0], [3, 4, 1], atol=1e-9)
    assert np.isnan(found[1]).all()


def test_postdated_corrections_are_put_back_to_when_they_were_known():
    recording = Recording("db3")
    for n in range(21):
        ns = START_NS + n * SECOND // 10
        recording.add_tf(ns, "odom", "base", (0.1 * n, 0.0, 0.0))
        recording.add_tf(ns + SECOND, "map", "odom", (0.0, 0.1 * n, 0.0), record_ns=ns)
    transforms = transforms_of(recording)
    chain = ("map", "odom", "base")
    found, _, postdated = transforms.poses(chain, at(0.5, 1.25), "header", None)
    assert postdated == pytest.approx(1.0)
    np.testing.assert_allclose(found, [[0.5, 0.5, 0], [1.25, 1.25, 0]], atol=1e-9)
    by_record, _, postdated = transforms.poses(chain, at(0.5, 1.25), "record", None)
    assert postdated == 0
    np.testing.assert_allclose(by_record, found, atol=1e-9)


def test_a_chain_through_a_tilted_frame_is_not_level():
    tilt = (math.pi / 2, 0.0, 0.0)
    chain = ("map", "camera", "base")
    edges = [("/tf", 0, "map", "camera", (0, 0, 0), tilt), ("/tf", 0, "camera", "base", (0, 0, 0))]
    assert not tree(*edges).is_level(chain)
    assert tree(*reversed(edges)).is_level(("camera", "base"))


def test_transforms_that_are_not_finite_are_left_out():
    edges = [
        ("/tf", n, "map", "base", (math.nan if n == 1 else 1.0 * n, 0.0, 0.0)) for n in range(3)
    ]
    found, _, _ = tree(*edges).poses(("map", "base"), at(1), "header", None)
    np.testing.assert_allclose(found, [[1, 0, 0]], atol=1e-9)
    assert tree(("/tf", 0, "map", "base", (math.inf, 0.0, 0.0))).frames == ()


def test_a_mount_published_with_either_sign_of_its_quaternion_is_one_mount():
    recording = Recording("db3")
    for n in range(4):
        recording.add_tf(START_NS + n, "base_link", "laser", (0.1, 0.0, 0.2), (0.0, 0.0, 0.6))
        turn = recording.messages[-1][3].transforms[0].transform.rotation
        if n % 2:
            for name in "xyzw":
                object.__setattr__(turn, name, -getattr(turn, name))
    transforms = transforms_of(recording)
    found = transforms.mount("base_link", "laser")
    np.testing.assert_allclose(found, (0.1, 0, 0.2, 0, 0, 0.6), atol=1e-12)


def test_a_tree_of_many_edges_keeps_its_samples_aside(tmp_path, monkeypatch):
    monkeypatch.setattr("conversion.messages.spill.temporary_folder", lambda: str(tmp_path))
    monkeypatch.setattr("conversion.messages.spill._IN_MEMORY", 10_000)
    transforms = Transforms()
    edges = [("map", "odom"), ("odom", "base"), *(("base", f"joint {n}") for n in range(18))]
    tracemalloc.start()
    for n in range(2000):
        stamp = START_NS + n * 10_000_000
        for k, frames in enumerate(edges):
            values = (0.001 * n * (k > 0), 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
            transforms.add(TransformSample(stamp, *frames, values, static=False), stamp)
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < 700_000  # of the 2.9 MB that the samples have
    found, _, _ = transforms.poses(("map", "odom", "base"), at(10.005), "header", None)
    np.testing.assert_allclose(found, [[1.0005, 0, 0]], atol=1e-9)
    assert list(tmp_path.iterdir()) == []
