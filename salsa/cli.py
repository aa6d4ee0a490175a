"""The ``semantic2d salsa`` commands."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from salsa.map_check import MapReport
    from salsa.sequences import Summary
    from salsa.sightings import Sightings
    from semantic2d_dataset.scene.taxonomy import Taxonomy

Force = Annotated[bool, typer.Option("--force", help="Replace what exists.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]
TaxonomyFile = Annotated[
    Path | None, typer.Option("--taxonomy", help="Classes (YAML); the published ten if not given.")
]

app = typer.Typer(
    name="salsa",
    help="Label sequences from one annotated map, and review what came of it.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


@app.callback()
def commands() -> None:
    """Label sequences from one annotated map, and review what came of it."""


@app.command()
def label(
    sequence: Annotated[Path, typer.Argument(help="Sequence (.h5) with rough poses.")],
    *,
    map_yaml: Annotated[Path, typer.Option("--map", help="map_server YAML file.")],
    annotation: Annotated[Path, typer.Option(help="labelme JSON or label image of that map.")],
    out: Annotated[Path, typer.Option(help="Labelled sequence to write.")],
    force: Force = False,
    as_json: AsJson = False,
    settings: Annotated[
        Path | None, typer.Option(help="Parameters of all steps (YAML), see docs/salsa.md.")
    ] = None,
    static_after: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Take what is seen to stay in free space for this many seconds, and has no legs, "
            "for a thing and not a person (5 if not given); 0 calls all of it Person.",
        ),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Let poses agree with the motion from scan to scan.")
    ] = False,
    odometry: Annotated[
        str, typer.Option(help="Stream of the sequence that tells this motion; implies --smooth.")
    ] = "",
    ignore_no_return: Annotated[
        bool,
        typer.Option(
            "--ignore-no-return", help="Leave beams without a return unlabelled, not Other."
        ),
    ] = False,
    camera: Annotated[
        Path | None, typer.Option(help="Calibrated camera (YAML) that saw other moving things.")
    ] = None,
    detections: Annotated[
        str | None, typer.Option(help="Detections in its images: a JSON file, or stream:NAME.")
    ] = None,
    detection_names: Annotated[
        Path | None, typer.Option(help="YAML: what the detector's classes are called here.")
    ] = None,
    camera_clock_offset: Annotated[
        float, typer.Option(help="Added to the stamps of the images, s.")
    ] = 0.0,
    taxonomy: Annotated[
        Path | None, typer.Option(help="Classes (YAML); those of the sequence if not given.")
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=1, help="Processes; one already uses all cores for most of it.")
    ] = 1,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, such as tcp://host:8786.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of all labelled points over the map, to write.")
    ] = None,
) -> None:
    """Align a sequence with its map and write a labelled copy."""
    from salsa.sequences import input_files, label_sequence
    from salsa.settings import read_settings
    from semantic2d_dataset.executors import open_executor
    from semantic2d_dataset.format.writing import check_target
    from semantic2d_dataset.scene.taxonomy import read_taxonomy

    if plot is not None:  # before hours of work
        from semantic2d_dataset.plotting import check_picture_name

        check_picture_name(plot)
        inputs = input_files(sequence, map_yaml, annotation).values()
        check_target(plot, (*inputs, out), force=force)
    changes: dict[str, Any] = {}
    if static_after is not None:
        changes["persistence"] = {"min_seconds": static_after} if static_after else None
    if smooth or odometry:
        changes["smoothing"] = {"odometry": odometry} if odometry else {}
    if ignore_no_return:
        changes["transfer"] = {"ignore_no_return": True}
    sightings = _sightings(camera, detections, detection_names, camera_clock_offset)
    with open_executor(jobs=jobs, scheduler=scheduler) as executor:
        summary = label_sequence(
            sequence,
            map_yaml,
            annotation,
            out,
            settings=read_settings(settings, changes),
            sightings=sightings,
            taxonomy=None if taxonomy is None else read_taxonomy(taxonomy),
            force=force,
            executor=executor,
        )
    typer.echo(json.dumps(asdict(summary), indent=1) if as_json else _describe(summary, out))
    if plot is not None:
        from salsa.pictures import plot_labelled_sequence

        plot_labelled_sequence(out, plot)
        if not as_json:
            typer.echo(f"wrote {plot}")


def _sightings(
    camera: Path | None, detections: str | None, names: Path | None, clock_offset_s: float
) -> Sightings | None:
    from salsa.sightings import sightings_of
    from semantic2d_dataset.errors import InvalidInputError

    if camera is None and detections is None and names is None:
        return None
    if camera is None or detections is None:
        raise InvalidInputError("--camera and --detections need each other; give both")
    return sightings_of(camera, detections, names, clock_offset_s=clock_offset_s)


@app.command(name="map")
def check_annotated_map(
    map_yaml: Annotated[Path, typer.Argument(metavar="MAP", help="map_server YAML file.")],
    annotation: Annotated[Path, typer.Argument(help="labelme JSON or label image of that map.")],
    *,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of the annotated map, to write.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Label image (.png) of the annotation, to write.")
    ] = None,
    taxonomy: TaxonomyFile = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Check the annotation of a map, draw it, or turn it into a label image.

    What should be looked at is listed; only what `salsa label` would refuse is an error.
    """
    from salsa.annotation import check_labelled, label_cells, read_annotation, write_label_image
    from salsa.map_check import check_map
    from semantic2d_dataset.scene.maps import read_map

    _check_map_targets(map_yaml, annotation, plot, out, force=force)
    classes = _classes(taxonomy)
    scene = read_map(map_yaml)
    said = read_annotation(annotation, scene.occupancy.shape, classes)
    check_labelled(label_cells(scene, said.regions, classes), map_yaml, annotation, classes)
    report = check_map(scene, said, classes)
    typer.echo(
        json.dumps(asdict(report), indent=1)
        if as_json
        else _describe_map(report, map_yaml, annotation)
    )
    if out is not None:
        write_label_image(out, said.regions, classes)
    if plot is not None:
        from salsa.map_pictures import plot_annotated_map
        from semantic2d_dataset.plotting import save

        save(plot_annotated_map(scene, said, report, taxonomy=classes), plot)


