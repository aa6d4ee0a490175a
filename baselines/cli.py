"""The commands ``semantic2d baseline``: train models, predict with them, evaluate them."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semantic2d_dataset.errors import InvalidInputError

if TYPE_CHECKING:
    from baselines.checkpoints import Checkpoint
    from baselines.configs import TrainingConfig
    from semantic2d_dataset.access.torch_datasets import LidarDataset

app = typer.Typer(
    help="Train models on labelled scans, and predict with them.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

DETECTORS = ("lines", "legs")  # of `detectors`, whose import is heavy

Data = Annotated[str, typer.Option("--data", help="Name of a data set, or its folder.")]
Json = Annotated[bool, typer.Option("--json", help="Print what was done as JSON.")]
Device = Annotated[
    str | None, typer.Option(help="cpu or cuda; cuda where there is one, if not given.")
]


@app.command()
def train(
    model: Annotated[str, typer.Argument(help="What to train: s3net or unet.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the model and its log.")],
    data: Data = "semantic2d-mini",
    lidar: Annotated[str, typer.Option(help="Whose scans to train on.")] = "hokuyo",
    scheme: Annotated[str, typer.Option(help="How the data set is divided.")] = "block",
    preset: Annotated[str, typer.Option(help="Settings to start from: quick or paper.")] = "paper",
    features: Annotated[str | None, typer.Option(help="Letters of R, I, P, A.")] = None,
    epochs: Annotated[int | None, typer.Option(help="Passes over the training split.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop after so many minutes.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of weights, order and latents.")] = None,
    device: Device = None,
    *,
    augment: Annotated[
        bool, typer.Option("--augment", help="Change training scans at random.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on where --out stopped.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the model in --out.")] = False,
    as_json: Json = False,
) -> None:
    """Train a model, and keep the epoch that does best on the validation split."""
    from baselines import training
    from baselines.architectures import check_model
    from semantic2d_dataset.access.torch_datasets import load_dataset
    from semantic2d_dataset.access.transforms import default_augmentation

    check_model(model)
    _check_free(out / "model.json", force=force or resume)
    config = _config(
        preset,
        model=model,
        features=features,
        epochs=epochs,
        time_limit_s=None if minutes is None else 60 * minutes,
        seed=seed,
        augment=augment or None,
    )
    train_part, val_part = (
        load_dataset(data, lidar=lidar, split=split, scheme=scheme, features=config.features)
        for split in ("train", "val")
    )
    if config.augment:
        train_part.transform = default_augmentation(train_part.lidar)
        train_part.transform_seed = config.seed
    manifest = train_part.source.data.manifest
    result = training.train(
        config,
        train_part,
        val_part,
        out,
        device=_device(device),
        resume=resume,
        about={"name": manifest.name, "version": manifest.version, "scheme": scheme},
    )
    said = {
        "model": str(out),
        "best_epoch": result.best_epoch,
        "val_mIoU": result.best_miou,
        "epochs": result.epochs,
        "seconds": round(result.seconds, 1),
    }
    _report(
        said,
        f"{out}: validation mIoU {100 * result.best_miou:.2f} % after epoch {result.best_epoch} "
        f"of {result.epochs} ({result.seconds:.0f} s)",
        as_json=as_json,
    )


@app.command()
def predict(
    run: Annotated[
        str, typer.Argument(help="Folder that training left, or a geometric detector: lines, legs.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Predictions file to write.")],
    data: Data = "semantic2d-mini",
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    scheme: Annotated[str, typer.Option(help="How the data set is divided.")] = "block",
    lidar: Annotated[
        str | None,
        typer.Option(help="Whose scans to label; if not given, that of training, or the hokuyo."),
    ] = None,
    samples: Annotated[
        int | None, typer.Option(min=1, help="Latents drawn for each scan; 32, if not given.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the latents; 0, if not given.")] = None,
    device: Device = None,
    *,
    probabilities: Annotated[
        bool, typer.Option("--probabilities", help="Write class probabilities too.")
    ] = False,
    all_samples: Annotated[
        bool, typer.Option("--all-samples", help="Write the labels of every sample too.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file --out.")] = False,
    as_json: Json = False,
) -> None:
    """Label the scans of a split: by a model, or by the geometry of lines or legs.

    S3-Net decides by the majority of many samples. A folder named as a detector is, say, ./lines.
    """
    _check_free(out, force=force)
    if run in DETECTORS:
        given = {"--samples": samples, "--seed": seed, "--device": device}
        refused = [name for name, value in given.items() if value is not None]
        refused += ["--probabilities"] * probabilities + ["--all-samples"] * all_samples
        if refused:
            raise typer.BadParameter(
                f"{run} is a geometric detector: it has no {', '.join(refused)} "
                f"(for a model in a folder of that name, say ./{run})"
            )
        _detect(run, out, data, lidar or "hokuyo", split, scheme, as_json=as_json)
        return
    from baselines import inference
    from baselines.checkpoints import load_checkpoint

    checkpoint = load_checkpoint(Path(run), device=_device(device))
    scans = _scans_for(checkpoint, data, lidar, split, scheme)
    samples = samples or inference.SAMPLES
    count = inference.predict(
        checkpoint,
        scans,
        out,
        samples=samples,
        seed=seed or 0,
        with_probabilities=probabilities,
        with_samples=all_samples,
    )
    said = {"predictions": str(out), "scans": count, "samples": samples}
    text = f"{out}: {count} scans labelled by {checkpoint.network.title}"
    _report(said, text, as_json=as_json)


@app.command(name="import")
def import_weights(
    file: Annotated[Path, typer.Argument(help="A .pth file of the published code.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the model.")],
    lidar: Annotated[str, typer.Option(help="Whose scans the network takes.")] = "hokuyo",
    features: Annotated[str, typer.Option(help="Letters of R, I, P, A.")] = "RIA",
    data: Annotated[
        str | None,
        typer.Option(
            "--data",
            help="Data set whose training split gives lidar, classes and statistics; the "
            "published ones of the Hokuyo, if not given.",
        ),
    ] = None,
    scheme: Annotated[str, typer.Option(help="How the data set is divided.")] = "block",
    *,
    force: Annotated[bool, typer.Option("--force", help="Replace the model in --out.")] = False,
    as_json: Json = False,
) -> None:
    """Make published weights of S3-Net a model that predict takes."""
    _check_free(out / "model.json", force=force)
    from baselines.checkpoints import save_checkpoint
    from baselines.published_weights import load_published
    from semantic2d_dataset.access.torch_datasets import load_dataset
    from semantic2d_dataset.scene.lidars import find_lidar

    if data is None:
        checkpoint = load_published(file, lidar=find_lidar(lidar), features=features)
    else:
        scans = load_dataset(data, lidar=lidar, split="train", scheme=scheme, features=features)
        checkpoint = load_published(
            file,
            lidar=scans.lidar,
            features=features,
            statistics=scans.statistics,
            taxonomy=scans.taxonomy,
        )
    out.mkdir(parents=True, exist_ok=True)
    save_checkpoint(out, checkpoint)
    said: dict[str, object] = {
        "model": str(out),
        "lidar": checkpoint.lidar.name,
        "features": checkpoint.features,
    }
    text = f"{out}: {file} for {checkpoint.lidar.name} with features {checkpoint.features}"
    _report(said, text, as_json=as_json)


def _detect(
    name: str, out: Path, data: str, lidar: str, split: str, scheme: str, *, as_json: bool
) -> None:
    """Label the scans of a split by one of `DETECTORS`."""
    from baselines import detectors
    from semantic2d_dataset.access.registry import open_dataset
    from semantic2d_dataset.access.scan_source import ScanSource

    detector = detectors.DETECTORS[name]
    source = ScanSource(
        open_dataset(data), lidar=lidar, split=split, scheme=scheme, in_memory=False
    )
    count = detectors.predict(detector, source, out)
    said = {"predictions": str(out), "scans": count, "method": detector.method}
    _report(said, f"{out}: {count} scans labelled by {detector.method}", as_json=as_json)


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(help="Folder that training left.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for evaluation.json and pictures.")],
    data: Data = "semantic2d-mini",
    split: Annotated[str, typer.Option(help="train, val or test.")] = "test",
    scheme: Annotated[str, typer.Option(help="How the data set is divided.")] = "block",
    lidar: Annotated[
        str | None, typer.Option(help="Whose scans to score; those of training, if not given.")
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="Latents drawn for each scan.")] = 32,
    seed: Annotated[int, typer.Option(help="Of the latents.")] = 0,
    device: Device = None,
    *,
    force: Annotated[bool, typer.Option("--force", help="Replace what is in --out.")] = False,
    as_json: Json = False,
) -> None:
    """Score a model on a split: mean and spread over samples, calibration, and speed."""
    _check_free(out / "evaluation.json", force=force)
    from baselines import evaluation
    from baselines.checkpoints import load_checkpoint

    checkpoint = load_checkpoint(run, device=_device(device))
    scans = _scans_for(checkpoint, data, lidar, split, scheme)
    found = evaluation.evaluate(checkpoint, scans, samples=samples, seed=seed)
    out.mkdir(parents=True, exist_ok=True)
    evaluation.write_evaluation(found, out)
    typer.echo(found.to_json() if as_json else evaluation.format_evaluation(found), nl=not as_json)


def _scans_for(
    checkpoint: Checkpoint, data: str, lidar: str | None, split: str, scheme: str
) -> LidarDataset:
    """Load the scans of a split as a model wants them."""
    from semantic2d_dataset.access.torch_datasets import load_dataset

    return load_dataset(
        data,
        lidar=lidar or checkpoint.lidar.name,
        split=split,
        scheme=scheme,
        features=checkpoint.features,
        statistics=checkpoint.statistics,
    )


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Folder that training left.")],
    out: Annotated[Path, typer.Option("--out", help="File to write.")],
    *,
    onnx: Annotated[bool, typer.Option("--onnx", help="As an ONNX file, for a robot.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the file --out.")] = False,
    as_json: Json = False,
) -> None:
    """Write a trained model as one file that runs without torch."""
    from semantic2d_dataset.format.writing import check_target

    if not onnx:
        raise InvalidInputError("say as what to write the model: --onnx")
    check_target(out, [], force=force)
    from baselines.checkpoints import load_checkpoint
    from baselines.onnx_export import export_onnx

    difference = export_onnx(load_checkpoint(run), out)
    said = {"onnx": str(out), "bytes": out.stat().st_size, "difference": difference}
    text = f"{out}: written; ONNX Runtime gives torch's logits to within {difference:.1g}"
    _report(said, text, as_json=as_json)


@app.command()
def label(
    sequence: Annotated[Path, typer.Argument(help="Sequence file (.h5).")],
    model: Annotated[Path, typer.Option("--model", help="Folder of training, or ONNX file.")],
    out: Annotated[Path, typer.Option("--out", help="Labelled copy to write.")],
    samples: Annotated[int, typer.Option(min=1, help="Latents drawn for each scan.")] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Of the latents.")] = 0,
    device: Device = None,
    *,
    force: Annotated[bool, typer.Option("--force", help="Replace the file --out.")] = False,
    as_json: Json = False,
) -> None:
    """Label the scans of a recording by a model, in a copy of its sequence."""
    from dataclasses import asdict

    from baselines.labelling import label_sequence

    summary = label_sequence(
        sequence,
        model,
        out,
        samples=samples,
        seed=seed,
        device=_device(device) if model.is_dir() else "cpu",
        force=force,
    )
    total = sum(summary.points.values())
    shares = (f"{name} {100 * n / max(total, 1):.1f} %" for name, n in summary.points.items())
    text = f"{out}: {summary.scans} scans, {total} points labelled: {', '.join(shares)}"
    _report({"sequence": str(out)} | asdict(summary), text, as_json=as_json)


@app.command()
def transfer(
    out: Annotated[Path, typer.Option("--out", help="Folder for models, scores and picture.")],
    data: Data = "semantic2d-mini",
    lidars: Annotated[
        str | None, typer.Option(help="Names with commas between; all of the data set's.")
    ] = None,
    scheme: Annotated[str, typer.Option(help="How the data set is divided.")] = "block",
    preset: Annotated[str, typer.Option(help="Settings to start from: quick or paper.")] = "paper",
    model: Annotated[str, typer.Option(help="What to train.")] = "s3net",
    features: Annotated[str | None, typer.Option(help="Letters of R, I, P, A.")] = None,
    epochs: Annotated[int | None, typer.Option(help="Of each training from scratch.")] = None,
    tuning_epochs: Annotated[
        int | None, typer.Option(help="Of each fine-tuning; a quarter of --epochs, if not given.")
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="Latents drawn for each scan.")] = 32,
    seed: Annotated[int | None, typer.Option(help="Of weights, order and latents.")] = None,
    device: Device = None,
    *,
    as_json: Json = False,
) -> None:
    """Train on every lidar, test on every other, as it is and fine-tuned on the val split.

    Run again after an interruption, it goes on where --out stopped.
    """
    from baselines.architectures import check_model
    from baselines.transfer import TransferStudy, fine_tuning_of, lidars_of, measure_transfer
    from baselines.transfer_report import describe_transfer, format_transfer, write_transfer
    from semantic2d_dataset.access.registry import open_dataset

    check_model(model)
    config = _config(preset, model=model, features=features, epochs=epochs, seed=seed)
    opened = open_dataset(data)
    names = lidars_of(opened) if lidars is None else [n.strip() for n in lidars.split(",")]
    tuning = fine_tuning_of(config, tuning_epochs)
    study = TransferStudy(opened, names, config, tuning, scheme, samples)
    found = measure_transfer(study, out, device=_device(device))
    write_transfer(out, study, found)
    _report(describe_transfer(study, found), format_transfer(study, found), as_json=as_json)


@app.command()
def reproduce(
    experiment: Annotated[
        str, typer.Argument(help="What to reproduce: table-segmentation, ablation or transfer.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for models, tables and pictures.")],
    data: Data = "semantic2d-mini",
    lidar: Annotated[str, typer.Option(help="Whose scans.")] = "hokuyo",
    scheme: Annotated[str, typer.Option(help="How the data set is divided.")] = "block",
    preset: Annotated[str, typer.Option(help="Settings of training: quick or paper.")] = "quick",
    epochs: Annotated[int | None, typer.Option(help="Passes over the training split.")] = None,
    seeds: Annotated[str, typer.Option(help="Of the trainings, such as 0,1,2.")] = "0",
    samples: Annotated[int, typer.Option(min=1, help="Latents drawn for each scan.")] = 32,
    device: Device = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Trainings at a time.")] = 1,
    *,
    as_json: Json = False,
) -> None:
    """Train and score all that a table of the paper holds, and print it with what was published.

    What is done in --out stays, so that the same command goes on where it was stopped.
    """
    from baselines import experiments
    from baselines.reporting import write_report
    from baselines.reproduction import Settings, run_experiment
    from baselines.tables import to_text

    if experiment == experiments.TRANSFER:
        transfer(
            out / "transfer",
            data,
            scheme=scheme,
            preset=preset,
            epochs=epochs,
            samples=samples,
            seed=experiments.parse_seeds(seeds)[0],
            device=device,
            as_json=as_json,
        )
        return
    chosen = experiments.find_experiment(experiment)
    settings = Settings(
        data,
        scheme,
        lidar,
        _config(preset, epochs=epochs),
        experiments.parse_seeds(seeds),
        samples,
        _device(device),
    )
    results = run_experiment(
        chosen, settings, out / "runs", jobs=jobs, tell=partial(typer.echo, err=True)
    )
    table = write_report(chosen, settings, results, out / chosen.name)
    said: dict[str, object] = {"results": str(out / chosen.name / "results.json")}
    _report(said, f"{to_text(table)}\n{out / chosen.name}: written", as_json=as_json)


def _check_free(path: Path, *, force: bool) -> None:
    if path.exists() and not force:
        raise InvalidInputError(f"{path}: exists already; choose another, or pass --force")


def _config(preset: str, **changes: object) -> TrainingConfig:
    """Return the settings of a preset with those changes that are not None."""
    from dataclasses import replace

    from baselines.configs import PRESETS

    if preset not in PRESETS:
        raise InvalidInputError(f"unknown preset {preset!r}; known are {', '.join(PRESETS)}")
    given = {name: value for name, value in changes.items() if value is not None}
    if "epochs" in given:  # a number of epochs is kept, whatever time they take
        given.setdefault("time_limit_s", None)
    return replace(PRESETS[preset](), **given)  # type: ignore[arg-type]


def _device(name: str | None) -> str:
    """Return a device that can be used; a GPU is taken where there is one, never required."""
    import torch

    chosen = name or ("cuda" if torch.cuda.is_available() else "cpu")
    try:
        torch.empty(0, device=chosen)
    except (RuntimeError, AssertionError) as err:
        raise InvalidInputError(f"device {chosen!r} cannot be used here: {err}") from err
    return chosen


def _report(said: dict[str, object], text: str, *, as_json: bool) -> None:
    typer.echo(json.dumps(said) if as_json else text)
