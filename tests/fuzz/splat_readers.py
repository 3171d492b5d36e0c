"""Files of Gaussian splats, each as another program writes it."""

from __future__ import annotations

from pathlib import Path

from tests.formats.splats import writers
from tests.fuzz.describe import Reader


def _make(name: str, **how):
    def make(folder: Path) -> None:
        write = {
            ".ply": writers.write_inria,
            ".splat": writers.write_antimatter,
            ".spz": writers.write_spz,
            ".glb": writers.write_khronos,
        }[Path(name).suffix]
        write(folder / name, writers.random_splats(12, degree=1), **how)

    return make


def _read(name: str):
    def read(folder: Path) -> object:
        from nerg_mi.formats.splats import read_splats

        splats = read_splats(folder / name)
        return splats.axes(), splats.degree

    return read


SPLATS = [
    Reader("splats: binary.ply", _make("binary.ply"), {"binary.ply": ()}, _read("binary.ply")),
    Reader("splats: text.ply", _make("text.ply", style="ascii"), {"text.ply": ("text",)}, _read("text.ply")),
    Reader("splats: a.splat", _make("a.splat"), {"a.splat": ()}, _read("a.splat")),
    Reader("splats: a.spz", _make("a.spz"), {"a.spz": ("gzip",)}, _read("a.spz")),
    Reader("splats: a.glb", _make("a.glb"), {"a.glb": ()}, _read("a.glb")),
]
