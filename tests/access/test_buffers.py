import pickle

import numpy as np
import torch

from semantic2d_dataset.access.buffers import Buffers


def test_memory_is_used_again_when_nobody_holds_it():
    buffers = Buffers()
    first = buffers.take((3, 4), np.float32)
    address = first.ctypes.data
    del first
    assert buffers.take((3, 4), np.float32).ctypes.data == address


def test_memory_that_is_held_is_never_handed_out():
    buffers = Buffers()
    held = [buffers.take((3, 4), np.float32) for _ in range(50)]
    assert len({array.ctypes.data for array in held}) == 50


def test_a_tensor_a_slice_and_a_view_hold_their_memory():
    buffers = Buffers()
    tensor = torch.from_numpy(buffers.take((3, 4), np.float32))
    slice_of_tensor = torch.from_numpy(buffers.take((3, 4), np.float32))[1:]
    view = buffers.take((3, 4), np.float32)[:, 2]
    again = torch.from_numpy(buffers.take((3, 4), np.float32)).numpy()
    fresh = buffers.take((3, 4), np.float32)
    held = (tensor.numpy(), slice_of_tensor.numpy(), view, again)
    assert not any(np.shares_memory(fresh, other) for other in held)


def test_shape_and_dtype_are_as_asked_for():
    buffers = Buffers()
    buffers.take((3, 4), np.float32)
    for shape, dtype in (((4, 3), np.float32), ((3, 4), np.int64), ((3, 4), np.bool_)):
        array = buffers.take(shape, dtype)
        assert (array.shape, array.dtype) == (shape, dtype)


def test_copies_in_other_processes_start_empty():
    buffers = Buffers()
    buffers.take((1000, 1000), np.float32)
    assert len(pickle.dumps(buffers)) < 200
