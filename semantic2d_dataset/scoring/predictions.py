"""The predictions of one method on one split, as a file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import resources
from itertools import chain, islice
from pathlib import Path
from typing import Any, Self

import jsonschema
import numpy as np
from numpy.typing import NDArray

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError, UnsafeFileError
from semantic2d_dataset.format.container import ContainerReader
from semantic2d_dataset.format.schema import PREDICTIONS
from semantic2d_dataset.format.writing import ContainerWriter, root_attributes
from semantic2d_dataset.scene.documents import hint
from semantic2d_dataset.scene.scans import check_array
from semantic2d_dataset.scene.taxonomy import Taxonomy

MAX_SAMPLES = 1024
_MAX_METADATA_BYTES = 1 << 16
_MAX_BLOCK_BYTES, _MAX_CHUNK_BYTES = 1 << 26, 1 << 24
_PROBLEMS, _PART = 50, 200  # of metadata: how many are listed, characters of names and values


class PredictionsWriter:
    """Write a predictions file, as a context manager; it appears when it is complete.

    Parameters
    ----------
    path
        The file to make.
    dataset, dataset_version, scheme, split
        What was predicted: the name and version in the data set's manifest, and the split.
    taxonomy
        The C classes that label ids count in.
    metadata
        About the method; ``method``, its name, is required (see ``metadata.schema.json``).

    Raises
    ------
    InvalidInputError
        If the metadata does not fit its schema.
    WriteError
        If the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        dataset: str,
        dataset_version: str,
        scheme: str,
        split: str,
        taxonomy: Taxonomy,
        metadata: Mapping[str, Any],
    ) -> None:
        problems = metadata_problems(dict(metadata))
        if problems:
            raise InvalidInputError(f"{path}: {'; '.join(problems)}")
        self.taxonomy = taxonomy
        self._layouts: dict[str, tuple[int, bool, int]] = {}
        self._samples: dict[str, list[NDArray[np.uint8]]] = {}
        root = root_attributes(
            PREDICTIONS,
            dataset=dataset,
            dataset_version=dataset_version,
            scheme=scheme,
            split=split,
            taxonomy_digest=taxonomy.digest,
        )
        self._container = ContainerWriter(Path(path), PREDICTIONS, {"": root})
        self._container.append_json("metadata", dict(metadata))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._container.abort()
            return
        with self._container:
            for sequence_id, blocks in self._samples.items():
                samples = np.concatenate(blocks, axis=1)
                self._container.append({_path(sequence_id, "samples"): samples})

    def add(
        self,
        sequence_id: str,
        scan_index: NDArray[np.int64],
        labels: NDArray[np.uint8],
        probabilities: NDArray[np.float16] | None = None,
        samples: NDArray[np.uint8] | None = None,
    ) -> None:
        """Add the predictions of n scans of a sequence, in any order of scans.

        Parameters
        ----------
        sequence_id
            The sequence that the scans belong to.
        scan_index
            (n,) i8, their indices in it.
        labels
            (n, B) u1, class ids of every beam.
        probabilities
            (n, B, C) f2, or None.
        samples
            (S, n, B) u1, class ids drawn S times, or None. They stay in memory until the end,
            because the file holds them by sample and not by scan.

        Raises
        ------
        InvalidInputError
            If an array does not fit, or the parts given, beams or number of samples differ from
            those of an earlier call for this sequence.
        """
        self._check(sequence_id, scan_index, labels, probabilities, samples)
        if samples is not None:
            self._samples.setdefault(sequence_id, []).append(samples.copy())
        arrays: dict[str, NDArray[Any]] = {"scan_index": scan_index, "labels": labels}
        if probabilities is not None:
            arrays["probabilities"] = probabilities
        self._container.append({_path(sequence_id, name): a for name, a in arrays.items()})

    def _check(
        self,
        sequence_id: str,
        scan_index: NDArray[np.int64],
        labels: NDArray[np.uint8],
        probabilities: object,
        samples: NDArray[np.uint8] | None,
    ) -> None:
        classes, where = len(self.taxonomy), f"{self._container.path}: {sequence_id}"
        check_array("scan_index", scan_index, np.int64, (None,), where)
        check_array("labels", labels, np.uint8, (len(scan_index), None), where)
        if probabilities is not None:
            shape = (*labels.shape, classes)
            check_array("probabilities", probabilities, np.float16, shape, where)
        if samples is not None:
            check_array("samples", samples, np.uint8, (None, *labels.shape), where)
        layout = (labels.shape[1], probabilities is not None, samples is not None and len(samples))
        if self._layouts.setdefault(sequence_id, layout) != layout:
            raise InvalidInputError(
                f"{where}: every call for a sequence must give the same parts, beams and samples"
            )
        highest = max(ids.max(initial=0) for ids in (labels, samples) if ids is not None)
        if highest >= classes:
            raise InvalidInputError(
                f"{where}: expected class ids 0 to {classes - 1}, found {highest}"
            )


