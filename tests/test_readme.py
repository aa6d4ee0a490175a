"""What the README shows works as it stands there."""

import re
import subprocess
import sys

import pytest
import torch

from tests.conftest import PROJECT

README = (PROJECT / "README.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("mini")
def test_the_ten_lines_train_and_the_score_follows(capsys):
    torch.manual_seed(0)
    training, scoring = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len([line for line in training.splitlines() if line]) == 10
    names: dict[str, object] = {}
    exec(training, names)
    exec(scoring, names)
    miou = float(capsys.readouterr().out.split()[0])
    assert miou == names["result"]["mIoU"]
    assert miou > 0.06  # Wall everywhere gives about 0.04
    assert names["loss"].item() < 2.0  # ln 10 is 2.3


def test_every_command_shown_exists():
    shown = set(re.findall(r"^semantic2d (\w+(?: [a-z]+)?)", README, re.MULTILINE))
    assert {"convert my", "salsa label", "baseline train"} <= shown
    for words in shown:
        known = [w for w in words.split() if w not in ("my", "labelled", "runs", "recording")]
        done = subprocess.run(
            [sys.executable, "-m", "semantic2d_dataset.cli", *known, "--help"],
            capture_output=True,
            text=True,
            check=False,
            cwd=PROJECT,
        )
        assert done.returncode == 0, words


def test_every_page_linked_exists():
    for page in re.findall(r"\]\((docs/[^)#]+)\)", README):
        assert (PROJECT / page).is_file(), page
