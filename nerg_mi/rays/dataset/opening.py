"""Rays from what a user names: a file of them, or a dataset."""

from __future__ import annotations

import os
from pathlib import Path

from nerg_mi.files.checksum import file_sha256
from nerg_mi.rays.rays import Rays

from .dataset import MOST, RayDataset
from .layout import is_dataset


def load_rays(path: str | os.PathLike, most: int | None = None, seed: int = 0) -> Rays:
    """The rays of a file, or of a dataset or a part of it (``shop.rays/place=north``).

    ``most``: of a dataset, take so many at most: of more, a sample by ``seed`` in which each is as likely as any other.
    None: all, of which there may be 50 million. Raises `NergError` for what is neither, or damaged.
    """
    if not Path(path).is_dir():
        return Rays.load(path)
    found = RayDataset.open(path)
    if most is not None and len(found) > most:
        return found.sample(most, seed)
    return found.load(most=MOST if most is None else most)


def rays_digest(path: str | os.PathLike) -> str:
    """SHA-256 of a file of rays, or that of which rays a dataset holds."""
    return RayDataset.open(path).digest if is_dataset(path) else file_sha256(Path(path))
