"""Where data sets are kept on this machine, and whether hosts may be asked for them."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs

HOME_VARIABLE = "SEMANTIC2D_HOME"
OFFLINE_VARIABLE = "SEMANTIC2D_OFFLINE"


def home() -> Path:
    """Return the folder that data sets are kept in: ``SEMANTIC2D_HOME`` or the user's cache."""
    chosen = os.environ.get(HOME_VARIABLE)
    return Path(chosen) if chosen else platformdirs.user_cache_path("semantic2d_dataset")


def is_offline() -> bool:
    """Tell whether ``SEMANTIC2D_OFFLINE`` forbids downloads."""
    return os.environ.get(OFFLINE_VARIABLE, "").strip().lower() not in ("", "0", "false", "no")
