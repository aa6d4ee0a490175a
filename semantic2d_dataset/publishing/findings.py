"""What a check finds: where, what was expected and found, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

ERROR, WARNING, NOTE = "error", "warning", "note"
_ORDER = (ERROR, WARNING, NOTE)


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Parameters
    ----------
    level
        ``error`` (must be put right), ``warning`` (look at it) or ``note`` (good to know).
    where
        File, and what in it.
    found, expected
        What is there, and what should be.
    advice
        What to do.
    """

    level: str
    where: str
    found: str
    expected: str
    advice: str

    def __str__(self) -> str:
        return f"{self.level}: {self.where}: {self.found}; expected {self.expected}: {self.advice}"

    def as_dict(self) -> dict[str, str]:
        """Return plain values for JSON."""
        return asdict(self)


def ordered(findings: Sequence[Finding]) -> list[Finding]:
    """Return errors first, notes last."""
    return sorted(findings, key=lambda each: _ORDER.index(each.level))
