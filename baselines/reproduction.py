"""Run all trainings of a table of the paper, keep what each gave, and lay the table out.

Every run has a folder of its own and is done when its ``result.json`` is there; a run that was
killed goes on from its last epoch. Each trains and labels in one thread, because the number of
threads changes the rounding of floats, and with it the model.
"""

from __future__ import annotations

import contextlib
import io
import json
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import torch
from tqdm import tqdm

from baselines.architectures import build_network
from baselines.checkpoints import load_checkpoint
from baselines.configs import TrainingConfig, changed_settings
from baselines.detector_scores import score_detector
from baselines.detectors import DETECTORS
from baselines.evaluation import ALL_CLASSES, Evaluation, evaluate
from baselines.experiments import Experiment, Method, RunSpec
from baselines.inference import SAMPLES
from baselines.locks import alone_in
from baselines.training import train
from semantic2d_dataset.access.features import channel_count
from semantic2d_dataset.access.registry import open_dataset
from semantic2d_dataset.access.scan_source import ScanSource
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, LeakageWarning
from semantic2d_dataset.executors import open_executor
from semantic2d_dataset.format.container import load_json
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.loading import load_dataset
from semantic2d_dataset.scoring.metrics import percent
from semantic2d_dataset.scoring.published import ALL, METRICS, ClassFigures
from semantic2d_dataset.simulation.mini import combined_digest

_TASK, _RESULT = "run.json", "result.json"

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Settings:
    """What all runs of a reproduction share.

    Parameters
    ----------
    data
        Name of a data set, or its folder.
    scheme
        How it is divided.
    lidar
        Whose scans.
    config
        Settings of every training but model, features and seed. A time limit is left out, so
        that a busy machine trains the same model.
    seeds
        Of the trainings.
    samples
        Latents drawn for each scan of the test split.
    device
        ``cpu`` or ``cuda``.
    """

    data: str
    scheme: str
    lidar: str
    config: TrainingConfig
    seeds: tuple[int, ...] = (0,)
    samples: int = SAMPLES
    device: str = "cpu"

    def config_of(self, spec: RunSpec) -> TrainingConfig:
        """Return the settings of one training."""
        return replace(
            self.config,
            model=spec.model,
            features=spec.features,
            seed=spec.seed,
            time_limit_s=None,
        )


