"""The steps of ``semantic2d run``: convert, label, publish; each kept where it is done."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray
from tqdm import tqdm

from semantic2d_dataset.errors import (
    CorruptFileError,
    DatasetNotFoundError,
    InvalidInputError,
    Semantic2DError,
)
from semantic2d_dataset.executors import Executor
from semantic2d_dataset.format.manifest import read_manifest
from semantic2d_dataset.pipeline.config import Config, RecordingConfig
from semantic2d_dataset.pipeline.drops import read_drops
from semantic2d_dataset.pipeline.labelling import Labelled, find_labelled, label
from semantic2d_dataset.pipeline.publication import WORK, publish_sequences
from semantic2d_dataset.pipeline.report import Report, Row
from semantic2d_dataset.pipeline.siblings import load_sibling
from semantic2d_dataset.publishing.staging import SEQUENCES

_CONVERTED, _LABELLED = "converted", "labelled"
_LOCK = ".lock"


def run_pipeline(config: Config, executor: Executor, *, only: Collection[str] = ()) -> Report:
    """Make a data set, or go on where an earlier run ended.

    A recording that fails stops no other; the data set is published only when all are well, and
    an earlier one is the same until then.

    Parameters
    ----------
    config
        What to make.
    executor
        Where recordings are converted, and blocks of scans are labelled.
    only
        Names of recordings; the others are left alone then, and nothing is published.

    Raises
    ------
    InvalidInputError
        If a name is unknown, another run is at work, or the folder holds another data set.
    Semantic2DError
        If the data set cannot be published.
    """
    recordings = config.select(only)
    _check_out(config)
    with _alone(config.out / WORK):
        converted = _convert_all(config, recordings, executor)
        rows, dropped = _label_all(config, recordings, converted, executor)
        if only or any(row.error for row in rows):
            return Report(config, rows, published=False, changed=False)
        files = [each.file for row in rows for each in row.sequences]
        changed = publish_sequences(config, files, dropped)
        for left_over in (config.out / WORK / _LABELLED).glob("*.h5"):
            left_over.unlink()
        return Report(config, rows, published=True, changed=changed)


def plan_pipeline(config: Config, *, only: Collection[str] = ()) -> list[dict[str, Any]]:
    """Say what a run would do to each recording, and change nothing.

    The recordings are read, as their digests tell what is done already.

    Returns
    -------
    list
        For each its ``recording`` (id), ``paths``, ``steps`` to do, and the ``error`` if it
        cannot be opened.

    Raises
    ------
    InvalidInputError
        If a name is unknown, or the folder holds another data set.
    """
    recordings = config.select(only)
    _check_out(config)
    convert = load_sibling("conversion", "convert")
    said = []
    for each in recordings:
        plan: dict[str, Any] = {"recording": each.id, "paths": [*map(str, each.paths)]}
        try:
            kept = convert.find_kept(each.paths, _converted(config, each), each.convert)
            files = [Path(one.file) for one in kept]
            whole = [find_labelled(each, file, _places(config, file)) is not None for file in files]
            steps = [] if kept else ["convert"]
            steps += [] if kept and all(whole) else ["label"]
            said.append(plan | {"steps": steps, "error": None})
        except Semantic2DError as err:
            said.append(plan | {"steps": [], "error": str(err)})
        except OSError as err:
            said.append(plan | {"steps": [], "error": _message(err, each)})
    return said


def _message(err: OSError, recording: RecordingConfig) -> str:
    return f"{err.filename or recording.paths[0]}: {(err.strerror or str(err)).lower()}"


def _check_out(config: Config) -> None:
    """Refuse a folder that is somebody's: what does not belong to the data set is moved aside."""
    if not config.out.is_dir():
        return
    inside = [
        path
        for each in config.recordings
        for path in (*each.paths, each.map_yaml, each.annotation)
        if path.resolve().is_relative_to(config.out.resolve())
    ]
    if inside:
        raise InvalidInputError(
            f"{config.out}: holds {inside[0]}, which is read; choose a folder of its own as 'out' "
            f"in {config.path}"
        )
    try:
        found = read_manifest(config.out).name
    except (DatasetNotFoundError, CorruptFileError):
        if any(config.out.iterdir()) and not (config.out / WORK / _LOCK).exists():
            raise InvalidInputError(
                f"{config.out}: holds files, but no data set; choose a new or empty folder as "
                f"'out' in {config.path}"
            ) from None
        return
    if found != config.name:
        raise InvalidInputError(
            f"{config.out}: holds the data set {found!r}, not {config.name!r}; choose another "
            f"folder as 'out' in {config.path}"
        )


