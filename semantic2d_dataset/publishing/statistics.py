"""``statistics.json`` and ``sequences.csv``: what a data set holds, for programs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.access.features import Statistics
from semantic2d_dataset.format.sequence import slug
from semantic2d_dataset.publishing.facts import SPLITS, Facts, LidarFacts, SequenceFacts
from semantic2d_dataset.publishing.percentiles import Percentiles
from semantic2d_dataset.scene.taxonomy import Taxonomy

STATISTICS_NAME, TABLE_NAME = "statistics.json", "sequences.csv"
STATISTICS_VERSION = "1.0"
_PERCENTS = (1, 5, 25, 50, 75, 95, 99)
_CHANNELS = {"R": ("range",), "I": ("intensity",), "P": ("x", "y"), "A": ("incidence",)}


def statistics_json(facts: Facts) -> str:
    """Return the text of ``statistics.json``; its form is ``statistics.schema.json``."""
    manifest, sequences = facts.data.manifest, facts.sequences
    said = {
        "format": "semantic2d-statistics",
        "format_version": STATISTICS_VERSION,
        "dataset": manifest.name,
        "version": manifest.version,
        "classes": list(facts.taxonomy.names),
        "total": _totals(sequences, facts.taxonomy) | {"recorded_seconds": _short(facts.seconds)},
        "lidars": {name: _lidar(lidar, facts) for name, lidar in facts.lidars.items()},
    }
    return json.dumps(said, indent=1, ensure_ascii=False) + "\n"


def table_columns(taxonomy: Taxonomy) -> dict[str, str]:
    """Return the columns of ``sequences.csv`` with their kinds: text, int or float."""
    texts = dict.fromkeys(("id", "file", "environment", "recording", "lidar"), "text")
    numbers = {"scans": "int", "seconds": "float", "beams": "int", "returns": "int"}
    shares = {f"share_{slug(name).replace('-', '_')}": "float" for name in taxonomy.names}
    return texts | numbers | {"labelled": "int"} | shares


def table_csv(facts: Facts) -> str:
    """Return the text of ``sequences.csv``.

    ``labelled`` are the beams with a return and a label; shares are shares of these.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table_columns(facts.taxonomy))
    for each in facts.sequences:
        entry = each.entry
        names = (entry.id, entry.file, entry.environment, entry.recording, entry.lidar)
        numbers = (entry.scans, f"{each.seconds:.3f}", each.beams, each.returns)
        shares = (f"{share:.6f}" for share in shares_of(each.counts))
        writer.writerow([*names, *numbers, int(each.counts.sum()), *shares])
    return text.getvalue()


def shares_of(counts: NDArray[np.int64]) -> list[float]:
    """Return shares of classes, (C,); all 0 where nothing is labelled."""
    return (counts / max(1, int(counts.sum()))).tolist()  # type: ignore[no-any-return]


def _lidar(lidar: LidarFacts, facts: Facts) -> dict[str, Any]:
    spec = lidar.lidar
    names = [name for letter in lidar.features for name in _CHANNELS[letter]]
    return {
        "model": spec.model,
        "beams_a_scan": spec.beams,
        "range_limits_m": [spec.range_min, spec.range_max],
        **_totals(lidar.sequences, facts.taxonomy),
        "range_m": _percentiles(lidar.ranges),
        "intensity": _percentiles(lidar.intensities) if "I" in lidar.features else None,
        "channels": names,
        "train": {
            scheme: _moments(names, found) for scheme, found in sorted(lidar.moments.items())
        },
        "splits": {
            scheme: {split: _split(lidar, scheme, split, facts.taxonomy) for split in SPLITS}
            for scheme in sorted({scheme for scheme, _ in lidar.scans})
        },
    }


def _totals(sequences: Sequence[SequenceFacts], taxonomy: Taxonomy) -> dict[str, Any]:
    counts = np.sum([each.counts for each in sequences], axis=0)
    entries = [each.entry for each in sequences]
    environments: dict[str, int] = {}
    for entry in entries:
        environments[entry.environment] = environments.get(entry.environment, 0) + entry.scans
    return {
        "sequences": len(entries),
        "recordings": len({(entry.environment, entry.recording) for entry in entries}),
        "scans": sum(entry.scans for entry in entries),
        "seconds": _short(sum(each.seconds for each in sequences)),
        "scans_by_environment": dict(sorted(environments.items())),
        "beams": sum(each.beams for each in sequences),
        "beams_with_return": sum(each.returns for each in sequences),
        "labelled_beams": int(counts.sum()),
        "class_counts": dict(zip(taxonomy.names, counts.tolist(), strict=True)),
        "class_shares": dict(zip(taxonomy.names, map(_short, shares_of(counts)), strict=True)),
    }


def _split(lidar: LidarFacts, scheme: str, split: str, taxonomy: Taxonomy) -> dict[str, Any]:
    counts = lidar.counts[scheme, split].tolist()
    return {
        "scans": lidar.scans[scheme, split],
        "class_counts": dict(zip(taxonomy.names, counts, strict=True)),
    }


def _moments(names: Sequence[str], found: Statistics) -> dict[str, Any]:
    return {
        "mean": dict(zip(names, map(_short, found.mean), strict=True)),
        "std": dict(zip(names, map(_short, found.std), strict=True)),
    }


def _percentiles(values: Percentiles) -> dict[str, float] | None:
    found = values.compute(_PERCENTS)
    if found is None:
        return None
    return {f"p{p}": _short(v) for p, v in zip(_PERCENTS, found, strict=True)}


def _short(value: float) -> float:
    """Six digits, so that the order of a sum on another machine does not show."""
    return float(f"{value:.6g}")
