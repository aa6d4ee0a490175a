"""S3-Net against plain eager PyTorch: a training step, and inference by 32 samples.

Each way runs in a process of its own, ours and the plain one in turn:

    python benchmarks/s3net_training.py [--rounds 3] [--batch 1024] [--threads 2]

The plain network is the published architecture as one would write it with Conv1d, the plain loss
sorts the errors of Lovasz-softmax, and plain inference runs the whole network once a sample.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn

BEAMS, CLASSES, SAMPLES = 1081, 10, 32


def residual() -> nn.Module:
    return nn.Sequential(
        nn.ReLU(),
        nn.Conv1d(64, 32, 3, padding=1, bias=False),
        nn.BatchNorm1d(32),
        nn.ReLU(),
        nn.Conv1d(32, 64, 1, bias=False),
        nn.BatchNorm1d(64),
    )


class PlainS3Net(nn.Module):
    """The published architecture with torch's 1D layers, for 1081 beams."""

    def __init__(self) -> None:
        super().__init__()
        self.down = nn.Sequential(
            nn.Conv1d(3, 32, 4, stride=2, padding=1),
            nn.BatchNorm1d(32),
            nn.ReLU(),
            nn.Conv1d(32, 64, 4, stride=2, padding=1),
            nn.BatchNorm1d(64),
        )
        self.encoder, self.decoder = (nn.ModuleList([residual(), residual()]) for _ in range(2))
        self.mean, self.log_sd = nn.Conv1d(64, 1, 1), nn.Conv1d(64, 1, 1)
        self.widen = nn.ConvTranspose1d(1, 64, 1)
        self.up = nn.Sequential(
            nn.ConvTranspose1d(64, 32, 4, stride=2, padding=1),
            nn.BatchNorm1d(32),
            nn.ReLU(),
            nn.ConvTranspose1d(32, 32, 4, stride=2, padding=1, output_padding=1),
            nn.BatchNorm1d(32),
            nn.ReLU(),
            nn.Conv1d(32, CLASSES, 3, padding=1),
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        h = self.down(x)
        for layer in self.encoder:
            h = h + layer(h)
        mean, log_sd = self.mean(h.relu()), self.log_sd(h.relu())
        z = mean + log_sd.exp() * torch.randn_like(mean)
        h = self.widen(z)
        for layer in self.decoder:
            h = h + layer(h)
        return self.up(h.relu()), z, mean, log_sd


def sorted_lovasz(probabilities: Tensor, labels: Tensor, weights: Tensor) -> Tensor:
    points = probabilities.permute(0, 2, 1).reshape(-1, CLASSES)
    total = torch.zeros(())
    for c in range(CLASSES):
        foreground = (labels.flatten() == c).float()
        errors, order = (foreground - points[:, c]).abs().sort(descending=True)
        hits = foreground[order].cumsum(0)
        misses = (1 - foreground[order]).cumsum(0)
        jaccard = 1 - (hits[-1] - hits) / (hits[-1] + misses)
        slopes = torch.diff(jaccard, prepend=torch.zeros(1))
        total = total + weights[c] * torch.dot(errors, slopes)
    return total


def batch_of(scans: int) -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    runs = (torch.rand(scans, BEAMS) < 0.03).cumsum(1)
    labels = torch.randint(0, CLASSES, (scans, BEAMS)).gather(1, runs)
    return torch.randn(scans, 3, BEAMS) + labels[:, None] / 3, labels


def plain_step(scans: int) -> Callable[[], object]:
    features, labels = batch_of(scans)
    network, weights = PlainS3Net(), torch.ones(CLASSES)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-4, weight_decay=1e-3)

    def step() -> None:
        optimiser.zero_grad()
        logits, z, mean, log_sd = network(features)
        entropy = nn.functional.cross_entropy(logits, labels, weights, reduction="sum") / scans
        lovasz = sorted_lovasz(logits.softmax(1), labels, weights)
        law = torch.distributions.Normal(mean, log_sd.exp(), validate_args=False)
        prior = torch.distributions.Normal(0.0, 1.0)
        divergence = (law.log_prob(z) - prior.log_prob(z)).sum() / scans
        (entropy + lovasz + 0.01 * divergence).backward()
        optimiser.step()

    return step


def tuned_plain_step(scans: int) -> Callable[[], object]:
    from baselines.steps import keep_freed_memory

    keep_freed_memory()
    return plain_step(scans)


def our_step(
    scans: int, micro_batch: int | None = None, *, bf16: bool = False
) -> Callable[[], object]:
    from baselines.s3net import S3Net
    from baselines.steps import keep_freed_memory, momentum_of_micro_batches, step

    keep_freed_memory()
    features, labels = batch_of(scans)
    network = S3Net()
    momentum_of_micro_batches(network, scans, micro_batch)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-4, weight_decay=1e-3, fused=True)
    batch, weights, betas = (
        {"features": features, "target": labels},
        torch.ones(CLASSES),
        (1, 1, 0.01),
    )
    return lambda: step(
        network, optimiser, batch, weights, betas=betas, micro_batch=micro_batch, bf16=bf16
    )


def plain_inference(scans: int) -> Callable[[], object]:
    features, _ = batch_of(scans)
    network = PlainS3Net().eval()

    @torch.inference_mode()
    def infer() -> Tensor:
        return torch.stack(
            [network(one.expand(SAMPLES, -1, -1))[0].argmax(1).mode(0).values for one in features]
        )

    return infer


def our_inference(scans: int) -> Callable[[], object]:
    from baselines.inference import infer
    from baselines.s3net import S3Net

    features, _ = batch_of(scans)
    network = S3Net().eval()
    return lambda: infer(network, features, samples=SAMPLES)


def measure(way: str, scans: int) -> float:
    """Scans per second, the median of three runs after one that warms up."""
    run = {
        "plain step": lambda: plain_step(scans),
        "plain step, tuned malloc": lambda: tuned_plain_step(scans),
        "our step": lambda: our_step(scans),
        "our step in 16 bits": lambda: our_step(scans, bf16=True),
        "our step in parts of 32": lambda: our_step(scans, 32),
        "our step in parts of 128": lambda: our_step(scans, 128),
        "plain inference": lambda: plain_inference(scans),
        "our inference": lambda: our_inference(scans),
    }[way]()
    run()
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return scans / statistics.median(seconds)


def compare(ways: tuple[str, ...], rounds: int, options: list[str]) -> None:
    rates: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(rounds):
        for way, found in rates.items():
            command = [sys.executable, __file__, "--way", way, *options]
            found.append(float(subprocess.run(command, check=True, capture_output=True).stdout))
    plain = statistics.median(rates[ways[0]])
    for way, found in rates.items():
        rate = statistics.median(found)
        print(f"{way}: {rate:.0f} scans/s, {rate / plain:.1f} times the plain one", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--batch", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--way")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    if given.way:
        print(measure(given.way, given.batch))
        return
    threads = ["--threads", str(given.threads)]
    ways = ("16 bits", "parts of 128", "parts of 32")
    plain = ("plain step", "plain step, tuned malloc")
    steps = (*plain, "our step", *(f"our step in {way}" for way in ways))
    compare(steps, given.rounds, [*threads, "--batch", str(given.batch)])
    compare(("plain inference", "our inference"), given.rounds, [*threads, "--batch", "32"])


if __name__ == "__main__":
    main()
