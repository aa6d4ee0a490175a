"""The commands ``semantic2d baseline export`` and ``label``: a model leaves the training."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from baselines.cli_options import Device, Json, report, usable_device
from semantic2d_dataset.errors import InvalidInputError


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
    report(said, text, as_json=as_json)


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

    if device is not None and model.is_file():
        raise InvalidInputError(f"{model}: an ONNX file runs on the CPU; leave --device out")
    summary = label_sequence(
        sequence,
        model,
        out,
        samples=samples,
        seed=seed,
        device=usable_device(device) if model.is_dir() else "cpu",
        force=force,
    )
    total = sum(summary.points.values())
    shares = (f"{name} {100 * n / max(total, 1):.1f} %" for name, n in summary.points.items())
    text = f"{out}: {summary.scans} scans, {total} points labelled: {', '.join(shares)}"
    report({"sequence": str(out)} | asdict(summary), text, as_json=as_json)
