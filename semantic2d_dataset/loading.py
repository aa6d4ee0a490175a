"""From the name of a data set to scans that a model trains on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semantic2d_dataset.access.installed import is_installed, read_record
from semantic2d_dataset.access.known_datasets import find_known
from semantic2d_dataset.access.registry import OpenDataset, open_dataset
from semantic2d_dataset.access.torch_datasets import LidarDataset, load_lidar
from semantic2d_dataset.access.torch_lidars import CombinedLidars
from semantic2d_dataset.errors import DatasetNotFoundError


def load_dataset(
    name: str | Path,
    *,
    lidar: str,
    split: str | None = "train",
    download: bool = False,
    version: str | None = None,
    registry: Path | str | None = None,
    **options: Any,
) -> LidarDataset:
    """Load one lidar's scans of one split of a data set.

    Parameters
    ----------
    name
        ``semantic2d-mini`` (made on first use), a data set that is installed, or the folder of
        one; as for `open_dataset`.
    lidar
        ``hokuyo``, ``wlr716``, ``rplidar``, or any name that the data set uses.
    split
        ``train``, ``val`` (or ``dev``), ``test``; None takes every scan.
    download
        Whether what is not installed is downloaded and installed first, as ``semantic2d
        download NAME --lidar LIDAR`` does.
    version, registry
        As for `open_dataset`.
    options
        As for `LidarDataset`.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError, CorruptFileError
        As from `open_dataset` and `LidarDataset`.
    DownloadError, OfflineError, ChecksumError, RecordingError, WriteError
        As from `semantic2d_dataset.pipeline.installation.install`.

    Examples
    --------
    >>> train = load_dataset("semantic2d-mini", lidar="hokuyo", features="RIA")  # doctest: +SKIP
    """
    data = _open(name, [lidar], download=download, version=version, registry=registry)
    return load_lidar(data, lidar=lidar, split=split, **options)


def load_lidars(
    name: str | Path,
    lidars: Sequence[str] | None = None,
    *,
    split: str | None = "train",
    download: bool = False,
    version: str | None = None,
    registry: Path | str | None = None,
    **options: Any,
) -> CombinedLidars:
    """Load the scans of several lidars of one split of a data set, on one grid of bearings.

    Parameters
    ----------
    lidars
        Ids or short names; all that it has where not given.
    name, split, download, version, registry
        As for `load_dataset`.
    options
        As for `CombinedLidars`.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError, CorruptFileError
        As from `open_dataset` and `CombinedLidars`.
    DownloadError, OfflineError, ChecksumError, RecordingError, WriteError
        As from `semantic2d_dataset.pipeline.installation.install`.

    Examples
    --------
    >>> train = load_lidars("semantic2d-mini", features="RA", grid="union")  # doctest: +SKIP
    """
    data = _open(name, lidars or (), download=download, version=version, registry=registry)
    return CombinedLidars(data, lidars=lidars, split=split, **options)


def _open(
    name: str | Path,
    lidars: Sequence[str],
    *,
    download: bool,
    version: str | None,
    registry: Path | str | None,
) -> OpenDataset:
    """Open a data set that has the lidars, downloading it first where that is wished."""
    if (
        download
        and not isinstance(name, Path)
        and not (version is None and is_installed(Path(name)))
    ):
        from semantic2d_dataset.pipeline.installation import install

        known = find_known(name if version is None else f"{name}@{version}", registry)
        data = install(known, lidars=lidars).data
    else:
        data = open_dataset(name, version=version, registry=registry)
    for lidar in lidars:
        _check_lidar(data, lidar)
    return data


def _check_lidar(data: OpenDataset, lidar: str) -> None:
    record = read_record(data.root)
    try:
        data.sequences(lidar)
    except DatasetNotFoundError as err:
        if record is None or record.lidars is None:
            raise
        raise DatasetNotFoundError(
            f"{err}; if it was published, get it with: semantic2d download {record.dataset} "
            f"--lidar {lidar} (load_dataset: download=True)"
        ) from err
