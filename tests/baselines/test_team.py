import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from baselines import training
from baselines.checkpoints import load_checkpoint
from baselines.configs import TrainingConfig
from baselines.s3net import S3Net
from baselines.steps import step
from baselines.team import Team
from baselines.training import validate
from semantic2d_dataset.errors import InvalidInputError
from tests.baselines.generated import ToyScans, make_scans
from tests.conftest import PROJECT

BETAS = (1.0, 1.0, 0.01)

# What each of two processes does: one step of a team, or a whole training.
STEP = """
import sys, torch
from baselines.team import join_team
from tests.baselines.test_team import gradients_of, make_network
with join_team(torch.device("cpu")) as team:
    for micro_batch in (None, 3):
        found = gradients_of(team, team.wrap(make_network()), micro_batch)
        torch.save(found, f"{sys.argv[1]}/{micro_batch}-{team.rank}.pt")
"""
TRAIN = """
import sys
from pathlib import Path
from baselines.configs import TrainingConfig
from baselines.training import train
from tests.baselines.generated import ToyScans
config = TrainingConfig(epochs=2, batch_size=9, learning_rate=5e-3)
print(train(config, ToyScans(40), ToyScans(8, seed=1), Path(sys.argv[1])).best_miou)
"""
TIMED = TRAIN.replace("learning_rate=5e-3", "time_limit_s=9.0")


def make_network() -> S3Net:
    """A network whose batch norms are as in evaluation, which look at one scan at a time."""
    torch.manual_seed(0)
    return S3Net().eval()


def gradients_of(team: Team, network: torch.nn.Module, micro_batch: int | None = None):
    features, target = make_scans(8, 61)
    torch.manual_seed(team.rank)
    step(
        network,
        torch.optim.SGD(network.parameters(), lr=0.0),
        team.share({"features": features, "target": target}),
        torch.ones(10),
        betas=BETAS,
        micro_batch=micro_batch,
    )
    return [parameter.grad for parameter in network.parameters()]


def free_port() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return str(probe.getsockname()[1])


def run_two(script: str, *arguments: object) -> list[subprocess.CompletedProcess]:
    """Run a script in two processes with what torchrun would set."""
    common = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": free_port()}
    common |= {"PYTHONPATH": str(PROJECT), "OMP_NUM_THREADS": "1"}
    running = [
        subprocess.Popen(
            [sys.executable, "-c", script, *map(str, arguments)],
            env=os.environ | common | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in (0, 1)
    ]
    out = [process.communicate(timeout=120) for process in running]
    return [
        subprocess.CompletedProcess((), process.returncode, *texts)
        for process, texts in zip(running, out, strict=True)
    ]


def test_a_team_shares_a_batch_without_loss_or_double():
    batch = {"x": torch.arange(7)}
    shares = [Team(rank, 3).share(batch)["x"].tolist() for rank in range(3)]
    assert sorted(scan for share in shares for scan in share) == list(range(7))


def test_two_processes_have_the_gradients_of_one_that_averages_both_halves(tmp_path: Path):
    done = run_two(STEP, tmp_path)
    assert not any(process.returncode for process in done), done[0].stderr
    for micro_batch in (None, 3):
        paths = [tmp_path / f"{micro_batch}-{rank}.pt" for rank in (0, 1)]
        found = [torch.load(path, weights_only=True) for path in paths]
        halves = [gradients_of(Team(rank, 2), make_network(), micro_batch) for rank in (0, 1)]
        for one, other, first, second in zip(*found, *halves, strict=True):
            assert torch.equal(one, other)
            torch.testing.assert_close(one, (first + second) / 2, rtol=1e-4, atol=1e-5)


def test_two_processes_train_one_model(tmp_path: Path):
    done = run_two(TRAIN, tmp_path)
    assert not any(process.returncode for process in done), done[0].stderr
    one, other = (float(process.stdout) for process in done)
    assert one == other
    assert len((tmp_path / "log.csv").read_text().splitlines()) == 3
    assert validate(load_checkpoint(tmp_path).network, ToyScans(8, seed=1)) == one


def test_a_team_refuses_a_time_limit(tmp_path: Path):
    done = run_two(TIMED, tmp_path)
    assert all(process.returncode for process in done)
    # the first to refuse is gone, perhaps before the other has found it
    assert any("2 processes cannot keep one time limit" in each.stderr for each in done)


@pytest.mark.parametrize(("scans", "batch_size"), [(2, 8), (8, 2)])
def test_a_team_that_a_batch_does_not_go_round_is_refused(scans: int, batch_size: int):
    config = TrainingConfig(batch_size=batch_size)
    with pytest.raises(InvalidInputError, match="too few for 3 processes"):
        training._check_team(Team(0, 3), config, scans)
    training._check_team(Team(0, 2), config, scans)


def test_batch_norms_of_a_team_forget_by_the_parts_of_one_share():
    config = TrainingConfig(batch_size=64, micro_batch=16)
    for size, momentum in ((4, 0.1), (2, 1 - 0.9 ** (1 / 2)), (1, 1 - 0.9 ** (1 / 4))):
        run = training._start(config, ToyScans(8), torch.device("cpu"), None, Team(0, size))
        norms = [m for m in run.network.modules() if isinstance(m, torch.nn.BatchNorm2d)]
        assert [norm.momentum for norm in norms] == pytest.approx([momentum] * 12)
