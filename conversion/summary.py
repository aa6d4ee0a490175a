"""What a conversion found, guessed and wrote, for people and for programs."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conversion.plan import Arrays, SequencePlan
from semantic2d_dataset.scene.lidars import LidarSpec

# Where intensity is zero wherever there is no return, in one order of the beams only:
# one real driver reaches 0.9999 reversed and 0.5 as stored.
_FITS, _BETTER_BY = 0.95, 0.2


@dataclass
class Tally:
    """Count what the beams of a sequence hold, block by block."""

    lidar: LidarSpec
    scans: int = 0
    counts: dict[str, int] = field(default_factory=dict)
    intensity_span: tuple[float, float] | None = None
    _agreements: NDArray[np.int64] = field(default_factory=lambda: np.zeros(3, np.int64))

    def add(self, arrays: Arrays) -> None:
        """Count a block; those without scans (streams) count nothing."""
        if "scans/ranges" not in arrays:
            return
        ranges, intensities = arrays["scans/ranges"], arrays.get("scans/intensities")
        self.scans += len(ranges)
        kinds = {
            "returns": self.lidar.has_return(ranges),
            "no return (+inf)": ranges == np.inf,
            "too close (-inf)": ranges == -np.inf,
            "invalid (NaN)": np.isnan(ranges),
        }
        for name, mask in kinds.items():
            self.counts[name] = self.counts.get(name, 0) + int(mask.sum())
        if intensities is not None:
            self._add_intensities(ranges, intensities)

    @property
    def shares(self) -> dict[str, float]:
        """Share of beams by kind; `outside the limits` is what no other kind holds."""
        beams = max(self.scans * self.lidar.beams, 1)
        shares = {name: count / beams for name, count in self.counts.items()}
        return shares | {"outside the limits": 1.0 - sum(self.counts.values()) / beams}

    @property
    def intensity_kind(self) -> str:
        """``none``, ``all zero``, ``constant`` or ``measured``."""
        if self.intensity_span is None:
            return "none"
        low, high = self.intensity_span
        if low < high:
            return "measured"
        return "all zero" if low == 0 else "constant"

    @property
    def intensities_run_backward(self) -> bool:
        """Whether zero intensity meets no return only when intensities are reversed."""
        _, kept, reversed_ = self._agreements / max(int(self._agreements[0]), 1)
        return bool(reversed_ > _FITS and reversed_ > kept + _BETTER_BY)

    def _add_intensities(
        self, ranges: NDArray[np.float32], intensities: NDArray[np.float32]
    ) -> None:
        finite = intensities[np.isfinite(intensities)]
        if finite.size:
            low, high = self.intensity_span or (np.inf, -np.inf)
            self.intensity_span = (min(low, float(finite.min())), max(high, float(finite.max())))
        missed, zero = ~np.isfinite(ranges), intensities == 0
        agree, agree_reversed = zero == missed, zero[:, ::-1] == missed
        self._agreements += (ranges.size, int(agree.sum()), int(agree_reversed.sum()))


@dataclass(frozen=True)
class Summary:
    """What a conversion did; `as_dict` for programs, `str` for people."""

    file: str
    sequence_id: str
    topic: str
    frame: str
    lidar: str
    beams: int
    scans_in: int
    scans_out: int
    duration_s: float
    pose_source: str
    pose_max_gap_s: float | None
    scans_with_pose: int
    beam_shares: dict[str, float]
    intensities: str
    mount: tuple[float, ...]
    notices: tuple[str, ...]
    suggestions: tuple[str, ...]

    @classmethod
    def of(cls, file: str, plan: SequencePlan, tally: Tally) -> Summary:
        """Gather what is known after a conversion."""
        return cls(
            file=file,
            sequence_id=plan.header.sequence_id,
            topic=plan.topic,
            frame=plan.frame,
            lidar=plan.header.lidar.name,
            beams=plan.header.lidar.beams,
            scans_in=plan.scans_in,
            scans_out=tally.scans,
            duration_s=plan.duration_s,
            pose_source=plan.pose_source,
            pose_max_gap_s=plan.pose_max_gap_s,
            scans_with_pose=plan.scans_with_pose,
            beam_shares=tally.shares,
            intensities=tally.intensity_kind,
            mount=plan.header.lidar.base_T_lidar,
            notices=plan.notices,
            suggestions=_suggestions(plan, tally),
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)

    def __str__(self) -> str:
        share = self.scans_with_pose / max(1, self.scans_in)
        gap = "" if self.pose_max_gap_s is None else f", gaps up to {self.pose_max_gap_s:.2f} s"
        scans = f"{self.scans_out} of {self.scans_in} of {self.topic}, {self.duration_s:.1f} s"
        poses = f"{share:.1%}, from {self.pose_source}{gap}"
        poses = "no source" if self.pose_source == "none" else poses
        shares = ", ".join(f"{name} {share:.1%}" for name, share in self.beam_shares.items())
        frame = f"frame {self.frame!r}, " if self.frame else ""
        mount = " ".join(f"{value:.4g}" for value in self.mount)
        lines = [
            f"{self.file}: {self.sequence_id}",
            f"  scans      {scans}",
            f"  poses      {self.scans_with_pose} of {self.scans_in} scans ({poses})",
            f"  beams      {shares}",
            f"  intensity  {self.intensities}",
            f"  lidar      {self.lidar}, {self.beams} beams, {frame}mount {mount}",
        ]
        lines += [f"  note       {text}" for text in self.notices]
        lines += [f"  suggestion {text}" for text in self.suggestions]
        return "\n".join(lines)


def _suggestions(plan: SequencePlan, tally: Tally) -> tuple[str, ...]:
    if not tally.intensities_run_backward:
        return ()
    action = "drop" if plan.reverse_intensities else "pass"
    why = "zero intensity meets no return only when intensities are reversed"
    return (f"{action} --reverse-intensities: {why}",)
