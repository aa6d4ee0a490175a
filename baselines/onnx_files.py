"""ONNX files that say what they are, and notice when they are damaged.

The last 64 characters of such a file are the SHA-256 of all before them. They are the value of
its last piece of metadata, so that every tool reads it as the ONNX model that it is.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from baselines.descriptions import check_format
from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.schema import FORMAT_VERSION

if TYPE_CHECKING:
    import onnx
    import onnxruntime

_KIND = "semantic2d-onnx"
_KEY, _SEAL = "semantic2d", "semantic2d.sha256"
_DIGITS = 64


def seal(model: onnx.ModelProto, said: Mapping[str, Any]) -> bytes:
    """Return the content of a file from a graph and what is said of it."""
    import onnx

    head = {"format": _KIND, "format_version": FORMAT_VERSION}
    onnx.helper.set_model_props(model, {_KEY: json.dumps(head | dict(said))})
    last = onnx.ModelProto()
    onnx.helper.set_model_props(last, {_SEAL: "0" * _DIGITS})
    # Protocol Buffers that stand behind each other are read as one, their lists joined.
    content = bytes(model.SerializeToString() + last.SerializeToString()[:-_DIGITS])
    return content + hashlib.sha256(content).hexdigest().encode()


def read_sealed(path: Path) -> bytes:
    """Read a file whose last characters fit what is before them.

    Raises
    ------
    FileNotFoundError
        If there is none.
    CorruptFileError
        If it is damaged, or not one that `seal` made.
    """
    content = Path(path).read_bytes()
    if hashlib.sha256(content[:-_DIGITS]).hexdigest().encode() != content[-_DIGITS:]:
        raise CorruptFileError(
            f"{path}: not a model that `semantic2d baseline export` wrote, or damaged or changed "
            "since; export it again"
        )
    return content


def open_session(path: Path, content: bytes, threads: int) -> onnxruntime.InferenceSession:
    """Return a session of ONNX Runtime on the CPU, for the content of a file.

    Raises
    ------
    InvalidInputError
        If there is no thread to run in.
    CorruptFileError
        If ONNX Runtime cannot run it.
    ImportError
        If ONNX Runtime is not installed.
    """
    if threads < 1:
        raise InvalidInputError(f"threads: expected at least 1, found {threads}")
    try:
        import onnxruntime
    except ImportError as err:
        raise ImportError(
            "ONNX Runtime is missing: pip install 'semantic2d-dataset[onnx]'", name="onnxruntime"
        ) from err
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as err:  # its errors have no other base
        raise CorruptFileError(f"{path}: ONNX Runtime cannot open it: {err}") from err


def said_of(session: onnxruntime.InferenceSession, path: Path) -> dict[str, Any]:
    """Return what the file behind a session says of itself.

    Raises
    ------
    CorruptFileError, FormatVersionError
        If that is nothing that can be understood.
    """
    text = session.get_modelmeta().custom_metadata_map.get(_KEY, "null")
    try:
        return check_format(path, json.loads(text), _KIND)
    except ValueError as err:
        raise CorruptFileError(f"{path}: what it says of itself is no JSON: {err}") from err
