"""Licences by their SPDX ids, and what Hugging Face and Croissant call them."""

from __future__ import annotations

import re

from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression

UNKNOWN = "unknown"

# Of the ids that Hugging Face lists, those of licences that people give data.
_HUGGING_FACE = re.compile(
    r"cc-by(-nc|-nd|-sa|-nc-nd|-nc-sa)?-[234]\.0|cc-by-2\.5|cc0-1\.0|cdla-permissive-[12]\.0"
    r"|cdla-sharing-1\.0|odbl|pddl|mit|isc|apache-2\.0|bsd-[23]-clause|mpl-2\.0|gpl-[23]\.0"
    r"|agpl-3\.0|lgpl-(2\.1|3\.0)|eupl-1\.[12]|unlicense|unknown"
)
_RENAMED = {"odbl-1.0": "odbl", "pddl-1.0": "pddl"}


def find_spdx(text: str) -> str | None:
    """Return a licence as SPDX writes it, None where it is not of SPDX.

    >>> find_spdx("cc-by-4.0")
    'CC-BY-4.0'
    """
    try:
        return str(canonicalize_license_expression(text))
    except InvalidLicenseExpression:
        return None


def hugging_face_license(text: str) -> str:
    """Return the word for a licence in the front matter of a card: its id, unknown or other."""
    lower = text.lower()
    known = _RENAMED.get(lower, lower).removesuffix("-only").removesuffix("-or-later")
    return known if _HUGGING_FACE.fullmatch(known) else "other"


def license_address(text: str) -> str:
    """Return the page of a licence of SPDX, the text itself where it is no single one of these."""
    spdx = find_spdx(text)
    is_single = spdx is not None and " " not in spdx and not spdx.startswith("LicenseRef-")
    return f"https://spdx.org/licenses/{spdx}.html" if is_single else text
