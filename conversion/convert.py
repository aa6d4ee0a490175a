"""One recording to its sequences: what is in it, what becomes of it, then the scans by blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from conversion.dataset import SEQUENCES, publish_with_lists
from conversion.options import Options
from conversion.plan import SequencePlan, Source
from conversion.presets import apply_preset
from conversion.provenance import Done, Facts, facts_of, find_done, provenance_of
from conversion.sources import open_source
from conversion.summary import Summary, Tally
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader, SequenceWriter

_FILES = (".h5", ".hdf5")


@dataclass(frozen=True)
class Kept:
    """A sequence that was complete already, of the same source and options."""

    file: str
    sequence_id: str
    scans_out: int

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self) | {"kept": True}

    def __str__(self) -> str:
        return f"{self.file}: {self.sequence_id}: complete already, {self.scans_out} scans: kept"


Result = Summary | Kept


def convert_recording(
    recording: Path | Sequence[Path],
    out: Path,
    options: Options | None = None,
    *,
    force: bool = False,
    replace_outdated: bool = False,
    done: Done | None = None,
) -> tuple[Result, ...]:
    """Convert a recording of any kind into sequences.

    Memory is bounded by a block of scans, and by the transforms and poses of the recording. What
    is complete already, of the same source and options, is kept.

    Parameters
    ----------
    recording
        A recording, as `conversion.sources.open_source` takes it: its file or folder, or its
        several files.
    out
        A file name that ends with ``.h5``, for a recording that becomes one sequence; else a
        folder. A layout that comes with split lists becomes a data set in that folder.
    options
        What is not to be found from the recording.
    force
        Whether files that exist are replaced, complete or not.
    replace_outdated
        Whether files of another source, version or options are replaced, and only these.
    done
        What `out` holds already; looked up where None.

    Returns
    -------
    tuple of Summary or Kept
        What was found, guessed and written for each sequence.

    Raises
    ------
    FileNotFoundError
        If there is no such recording.
    RecordingError
        If it cannot be converted; of the sequence that fails nothing is written.
    InvalidInputError
        If an option names nothing known, `out` exists, or is a file of the recording.
    WriteError
        If a sequence cannot be written.
    """
    out = Path(out)
    paths = [recording] if isinstance(recording, Path) else list(recording)
    options = apply_preset(options or Options(), paths)
    with open_source(paths, options) as source:
        _check_apart(source, out)
        facts = facts_of(source, options)
        done = find_done(out) if done is None else done
        key = facts["conversion"]
        if not force and done.is_whole(key) and not _is_dataset(done.files(key)):
            return tuple(_kept(file) for file in done.files(key))
        plans = _plans(source, options)
        with_lists = any(plan.members is not None for plan in plans)
        if with_lists and out.suffix in _FILES:
            raise InvalidInputError(
                f"{out}: {source.path} brings split lists, and becomes a data set: give a folder "
                "as --out"
            )
        kept = () if force else done.files(key)
        may_replace = force or replace_outdated
        targets = _targets(out / SEQUENCES if with_lists else out, plans, kept, force=may_replace)
        results = tuple(
            _kept(target) if target in kept else _write(target, plan, facts, len(plans))
            for target, plan in zip(targets, plans, strict=True)
        )
        if with_lists:
            publish_with_lists(out, plans)
        return results


def find_kept(
    recording: Sequence[Path], out: Path, options: Options | None = None
) -> tuple[Kept, ...]:
    """Return the sequences that `convert_recording` would keep; none unless all are complete.

    Raises
    ------
    FileNotFoundError, RecordingError
        If there is no such recording, or it cannot be opened.
    """
    options = apply_preset(options or Options(), recording)
    with open_source(recording, options) as source:
        key = facts_of(source, options)["conversion"]
    done = find_done(out)
    return tuple(map(_kept, done.files(key))) if done.is_whole(key) else ()


def _plans(source: Source, options: Options) -> Sequence[SequencePlan]:
    """Decide what becomes of a recording; which lidars are wanted is no matter of its kind."""
    plans, wanted = source.plans(replace(options, only_lidars=())), options.only_lidars
    return [plan for plan in plans if not wanted or plan.header.lidar.name in wanted]


def _write(file: Path, plan: SequencePlan, facts: Facts, sequences: int) -> Summary:
    provenance = provenance_of(facts, plan, sequences=sequences)
    tally = Tally(plan.header.lidar)
    with SequenceWriter(file, replace(plan.header, provenance=provenance)) as writer:
        for arrays in plan.blocks():
            writer.append(arrays)
            tally.add(arrays)
        if plan.scene is not None:
            writer.set_map(plan.scene)
    return Summary.of(str(file), plan, tally)


def _targets(
    out: Path, plans: Sequence[SequencePlan], kept: Sequence[Path], *, force: bool
) -> list[Path]:
    """Name the file of each sequence; refuse to replace what is of something else."""
    ids = [plan.header.sequence_id for plan in plans]
    targets = [out / f"{sequence_id}{_FILES[0]}" for sequence_id in ids]
    if out.suffix in _FILES:
        targets = [out]
    else:
        _make_folder(out)
    if len(targets) != len(ids):
        raise InvalidInputError(
            f"{out}: the recording becomes {len(ids)} sequences ({', '.join(ids[:5])}"
            f"{', ...' if len(ids) > 5 else ''}): give a folder as --out, or choose one scan "
            "topic with --scan-topic"
        )
    for target in targets:
        if target.is_dir():
            raise InvalidInputError(f"{target}: is a folder; give another name as --out")
        if target.exists() and target not in kept and not force:
            raise InvalidInputError(
                f"{target}: the file exists, and is of another source, version or options; pass "
                "--force to replace it"
            )
    return targets


def _is_dataset(files: Sequence[Path]) -> bool:
    return any(file.parent.name == SEQUENCES for file in files)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as err:
        raise InvalidInputError(
            f"{folder}: a file is in the way; --out takes a folder, or a file name that ends "
            f"with {_FILES[0]}"
        ) from err


def _kept(file: Path) -> Kept:
    with SequenceReader(file) as reader:
        return Kept(str(file), reader.header.sequence_id, len(reader))


def _check_apart(source: Source, out: Path) -> None:
    """Refuse to replace what is being read, whatever name or link it goes by."""
    if out.is_file() and any(map(out.samefile, chain((source.path,), source.files()))):
        raise InvalidInputError(f"{out}: belongs to the recording {source.path}; choose another")
