"""The wheel, installed into an environment that holds nothing else."""

import os
import subprocess
import sys

import pytest

from tests.conftest import PROJECT


def run(*words, cwd, **extra):
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    return subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env=clean | extra,
        check=True,
        capture_output=True,
        text=True,
    ).stdout


@pytest.mark.long
def test_wheel_without_torch_makes_verifies_and_scores_the_embedded_data(tmp_path):
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps")
    run(*pip, "--wheel-dir", tmp_path, PROJECT, cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    run(sys.executable, "-m", "venv", "alone", cwd=tmp_path)
    python = tmp_path / "alone" / "bin" / "python"
    constraints = PROJECT / "constraints.txt"
    run(python, "-m", "pip", "install", "--quiet", "-c", constraints, wheel, cwd=tmp_path)
    semantic2d, home = python.parent / "semantic2d", {"SEMANTIC2D_HOME": str(tmp_path / "home")}
    assert "semantic2d-dataset" in run(semantic2d, "--version", cwd=tmp_path)
    said = run(semantic2d, "verify", "semantic2d-mini", "--full", cwd=tmp_path, **home)
    assert "no problem(s)" in said
    for command in ("convert", "salsa", "leaderboard"):
        assert "Usage" in run(semantic2d, command, "--help", cwd=tmp_path)
    code = "import importlib.util as u; assert not u.find_spec('torch')"
    run(python, "-c", code, cwd=tmp_path)
    code = "from semantic2d_dataset import Evaluator as E; print(E().update([1], [1]).confusion)"
    assert "1" in run(python, "-c", code, cwd=tmp_path)
