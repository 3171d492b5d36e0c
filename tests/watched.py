"""A scene with a field, a gaze field and an observer, small enough to render in a second."""

from __future__ import annotations

from pathlib import Path

from tests.figures.test_films import OVERLAYS_SCENE as SCENE
from tests.plugins import fields

MODE = "llvm_ad_rgb"


def write_scene(folder: Path, name: str = "scene.xml") -> Path:
    """Create ``folder``, and write the scene and its fields to it."""
    import mitsuba as mi

    mi.set_variant(MODE)
    folder.mkdir(exist_ok=True)
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    (folder / name).write_text(SCENE)
    return folder / name
