import numpy as np

from salsa import copying
from salsa.copying import copy_arrays
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from tests.generators import SMALL_LIDAR, make_arrays


def test_arrays_are_copied_whole_in_blocks_and_empty_ones_too(tmp_path, monkeypatch):
    monkeypatch.setattr(copying, "_BLOCK_BYTES", 1 << 12)
    arrays = make_arrays(150) | {
        "streams/imu/stamps_ns": np.zeros(0, np.int64),
        "streams/picture/data": np.arange(5000).astype(np.uint8),
    }
    header = SequenceHeader("lobby", "first", SMALL_LIDAR)
    with SequenceWriter(tmp_path / "source.h5", header) as writer:
        writer.append(arrays)
    with (
        SequenceReader(tmp_path / "source.h5") as reader,
        SequenceWriter(tmp_path / "copy.h5", header) as writer,
    ):
        copy_arrays(reader, writer, arrays)
    with SequenceReader(tmp_path / "copy.h5") as reader:
        for name, values in arrays.items():
            found = reader.read(name)
            assert found.dtype == values.dtype
            np.testing.assert_array_equal(found, values, err_msg=name)
