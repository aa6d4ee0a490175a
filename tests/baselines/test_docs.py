"""What docs/robot.md shows in Python works as it stands there."""

import re
import subprocess
import sys
from pathlib import Path

from baselines.onnx_export import export_onnx
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from tests.baselines.generated import make_checkpoint
from tests.conftest import PROJECT
from tests.generators import make_sequence

TEXT = (PROJECT / "docs" / "robot.md").read_text(encoding="utf-8")


def test_the_examples_label_scans(tmp_path: Path, monkeypatch):
    export_onnx(make_checkpoint(HOKUYO_UTM_30LX_EW), tmp_path / "model.onnx")
    make_sequence(tmp_path / "recording.h5", 20, lidar=HOKUYO_UTM_30LX_EW)
    monkeypatch.setenv("PYTHONPATH", str(PROJECT))
    code = "\n".join(re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL))
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    people, unsure, logits = done.stdout.splitlines()
    assert re.fullmatch(r"\d+ beams on people", people)
    assert re.fullmatch(r"\d+ beams to be careful with", unsure)
    assert logits.endswith("(1, 1, 10, 1081)")
