"""``DATASET_CARD.md``: what somebody should know before using a data set, counted, not typed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined

from semantic2d_dataset.access.registry import MINI
from semantic2d_dataset.format.leakage import Audit, audit_schemes, read_tracks
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.publishing.about import About, Author
from semantic2d_dataset.publishing.facts import Facts, LidarFacts
from semantic2d_dataset.publishing.licenses import UNKNOWN, find_spdx, hugging_face_license
from semantic2d_dataset.publishing.statistics import STATISTICS_NAME, shares_of

CARD_NAME = "DATASET_CARD.md"
TAGS = ("lidar", "laser-scan", "robotics", "semantic-segmentation")
_SIZES = ("n<1K", "1K<n<10K", "10K<n<100K", "100K<n<1M", "1M<n<10M", "10M<n<100M")
_MEANINGS = {
    "block": "contiguous blocks of each recording with gaps between them, disjoint in time but "
    "not in place; for new work.",
    "frame": "single scans, each beside scans of the other splits. It leaks: use it only to "
    "compare with figures that were measured on it.",
    "environment": "whole environments held out, disjoint in time and in place; for what a model "
    "does in a building that it has not seen.",
    "lidar": "lidars held out; the scans of the others come from the same times and places.",
}


def make_card(facts: Facts, about: About) -> str:
    """Return the card of a data set, Markdown with the front matter of Hugging Face.

    Parameters
    ----------
    facts
        What was counted in it.
    about
        What is said of it.
    """
    environment = Environment(
        loader=PackageLoader("semantic2d_dataset.publishing", ""),
        autoescape=False,  # noqa: S701 - the result is Markdown
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template("card.md.jinja").render(**_context(facts, about))


def _context(facts: Facts, about: About) -> dict[str, Any]:
    manifest, sequences = facts.data.manifest, facts.sequences
    lidars = [facts.lidars[name] for name in facts.lidars]
    counts = [np.sum([s.counts for s in lidar.sequences], axis=0) for lidar in lidars]
    columns = [*counts, np.sum(counts, axis=0)]
    shares = [shares_of(column) for column in columns]
    audits = audit_schemes(_ordered(facts.schemes), read_tracks(facts.data.root, manifest))
    return {
        "about": about,
        "front_matter": _front_matter(facts, about),
        "title": about.title or f"{manifest.name} {manifest.version}",
        "description": about.description
        or "Scans of 2D lidars with a class for every beam. Those who made it say no more.",
        "total": {
            "scans": sum(manifest.lengths.values()),
            "sequences": len(sequences),
            "recordings": len({(s.entry.environment, s.entry.recording) for s in sequences}),
        },
        "duration": _duration(facts.seconds),
        "size": _size(sum(each.entry.bytes for each in sequences)),
        "lidars": [_lidar(lidar) for lidar in lidars],
        "environments": _environments(facts),
        "classes": [
            {"name": _cell(name), "shares": [f"{column[i]:.1%}" for column in shares]}
            for i, name in enumerate(facts.taxonomy.names)
        ],
        "labelled_beams": [f"{int(column.sum()):,}" for column in columns],
        "schemes": [_scheme(each) for each in audits],
        "origins": _origins(facts),
        "label_facts": _label_facts(facts),
        "has_statistics": (facts.data.root / STATISTICS_NAME).is_file(),
        "license": _license(manifest.license),
        "authors": [_author(author) for author in about.authors],
        "load_name": MINI if manifest.name == MINI else "FOLDER",
        "default_scheme": _ordered(facts.schemes)[0].name if facts.schemes else "block",
    }


def _front_matter(facts: Facts, about: About) -> str:
    manifest = facts.data.manifest
    said: dict[str, Any] = {"license": hugging_face_license(manifest.license)}
    if said["license"] == "other":
        said["license_name"] = manifest.license
    scans = sum(manifest.lengths.values())
    size = max(0, min(len(str(scans)) - 3, len(_SIZES) - 1))
    said |= {
        "pretty_name": about.title or manifest.name,
        "task_categories": ["other"],
        "tags": [*dict.fromkeys((*TAGS, *about.tags))],
        "size_categories": [_SIZES[size]],
    }
    return yaml.safe_dump(said, sort_keys=False, allow_unicode=True)


def _lidar(lidar: LidarFacts) -> dict[str, Any]:
    beams = sum(each.beams for each in lidar.sequences)
    returns = sum(each.returns for each in lidar.sequences)
    labelled = sum(int(each.counts.sum()) for each in lidar.sequences)
    return {
        "name": lidar.lidar.name,
        "model": _cell(lidar.lidar.model),
        "beams_a_scan": lidar.lidar.beams,
        "sequences": len(lidar.sequences),
        "scans": sum(each.entry.scans for each in lidar.sequences),
        "return_share": f"{returns / max(1, beams):.1%}",
        "labelled_share": f"{labelled / max(1, returns):.1%}",
    }


def _environments(facts: Facts) -> list[dict[str, Any]]:
    scans: Counter[tuple[str, str]] = Counter()
    for each in facts.sequences:
        scans[each.entry.environment, each.entry.lidar] += each.entry.scans
    names = sorted({environment for environment, _ in scans})
    return [
        {"name": name, "scans": [f"{scans[name, lidar]:,}" for lidar in facts.lidars]}
        for name in names
    ]


def _ordered(schemes: Mapping[str, SplitScheme]) -> list[SplitScheme]:
    """Schemes with the one for new work first, those that nobody knows last."""
    known = [*_MEANINGS]
    return sorted(
        schemes.values(),
        key=lambda s: (known.index(s.name) if s.name in known else len(known), s.name),
    )


def _scheme(audit: Audit) -> dict[str, Any]:
    scheme, found = audit.scheme, audit.of("test").summarise()
    near = [found[key] for key in ("next_to_train", "within_1_s", "within_25_cm_15_deg")]
    return {
        "name": scheme.name,
        "sizes": [f"{size:,}" for size in scheme.sizes.values()],
        "near": ["-" if share is None else f"{share:.1%}" for share in near],
        "meaning": _MEANINGS.get(scheme.name, "a scheme of this data set's own."),
        "made_by": scheme.made_by.rstrip("."),
    }


def _origins(facts: Facts) -> list[str]:
    """Say how many sequences have which provenance."""
    found = Counter(_origin(each.header.provenance) for each in facts.sequences)
    return [
        f"{count} {'sequence' if count == 1 else 'sequences'}: {text}"
        for text, count in sorted(found.items())
    ]


def _origin(said: Mapping[str, Any]) -> str:
    steps = []
    if "generator" in said:
        steps.append(f"made by {said['generator']}")
    if "tool" in said:
        kind, sources = said.get("kind", "unknown"), said.get("sources", ())
        steps.append(
            f"converted by {said['tool']}{_version(said)} from {kind}"
            f" ({len(sources)} source file(s), with their SHA-256 in the provenance)"
        )
    if isinstance(said.get("salsa"), Mapping):
        steps.append(f"labelled by semantic2d salsa{_version(said['salsa'])} from an annotated map")
    return "; ".join(steps) or "does not say how it was made"


def _version(said: Mapping[str, Any]) -> str:
    versions = said.get("versions")
    found = versions.get("semantic2d-dataset") if isinstance(versions, Mapping) else None
    return f" {found}" if found else ""


def _label_facts(facts: Facts) -> list[str]:
    """Count what can be counted of labels that may be wrong."""
    aligned = [each for each in facts.sequences if each.accepted is not None]
    lines = []
    if aligned:
        scans = sum(each.entry.scans for each in aligned)
        accepted = sum(each.accepted or 0 for each in aligned)
        lines.append(
            f"{accepted:,} of {scans:,} scans ({accepted / max(1, scans):.1%}) were accepted as "
            "aligned with their map; the others are unlabelled."
        )
    returns = sum(each.returns for each in facts.sequences)
    labelled = sum(int(each.counts.sum()) for each in facts.sequences)
    lines.append(
        f"{labelled:,} of {returns:,} beams with a return ({labelled / max(1, returns):.1%}) "
        "have a label."
    )
    return lines


def _license(text: str) -> str:
    if text == UNKNOWN:
        return "Unknown: nobody said. Ask those who made it before using the data."
    spdx = find_spdx(text)
    return f"{text} (SPDX: {spdx})" if spdx not in (None, text) else text


def _author(author: Author) -> str:
    parts: Iterable[str | None] = (author.name, author.affiliation, author.url)
    return ", ".join(part for part in parts if part)


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _size(count: int) -> str:
    """Two digits: another library compresses the same data into a few bytes more or less."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return (
                f"{count / size:.1f} {unit}" if count < 10 * size else f"{count / size:.0f} {unit}"
            )
    return f"{count} bytes"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
