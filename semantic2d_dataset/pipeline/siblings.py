"""The packages that are installed beside this one, looked up by name when they are needed."""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType

import semantic2d_dataset
from semantic2d_dataset.errors import InvalidInputError


def load_sibling(package: str, module: str = "cli") -> ModuleType:
    """Import a module of a package that is installed beside this one.

    Parameters
    ----------
    package
        Such as ``conversion``.
    module
        Of that package; its commands where not given.

    Raises
    ------
    InvalidInputError
        If another package of that name comes first on the import path.
    """
    expected = Path(semantic2d_dataset.__file__).resolve().parents[1] / package
    spec = importlib.util.find_spec(package)
    if spec is None:
        raise InvalidInputError(
            f"the package {package!r} of semantic2d-dataset is not there (expected at {expected}); "
            "install semantic2d-dataset again"
        )
    origin = Path(spec.origin).resolve().parent if spec.origin else None
    if origin != expected:
        raise InvalidInputError(
            f"the package {package!r} of semantic2d-dataset is {expected}, but Python finds "
            f"{origin or 'another one'} first; run from another folder, rename or uninstall "
            "that one, or take it off PYTHONPATH"
        )
    return importlib.import_module(f"{package}.{module}")
