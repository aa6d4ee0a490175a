"""Hosts on this machine that keep small data sets: archives of two lidars, or files as they are."""

import json
from dataclasses import replace
from pathlib import Path

from semantic2d_dataset.access.known_datasets import FileTable, KnownDataset, RemoteFile
from semantic2d_dataset.scene.lidars import WLR_716
from tests.access.hosts import Host, md5
from tests.conversion.releases import make_release, pack_tar, pack_zip

HOKUYO, WLR = "hokuyo-utm-30lx-ew", "wlr-716"
SESSIONS = ("2024-04-04-12-16-41",)


def pack_archives(folder: Path, scans: int = 6) -> dict[str, bytes]:
    """Archives in the published layout, by name: one of each lidar, and one of raw bags."""
    folder.mkdir(parents=True, exist_ok=True)
    lobby = make_release(folder / "lobby", sessions=SESSIONS, scans=scans)
    hall = make_release(folder / "hall", sessions=SESSIONS, scans=scans, beams=WLR_716.beams)
    return {
        "lobby.zip": pack_zip(lobby, folder / "lobby.zip").read_bytes(),
        "hall.tar.gz": pack_tar(hall, folder / "hall.tar.gz").read_bytes(),
        "rosbags.zip": b"a bag",
    }


def archives_at(host: Host, **more) -> KnownDataset:
    """The entry of a registry for archives that a host serves."""
    said = {"parts": {"raw": ("*bag*",)}, "lidars": {HOKUYO: ("lobby*",), WLR: ("hall*",)}}
    return replace(host.dataset(), license="CC0-1.0", **said | more)


def files_at(host: Host) -> KnownDataset:
    """The entry of a registry for files that a host serves and the registry lists."""
    files = [
        RemoteFile(name, len(body), md5(body), (f"{host.url}/files/{name}",))
        for name, body in host.files.items()
    ]
    return KnownDataset("d", "1", "D", "CC0-1.0", (FileTable(tuple(files)),))


def files_in(folder: Path) -> dict[str, bytes]:
    """The files of a data set as a host serves them."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def write_registry(path: Path, host: Host) -> Path:
    """A registry file that holds what `archives_at` says."""
    entry = {
        "id": "d",
        "version": "1",
        "title": "D",
        "license": "CC0-1.0",
        "doi": "10.1/x",
        "citation": "We, 2024",
        "parts": {"raw": ["*bag*"]},
        "lidars": {HOKUYO: ["lobby*"], WLR: ["hall*"]},
        "sources": [{"kind": "zenodo", "record": "7", "host": host.url}],
    }
    said = {"format": "semantic2d-registry", "format_version": "1.0", "datasets": [entry]}
    path.write_text(json.dumps(said))
    return path
