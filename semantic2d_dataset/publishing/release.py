"""``semantic2d release``: labelled sequences become a data set that others can use and cite."""

from __future__ import annotations

import datetime
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.errors import (
    DatasetNotFoundError,
    InvalidInputError,
)
from semantic2d_dataset.format.checksums import CHECKSUMS_NAME, size_and_digest
from semantic2d_dataset.format.manifest import (
    MANIFEST_NAME,
    Manifest,
    check_names,
    describe_document,
    find_problems,
    read_manifest,
    write_digests,
    write_manifest,
)
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.format.writing import write_text_atomically
from semantic2d_dataset.publishing.about import ABOUT_NAME, About, read_about
from semantic2d_dataset.publishing.card import CARD_NAME, make_card
from semantic2d_dataset.publishing.croissant import CROISSANT_NAME, croissant_json
from semantic2d_dataset.publishing.facts import SPLITS as SPLIT_NUMBERS
from semantic2d_dataset.publishing.facts import Facts, gather_facts
from semantic2d_dataset.publishing.licenses import UNKNOWN, find_spdx
from semantic2d_dataset.publishing.schemes import read_schemes, schemes_for
from semantic2d_dataset.publishing.staging import PREVIOUS_NAME, SEQUENCES, SPLITS, stage, swap
from semantic2d_dataset.publishing.statistics import (
    STATISTICS_NAME,
    TABLE_NAME,
    statistics_json,
    table_csv,
)
from semantic2d_dataset.publishing.versions import (
    Change,
    Difference,
    Schemes,
    change_of,
    compare,
    next_version,
    parse_version,
)

_WORK, _STAGED = ".release", "staged"
_MADE = (STATISTICS_NAME, TABLE_NAME, CARD_NAME, CROISSANT_NAME)


@dataclass(frozen=True)
class Release:
    """What became of a release.

    Parameters
    ----------
    manifest
        Of the data set as it is now.
    changed
        Whether anything was written; not where all was there already.
    differences
        From the version before, where there is one.
    notices
        What should be looked at.
    """

    manifest: Manifest
    changed: bool
    differences: tuple[Difference, ...]
    notices: tuple[str, ...]


@dataclass(frozen=True)
class _Sources:
    """Labelled sequences as they lie in a folder."""

    paths: tuple[Path, ...]
    stamps_ns: Mapping[str, NDArray[np.int64]]
    licenses: Mapping[str, str]


@dataclass(frozen=True)
class _Version:
    """A version that a release is compared with."""

    manifest: Manifest
    schemes: Schemes


def release(
    folder: Path,
    *,
    version: str,
    name: str | None = None,
    license: str | None = None,  # noqa: A002 - the field's name in the format
    previous: Path | None = None,
    allow_unlabelled: bool = False,
) -> Release:
    """Publish the sequences in ``folder/sequences``, with all that users need to judge them.

    Everything is made aside and then put in its place; until then the folder is what it was.

    Parameters
    ----------
    folder
        The data set's folder; its ``release.yaml`` says what nobody can count.
    version
        ``MAJOR.MINOR.PATCH``.
    name, license
        As before where not given; the licence else as the sequences say.
    previous
        Folder of the version to compare with; what the folder itself holds if not given.
    allow_unlabelled
        Take sequences without any label.

    Raises
    ------
    DatasetNotFoundError
        If there is no sequence.
    InvalidInputError
        If a name, licence or ``release.yaml`` is not right, a sequence has no label, or the
        version is not one that the change allows.
    CorruptFileError, UnsafeFileError
        If a sequence or scheme cannot be read whole.
    """
    folder = Path(folder)
    about = read_about(folder)
    sources = _read_sources(folder, allow_unlabelled=allow_unlabelled)
    with _alone(folder / _WORK) as work:
        here = _manifest_before(folder, work)
        before = _version_before(folder, here, name, previous)
        said = {
            "name": _name(folder, name, here),
            "version": version,
            "license": _license(license, here, sources),
        }
        check_names(said["name"], version, sources.paths)
        existing = read_schemes(folder / SPLITS)
        schemes = schemes_for(sources.stamps_ns, existing, here)
        staged = work / _STAGED
        made = stage(staged, sources.paths, schemes, **said)
        made = _keep_files(folder, staged, made, existing, schemes)
        _check_version(folder, before, made, schemes, documented=False)
        facts = gather_facts(OpenDataset(staged, made))
        if not allow_unlabelled:
            _check_labels(facts)
        made = _document(folder, staged, made, facts, about)
        differences = _check_version(folder, before, made, schemes, documented=True)
        notices = _notices(made, sources, about, schemes, here if before is None else None)
        if _is_there(folder, here, made):
            return Release(read_manifest(folder), False, (), notices)  # noqa: FBT003
        swap(
            folder,
            staged,
            {path.name: path for path in sources.paths},
            removed=work / "removed",
            documents=(*_MADE, CHECKSUMS_NAME),
        )
    return Release(made, True, tuple(differences), notices)  # noqa: FBT003


