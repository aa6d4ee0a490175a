"""The command ``semantic2d convert``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def convert(
    recording: Annotated[
        Path,
        typer.Argument(help="A ROS 1 .bag, or a ROS 2 .db3, .mcap or folder with metadata.yaml."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="The sequence file to write (.h5).")],
    scan_topic: Annotated[
        str | None, typer.Option(help="The LaserScan topic; needed where there are several.")
    ] = None,
    poses: Annotated[
        str, typer.Option(help="Where poses come from: auto, tf, none, or a topic.")
    ] = "auto",
    map_frame: Annotated[str, typer.Option(help="The frame that poses are given in.")] = "map",
    base_frame: Annotated[
        str | None,
        typer.Option(help="The robot's frame.  [default: base_link, else base_footprint]"),
    ] = None,
    max_gap: Annotated[
        float | None,
        typer.Option(
            help="Longest time in s to interpolate poses over.  "
            "[default: twice the source's median period, at least 0.5]"
        ),
    ] = None,
    mount: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z,ROLL,PITCH,YAW",
            help="Mount of the lidar on its base, m and rad.  [default: from tf]",
        ),
    ] = None,
    stamps: Annotated[
        str, typer.Option(help="Which stamps scans get: header, or record (time of recording).")
    ] = "header",
    lidar: Annotated[
        str | None,
        typer.Option(help="A lidar of the release or a YAML file.  [default: recognised]"),
    ] = None,
    environment: Annotated[
        str | None, typer.Option(help="First part of the sequence id.  [default: the folder]")
    ] = None,
    recording_name: Annotated[
        str | None, typer.Option(help="Second part of the sequence id.  [default: the file]")
    ] = None,
    license_: Annotated[str, typer.Option("--license", help="Licence of the data.")] = "unknown",
    *,
    reverse_intensities: Annotated[
        bool,
        typer.Option(
            "--reverse-intensities", help="The driver stores intensities against the ranges."
        ),
    ] = False,
    drop_without_pose: Annotated[
        bool,
        typer.Option("--drop-without-pose", help="Leave scans out whose pose is not known."),
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the sequence file if it exists.")
    ] = False,
    json_: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Convert a recording of a ROS robot into an unlabelled sequence.

    Topic, lidar, mount and poses are found where they can be; the summary says how.
    """
    import json

    from conversion.convert import convert_recording
    from conversion.plan import Options
    from semantic2d_dataset.errors import InvalidInputError

    if out.is_dir():
        raise InvalidInputError(f"{out}: --out takes a file name such as {out / 'sequence.h5'}")
    if out.exists() and not force:
        raise InvalidInputError(f"{out}: the file exists; pass --force to replace it")
    options = Options(
        scan_topic=scan_topic,
        poses=poses,
        map_frame=map_frame,
        base_frame=base_frame,
        max_gap_s=max_gap,
        mount=None if mount is None else parse_mount(mount),
        stamps=stamps,
        lidar=lidar,
        environment=environment,
        recording=recording_name,
        license=license_,
        reverse_intensities=reverse_intensities,
        drop_without_pose=drop_without_pose,
    )
    summary = convert_recording(recording, out, options)
    typer.echo(json.dumps(summary.as_dict()) if json_ else str(summary))


def parse_mount(text: str) -> tuple[float, float, float, float, float, float]:
    """Read ``x,y,z,roll,pitch,yaw``.

    Raises
    ------
    InvalidInputError
        If it is not six numbers.
    """
    from semantic2d_dataset.errors import InvalidInputError

    try:
        x, y, z, roll, pitch, yaw = (float(part) for part in text.split(","))
    except ValueError as err:
        raise InvalidInputError(
            f"--mount: expected six numbers x,y,z,roll,pitch,yaw, found {text!r}"
        ) from err
    return (x, y, z, roll, pitch, yaw)
