"""Which file describes a posed image set, and its poses by the names of its images, whether or not they are there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import MissingFile, NergError

from .colmap import model_files, read_image_poses
from .transforms import read_frame_poses

_MODELS = ("", "sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """The N images of a posed image set, in its own coordinates."""

    path: Path  # the file that lists them
    sha256: str  # of the set, as the provenance of what is trained on it has it
    names: list[str]
    to_world: np.ndarray  # (N, 4, 4) rigid OpenGL camera-to-world: x right, y up, z back


def find_source(dataset: str | Path) -> Path:
    """The transforms file of ``dataset``, or the folder of its COLMAP model. ``dataset``: a folder, or that file
    itself."""
    dataset = Path(dataset)
    if dataset.is_file():
        # A file of a COLMAP model stands for the model.
        return dataset.parent if dataset.suffix in (".bin", ".txt") else dataset
    for name in ("transforms.json", "transforms_train.json"):
        if (dataset / name).is_file():
            return dataset / name
    for name in _MODELS:
        if model_files(dataset / name) is not None:
            return dataset / name
    raise MissingFile(
        f'"{dataset}" holds neither transforms.json nor transforms_train.json nor a COLMAP model '
        "(sparse/0/cameras.bin); name the folder of a posed image set"
    )


def read_named_poses(source: str | Path) -> NamedPoses:
    """Of a transforms file, or of the folder of a COLMAP model; `find_source` finds either.

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
