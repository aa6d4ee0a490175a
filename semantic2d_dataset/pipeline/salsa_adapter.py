"""Temporary: what `salsa.sequences` is about to offer by itself; delete when it does.

`load_salsa()` becomes ``load_sibling("salsa", "sequences")``; ``settings_from`` is in "settings".
"""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.pipeline.siblings import load_sibling


def load_salsa() -> Any:
    """Return `salsa.sequences`, with what it does not offer yet."""
    module = load_sibling("salsa", "sequences")

    def label_sequence(*words: Any, executor: Any, **more: Any) -> Any:
        if "executor" in inspect.signature(module.label_sequence).parameters:
            more["executor"] = executor
        return module.label_sequence(*words, **more)

    def salsa_facts(source: Any, map_yaml: Any, annotation: Any, settings: Any) -> Any:
        if hasattr(module, "salsa_facts"):
            return module.salsa_facts(source, map_yaml, annotation, settings)
        inputs = module.input_files(source, map_yaml, annotation)
        return module._provenance(inputs, settings)  # noqa: SLF001

    def settings_from(said: Any) -> Any:
        if Path(str(module.__file__)).with_name("settings.py").is_file():
            return load_sibling("salsa", "settings").settings_from(said)
        return _settings(module.Settings, said, "")

    return SimpleNamespace(
        label_sequence=label_sequence, salsa_facts=salsa_facts, settings_from=settings_from
    )


def _settings(kind: Any, said: Mapping[str, Any], where: str) -> Any:
    hints = typing.get_type_hints(kind)
    values = {}
    for name, value in said.items():
        if name not in hints:
            raise InvalidInputError(f"unknown key {where}{name}; known are {', '.join(hints)}")
        parts = [
            each
            for each in (hints[name], *typing.get_args(hints[name]))
            if dataclasses.is_dataclass(each)
        ]
        if parts and isinstance(value, Mapping):
            values[name] = _settings(parts[0], value, f"{name}.")
        elif parts and value is not None:
            raise InvalidInputError(f"{where}{name}: expected a mapping, found {value!r}")
        elif not parts and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise InvalidInputError(f"{where}{name}: expected a number, found {value!r}")
        else:
            values[name] = value
    return kind(**values)