@app.command(name="labelmerc")
def write_labelmerc(
    *,
    out: Annotated[Path, typer.Option(help="File to write.")] = Path(".labelmerc"),
    taxonomy: TaxonomyFile = None,
    force: Force = False,
) -> None:
    """Write settings for labelme: the classes, their colours, and no other names."""
    from salsa.labelmerc import labelmerc
    from semantic2d_dataset.format.writing import check_target, write_text_atomically

    check_target(out, (), force=force)
    write_text_atomically(out, labelmerc(_classes(taxonomy)))
    typer.echo(f"{out}: written; annotate with: labelme --config {out} MAP_IMAGE")


def _classes(path: Path | None) -> Taxonomy:
    from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, read_taxonomy

    return SEMANTIC2D if path is None else read_taxonomy(path)


def _check_map_targets(
    map_yaml: Path, annotation: Path, plot: Path | None, out: Path | None, *, force: bool
) -> None:
    """Refuse names that cannot be written before anything is read."""
    from semantic2d_dataset.errors import InvalidInputError
    from semantic2d_dataset.format.writing import check_target
    from semantic2d_dataset.plotting import check_picture_name
    from semantic2d_dataset.scene.maps import map_image

    inputs = (map_yaml, map_image(map_yaml), annotation)
    if plot is not None:
        check_picture_name(plot)
        check_target(plot, inputs, force=force)
    if out is not None:
        if out.suffix.lower() != ".png":
            raise InvalidInputError(f"{out}: a label image is a PNG file; end its name in .png")
        check_target(out, inputs, force=force)
        if plot is not None and plot.resolve() == out.resolve():
            raise InvalidInputError(f"{out}: cannot be both the picture and the label image")


