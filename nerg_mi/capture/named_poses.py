"""Poses of a model by the names of its images, whether or not the images are there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError

from .colmap import model_files, read_image_poses
from .transforms import read_frame_poses


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """The N images of a posed image set, in its own coordinates."""

    path: Path  # the file that lists them
    sha256: str  # of the set, as the provenance of what is trained on it has it
    names: list[str]
    to_world: np.ndarray  # (N, 4, 4) rigid OpenGL camera-to-world: x right, y up, z back


def read_named_poses(source: str | Path) -> NamedPoses:
    """Of a transforms file, or of the folder of a COLMAP model; `nerg_mi.capture.sources.find_source` finds either.

    Raises `NergError` for what cannot be parsed, and for a file that lists nothing.
    """
    source = Path(source)
    if source.is_dir() and model_files(source) is not None:
        path, sha256, listed = read_image_poses(source)
    else:
        path, (sha256, listed) = source, read_frame_poses(source)
    if not listed:
        raise NergError(f'"{path}" lists no images; name the file of a posed image set')
    return NamedPoses(path, sha256, [name for name, _ in listed], np.stack([pose for _, pose in listed]))
