"""The commands ``semantic2d baseline``: train models, predict with them, evaluate them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from baselines.cli_options import Data, Device, Json, check_free, config_of, report, usable_device
from baselines.cli_robot import export, label
from baselines.cli_studies import reproduce, transfer

if TYPE_CHECKING:
    from baselines.checkpoints import Checkpoint
    from semantic2d_dataset.access.torch_datasets import LidarDataset

app = typer.Typer(
    help="Train models on labelled scans, and predict with them.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

DETECTORS = ("lines", "legs")  # of `detectors`, whose import is heavy


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
    batch_size: Annotated[int | None, typer.Option(help="Scans of a step.")] = None,
    micro_batch: Annotated[
        int | None,
        typer.Option(help="Scans of a step that go at a time: quicker."),
    ] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Of Adam.")] = None,
    seed: Annotated[int | None, typer.Option(help="Of weights, order and latents.")] = None,
    device: Device = None,
    *,
    bf16: Annotated[
        bool, typer.Option("--bf16", help="Let convolutions compute with 16 bits.")
    ] = False,
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
    from semantic2d_dataset.access.transforms import default_augmentation
    from semantic2d_dataset.loading import load_dataset

    check_model(model)
    check_free(out / "model.json", force=force or resume)
    config = config_of(
        preset,
        model=model,
        features=features,
        epochs=epochs,
        time_limit_s=None if minutes is None else 60 * minutes,
        batch_size=batch_size,
        micro_batch=micro_batch,
        learning_rate=learning_rate,
        seed=seed,
        bf16=bf16 or None,
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
        device=usable_device(device),
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
    if os.environ.get("RANK", "0") != "0":
        return  # the first process of a team speaks for all
    report(
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
    check_free(out, force=force)
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

    checkpoint = load_checkpoint(Path(run), device=usable_device(device))
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
    said = {"predictions": str(out), "scans": count, "method": checkpoint.network.title}
    text = f"{out}: {count} scans labelled by {checkpoint.network.title}"
    report(said, text, as_json=as_json)


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
    check_free(out / "model.json", force=force)
    from baselines.checkpoints import save_checkpoint
    from baselines.published_weights import load_published
    from semantic2d_dataset.loading import load_dataset
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
    report(said, text, as_json=as_json)


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
    report(said, f"{out}: {count} scans labelled by {detector.method}", as_json=as_json)


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
    check_free(out / "evaluation.json", force=force)
    from baselines import evaluation
    from baselines.checkpoints import load_checkpoint

    checkpoint = load_checkpoint(run, device=usable_device(device))
    scans = _scans_for(checkpoint, data, lidar, split, scheme)
    out.mkdir(parents=True, exist_ok=True)  # before minutes of work
    found = evaluation.evaluate(checkpoint, scans, samples=samples, seed=seed)
    evaluation.write_evaluation(found, out)
    typer.echo(found.to_json() if as_json else evaluation.format_evaluation(found), nl=not as_json)


def _scans_for(
    checkpoint: Checkpoint, data: str, lidar: str | None, split: str, scheme: str
) -> LidarDataset:
    """Load the scans of a split as a model wants them."""
    from semantic2d_dataset.loading import load_dataset

    return load_dataset(
        data,
        lidar=lidar or checkpoint.lidar.name,
        split=split,
        scheme=scheme,
        features=checkpoint.features,
        statistics=checkpoint.statistics,
    )


for _command in (export, label, transfer, reproduce):
    app.command()(_command)
