"""What breaks a JSON schema in a document that somebody wrote, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import slug
from semantic2d_dataset.scene.documents import hint

_KINDS = {
    "string": "text",
    "number": "a number",
    "integer": "a whole number",
    "object": "a mapping",
    "array": "a list",
}


def check_document(path: Path, said: Any, schema: Mapping[str, Any]) -> None:
    """Check a document against a JSON schema.

    Raises
    ------
    InvalidInputError
        With all that is wrong: where, what was expected and what was found.
    """
    problems = sorted(_problems(said, schema))
    if problems:
        raise InvalidInputError(
            f"{path}: {problems[0]}"
            if len(problems) == 1
            else f"{path}: {len(problems)} problems\n  - " + "\n  - ".join(problems)
        )


def _problems(said: Any, schema: Mapping[str, Any]) -> Iterator[str]:
    for error in jsonschema.Draft202012Validator(schema).iter_errors(said):
        where = error.json_path.removeprefix("$").removeprefix(".")
        yield from _in_words(f"{where}: " if where else "", error)


def _in_words(where: str, error: Any) -> Iterator[str]:
    """Say what was expected and what was found."""
    schema, found = error.schema, error.instance
    if error.validator == "additionalProperties":
        known = schema["properties"]
        for key in found:
            if key not in known:
                yield f"{where}unknown key {key!r}{hint(key, known)}"
    elif error.validator == "required":
        key = next(key for key in error.validator_value if error.message.startswith(repr(key)))
        yield f"{where}expected the key {key!r}, which is missing"
    elif error.validator == "type":
        quoted = f"; quote it: '{found}'" if error.validator_value == "string" else ""
        is_plain = isinstance(found, int | float) and not isinstance(found, bool)
        yield (
            f"{where}expected {_KINDS[error.validator_value]}, found {found!r}"
            f"{quoted if is_plain else ''}"
        )
    elif error.validator == "pattern":
        yield (
            f"{where}expected lower-case letters and digits with single '-', '.' or '_' between "
            f"them, such as {slug(found)!r}; found {found!r}"
        )
    elif error.validator in ("minItems", "minProperties", "minLength"):
        yield f"{where}is empty"
    else:
        yield f"{where}{error.message}"
