"""Whether files are whole: as they were, byte for byte, or another that the reader of their kind takes to its end."""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path


def contents(*folders: Path) -> dict[Path, str]:
    """SHA-256 of every file in ``folders``, without the hidden ones that a killed writer leaves."""
    found = (p for folder in folders for p in folder.rglob("*") if p.is_file() and not part(p))
    return {p: hashlib.sha256(p.read_bytes()).hexdigest() for p in found}


def part(path: Path) -> bool:
    """Whether ``path`` is a file that was being written."""
    return path.name.startswith(".") and ".part" in path.name


def read_whole(path: Path) -> None:
    """Read ``path`` to its end by the reader of its kind; raises whatever that raises where it is not whole."""
    data = path.read_bytes()
    if path.suffix in (".safetensors", ".run"):
        from safetensors.numpy import load

        assert load(data)
    elif path.suffix == ".npz":
        from nerg_mi.rays.rays import Rays

        assert len(Rays.load(path))
    elif path.suffix == ".ply":
        import trimesh

        assert len(trimesh.load(path, process=False).vertices)
    elif path.suffix == ".vol":
        x, y, z, channels = struct.unpack("<4i", data[8:24])
        assert data[:3] == b"VOL" and len(data) == 48 + 4 * x * y * z * channels
    elif path.suffix == ".exr":
        import OpenEXR

        with OpenEXR.File(str(path)) as picture:
            assert all(c.pixels is not None for c in picture.channels().values())
    elif path.suffix == ".json":
        json.loads(data)
    elif path.suffix == ".png":
        import matplotlib.image

        assert matplotlib.image.imread(path).size
    else:
        assert data.endswith(b"\n"), "its last line is cut off"


def lost_files(before: dict[Path, str], after: dict[Path, str]) -> list[str]:
    """Files that are gone, or neither as they were nor whole, each with what is wrong."""
    found = [f"{path} is gone" for path in before if path not in after and path.suffix != ".run"]
    for path, digest in after.items():
        if before.get(path) == digest:
            continue
        try:
            read_whole(path)
        except Exception as error:  # whatever a reader says of what is not whole
            found.append(f"{path} is not whole: {type(error).__name__}: {error}")
    return found
