"""The wheel, installed into an environment that holds nothing else."""

import contextlib
import json
import os
import subprocess
import sys

import pytest

from tests.access.hosts import Host
from tests.conftest import PROJECT
from tests.pipeline.published import pack_archives, write_registry


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


@pytest.fixture(scope="module")
def semantic2d(tmp_path_factory):
    """The command of an environment that holds the wheel, what it requires, and nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps")
    run(*pip, "--wheel-dir", folder, PROJECT, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    run(sys.executable, "-m", "venv", "alone", cwd=folder)
    python = folder / "alone" / "bin" / "python"
    constraints = PROJECT / "constraints.txt"
    run(python, "-m", "pip", "install", "--quiet", "-c", constraints, wheel, cwd=folder)
    code = "import importlib.util as u; assert not u.find_spec('torch')"
    run(python, "-c", code, cwd=folder)
    return python.parent / "semantic2d"


@pytest.mark.long
def test_wheel_without_torch_makes_verifies_and_scores_the_embedded_data(semantic2d, tmp_path):
    home = {"SEMANTIC2D_HOME": str(tmp_path / "home")}
    assert "semantic2d-dataset" in run(semantic2d, "--version", cwd=tmp_path)
    said = run(semantic2d, "verify", "semantic2d-mini", "--full", cwd=tmp_path, **home)
    assert "no problem(s)" in said
    for command in ("convert", "salsa", "leaderboard"):
        assert "Usage" in run(semantic2d, command, "--help", cwd=tmp_path)
    code = "from semantic2d_dataset import Evaluator as E; print(E().update([1], [1]).confusion)"
    assert "1" in run(semantic2d.parent / "python", "-c", code, cwd=tmp_path)


@pytest.mark.long
def test_wheel_without_torch_downloads_converts_verifies_and_scores(semantic2d, tmp_path):
    home = {"SEMANTIC2D_HOME": str(tmp_path / "home")}
    with contextlib.closing(Host(pack_archives(tmp_path / "archives", scans=20))) as host:
        home["SEMANTIC2D_REGISTRY"] = str(write_registry(tmp_path / "registry.json", host))
        run(semantic2d, "download", "d", cwd=tmp_path, **home)
    assert "no problem(s)" in run(semantic2d, "verify", "d", "--full", cwd=tmp_path, **home)
    perfect = ("leaderboard", "sanity", "perfect", "--data", "d", "--scheme", "frame")
    run(semantic2d, *perfect, "--out", "perfect.h5", cwd=tmp_path, **home)
    score = ("score", "perfect.h5", "--data", "d", "--out", "result.json")
    run(semantic2d, *score, cwd=tmp_path, **home)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["mIoU"] == result["mCA"] == 1


@pytest.mark.long
def test_wheel_without_torch_says_how_to_install_it(semantic2d, tmp_path):
    code = "from semantic2d_dataset import load_dataset; load_dataset('semantic2d-mini')"
    with pytest.raises(subprocess.CalledProcessError) as raised:
        run(semantic2d.parent / "python", "-c", code, cwd=tmp_path)
    assert "pip install 'semantic2d-dataset[torch]'" in raised.value.stderr
