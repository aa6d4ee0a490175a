"""The commands ``semantic2d baseline transfer`` and ``reproduce``: many trainings, one table."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from baselines.cli_options import Data, Device, Json, config_of, report, usable_device


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
    config = config_of(preset, model=model, features=features, epochs=epochs, seed=seed)
    opened = open_dataset(data)
    names = lidars_of(opened) if lidars is None else [n.strip() for n in lidars.split(",")]
    tuning = fine_tuning_of(config, tuning_epochs)
    study = TransferStudy(opened, names, config, tuning, scheme, samples)
    found = measure_transfer(study, out, device=usable_device(device))
    write_transfer(out, study, found)
    report(describe_transfer(study, found), format_transfer(study, found), as_json=as_json)


def reproduce(
    experiment: Annotated[
        str, typer.Argument(help="What to reproduce: table-segmentation, ablation or transfer.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for models, tables and pictures.")],
    data: Data = "semantic2d-mini",
    lidar: Annotated[
        str | None, typer.Option(help="Whose scans; the hokuyo, if not given.")
    ] = None,
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

    trained_with = experiments.parse_seeds(seeds)
    if experiment == experiments.TRANSFER:
        given = {"--lidar": lidar, "--jobs": jobs > 1, "more than one seed": len(trained_with) > 1}
        refused = ", ".join(name for name, value in given.items() if value)
        if refused:
            raise typer.BadParameter(f"transfer takes every lidar in turn, without {refused}")
        transfer(
            out / "transfer",
            data,
            scheme=scheme,
            preset=preset,
            epochs=epochs,
            samples=samples,
            seed=trained_with[0],
            device=device,
            as_json=as_json,
        )
        return
    chosen = experiments.find_experiment(experiment)
    settings = Settings(
        data,
        scheme,
        lidar or "hokuyo",
        config_of(preset, epochs=epochs),
        trained_with,
        samples,
        usable_device(device),
    )
    results = run_experiment(
        chosen, settings, out / "runs", jobs=jobs, tell=partial(typer.echo, err=True)
    )
    table = write_report(chosen, settings, results, out / chosen.name)
    said: dict[str, object] = {"results": str(out / chosen.name / "results.json")}
    report(said, f"{to_text(table)}\n{out / chosen.name}: written", as_json=as_json)
