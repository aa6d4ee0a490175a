"""Where a sequence comes from, and whether it is there already."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

import semantic2d_dataset
from conversion.options import Options
from conversion.plan import SequencePlan, Source
from semantic2d_dataset.errors import Semantic2DError
from semantic2d_dataset.format.sequence import SequenceReader

_LISTED = 64
"""Files listed one by one; of more, the digest of their digests is kept."""

Facts = dict[str, Any]


def facts_of(source: Source, options: Options) -> Facts:
    """Return what a conversion depends on: sources with SHA-256, options, versions."""
    own = {"semantic2d-dataset": semantic2d_dataset.__version__}
    facts = {
        "tool": "semantic2d convert",
        "kind": source.kind,
        "sources": _digests(source),
        "options": json.loads(json.dumps(asdict(options))),
        "versions": own | dict(source.versions),
    }
    text = json.dumps(facts, sort_keys=True)
    return facts | {"conversion": hashlib.sha256(text.encode()).hexdigest()}


def provenance_of(facts: Facts, plan: SequencePlan, *, sequences: int) -> Facts:
    """Return the provenance of one of the sequences of a conversion."""
    return {
        **facts,
        **plan.header.provenance,
        "sequences": sequences,
        "topic": plan.topic,
        "frame": plan.frame,
        "poses": plan.pose_source,
        "notices": list(plan.notices),
    }


@dataclass(frozen=True)
class Done:
    """Sequence files by the conversion that wrote them, and how many each should have written."""

    by_conversion: Mapping[str, tuple[Path, ...]]
    expected: Mapping[str, int]

    def files(self, conversion: str) -> tuple[Path, ...]:
        """Return the sequences that a conversion has written."""
        return self.by_conversion.get(conversion, ())

    def is_whole(self, conversion: str) -> bool:
        """Tell whether a conversion has written all its sequences."""
        return len(self.files(conversion)) == self.expected.get(conversion, -1)


def find_done(out: Path) -> Done:
    """Look up what a sequence file, or those of a folder or a data set, come from."""
    found: dict[str, tuple[Path, ...]] = {}
    expected: dict[str, int] = {}
    files = [*out.glob("*.h5"), *out.glob("sequences/*.h5")] if out.is_dir() else [out]
    for file in sorted(files):
        said = _provenance(file)
        if "conversion" in said:
            key = str(said["conversion"])
            found[key] = (*found.get(key, ()), file)
            expected[key] = int(said["sequences"])
    return Done(found, expected)


def _provenance(file: Path) -> Mapping[str, Any]:
    try:
        with SequenceReader(file) as reader:
            return reader.header.provenance
    except (Semantic2DError, OSError):
        return {}


def _digests(source: Source) -> Sequence[Facts]:
    files = source.files()
    total = sum(file.stat().st_size for file in files)
    with tqdm(
        total=total, desc="hash", unit="B", unit_scale=True, disable=None, leave=False
    ) as bar:
        if len(files) <= _LISTED:
            return [_digest(file, bar) for file in files]
        top = source.path if source.path.is_dir() else source.path.parent
        whole = hashlib.sha256()
        for file in files:
            name = Path(os.path.relpath(file, top)).as_posix()
            whole.update(f"{_digest(file, bar)['sha256']}  {name}\n".encode())
    said = {"name": source.path.name, "files": len(files), "bytes": total}
    return [said | {"sha256": whole.hexdigest()}]


def _digest(file: Path, bar: Any) -> Facts:
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    size = file.stat().st_size
    bar.update(size)
    return {"name": file.name, "bytes": size, "sha256": digest}