class PredictionsReader:
    """Read a predictions file; nothing of it is believed before `validate` has seen it.

    Parameters
    ----------
    path
        The file.

    Raises
    ------
    FileNotFoundError, CorruptFileError, UnsafeFileError, FormatVersionError
        As `ContainerReader` does.
    """

    def __init__(self, path: Path) -> None:
        self._container = ContainerReader(Path(path), PREDICTIONS)
        self.path = self._container.path
        root = self._container.attributes()
        self.dataset = str(root.get("dataset", ""))
        self.dataset_version = str(root.get("dataset_version", ""))
        self.scheme = str(root.get("scheme", ""))
        self.split = str(root.get("split", ""))
        self.taxonomy_digest = str(root.get("taxonomy_digest", ""))
        paths = (path.split("/") for path in self._container.groups)
        self.sequence_ids = tuple(sorted(parts[1] for parts in paths if len(parts) == 2))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    @property
    def metadata(self) -> Any:
        """What the file says about its method, whatever JSON value that is; None without.

        Raises
        ------
        CorruptFileError
            If it is no JSON, or longer than 64 KiB.
        """
        if "metadata" not in self._container:
            return None
        size = self._container.shape("metadata")[0]
        if size > _MAX_METADATA_BYTES:
            raise CorruptFileError(
                f"{self.path}: metadata: expected at most {_MAX_METADATA_BYTES} bytes, found {size}"
            )
        return self._container.read_json("metadata")

    def has(self, sequence_id: str, part: str) -> bool:
        """Tell whether scan_index, labels, probabilities or samples of a sequence are there."""
        return _path(sequence_id, part) in self._container

    def shape(self, sequence_id: str, part: str) -> tuple[int, ...]:
        """Return the shape of one part of a sequence's predictions."""
        return self._container.shape(_path(sequence_id, part))

    def read(
        self, sequence_id: str, part: str, start: int = 0, stop: int | None = None
    ) -> NDArray[Any]:
        """Read rows start to stop of one part of a sequence's predictions."""
        name = _path(sequence_id, part)
        self._row_bytes(name)
        return self._container.read(name, start, stop)

    def blocks(self, sequence_id: str, part: str) -> Iterator[NDArray[Any]]:
        """Yield one part of a sequence's predictions in runs of whole chunks.

        Raises
        ------
        UnsafeFileError
            If a run would take more than 64 MiB, or chunks are larger than they need to be.
        """
        name = _path(sequence_id, part)
        row = self._row_bytes(name)
        held = row * min(self._container.chunks(name)[0], self._container.shape(name)[0])
        if held > _MAX_BLOCK_BYTES:
            raise UnsafeFileError(
                f"{self.path}: {name}: its chunks make readers hold {held} bytes at once, and at "
                f"most {_MAX_BLOCK_BYTES} are read: store fewer rows in a chunk"
            )
        return self._container.blocks(name)

    def _row_bytes(self, name: str) -> int:
        """Return the bytes of one row, once it is known that its chunks are no larger than needed.

        A small array in large chunks would take long to unpack.
        """
        size = self._container.dtype(name).itemsize
        row = math.prod(self._container.shape(name)[1:]) * size
        chunk = math.prod(self._container.chunks(name)) * size
        if chunk > max(_MAX_CHUNK_BYTES, row):
            raise UnsafeFileError(
                f"{self.path}: {name}: expected chunks of at most {max(_MAX_CHUNK_BYTES, row)} "
                f"bytes, found {chunk}"
            )
        return row


def metadata_problems(metadata: Any) -> list[str]:
    """List what keeps metadata from fitting ``metadata.schema.json``: where, and what is wrong."""
    found = jsonschema.Draft202012Validator(metadata_schema()).iter_errors(metadata)
    problems = (
        f"metadata{_cut(error.json_path.removeprefix('$'))}: {_what_is_wrong(error)}"
        for error in found
    )
    return list(islice(chain(_not_json(metadata), problems), _PROBLEMS))


def _not_json(metadata: Any) -> Iterator[str]:
    """Find what YAML and Python have, a schema lets pass, and JSON cannot say."""
    for name, value in metadata.items() if isinstance(metadata, dict) else ():
        for key in (name, *(value if isinstance(value, dict) else ())):
            if not isinstance(key, str):
                yield f"metadata: expected text as the name of a field, found {_found(key)}"
        if isinstance(value, float) and not math.isfinite(value):
            yield f"metadata.{_cut(str(name))}: expected a finite number, found {value}"


def _what_is_wrong(error: jsonschema.ValidationError) -> str:
    """Say what was expected and found, as people put it; the schema's titles name its types."""
    schema: Any = error.schema
    instance: Any = error.instance
    if error.validator == "required":
        return f"{error.message}; add it"
    if error.validator == "maxProperties":
        return f"expected at most {error.validator_value} fields, found {len(instance)}"
    if error.validator == "additionalProperties":
        extra = [name for name in instance if name not in schema["properties"]]
        return f"unknown field {_found(extra[0])}{hint(extra[0], schema['properties'])}"
    advice = ""
    if error.validator == "anyOf":  # a field that the schema does not know
        advice = hint(error.absolute_path[-1], metadata_schema()["properties"])
    return f"expected {schema['title']}, found {_found(instance)}{advice}"


def _found(value: Any) -> str:
    return "nothing" if value is None else _cut(repr(value))


def _cut(text: str) -> str:
    return text if len(text) <= _PART else f"{text[:_PART]} ..."


def _path(sequence_id: str, part: str) -> str:
    return f"predictions/{sequence_id}/{part}"


@cache
def metadata_schema() -> Any:
    """Return what metadata must keep to, ``metadata.schema.json``; do not change it."""
    text = resources.files(__package__).joinpath("metadata.schema.json").read_text("utf-8")
    return json.loads(text)
