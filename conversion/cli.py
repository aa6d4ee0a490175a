"""The commands ``semantic2d convert``, ``inspect``, ``audit`` and ``export``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

_RECORDINGS = (
    "ROS 1 or ROS 2 bags (files or folders), CARMEN logs, folders or archives of the published "
    "layout or of OGM-Turtlebot2, or the YAML that describes other arrays."
)

Recordings = Annotated[list[Path], typer.Argument(help=_RECORDINGS)]
ScanTopics = Annotated[
    list[str] | None, typer.Option("--scan-topic", help="Only these.  [default: every scan topic]")
]
Poses = Annotated[
    str, typer.Option(help="Where poses come from: auto, tf, none, a topic, or a pose file.")
]
PosesOf = Annotated[
    str | None, typer.Option(help="What a pose file gives poses of: base or lidar.")
]
ClockOffset = Annotated[
    float, typer.Option(help="Added to the stamps of a pose file, s.", metavar="SECONDS")
]
MapFrame = Annotated[str, typer.Option(help="The frame that poses are given in.")]
BaseFrame = Annotated[
    str | None, typer.Option(help="The robot's frame.  [default: base_link, else base_footprint]")
]
MaxGap = Annotated[
    float | None,
    typer.Option(
        help="Longest time in s to interpolate poses over.  "
        "[default: twice the source's median period, at least 0.5]"
    ),
]
MountText = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z,ROLL,PITCH,YAW",
        help="Mount of the lidar on its base, m and rad.  [default: from tf]",
    ),
]
Stamps = Annotated[
    str, typer.Option(help="Which stamps scans get: auto, header, or record (time of recording).")
]
Lidar = Annotated[
    str | None, typer.Option(help="A lidar of the release or a YAML file.  [default: recognised]")
]
Velocity = Annotated[
    str, typer.Option(help="Topic of the velocity commands, auto (cmd_vel), or none.")
]
NoReturn = Annotated[
    list[float] | None,
    typer.Option(help="A range that the driver writes where there is no return, m."),
]
ReverseIntensities = Annotated[
    bool,
    typer.Option("--reverse-intensities", help="Intensities are stored against the ranges."),
]
Preset = Annotated[str | None, typer.Option(help="A known data set: stata, ogm-turtlebot2.")]
Distro = Annotated[
    str | None,
    typer.Option(
        help="ROS release whose messages a bag without definitions holds.  "
        "[default: as it says, else humble]"
    ),
]
Merge = Annotated[bool, typer.Option("--merge", help="The files given are parts of one recording.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]


def convert(
    recordings: Recordings,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder for the sequences, or a file name (.h5) for one."),
    ],
    scan_topic: ScanTopics = None,
    poses: Poses = "auto",
    poses_of: PosesOf = None,
    clock_offset: ClockOffset = 0.0,
    map_frame: MapFrame = "map",
    base_frame: BaseFrame = None,
    max_gap: MaxGap = None,
    mount: MountText = None,
    stamps: Stamps = "auto",
    lidar: Lidar = None,
    velocity: Velocity = "auto",
    stream: Annotated[
        list[str] | None,
        typer.Option(help="A topic to keep in /streams, or all (but images)."),
    ] = None,
    no_return: NoReturn = None,
    preset: Preset = None,
    distro: Distro = None,
    environment: Annotated[
        str | None, typer.Option(help="First part of the sequence id.  [default: the folder]")
    ] = None,
    recording_name: Annotated[
        str | None, typer.Option(help="Second part of the sequence id.  [default: the file]")
    ] = None,
    license_: Annotated[str, typer.Option("--license", help="Licence of the data.")] = "unknown",
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Recordings at a time.")] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Dask scheduler (tcp://host:8786) whose workers see the same files."),
    ] = None,
    *,
    reverse_intensities: ReverseIntensities = False,
    drop_without_pose: Annotated[
        bool,
        typer.Option("--drop-without-pose", help="Leave scans out whose pose is not known."),
    ] = False,
    merge: Merge = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace sequence files that exist.")
    ] = False,
    json_: AsJson = False,
) -> None:
    """Convert recordings of any kind into unlabelled sequences.

    Topics, lidars, mounts and poses are found where they can be; the summary says how. What is
    complete already is kept. See first what a recording holds with: semantic2d inspect
    """
    from conversion.jobs import convert_recordings
    from conversion.options import Options

    options = Options(
        scan_topics=tuple(scan_topic or ()),
        poses=poses,
        poses_of=poses_of,
        clock_offset_s=clock_offset,
        map_frame=map_frame,
        base_frame=base_frame,
        max_gap_s=max_gap,
        mount=None if mount is None else parse_mount(mount),
        stamps=stamps,
        lidar=lidar,
        velocity=velocity,
        streams=tuple(stream or ()),
        no_return=tuple(no_return or ()),
        reverse_intensities=reverse_intensities,
        drop_without_pose=drop_without_pose,
        preset=preset,
        distro=distro,
        environment=environment,
        recording=recording_name,
        license=license_,
    )
    outcomes = []
    for outcome in convert_recordings(
        _grouped(recordings, merge=merge), out, options, force=force, jobs=jobs, scheduler=scheduler
    ):
        outcomes.append(outcome)
        if outcome.error is not None:
            typer.echo(f"error: {outcome.error}", err=True)
        elif not json_:
            typer.echo("\n".join(map(str, outcome.results)))
    if json_:
        typer.echo(json.dumps([outcome.as_dict() for outcome in outcomes], indent=1))
    failed = sum(outcome.error is not None for outcome in outcomes)
    if failed and len(outcomes) > 1:
        typer.echo(f"{failed} of {len(outcomes)} recordings could not be converted", err=True)
    if failed:
        raise typer.Exit(1)


def inspect(
    recordings: Recordings,
    scan_topic: ScanTopics = None,
    poses: Poses = "auto",
    poses_of: PosesOf = None,
    clock_offset: ClockOffset = 0.0,
    map_frame: MapFrame = "map",
    base_frame: BaseFrame = None,
    max_gap: MaxGap = None,
    mount: MountText = None,
    stamps: Stamps = "auto",
    lidar: Lidar = None,
    velocity: Velocity = "auto",
    no_return: NoReturn = None,
    preset: Preset = None,
    distro: Distro = None,
    plot: Annotated[Path | None, typer.Option(help="Picture to write (.png).")] = None,
    *,
    reverse_intensities: ReverseIntensities = False,
    merge: Merge = False,
    json_: AsJson = False,
) -> None:
    """Say what a recording holds, how it would be converted, and what stands against it."""
    from conversion.inspection.inspection import inspect_source
    from conversion.inspection.plot import draw_inspection
    from conversion.options import Options
    from conversion.presets import apply_preset
    from conversion.sources import open_source
    from semantic2d_dataset.errors import InvalidInputError
    from semantic2d_dataset.plotting import check_picture_name

    options = Options(
        scan_topics=tuple(scan_topic or ()),
        poses=poses,
        poses_of=poses_of,
        clock_offset_s=clock_offset,
        map_frame=map_frame,
        base_frame=base_frame,
        max_gap_s=max_gap,
        mount=None if mount is None else parse_mount(mount),
        stamps=stamps,
        lidar=lidar,
        velocity=velocity,
        no_return=tuple(no_return or ()),
        reverse_intensities=reverse_intensities,
        preset=preset,
        distro=distro,
    )
    grouped = _grouped(recordings, merge=merge)
    if plot is not None:
        check_picture_name(plot)
        if len(grouped) > 1:
            raise InvalidInputError(f"{plot}: one picture shows one recording; give one")
    said = []
    for paths in grouped:
        given = apply_preset(options, paths)
        with open_source(paths, given) as source:
            found = inspect_source(source, given)
        said.append(found.as_dict())
        if plot is not None:
            draw_inspection(found, plot)
        if not json_:
            typer.echo(str(found))
    if json_:
        typer.echo(json.dumps(said, indent=1))
    elif plot is not None:
        typer.echo(f"wrote {plot}")


def audit(
    path: Annotated[
        Path, typer.Argument(help="Session folder, folder of sessions, or archive of the release.")
    ],
    *,
    json_: AsJson = False,
) -> None:
    """Count what is wrong in the published layout; exit status 1 where anything is."""
    from conversion.layouts.audit import audit as audit_release

    found = audit_release(path)
    typer.echo(json.dumps(found.as_dict(), indent=1) if json_ else str(found))
    if found.problems:
        raise typer.Exit(1)


def export(
    sequence: Annotated[Path, typer.Argument(help="Sequence file (.h5).")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File or folder to write.")],
    to: Annotated[
        str, typer.Option(help="mcap (ROS 2, RViz, Foxglove) or npy (published layout).")
    ],
) -> None:
    """Write a sequence as a ROS 2 recording with labelled points, or in the published layout."""
    from semantic2d_dataset.errors import InvalidInputError

    if to == "mcap":
        from conversion.exports.mcap import export_mcap

        made = export_mcap(sequence, out)
        typer.echo(f"wrote {made.path}: {made.scans} scans, {made.messages} messages")
    elif to == "npy":
        from conversion.exports.npy import export_npy

        session = export_npy(sequence, out)
        kept = f"; as in its source, byte for byte: {', '.join(session.identical)}"
        typer.echo(
            f"wrote {session.folder}: {session.scans} scans, {', '.join(session.fields)}"
            + (kept if session.identical else "")
        )
    else:
        raise InvalidInputError(f"--to: expected mcap or npy, found {to!r}")


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


def _grouped(recordings: list[Path], *, merge: bool) -> list[tuple[Path, ...]]:
    from conversion.sources import find_recordings

    return [tuple(recordings)] if merge else find_recordings(recordings)
