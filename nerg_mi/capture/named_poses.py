"""Which file describes a posed image set, and its poses by the names of its images, whether or not they are there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.bounded import size_of

from .colmap import count_images, model_files, read_image_poses
from .posed import name_some
from .transforms import read_frame_poses

_MODELS = ("", "sparse", "colmap/sparse")


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """The N images of a posed image set, in its own coordinates."""

    path: Path  # the file that lists them
    sha256: str  # of the set, as the provenance of what is trained on it has it
    names: list[str]
    to_world: np.ndarray  # (N, 4, 4) rigid OpenGL camera-to-world: x right, y up, z back
    notes: list[str]  # sentences on what of a COLMAP model contradicts itself, and on models that are not used


def find_source(dataset: str | Path) -> Path:
    """The transforms file of ``dataset``, or the folder of its COLMAP model, of several the one with the most images.
    ``dataset``: a folder, or that file itself."""
    dataset = Path(dataset)
    if dataset.exists() and not dataset.is_dir():
        size_of(dataset, "posed image set")
        # A file of a COLMAP model stands for the model.
        return dataset.parent if dataset.suffix in (".bin", ".txt") else dataset
    for name in ("transforms.json", "transforms_train.json"):
        if (dataset / name).is_file():
            return dataset / name
    for name in _MODELS:
        models = _list_models(dataset / name)
        if models:
            return models[0] if len(models) == 1 else max(models, key=count_images)
    raise MissingFile(
        f'"{dataset}" holds neither transforms.json nor transforms_train.json nor a COLMAP model '
        "(sparse/0/cameras.bin); name the folder of a posed image set"
    )


def _list_models(folder: Path) -> list[Path]:
    """COLMAP's models of one reconstruction: in the numbered folders of ``folder``, and ``folder`` itself."""
    numbered = sorted((p for p in folder.glob("*") if p.name.isdecimal()), key=lambda p: int(p.name))
    return [p for p in (*numbered, folder) if model_files(p) is not None]


def describe_other_models(model: Path) -> list[str]:
    """A sentence on the models of the same reconstruction that are not used where the COLMAP ``model`` is."""
    models = _list_models(model.parent if model.name.isdecimal() else model)
    others = [p for p in models if p.resolve() != model.resolve()]
    if not others:
        return []
    describe = lambda p: f'"{p.name}" ({count_images(p):,} images)'
    return [
        f"of {len(models)} COLMAP models {describe(model)} is used, and not {name_some(describe(p) for p in others)}"
    ]


def read_named_poses(source: str | Path) -> NamedPoses:
    """Of a transforms file, or of the folder of a COLMAP model; `find_source` finds either.

    Raises `NergError` for what cannot be parsed, and for a file that lists nothing.
    """
    source = Path(source)
    if source.is_dir() and model_files(source) is not None:
        path, sha256, listed, notes = read_image_poses(source)
        notes += describe_other_models(source)
    else:
        path, (sha256, listed), notes = source, read_frame_poses(source), []
    if not listed:
        raise NergError(f'"{path}" lists no images; name the file of a posed image set')
    return NamedPoses(path, sha256, [name for name, _ in listed], np.stack([pose for _, pose in listed]), notes)
