"""What is known of every scan of a data set, as a table of pandas."""

from __future__ import annotations

import io
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.schema import CHUNK_ROWS
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, VAL, SplitScheme
from semantic2d_dataset.format.writing import write_bytes_atomically, write_text_atomically
from semantic2d_dataset.scene.taxonomy import UNLABELLED

if TYPE_CHECKING:
    import pandas as pd

_BLOCK = 16 * CHUNK_ROWS
_SPLITS = {TRAIN: "train", VAL: "val", TEST: "test"}


def scan_table(
    data: OpenDataset | str | Path, *, lidar: str | None = None, beams: bool = True
) -> pd.DataFrame:
    """Return one row for each scan of a data set, in the order of the manifest.

    Parameters
    ----------
    data
        An open data set, its folder, or its name.
    lidar
        Id or short name of one lidar; all where not given.
    beams
        Read every beam, for the columns that count them; without them, a table of any size takes
        seconds.

    Returns
    -------
    Columns ``scan_id``, ``sequence_id``, ``environment``, ``recording``, ``lidar`` (categorical),
    ``index`` in the sequence, ``stamp`` (datetime64[ns]), ``x`` and ``y`` in m and ``yaw`` in rad
    (NaN where unknown); ``accepted``, ``residual_m`` and ``inlier_ratio`` of the alignment where a
    sequence has them; ``split_<scheme>`` for each scheme, ``train``, ``val``, ``test`` or NA
    (categorical). With `beams`: ``return_share`` of the beams, and ``beams_<class>``, how many
    beams with a return have that label.

    Raises
    ------
    DatasetNotFoundError, CorruptFileError
        If the data set or the lidar is not there, or a file is damaged.
    InvalidInputError
        If sequences differ in their classes.
    """
    import pandas as pd

    opened = data if isinstance(data, OpenDataset) else open_dataset(data)
    schemes = [opened.scheme(name) for name in sorted(opened.manifest.splits)]
    entries = opened.sequences(lidar)
    parts = []
    bar = tqdm(
        total=sum(entry.scans for entry in entries),
        desc="reading scans",
        unit="scan",
        disable=None,
        leave=False,
        delay=2,
    )
    names: tuple[str, ...] | None = None
    with bar:
        for entry in entries:
            with opened.reader(entry.id) as reader:
                found = reader.header.taxonomy.names
                if beams and found != (names or found):
                    raise InvalidInputError(
                        f"{reader.path}: its classes are {', '.join(found)}, those before "
                        f"{', '.join(names or ())}; take one lidar, or beams=False"
                    )
                names = found
                parts.append(pd.DataFrame(_columns_of(reader, schemes, bar, beams=beams)))
    table = pd.concat(parts, ignore_index=True)
    for name in ("sequence_id", "environment", "recording", "lidar"):
        table[name] = table[name].astype("category")
    for scheme in schemes:
        name = f"split_{scheme.name}"
        table[name] = pd.Categorical(table[name].map(_SPLITS), list(_SPLITS.values()))
    return table


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write a table as CSV, or as Parquet, which keeps types and needs pyarrow.

    Raises
    ------
    InvalidInputError
        If the name ends in neither ``.csv`` nor ``.parquet``, or pyarrow is not installed.
    WriteError
        If the file cannot be written.
    """
    check_table_name(path)
    if path.suffix == ".csv":
        write_text_atomically(path, table.to_csv(index=False))
        return
    content = io.BytesIO()
    table.to_parquet(content, index=False)
    write_bytes_atomically(path, content.getvalue())


def check_table_name(path: Path) -> None:
    """Check, before work is spent on a table, that it can be written under a name.

    Raises
    ------
    InvalidInputError
        If the name ends in neither ``.csv`` nor ``.parquet``, or pyarrow is not installed.
    """
    if path.suffix not in (".csv", ".parquet"):
        raise InvalidInputError(f"{path}: expected a name that ends in .csv or .parquet")
    if path.suffix == ".parquet" and find_spec("pyarrow") is None:
        raise InvalidInputError(f"{path}: Parquet needs pyarrow: pip install pyarrow, or give .csv")


def _columns_of(
    reader: SequenceReader, schemes: list[SplitScheme], bar: tqdm[Any], *, beams: bool
) -> dict[str, Any]:
    header, count = reader.header, len(reader)
    poses = reader.read_poses()
    columns: dict[str, Any] = {
        "scan_id": [f"{header.sequence_id}/{row}" for row in range(count)],
        "sequence_id": header.sequence_id,
        "environment": header.environment,
        "recording": header.recording,
        "lidar": header.lidar.name,
        "index": np.arange(count),
        "stamp": reader.read("scans/stamps_ns").view("datetime64[ns]"),
        **dict(zip(("x", "y", "yaw"), poses.T, strict=True)),
    }
    for name in ("accepted", "residual_m", "inlier_ratio"):
        if f"alignment/{name}" in reader:
            values = reader.read(f"alignment/{name}")
            columns[name] = values.astype(np.bool_) if name == "accepted" else values
    for scheme in schemes:
        none = np.full(count, NONE, np.uint8)
        columns[f"split_{scheme.name}"] = scheme.membership.get(header.sequence_id, none)
    if beams:
        columns |= _count_beams(reader, bar)
    else:
        bar.update(count)
    return columns


def _count_beams(reader: SequenceReader, bar: tqdm[Any]) -> dict[str, NDArray[Any]]:
    """Count returns and classes block by block."""
    from semantic2d_dataset.access.class_counts import count_classes

    names = reader.header.taxonomy.names
    parts = []
    for start in range(0, len(reader), _BLOCK):
        ranges = reader.read("scans/ranges", start, start + _BLOCK)
        labels = (
            reader.read("scans/labels", start, start + _BLOCK)
            if "scans/labels" in reader
            else np.full(ranges.shape, UNLABELLED, np.uint8)
        )
        parts.append(count_classes(ranges, labels, reader.lidar, len(names)))
        bar.update(len(ranges))
    counts, returns = (np.concatenate(each) for each in zip(*parts, strict=True))
    said = {f"beams_{name.lower().replace(' ', '_')}": counts[:, k] for k, name in enumerate(names)}
    return {"return_share": (returns / reader.lidar.beams).astype(np.float32)} | said
