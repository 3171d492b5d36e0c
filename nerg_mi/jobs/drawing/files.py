"""Pictures in files: colour, and quantities that were rendered with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Layers, Overlay
from nerg_mi.files.images import read_exr, read_exr_text
from nerg_mi.rendering.bands import SURFACE

EXR = ".exr"


def shared_note(names: Sequence[str], basis: Sequence[str]) -> str:
    """A line on what several pictures rest on: once where it is the same, otherwise by their names."""
    if len(set(basis)) == 1:
        return basis[0]
    return "; ".join(f"{name}: {words or 'not known'}" for name, words in zip(names, basis))


def read_stored(path: Path, overlay: Overlay) -> Layers:
    """The EXR file ``path`` with the quantity of ``overlay``; without opacity there are surfaces everywhere, and
    nothing rests on rays where the file does not say so. Raises `NergError` for other files and for one that has no
    such channel."""
    if path.suffix.lower() != EXR:
        raise NergError(f'"{path}" holds no quantities, which an EXR file does; give one that "nerg render" wrote')
    found = read_exr(path, "picture")
    values = next((found[name] for name in found if overlay.name in (name, name.partition(".")[0])), None)
    if values is None:
        raise NergError(f'"{path}" has no "{overlay.name}"; it has {", ".join(found)}')
    color = [found[name] for name in "RGB"] if {"R", "G", "B"} <= set(found) else [np.zeros_like(values)] * 3
    opacity = found.get("opacity.Y")
    mask = np.ones(values.shape, bool) if opacity is None else opacity >= SURFACE
    as_floats = lambda array: np.nan_to_num(np.asarray(array, np.float32))
    part = overlay.quantity.rests_on
    basis = read_exr_text(path, "picture").get(f"{part}.basis", "") if part else ""
    return Layers(as_floats(np.stack(color, axis=-1)), np.asarray(values, np.float32), mask, basis=basis)
