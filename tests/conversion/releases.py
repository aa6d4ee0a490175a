"""Small trees of files in the published Semantic2D layout, made when a test needs them."""

import io
import tarfile
import zipfile
from pathlib import Path

import numpy as np

from conversion.layouts.release import ReleaseSource
from conversion.options import Options
from semantic2d_dataset.format.sequence import SequenceWriter
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW, LidarSpec

SESSIONS = ("2024-04-04-12-16-41", "2024-04-11-14-37-14")


def save(path: Path, values) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values, allow_pickle=False)


def make_session(
    folder: Path,
    *,
    scans: int = 20,
    beams: int = HOKUYO_UTM_30LX_EW.beams,
    seed: int = 0,
    dtype: str = "<f4",
    more: bool = False,
    lists: bool = True,
) -> Path:
    """Write a session folder as the release has them.

    Parameters
    ----------
    dtype
        Of ranges, intensities and labels.
    more
        Whether it has the fields that only some sets have.
    """
    rng = np.random.default_rng(seed)
    for n in range(scans):
        name = f"{n:07d}.npy"
        ranges = rng.uniform(0.1, 30, beams).astype(np.float32)
        labels = rng.integers(0, 10, beams)
        missed = rng.random(beams) < 0.1
        ranges[missed], labels[missed] = 0, 0
        save(folder / "scans_lidar" / name, ranges.astype(dtype))
        intensities = rng.integers(0, 4000, beams)
        save(folder / "intensities_lidar" / name, intensities.astype(dtype))
        save(folder / "semantic_label" / name, labels.astype(dtype))
        save(folder / "positions" / name, np.array([0.05 * n, 0.01 * n, 0.002 * n]))
        save(folder / "velocities" / name, rng.normal(0, 0.3, 2))
        count = int(rng.integers(0, 6))
        segments = rng.uniform(-5, 5, (count, 4)) if count else np.array([])
        save(folder / "line_segments" / name, segments)
        if more:
            save(folder / "sub_goals_local" / name, rng.normal(0, 1, 2))
            save(folder / "angles_lidar" / name, np.linspace(-2.356194496, 2.356194496, beams))
            save(folder / "valid_mask_lidar" / name, ~missed)
    if lists:
        write_lists(folder, scans, rng)
    return folder


def write_lists(folder: Path, scans: int, rng) -> None:
    order = [f"{n:07d}.npy" for n in rng.permutation(scans)]
    cuts = {"train": (0, 0.7), "dev": (0.7, 0.8), "test": (0.8, 1)}
    for split, (start, stop) in cuts.items():
        names = order[round(start * scans) : round(stop * scans)]
        (folder / f"{split}.txt").write_text("".join(f"{name}\n" for name in names))


def make_release(folder: Path, *, sessions=SESSIONS, **how) -> Path:
    """Write a folder of sessions with its ``dataset.txt``."""
    for seed, name in enumerate(sessions):
        make_session(folder / name, seed=seed, **how)
    (folder / "dataset.txt").write_text("".join(f"{name}\n" for name in sessions))
    return folder


def small_lidar(path: Path, beams: int = 7) -> str:
    """Describe a lidar of few beams, so that tests are fast; returns the file's name."""
    spec = LidarSpec("small", "Small", beams, -1.5, 3.0 / beams, 0.1, 30.0)
    lines = [f"{key}: {getattr(spec, key)}" for key in ("name", "model", "beams", "angle_min")]
    lines += [
        f"{key}: {getattr(spec, key)}" for key in ("angle_increment", "range_min", "range_max")
    ]
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder with its bytes."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def pack_zip(folder: Path, target: Path) -> Path:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents(folder).items():
            archive.writestr(f"{folder.name}/{name}", content)
    return target


def pack_tar(folder: Path, target: Path, mode: str = "w:gz") -> Path:
    with tarfile.open(target, mode) as archive:
        for name, content in contents(folder).items():
            info = tarfile.TarInfo(f"{folder.name}/{name}")
            info.size = len(content)
            archive.addfile(info, io.BytesIO(content))
    return target


def write_sequences(path: Path, folder: Path, options: Options | None = None) -> list[Path]:
    """Convert every session of a release, and return the sequence files."""
    files = []
    with ReleaseSource(path) as source:
        for plan in source.plans(options or Options()):
            file = folder / f"{plan.header.sequence_id}.h5"
            with SequenceWriter(file, plan.header) as writer:
                for arrays in plan.blocks():
                    writer.append(arrays)
            files.append(file)
    return files