def _describe_map(report: MapReport, map_yaml: Path, annotation: Path) -> str:
    edge, area = report.resolution_m, report.resolution_m**2
    metres = f"{report.width * edge:.1f} x {report.height * edge:.1f} m"
    drawn = f"{len(report.shapes)} shapes" if report.shapes else "a label image"
    lines = [
        f"{map_yaml}: {report.width} x {report.height} pixels of {100 * edge:g} cm, {metres}",
        *(
            f"  {name:<11}{count:>10,}  {count * area:8.1f} m2"
            for name, count in (
                ("occupied", report.occupied),
                ("free", report.free),
                ("unknown", report.unknown),
            )
        ),
        f"{annotation}: {drawn}",
        "occupied cells by class:",
        *_class_lines(report),
        f"labelled pixels that are not occupied: {100 * report.not_occupied_share:.1f} %",
    ]
    if report.overlaps:
        lines.append("occupied cells in shapes of two classes (the later shape has them):")
        lines += [f"  {o.earlier} under {o.later}: {o.cells:,}" for o in report.overlaps]
    lines.append("to look at:" if report.warnings else "nothing to look at")
    lines += [f"  - {warning}" for warning in report.warnings]
    if report.clusters:
        lines.append(f"groups of cells without a class ({report.cluster_count}), largest first:")
        lines += [
            f"  {c.cells:>7,} cell(s), {c.size_m:6.2f} m long, at pixel ({c.column}, {c.row}), "
            f"x {c.x_m:.2f} y {c.y_m:.2f} m"
            for c in report.clusters
        ]
    return "\n".join(lines)


def _class_lines(report: MapReport) -> list[str]:
    total = max(sum(report.classes.values()) + report.unlabelled, 1)
    counts = report.classes | {"no class": report.unlabelled}
    return [
        f"  {name:<11}{count:>10,}  {100 * count / total:5.1f} %"
        for name, count in counts.items()
        if count or name == "no class"
    ]


@app.command()
def review(
    sequence: Annotated[Path, typer.Argument(help="Labelled sequence (.h5).")],
    *,
    out: Annotated[Path, typer.Option(help="Page to write.")] = Path("review.html"),
    drop: Annotated[
        Path | None,
        typer.Option(help="Scans to drop: an index or start-stop a line, as the page saves it."),
    ] = None,
    cleaned: Annotated[
        Path | None, typer.Option(help="Copy without these scans to write; the page is of it.")
    ] = None,
    force: Force = False,
) -> None:
    """Write a page to judge labels by; drop the scans that were found wrong."""
    from salsa.dropping import drop_scans, read_drop_list
    from salsa.review import write_review
    from semantic2d_dataset.format.sequence import SequenceReader
    from semantic2d_dataset.format.writing import check_target

    if (drop is None) != (cleaned is None):
        raise typer.BadParameter("--drop and --cleaned belong together: which scans, and where to")
    inputs = [path for path in (sequence, drop, cleaned) if path is not None]
    check_target(out, inputs, force=force)  # before minutes of work
    if drop is not None and cleaned is not None:
        check_target(cleaned, (sequence, drop), force=force)
        with SequenceReader(sequence) as reader:
            scans = read_drop_list(drop, len(reader))
        drop_scans(sequence, scans, cleaned, force=force)
        typer.echo(f"wrote {cleaned}: {len(scans)} scans dropped")
    write_review(out, cleaned or sequence)
    typer.echo(f"wrote {out}")


def _describe(summary: Summary, out: Path) -> str:
    total = max(sum(summary.points.values()), 1)
    before, after = 100 * summary.near_before, 100 * summary.near_after
    scans = f"{summary.scans} scans, {summary.scans_with_pose} with a pose"
    near = f"{before:.1f} % before, {after:.1f} % after"
    lines = [
        f"{out}: {scans}, {summary.scans_accepted} accepted",
        f"points within 10 cm of the map (median scan): {near}",
        f"rms distance of these: {100 * summary.median_residual_m:.1f} cm",
    ]
    if summary.things or summary.standing:
        lines.append(
            f"unmapped and staying: {summary.things} thing(s), {summary.things_moved} of them "
            f"mapped objects that were moved; {summary.standing} outline(s) of people who stand"
        )
    if summary.scans_with_image is not None:
        lines.append(f"scans with an image of the camera: {summary.scans_with_image}")
    lines.append("points:")
    lines += [
        f"  {name:<11}{count:>10}  {100 * count / total:5.1f} %"
        for name, count in summary.points.items()
        if count
    ]
    return "\n".join(lines)
