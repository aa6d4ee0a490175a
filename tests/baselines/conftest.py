from __future__ import annotations

from pathlib import Path

import pytest
import torch

from baselines.checkpoints import Checkpoint, save_checkpoint
from baselines.onnx_export import export_onnx
from tests.baselines.generated import make_checkpoint
from tests.generators import SMALL_LIDAR

# test processes run side by side: threads of one would wait for cores that another holds
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def small_checkpoint() -> Checkpoint:
    """An S3-Net for scans of `SMALL_LIDAR`; do not change it."""
    return make_checkpoint(SMALL_LIDAR)


@pytest.fixture(scope="session")
def small_run(small_checkpoint: Checkpoint, tmp_path_factory) -> Path:
    """The folder of that model."""
    folder = tmp_path_factory.mktemp("run")
    save_checkpoint(folder, small_checkpoint)
    return folder


@pytest.fixture(scope="session")
def small_onnx(small_checkpoint: Checkpoint, tmp_path_factory) -> Path:
    """That model as an ONNX file; do not change it."""
    path = tmp_path_factory.mktemp("onnx") / "model.onnx"
    export_onnx(small_checkpoint, path)
    return path