@contextmanager
def _alone(work: Path) -> Iterator[None]:
    try:
        for folder in (_CONVERTED, _LABELLED):
            (work / folder).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as err:
        raise InvalidInputError(f"{work}: a file is in the way; choose another 'out'") from err
    try:
        with FileLock(work / _LOCK, timeout=0):
            yield
    except Timeout as err:
        raise InvalidInputError(f"{work}: another run is at work there; wait for it") from err


def _converted(config: Config, recording: RecordingConfig) -> Path:
    return config.out / WORK / _CONVERTED / recording.id


def _places(config: Config, source: Path) -> tuple[Path, Path]:
    """Return where the labelled copy of a sequence may be: published, and not yet."""
    return config.out / SEQUENCES / source.name, config.out / WORK / _LABELLED / source.name


def _convert_all(
    config: Config, recordings: Sequence[RecordingConfig], executor: Executor
) -> dict[Path, Any]:
    """Convert recordings; return the outcome of each by its folder."""
    jobs = load_sibling("conversion", "jobs")
    todo = [
        jobs.Job(
            recording=each.paths,
            out=_converted(config, each),
            options=each.convert,
            force=False,
            done=jobs.find_done(_converted(config, each)),
            replace_outdated=True,
        )
        for each in recordings
    ]
    return {outcome.out: outcome for outcome in jobs.run_all(todo, executor)}


def _label_all(
    config: Config,
    recordings: Sequence[RecordingConfig],
    converted: Mapping[Path, Any],
    executor: Executor,
) -> tuple[tuple[Row, ...], dict[str, NDArray[np.int64]]]:
    """Label the sequences of all recordings; return also which scans are dropped."""
    rows: list[Row] = []
    dropped: dict[str, NDArray[np.int64]] = {}
    owners: dict[str, str] = {}
    for each in tqdm(recordings, desc="label", unit="recording", disable=None):
        outcome = converted[_converted(config, each)]
        row = Row(each.id, seconds=outcome.seconds, error=outcome.error)
        began = time.monotonic()
        try:
            if row.error is None:
                row = _label_recording(config, each, row, outcome, owners, executor)
                dropped |= _drops(each, row.sequences)
        except Semantic2DError as err:
            row = replace(row, error=str(err))
        except OSError as err:
            row = replace(row, error=_message(err, each))
        rows.append(replace(row, seconds=row.seconds + time.monotonic() - began))
    return tuple(rows), dropped


def _label_recording(
    config: Config,
    recording: RecordingConfig,
    row: Row,
    outcome: Any,
    owners: dict[str, str],
    executor: Executor,
) -> Row:
    sources = [Path(result.file) for result in outcome.results]
    for stale in {*_converted(config, recording).glob("*.h5")} - {*sources}:
        stale.unlink()
    sequences: list[Labelled] = []
    for source, result in zip(sources, outcome.results, strict=True):
        owner = owners.setdefault(result.sequence_id, recording.id)
        if owner != recording.id:
            raise InvalidInputError(
                f"{recording.paths[0]}: becomes the sequence {result.sequence_id}, and so does "
                f"{owner}; give it another name with 'recording'"
            )
        sequences.append(label(recording, source, _places(config, source), executor))
    return replace(
        row,
        sequences=tuple(sequences),
        converted=not all(result.as_dict().get("kept") for result in outcome.results),
    )


def _drops(
    recording: RecordingConfig, sequences: Sequence[Labelled]
) -> dict[str, NDArray[np.int64]]:
    if recording.drop is None:
        return {}
    return read_drops(recording.drop, {each.sequence_id: each.scans for each in sequences})