def _read_sources(folder: Path, *, allow_unlabelled: bool) -> _Sources:
    if not folder.is_dir():
        found = "a file" if folder.exists() else "nothing"
        raise DatasetNotFoundError(
            f"{folder}: expected a folder with {SEQUENCES}/*.h5, found {found}"
        )
    paths = sorted((folder / SEQUENCES).glob("*.h5"))
    if not paths:
        raise DatasetNotFoundError(
            f"{folder / SEQUENCES}: no sequences (*.h5) here; put the labelled ones there"
        )
    stamps, licenses, unlabelled = {}, {}, []
    for path in paths:
        with SequenceReader(path) as reader:
            sequence_id = reader.header.sequence_id
            if sequence_id in stamps:
                raise InvalidInputError(f"{path}: is {sequence_id}, as another file is; keep one")
            stamps[sequence_id] = reader.read("scans/stamps_ns")
            licenses[sequence_id] = reader.header.license
            if "scans/labels" not in reader:
                unlabelled.append(path)
    if unlabelled and not allow_unlabelled:
        raise _unlabelled(unlabelled)
    return _Sources(tuple(paths), stamps, licenses)


def _check_labels(facts: Facts) -> None:
    empty = [s.entry.file for s in facts.sequences if not s.counts.any() and s.returns]
    if empty:
        raise _unlabelled(empty)


def _unlabelled(files: Sequence[object]) -> InvalidInputError:
    return InvalidInputError(
        f"{files[0]}: has no label{f', as {len(files) - 1} more' if len(files) > 1 else ''}; "
        "label it with: semantic2d salsa label; or publish it as it is with --allow-unlabelled"
    )


@contextmanager
def _alone(work: Path) -> Iterator[Path]:
    work.mkdir(exist_ok=True)
    try:
        with FileLock(work / "lock", timeout=0):
            try:
                yield work
            finally:
                if not (work / _STAGED / PREVIOUS_NAME).exists():  # else it goes on from there
                    shutil.rmtree(work)
    except Timeout as err:
        raise InvalidInputError(f"{work.parent}: another release is being made there") from err


def _manifest_before(folder: Path, work: Path) -> Manifest | None:
    """Return the manifest in the folder, or that of a release which was killed while swapping."""
    staged = work / _STAGED
    if not (folder / MANIFEST_NAME).exists() and (staged / PREVIOUS_NAME).exists():
        (staged / PREVIOUS_NAME).replace(folder / MANIFEST_NAME)
    try:
        return read_manifest(folder)
    except DatasetNotFoundError:
        return None


def _version_before(
    folder: Path, here: Manifest | None, name: str | None, previous: Path | None
) -> _Version | None:
    """Return what to compare with: a version that was released, under the same name."""
    if previous is not None:
        return _Version(manifest := read_manifest(previous), read_published(previous, manifest))
    if here is None or not here.documents or name not in (None, here.name):
        return None
    return _Version(here, read_published(folder, here))


def read_published(folder: Path, manifest: Manifest) -> dict[str, SplitScheme | None]:
    """Read the schemes of a data set; None for those whose file is no longer the published one."""
    found: dict[str, SplitScheme | None] = {}
    for name, entry in manifest.splits.items():
        path = folder / entry.file
        is_same = path.is_file() and size_and_digest(path) == (entry.bytes, entry.sha256)
        found[name] = OpenDataset(folder, manifest).scheme(name) if is_same else None
    return found


def _name(folder: Path, name: str | None, here: Manifest | None) -> str:
    if name is None and here is None:
        raise InvalidInputError(f"{folder}: has no name yet; give it one with --name")
    return name if name is not None else here.name  # type: ignore[union-attr]


def _license(given: str | None, here: Manifest | None, sources: _Sources) -> str:
    said = {*sources.licenses.values()} - {UNKNOWN}
    if given is not None:
        found = given
    elif here is not None and here.license != UNKNOWN:
        found = here.license
    else:
        found = said.pop() if len(said) == 1 else UNKNOWN
    spdx = UNKNOWN if found == UNKNOWN else find_spdx(found)
    if spdx is None:
        raise InvalidInputError(
            f"licence {found!r}: expected an SPDX id, such as CC-BY-4.0, CC0-1.0 or MIT "
            "(https://spdx.org/licenses), LicenseRef-NAME for a licence of your own, or "
            f"{UNKNOWN!r}; say it with --license"
        )
    return spdx


def _keep_files(
    folder: Path,
    staged: Path,
    made: Manifest,
    existing: Mapping[str, SplitScheme],
    schemes: Sequence[SplitScheme],
) -> Manifest:
    """Take files of schemes that stay as they are, byte for byte."""
    entries = dict(made.splits)
    for scheme in schemes:
        before = existing.get(scheme.name)
        if before is not None and _digest(before) == _digest(scheme):
            file = entries[scheme.name].file
            shutil.copyfile(folder / file, staged / file)
            entries[scheme.name] = describe_document(staged, file)
    return replace(made, splits=entries)


