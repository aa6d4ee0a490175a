"""Semantic labels for 2D lidar scans: data sets, loading, labelling and scoring."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semantic2d_dataset.access.dask_arrays import dask_arrays
    from semantic2d_dataset.access.features import Statistics
    from semantic2d_dataset.access.histories import History
    from semantic2d_dataset.access.registry import OpenDataset, open_dataset
    from semantic2d_dataset.access.scan_tables import scan_table
    from semantic2d_dataset.access.torch_datasets import (
        WLR716,
        HokuyoUTM30LXEW,
        LidarDataset,
        RPLidarS2,
    )
    from semantic2d_dataset.access.torch_samplers import Shard
    from semantic2d_dataset.errors import Semantic2DError
    from semantic2d_dataset.format.manifest import Manifest, publish, read_manifest
    from semantic2d_dataset.format.sequence import (
        SequenceHeader,
        SequenceReader,
        SequenceWriter,
    )
    from semantic2d_dataset.format.splits import SplitScheme
    from semantic2d_dataset.loading import load_dataset, load_lidars
    from semantic2d_dataset.scene.geometry import Pose2
    from semantic2d_dataset.scene.lidars import LidarSpec
    from semantic2d_dataset.scene.maps import SemanticMap
    from semantic2d_dataset.scene.scans import Scan, ScanBatch
    from semantic2d_dataset.scene.taxonomy import Taxonomy
    from semantic2d_dataset.scoring.metrics import Evaluator

__version__ = "0.1.0"

# Names load when they are first used: neither torch nor numba slows an import down.
_HOMES = {
    "Evaluator": "scoring.metrics",
    "History": "access.histories",
    "HokuyoUTM30LXEW": "access.torch_datasets",
    "LidarDataset": "access.torch_datasets",
    "LidarSpec": "scene.lidars",
    "Manifest": "format.manifest",
    "OpenDataset": "access.registry",
    "Pose2": "scene.geometry",
    "RPLidarS2": "access.torch_datasets",
    "Scan": "scene.scans",
    "ScanBatch": "scene.scans",
    "Semantic2DError": "errors",
    "SemanticMap": "scene.maps",
    "SequenceHeader": "format.sequence",
    "SequenceReader": "format.sequence",
    "SequenceWriter": "format.sequence",
    "Shard": "access.torch_samplers",
    "SplitScheme": "format.splits",
    "Statistics": "access.features",
    "Taxonomy": "scene.taxonomy",
    "WLR716": "access.torch_datasets",
    "dask_arrays": "access.dask_arrays",
    "load_dataset": "loading",
    "load_lidars": "loading",
    "open_dataset": "access.registry",
    "publish": "format.manifest",
    "read_manifest": "format.manifest",
    "scan_table": "access.scan_tables",
}

__all__ = [
    "WLR716",
    "Evaluator",
    "History",
    "HokuyoUTM30LXEW",
    "LidarDataset",
    "LidarSpec",
    "Manifest",
    "OpenDataset",
    "Pose2",
    "RPLidarS2",
    "Scan",
    "ScanBatch",
    "Semantic2DError",
    "SemanticMap",
    "SequenceHeader",
    "SequenceReader",
    "SequenceWriter",
    "Shard",
    "SplitScheme",
    "Statistics",
    "Taxonomy",
    "dask_arrays",
    "load_dataset",
    "load_lidars",
    "open_dataset",
    "publish",
    "read_manifest",
    "scan_table",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    except ModuleNotFoundError as err:
        if err.name != "torch":
            raise
        raise ImportError(
            f"{name} needs PyTorch: pip install 'semantic2d-dataset[torch]'", name="torch"
        ) from err


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
