"""Single messages, serialised and read back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from conversion.exports.mcap_messages import MULTI_ARRAYS, cloud_dtype, open_mcap
from semantic2d_dataset.scene.geometry import rotation_matrix
from tests.conversion.exports.sequences import any_bits

STORE = get_typestore(Stores.ROS2_HUMBLE)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    with open_mcap(tmp_path_factory.mktemp("bag") / "any", ()) as writer:
        yield writer
        writer.send("/end", writer.text("end"), 0)


@pytest.mark.parametrize("dtype", MULTI_ARRAYS)
@pytest.mark.parametrize("shape", [(7,), (3, 4), (1, 3, 3), (0, 4)])
def test_arrays_keep_their_bits_and_shapes(dtype, shape, bag):
    rows = any_bits(np.random.default_rng(1), shape, dtype)
    message = bag.rows(rows)
    assert message.__msgtype__ == MULTI_ARRAYS[dtype]
    raw = STORE.serialize_cdr(message, message.__msgtype__)
    found = STORE.deserialize_cdr(raw, message.__msgtype__)
    sizes = [dim.size for dim in found.layout.dim]
    assert sizes == list(shape)
    assert [dim.stride for dim in found.layout.dim] == [
        int(np.prod(shape[i:])) for i in range(len(shape))
    ]
    assert found.data.tobytes() == rows.tobytes()


@given(angles=st.tuples(*[st.floats(-4, 4)] * 3))
def test_quaternions_turn_as_rotation_matrices(angles, bag):
    q = bag.turn(*angles)
    assert q.x**2 + q.y**2 + q.z**2 + q.w**2 == pytest.approx(1)
    ahead = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y))
    left = (2 * (q.x * q.y - q.w * q.z), 1 - 2 * (q.x**2 + q.z**2), 2 * (q.y * q.z + q.w * q.x))
    matrix = rotation_matrix(*angles)
    np.testing.assert_allclose((ahead, left), matrix.T[:2], atol=1e-9)


@pytest.mark.parametrize("stamp_ns", [0, 999_999_999, 1_700_000_000_123_456_789, 2**31 * 10**9 - 1])
def test_stamps_keep_their_nanoseconds(stamp_ns, bag):
    time = bag.time(stamp_ns)
    assert time.sec * 10**9 + time.nanosec == stamp_ns
    STORE.serialize_cdr(time, time.__msgtype__)


def test_fields_of_points_stay_where_they_are_when_others_are_absent():
    whole, part = cloud_dtype(()), cloud_dtype(("intensity", "confidence"))
    assert whole.itemsize == part.itemsize == 24
    assert part.names == ("x", "y", "z", "rgb", "label")
    assert whole.fields["label"][1] == part.fields["label"][1] == 20


def test_messages_are_read_in_the_order_of_their_times(tmp_path):
    with open_mcap(tmp_path / "any", ()) as writer:
        for log_ns in (5, 3, 9):
            writer.send("/chat", writer.text(str(log_ns)), log_ns)
        assert writer.counts == {"/chat": 3}
    with Reader(tmp_path / "any") as reader:
        assert [stamp for _, stamp, _ in reader.messages()] == [3, 5, 9]