def _digest(scheme: SplitScheme) -> tuple[str, str]:
    return scheme.made_by, scheme.digest


def _check_version(
    folder: Path,
    before: _Version | None,
    made: Manifest,
    schemes: Sequence[SplitScheme],
    *,
    documented: bool,
) -> list[Difference]:
    """Return what differs from the version before, whose number must allow it."""
    if before is None:
        return []
    old, new = before.manifest, made
    if not documented:
        new = replace(made, documents=old.documents)
    differences = [
        each
        for each in compare(old, new, before.schemes, {each.name: each for each in schemes})
        if not each.text.startswith(f"{CROISSANT_NAME} says")  # as the others, and a date
    ]
    change = change_of(differences)
    least = next_version(old.version, change)
    if parse_version(made.version) < parse_version(least):
        if change is Change.NONE:
            raise InvalidInputError(
                f"{folder}: version {made.version} is older than {old.version}, which this is"
            )
        raise InvalidInputError(
            f"{folder}: expected version {least} or later, found {made.version}: files of "
            f"{old.name} {old.version} are published and stay as they are, and "
            f"{differences[0].text}"
            + (f", and {len(differences) - 1} more differ" if len(differences) > 1 else "")
            + f"; release it with --version {least}"
        )
    return differences


def _document(folder: Path, staged: Path, made: Manifest, facts: Facts, about: About) -> Manifest:
    """Write the documents, the manifest that names them, and the digests."""
    write_text_atomically(staged / STATISTICS_NAME, statistics_json(facts))
    write_text_atomically(staged / TABLE_NAME, table_csv(facts))
    write_text_atomically(staged / CARD_NAME, make_card(facts, about))  # it names those
    lists = sorted((folder / SPLITS).glob("*/**/*.txt"))
    kept = [path.relative_to(folder).as_posix() for path in lists]
    if (folder / ABOUT_NAME).is_file():
        kept.append(ABOUT_NAME)
    entries = [describe_document(staged, name) for name in _MADE[:-1]]
    entries += [describe_document(folder, name) for name in kept]
    made = replace(made, documents=tuple(sorted(entries, key=lambda entry: entry.file)))
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    croissant = croissant_json(made, facts.taxonomy, about, date=today)
    write_text_atomically(staged / CROISSANT_NAME, croissant)
    made = replace(made, documents=(*made.documents, describe_document(staged, CROISSANT_NAME)))
    write_manifest(staged, made)
    write_digests(staged, made)
    return made


def _is_there(folder: Path, here: Manifest | None, made: Manifest) -> bool:
    """Tell whether the folder holds this very release, whole."""

    def lasting(manifest: Manifest) -> Manifest:
        kept = (entry for entry in manifest.documents if entry.file != CROISSANT_NAME)
        return replace(manifest, documents=tuple(kept))

    if here is None or lasting(here) != lasting(made):
        return False
    return (folder / CHECKSUMS_NAME).is_file() and not find_problems(folder)


def _notices(
    made: Manifest,
    sources: _Sources,
    about: About,
    schemes: Sequence[SplitScheme],
    unreleased: Manifest | None,
) -> tuple[str, ...]:
    """Say what should be looked at; `unreleased` was in the folder, and set no version to keep."""
    found = []
    gone = [] if unreleased is None else sorted({*unreleased.lengths} - {*made.lengths})
    if gone:
        found.append(
            f"{len(gone)} sequence(s) that {MANIFEST_NAME} named are not in {SEQUENCES}/ any more "
            f"and are left out (first: {gone[0]})"
        )
    if made.license == UNKNOWN:
        found.append("the licence is unknown: nobody may use the data then; say it with --license")
    others = {
        i: text for i, text in sources.licenses.items() if text not in (UNKNOWN, made.license)
    }
    if others:
        first = next(iter(others))
        found.append(
            f"the data set says {made.license}, and {len(others)} sequence(s) say otherwise "
            f"(first: {first}, {others[first]})"
        )
    missing = [
        key
        for key in ("description", "authors", "citation", "intended_use", "limits")
        if not getattr(about, key)
    ]
    if missing:
        found.append(f"{ABOUT_NAME} does not say: {', '.join(missing)}")
    for scheme in schemes:
        out = [i for i in made.lengths if i not in scheme.membership]
        if out:
            found.append(f"scheme {scheme.name} leaves out {len(out)} sequence(s): {out[0]}")
        members = np.concatenate([np.zeros(0, np.uint8), *scheme.membership.values()])
        empty = [split for split, number in SPLIT_NUMBERS.items() if number not in members]
        if empty:
            found.append(
                f"scheme {scheme.name} has no scan in {', '.join(empty)}; to have it made anew, "
                f"remove splits/{scheme.name}.h5 and release a MAJOR version"
            )
    return tuple(found)
