from __future__ import annotations

import platform
import time
from pathlib import Path

import pytest
import torch

from baselines import speed
from baselines.s3net import S3Net
from baselines.speed import frames_per_second, processor_name
from semantic2d_dataset.errors import InvalidInputError
from tests.baselines.generated import make_scans


class Sleeper(S3Net):
    """A network that takes 20 ms for a pass, however many threads there are."""

    threads = 0

    def expected_logits(self, features):
        assert features.shape == (1, 3, 61)
        self.threads = torch.get_num_threads()
        time.sleep(0.02)
        return torch.zeros(1, 10, 61)


def test_the_rate_is_that_of_single_scans_and_threads_are_given_back(monkeypatch):
    monkeypatch.setattr(speed, "_SECONDS", 0.3)
    before, network = torch.get_num_threads(), Sleeper().eval()
    assert 25 < frames_per_second(network, make_scans(3, 61)[0], threads=before + 1) <= 50
    assert network.threads == before + 1
    assert torch.get_num_threads() == before


def test_many_samples_take_longer_than_one_pass(monkeypatch):
    monkeypatch.setattr(speed, "_SECONDS", 0.2)
    network, features = S3Net().eval(), make_scans(3, 1081)[0]
    assert frames_per_second(network, features, samples=64) < frames_per_second(network, features)


def test_no_scans_and_no_threads_are_refused():
    for features, threads in ((torch.zeros(0, 3, 61), 1), (torch.zeros(1, 3, 61), 0)):
        with pytest.raises(InvalidInputError, match="at least one scan and thread"):
            frames_per_second(S3Net().eval(), features, threads=threads)


def test_a_processor_has_the_name_that_the_kernel_tells_or_its_architecture(
    tmp_path: Path, monkeypatch
):
    info = tmp_path / "cpuinfo"
    info.write_text("processor\t: 0\nmodel name\t: Quick (R) 1.6 GHz: two\n")
    monkeypatch.setattr(speed, "_CPU_INFO", info)
    assert processor_name() == "Quick (R) 1.6 GHz: two"
    for text in ("", "model name:\n"):
        info.write_text(text)
        assert processor_name() in (platform.processor(), platform.machine())
    info.unlink()
    assert processor_name()
