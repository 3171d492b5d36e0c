"""Figures as files: PNG and SVG, byte for byte the same for the same input, and as pixels for a video."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.files.atomic import check_writable, write_bytes

from .provenance import Provenance

FORMATS = (".png", ".svg")
"""Suffixes of figures that are written."""

_OF_SVG = {"Software": "Creator", "Comment": "Description", "Title": "Title"}
_SALT = "nerg_mi"


def save(figure: Any, path: str | os.PathLike, about: Provenance | Mapping[str, str] | None = None) -> None:
    """Write a matplotlib figure as .png, or as .svg with its pictures embedded and all else as lines and text.

    ``about``: what its header says, names of PNG's texts (such as ``Comment``) in a mapping; no time is in it, so that
    equal figures are equal files. Raises `NergError` for other suffixes and for what cannot be written.
    """
    check_writable(path, *FORMATS)
    text = dict(about.text() if isinstance(about, Provenance) else about or {})
    write_bytes(path, encode(figure, Path(path).suffix.lower(), text))


def encode(figure: Any, suffix: str, text: Mapping[str, str] | None = None) -> bytes:
    """The bytes of ``figure`` in one of `FORMATS`, with ``text`` in its header."""
    import matplotlib

    out, text = io.BytesIO(), dict(text or {})
    if suffix == ".svg":
        known = {_OF_SVG[k]: v for k, v in text.items() if k in _OF_SVG}
        metadata: dict[str, Any] = {"Date": None, "Creator": None, **known}
        # Ids are made of the salt, and at random without one.
        with matplotlib.rc_context({"svg.hashsalt": _SALT, "svg.fonttype": "none", "svg.image_inline": True}):
            figure.savefig(out, format="svg", dpi=figure.dpi, metadata=metadata)
        return out.getvalue()
    figure.savefig(
        out, format="png", dpi=figure.dpi, metadata={"Software": None, **text}, pil_kwargs={"optimize": True}
    )
    return out.getvalue()


def rasterize(figure: Any) -> np.ndarray:
    """``figure`` as display values (h, w, 3) of uint8, as its PNG has them."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
