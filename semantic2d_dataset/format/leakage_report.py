"""What an audit of a split scheme found, in words and as a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from semantic2d_dataset.format.leakage import Audit


def describe_audit(audit: Audit) -> dict[str, Any]:
    """Return the verdict and all figures as plain values."""
    said: dict[str, Any] = {
        "scheme": audit.scheme.name,
        "made_by": audit.scheme.made_by,
        "verdict": verdict(audit.of("test").summarise()),
    }
    for split, by_lidar in audit.nearness.items():
        lidars = {name: each.summarise() for name, each in sorted(by_lidar.items())}
        said[split] = audit.of(split).summarise() | {"per_lidar": lidars}
    return said


def verdict(test: Mapping[str, Any]) -> str:
    """Say in words what figures of a test split, as `Nearness.summarise` gives them, mean."""
    if not test["scans"]:
        return "has no test scan: nothing can be tested"
    if test["next_to_train"]:
        advice = (
            "for comparison with published figures only"
            if test["next_to_train"] >= 0.5
            else "leave a gap in time between train and test"
        )
        share = percent(test["next_to_train"])
        return f"leaks: {share} of test scans lie next to a train scan; {advice}"
    if test["within_1_s"] and not test["same_sequence"]:
        return (
            f"shares moments: {percent(test['within_1_s'])} of test scans were taken within 1 s "
            "of a train scan of another lidar; it tells how well another lidar is served, not "
            "another time or place"
        )
    if test["within_1_s"]:
        return (
            f"leaks a little: {percent(test['within_1_s'])} of test scans were taken within 1 s "
            "of a train scan; leave a longer gap"
        )
    return f"{_of_time(test)}; {_of_place(test)}"


def _of_time(test: Mapping[str, Any]) -> str:
    if test["nearest_s"] is None:
        return "no test recording is trained on"
    return f"disjoint in time: test scans lie {test['nearest_s']:.3g} s or more from train scans"


def _of_place(test: Mapping[str, Any]) -> str:
    if not test["scans_with_pose"]:
        return "no test scan has a pose to tell whether places are shared"
    if not test["same_environment"]:
        return "disjoint in place too: it tells how well new environments are served"
    return (
        f"environments are shared: {percent(test['within_25_cm_15_deg'])} of test scans lie "
        "within 0.25 m and 15 degrees of a train scan; it tells how well known environments are "
        "served at other times"
    )


def format_audit(said: Mapping[str, Any]) -> str:
    """Lay out what `Audit.as_dict` returns as text."""
    lines = [f"{said['scheme']}: {said['verdict']}", f"  {_HEAD}"]
    for split in ("test", "val"):
        rows = {split: said[split]}
        if len(said[split]["per_lidar"]) > 1:
            rows |= {f"  {name}": each for name, each in said[split]["per_lidar"].items()}
        lines += [f"  {_row(name, each)}" for name, each in rows.items()]
    return "\n".join(lines)


_COLUMNS = (("scans", 9), ("next to", 9), ("< 1 s", 8), ("median s", 10), ("same view", 11))
_HEAD = "".join([" " * 24, *(f"{name:>{width}}" for name, width in _COLUMNS), f"{'median m':>10}"])


def _row(name: str, said: Mapping[str, Any]) -> str:
    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.3g}"

    return (
        f"{name:<24}{said['scans']:>9,}{percent(said['next_to_train']):>9}"
        f"{percent(said['within_1_s']):>8}{number(said['median_s']):>10}"
        f"{percent(said['within_25_cm_15_deg']):>11}{number(said['median_pose_m']):>10}"
    )


def percent(share: float | None) -> str:
    """Return a share for people; never 0 or 100 % for what is not exactly that."""
    if share is None:
        return "-"
    shown = f"{100 * share:.0f}"
    exact = share in (0, 1) or shown not in ("0", "100")
    return f"{shown} %" if exact else f"{100 * share:.2g} %" if share < 0.5 else "> 99 %"
