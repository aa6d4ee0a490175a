"""``croissant.json``: a data set in the words of Croissant 1.0 (MLCommons), JSON-LD.

HDF5 has no place in Croissant, so its records are the rows of ``sequences.csv``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from importlib import resources
from typing import Any

from semantic2d_dataset.format.manifest import FileEntry, Manifest
from semantic2d_dataset.publishing.about import About
from semantic2d_dataset.publishing.card import TAGS
from semantic2d_dataset.publishing.licenses import license_address
from semantic2d_dataset.publishing.statistics import TABLE_NAME, table_columns
from semantic2d_dataset.scene.taxonomy import Taxonomy

CROISSANT_NAME = "croissant.json"
_VERSION = "http://mlcommons.org/croissant/1.0"
_FILES = "sequence-files"
_ENCODINGS = {
    ".h5": "application/x-hdf5",
    ".csv": "text/csv",
    ".json": "application/json",
    ".md": "text/markdown",
    ".yaml": "application/yaml",
}
_TYPES = {"text": "sc:Text", "int": "sc:Integer", "float": "sc:Float"}


def croissant_json(manifest: Manifest, taxonomy: Taxonomy, about: About, *, date: str) -> str:
    """Return the text of ``croissant.json``.

    Parameters
    ----------
    manifest
        Its files; the document itself and the manifest are not among them.
    taxonomy
        Its classes, which are columns of ``sequences.csv``.
    about
        What is said of it.
    date
        Of publication, where `about` says none.
    """
    said: dict[str, Any] = {
        "@context": _context(),
        "@type": "sc:Dataset",
        "conformsTo": _VERSION,
        "name": manifest.name,
        "alternateName": about.title or manifest.name,
        "description": about.description or f"{manifest.name}: labelled scans of 2D lidars",
        "version": manifest.version,
        "license": license_address(manifest.license),
        "datePublished": about.date or date,
        "keywords": [*dict.fromkeys((*TAGS, *about.tags))],
        "isLiveDataset": False,
        "distribution": [*map(_file_object, _files(manifest)), _file_set()],
        "recordSet": [_record_set(taxonomy)],
    }
    if about.url:
        said["url"] = about.url
    if about.citation:
        said["citeAs"] = about.citation
    if about.authors:
        said["creator"] = [
            {"@type": "sc:Person", "name": author.name}
            | ({"url": author.url} if author.url else {})
            | (
                {"affiliation": {"@type": "sc:Organization", "name": author.affiliation}}
                if author.affiliation
                else {}
            )
            for author in about.authors
        ]
    return json.dumps(said, indent=1, ensure_ascii=False) + "\n"


@cache
def _context() -> Any:
    """Return the context that the specification prescribes."""
    text = resources.files(__package__).joinpath("croissant_context.json").read_text("utf-8")
    return json.loads(text)


def _files(manifest: Manifest) -> Iterable[FileEntry]:
    return (entry for entry in manifest.files if entry.file != CROISSANT_NAME)


def _file_object(entry: FileEntry) -> dict[str, Any]:
    ending = "." + entry.file.rsplit(".", 1)[-1]
    return {
        "@type": "cr:FileObject",
        "@id": entry.file,
        "name": entry.file,
        "contentUrl": entry.file,
        "contentSize": f"{entry.bytes} B",
        "encodingFormat": _ENCODINGS.get(ending, "text/plain"),
        "sha256": entry.sha256,
    }


def _file_set() -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": _FILES,
        "name": _FILES,
        "description": "One HDF5 file for each recording by one lidar: ranges, intensities, "
        "labels, stamps, poses and the annotated map.",
        "encodingFormat": _ENCODINGS[".h5"],
        "includes": "sequences/*.h5",
    }


def _record_set(taxonomy: Taxonomy) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": "sequences",
        "name": "sequences",
        "description": "One row for each sequence; shares are of labelled beams with a return.",
        "key": {"@id": "sequences/id"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"sequences/{column}",
                "name": f"sequences/{column}",
                "dataType": _TYPES[kind],
                "source": {"fileObject": {"@id": TABLE_NAME}, "extract": {"column": column}},
            }
            for column, kind in table_columns(taxonomy).items()
        ],
    }
