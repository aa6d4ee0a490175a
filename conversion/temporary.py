"""Where large temporary files go."""

from __future__ import annotations

import os
from pathlib import Path

_ON_DISK = Path("/var/tmp")  # noqa: S108  a folder; the files in it get names of their own


def temporary_folder() -> str | None:
    """Return the folder for temporary files that may grow large; None means the usual one.

    TMPDIR counts where it is set. Else ``/var/tmp`` is taken: ``/tmp`` often lies in memory.
    """
    if os.environ.get("TMPDIR") or not os.access(_ON_DISK, os.W_OK | os.X_OK):
        return None
    return str(_ON_DISK)