@dataclass(frozen=True)
class RunResult:
    """What one run gave.

    Parameters
    ----------
    spec
        The run.
    title
        What tables call the model.
    classes
        Names of those that enter a mean, by id.
    figures
        Mean and standard deviation over the samples, fractions, by metric and class.
    majority
        The result of the label that most samples chose, as `Evaluator.compute` returns it.
    speed
        Scans a second by ``one_pass`` and with all samples (``sampled``), and the ``processor``.
    beside
        How many runs went on at a time, this one included.
    seconds
        Of training.
    """

    spec: RunSpec
    title: str
    classes: tuple[str, ...]
    figures: Mapping[str, ClassFigures]
    majority: Mapping[str, Any]
    speed: Mapping[str, Any]
    beside: int
    seconds: float

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what a run left in its folder.

        Raises
        ------
        CorruptFileError
            If it is damaged.
        """
        try:
            said = load_json(path.read_bytes())
            figures = {
                metric: {name: (mean, std) for name, (mean, std) in row.items()}
                for metric, row in said["figures"].items()
            }
            spec, classes = RunSpec(**said["spec"]), tuple(said["classes"])
            return cls(**said | {"spec": spec, "classes": classes, "figures": figures})
        except (ValueError, KeyError, TypeError, AttributeError) as err:
            raise CorruptFileError(f"{path}: damaged: {err!r}; delete it to run again") from err


@dataclass(frozen=True)
class _Run:
    """A run that travels to a process: what it is, where it goes, how many go on beside it."""

    spec: RunSpec
    settings: Settings
    dataset: Mapping[str, str]
    folder: Path
    beside: int

    @property
    def task(self) -> dict[str, Any]:
        """All that its result depends on, as plain values."""
        config = asdict(self.settings.config_of(self.spec)) if self.spec.features else {}
        said = {
            "lidar": self.spec.lidar,
            **self.dataset,
            "samples": self.settings.samples,
            "device": torch.device(self.settings.device).type,
        }
        return dict(json.loads(json.dumps(said | config)))

    @property
    def is_done(self) -> bool:
        return (self.folder / _RESULT).is_file()


def run_experiment(
    experiment: Experiment,
    settings: Settings,
    folder: Path,
    *,
    jobs: int = 1,
    tell: Tell = lambda _: None,
) -> dict[Method, list[RunResult]]:
    """Do all runs of an experiment that are not done yet.

    Parameters
    ----------
    experiment, settings
        What to run.
    folder
        Holds a folder for each run; experiments may share it.
    jobs
        Runs at a time, each in a process of its own.
    tell
        Called with a line for each run that is done.

    Returns
    -------
    dict
        Results of each method, by seed.

    Raises
    ------
    DatasetNotFoundError, InvalidInputError
        If the data set has not what is asked for; if a run in `folder` had other settings, or
        another process works there.
    WriteError
        If `folder` cannot be written.
    """
    dataset = describe_dataset(settings)
    _check_possible(experiment, settings)
    specs = {method: method.runs(settings.lidar, settings.seeds) for method in experiment.methods}
    runs = [
        _Run(spec, settings, dataset, folder / spec.name, jobs)
        for of_method in specs.values()
        for spec in of_method
    ]
    with alone_in(folder):
        for run in runs:
            _check_task(run)
        waiting = [run for run in runs if not run.is_done]
        tell(f"{experiment.name}: {len(runs)} runs, of which {len(runs) - len(waiting)} are done")
        started = time.monotonic()
        with open_executor(jobs=jobs) as executor:
            for n, result in enumerate(executor.map(_do, waiting, in_order=False), start=1):
                seconds = (time.monotonic() - started) / n * (len(waiting) - n)
                tell(f"{_describe(result)}; {_remaining(len(waiting) - n, seconds)}")
    return {
        method: [RunResult.read(folder / spec.name / _RESULT) for spec in of_method]
        for method, of_method in specs.items()
    }


def describe_dataset(settings: Settings) -> dict[str, str]:
    """Name a data set, and what tells it from another of that name."""
    data = open_dataset(settings.data)
    data.sequences(settings.lidar)
    data.scheme(settings.scheme)
    return {
        "name": data.manifest.name,
        "version": data.manifest.version,
        "scheme": settings.scheme,
        "sha256": combined_digest(data.manifest),
        "scheme_sha256": data.manifest.splits[settings.scheme].sha256,
    }


def _check_possible(experiment: Experiment, settings: Settings) -> None:
    """Find what cannot work before hours of training."""
    data = open_dataset(settings.data)
    reader = data.reader(data.sequences(settings.lidar)[0].id)
    lidar, taxonomy = reader.lidar, reader.header.taxonomy
    for method in experiment.methods:
        if method.model in DETECTORS:
            taxonomy.id_of(DETECTORS[method.model].predicts)
            continue
        build_network(method.model, channel_count(method.features), len(taxonomy), lidar)
        if "I" in method.features and "scans/intensities" not in reader:
            raise InvalidInputError(
                f"{data.manifest.name}: {lidar.name} gives no intensities, and {experiment.name} "
                f"needs them for the features {method.features}"
            )


def _check_task(run: _Run) -> None:
    """Raise InvalidInputError if the run that is there is another one."""
    path = run.folder / _TASK
    if not path.is_file():
        return
    try:
        before = dict(load_json(path.read_bytes()))
    except (ValueError, TypeError) as err:
        raise CorruptFileError(f"{path}: damaged; delete {run.folder} to run again") from err
    changed = changed_settings(run.task, {"device": "cpu"} | before)
    if changed:
        key = changed[0]
        raise InvalidInputError(
            f"{run.folder}: was run with another {', '.join(changed)} ({key}: "
            f"{before.get(key)!r}, now {run.task[key]!r}); choose another --out"
        )


def _do(run: _Run) -> RunResult:
    """Train, evaluate, and keep the result."""
    run.folder.mkdir(exist_ok=True)
    write_text_atomically(run.folder / _TASK, json.dumps(run.task, indent=1) + "\n")
    quiet = _no_bars() if run.beside > 1 else contextlib.nullcontext()
    with _one_thread(), quiet, warnings.catch_warnings():
        # what is compared with published figures is divided as they were
        warnings.simplefilter("ignore", LeakageWarning)
        result = _detect(run) if run.spec.model in DETECTORS else _train_and_evaluate(run)
    write_text_atomically(run.folder / _RESULT, json.dumps(asdict(result), indent=1) + "\n")
    return result


def _detect(run: _Run) -> RunResult:
    settings, spec = run.settings, run.spec
    detector, data = DETECTORS[spec.model], open_dataset(settings.data)
    source = ScanSource(data, lidar=spec.lidar, split="test", scheme=settings.scheme)
    found = score_detector(detector, source)
    classes = tuple(source.taxonomy.names[c] for c in source.taxonomy.scored_ids)
    return RunResult(
        spec, detector.method, classes, found.figures, found.result, found.speed, run.beside, 0.0
    )


def _train_and_evaluate(run: _Run) -> RunResult:
    settings, spec = run.settings, run.spec
    load = partial(
        load_dataset,
        settings.data,
        lidar=spec.lidar,
        scheme=settings.scheme,
        features=spec.features,
    )
    trained = train(
        settings.config_of(spec),
        load(split="train"),
        load(split="val"),
        run.folder,
        device=settings.device,
        resume=True,
        about={key: run.dataset[key] for key in ("name", "version", "scheme")},
    )
    checkpoint = load_checkpoint(run.folder, device=settings.device)
    test = load(split="test", statistics=checkpoint.statistics)
    found = evaluate(checkpoint, test, samples=settings.samples, seed=spec.seed)
    classes = tuple(test.taxonomy.names[c] for c in test.taxonomy.scored_ids)
    return RunResult(
        spec,
        checkpoint.network.title,
        classes,
        {metric: _figures(found, metric, classes) for metric in METRICS},
        found.majority,
        found.speed,
        run.beside,
        trained.seconds,
    )


def _figures(found: Evaluation, metric: str, classes: tuple[str, ...]) -> ClassFigures:
    """Return what there is of a row; a single sample has no spread."""
    names = {ALL: ALL_CLASSES} | {name: name for name in classes}
    there = {name: found.rows[metric][key] for name, key in names.items()}
    return {
        name: (figure[0], figure[1] if found.samples > 1 else None)
        for name, figure in there.items()
        if figure is not None
    }


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _no_bars() -> contextlib.AbstractContextManager[object]:
    """Keep the bars of several processes from writing over each other."""
    return contextlib.redirect_stderr(io.StringIO())


def _describe(result: RunResult) -> str:
    mean, _ = result.figures["IoU"].get(ALL, (None, None))
    return f"{result.spec.name}: mIoU {percent(mean)} %, {result.seconds:.0f} s"


def _remaining(runs: int, seconds: float) -> str:
    return f"{runs} to go, about {tqdm.format_interval(seconds)}" if runs else "all done"
