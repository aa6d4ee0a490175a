"""The arrays of a whole data set as Dask arrays, for analyses beyond memory or one machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader

if TYPE_CHECKING:
    import dask.array

_POSES = "poses"
_ARRAYS = ("scans/ranges", "scans/intensities", "scans/labels", "scans/confidence")


def dask_arrays(
    data: OpenDataset | str | Path, lidar: str, *, chunks_in_block: int = 16
) -> dict[str, dask.array.Array]:
    """Return every scan of one lidar as lazy arrays, in the order of `scan_table`.

    Nothing is read but headers. A task opens the file that it reads, and closes it: no handle
    travels, so that threads, processes and the workers of a cluster that see the same files may
    compute.

    Parameters
    ----------
    data
        An open data set, its folder, or its name.
    lidar
        Id or short name of the lidar.
    chunks_in_block
        How many chunks of 64 scans of a file make a block of an array.

    Returns
    -------
    ``ranges`` (N, B) f4 m, ``stamps_ns`` (N,) i8, ``poses`` (N, 3) f8 x y yaw, NaN where
    unknown; ``intensities`` (N, B) f4, ``labels`` and ``confidence`` (N, B) u1 where every
    sequence has them.

    Raises
    ------
    ImportError
        If the extra ``dask`` is not installed.
    DatasetNotFoundError, CorruptFileError
        If the data set or the lidar is not there, or a file is damaged.
    InvalidInputError
        If sequences of the lidar differ in their beams, or a block would have no chunk.
    """
    try:
        import dask.array as da
        from dask import delayed
    except ImportError as err:
        raise ImportError(
            "dask_arrays needs Dask: pip install 'semantic2d-dataset[dask]'", name="dask"
        ) from err

    if chunks_in_block < 1:
        raise InvalidInputError(f"chunks_in_block: expected 1 or more, found {chunks_in_block}")
    opened = data if isinstance(data, OpenDataset) else open_dataset(data)
    readers = [opened.reader(entry.id) for entry in opened.sequences(lidar)]
    beams = readers[0].lidar.beams
    for reader in readers:
        reader.close()
        if reader.lidar.beams != beams:
            raise InvalidInputError(
                f"{reader.path}: expected {beams} beams as in {readers[0].path}, found "
                f"{reader.lidar.beams}"
            )
    found: dict[str, tuple[tuple[int, ...], Any]] = {
        "scans/stamps_ns": ((), np.int64),
        _POSES: ((3,), np.float64),
    }
    for name in _ARRAYS:
        if all(name in reader for reader in readers):
            dtype = np.uint8 if name in ("scans/labels", "scans/confidence") else np.float32
            found[name] = ((beams,), dtype)
    step, read = chunks_in_block * CHUNK_ROWS, delayed(read_rows, pure=True)
    arrays = {}
    for name, (width, dtype) in found.items():
        blocks = [
            da.from_delayed(
                read(str(reader.path.resolve()), name, start, min(start + step, len(reader))),
                (min(step, len(reader) - start), *width),
                dtype,
            )
            for reader in readers
            for start in range(0, len(reader), step)
        ]
        arrays[name.removeprefix("scans/")] = da.concatenate(blocks)
    return arrays


def read_rows(path: str, name: str, start: int, stop: int) -> NDArray[Any]:
    """Open a sequence, read rows of an array, or the best poses, and close it."""
    with SequenceReader(Path(path)) as reader:
        return reader.read_poses(start, stop) if name == _POSES else reader.read(name, start, stop)
