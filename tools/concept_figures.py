"""The pictures of docs/concepts.md, rendered from the demo store.

    python -m tools.concept_figures [--width 360] [--out docs/images]

Half a minute on two cores. They are made again by hand, after a change of what they show.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import nerg_mi as nerg
from tools.imports import ROOT

STORE = ROOT / "scenes" / "store"
EYE, AHEAD = (4.4, 2.8, 1.6), (4.8, 4.4, 1.2)
"""The observer of the demo scene, and what they are turned to."""
ASIDE, TARGET = (7.4, 3.4, 2.2), (4.8, 4.2, 1.0)
"""A camera beyond a shelf."""


def draw(out: Path, width: int = 360, spp: int = 8) -> list[Path]:
    """Write all pictures into the folder ``out``, panels of ``width`` pixels with ``spp`` samples each."""
    out.mkdir(parents=True, exist_ok=True)
    gaze = nerg.load_gaze(STORE / "shoppers.safetensors")
    scene = nerg.make_scene(STORE / "store.safetensors", gaze, falloff=0.05)
    own = nerg.Camera(EYE, AHEAD, fov=78, width=width, height=2 * width // 3)
    aside = nerg.Camera(ASIDE, TARGET, fov=78, width=width, height=2 * width // 3)
    asked = ["color", "depth", "emit", "capture", "gaze"]
    seen = {k: v[0] for k, v in _values(nerg.render(scene, [EYE], asked, camera=own, spp=spp), asked).items()}
    asked = ["color", "depth", "observer_depth", "visibility", "gaze"]
    beside = {k: v[0] for k, v in _values(nerg.render(scene, [EYE], asked, camera=aside, spp=spp), asked).items()}
    bare = nerg.make_scene(STORE / "store.safetensors", gaze, occlusion=False)
    beside["unhidden"] = nerg.render(bare, [EYE], ["gaze"], camera=aside, spp=spp).gaze[0]
    pictures = {
        "concept-place.png": _place(seen),
        "concept-ray.png": _rays(scene),
        "concept-product.png": _product(seen),
        "concept-occlusion.png": _occlusion(beside),
        "concept-density.png": _density(scene, width),
    }
    for name, figure in pictures.items():
        figure.savefig(out / name, dpi=100, metadata={"Software": None}, pil_kwargs={"optimize": True})
    return [out / name for name in pictures]


def _values(pictures: Any, names: list[str]) -> dict[str, np.ndarray]:
    return {name: pictures[name] for name in names}


def _srgb(color: np.ndarray) -> np.ndarray:
    from nerg_mi.figures.tonemap import srgb

    return np.clip(srgb(color), 0, 1)


def _panels(count: int, size: tuple[float, float] = (4.2, 3.1)) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] * count, size[1]), layout="constrained")
    return figure, np.atleast_1d(figure.subplots(1, count))


def _show(axes: Any, picture: np.ndarray, title: str, label: str = "", cmap: str = "inferno", top: float = 0.0) -> None:
    shown = axes.imshow(picture, cmap=cmap, vmin=0 if top else None, vmax=top or None)
    axes.set(title=title, xticks=[], yticks=[])
    if label:
        axes.figure.colorbar(shown, ax=axes, label=label, shrink=0.85)


def _place(seen: dict[str, np.ndarray]) -> Any:
    figure, (left, right) = _panels(2)
    _show(left, _srgb(seen["color"]), "colour: what the field emits towards the eye")
    _show(right, seen["depth"], "depth: where most of the light comes from", "distance [m]", "viridis_r")
    return figure


def _rays(scene: Any) -> Any:
    """The floor plan, and where the gaze of one observer goes: rays drawn from the field's own density."""
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = nerg.trace(scene, EYE, directions, ["depth", "gaze"])
    kept = rng.random(4000) < seen.gaze / seen.gaze.max()
    ends = np.asarray(EYE) + seen.depth[:, None] * directions
    figure, (axes,) = _panels(1, (6.4, 4.6))
    for region in json.loads((STORE / "regions.json").read_text())["regions"]:
        low, high = region["min"], region["max"]
        corners = ([low[0], high[0], high[0], low[0]], [low[1], low[1], high[1], high[1]])
        axes.fill(*corners, facecolor="#d9d9d9", edgecolor="#a6a6a6", linewidth=0.6)
    for end in ends[kept]:
        axes.plot([EYE[0], end[0]], [EYE[1], end[1]], color="#d95f02", linewidth=0.6, alpha=0.45)
    axes.plot(ends[kept, 0], ends[kept, 1], ".", color="#7a3300", markersize=3, label="where they end: $p_{od}$")
    axes.plot(*EYE[:2], "o", color="#1b6ca8", markersize=9, label="the observer: $p_o$")
    axes.plot(*ASIDE[:2], "s", color="#333333", markersize=8, label="a camera elsewhere")
    axes.set(title=f"{kept.sum()} rays of one observer, from above", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.set_ylim(-0.4, 6.4)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), fontsize=8, ncols=3, frameon=False)
    return figure


def _product(seen: dict[str, np.ndarray]) -> Any:
    figure, (emit, capture, gaze) = _panels(3)
    top = float(np.percentile(seen["gaze"], 99.5))
    _show(emit, seen["emit"], "emit: how much a surface attracts", "1/sr", "inferno")
    _show(capture, seen["capture"], "sigmoid(capture): what is taken up", "share", "viridis")
    _show(gaze, seen["gaze"], "their product: gaze", "density [1/sr]", "inferno", top)
    return figure


def _occlusion(beside: dict[str, np.ndarray]) -> Any:
    figure, (without, visible, hidden) = _panels(3)
    top = float(np.percentile(beside["unhidden"], 99.5))
    _show(without, beside["unhidden"], "gaze without occlusion", "density [1/sr]", "inferno", top)
    _show(visible, beside["visibility"], "visible to the observer", "share", "cividis", 1.0)
    _show(hidden, beside["gaze"], "gaze: what they can see", "density [1/sr]", "inferno", top)
    return figure


def _density(scene: Any, width: int) -> Any:
    """All that the observer could turn to, by azimuth and elevation, and how large the cells of such a picture are."""
    rows = width // 2
    elevation = np.radians(np.linspace(89.5, -89.5, rows))
    azimuth = np.radians(np.linspace(-179.5, 179.5, 2 * rows))
    el, az = np.meshgrid(elevation, azimuth, indexing="ij")
    # The middle of the picture looks north (+y), east is to the right of it.
    directions = np.stack([np.sin(az) * np.cos(el), np.cos(az) * np.cos(el), np.sin(el)], axis=-1).reshape(-1, 3)
    gaze = nerg.trace(scene, EYE, directions, ["gaze"]).gaze.reshape(el.shape)
    solid = np.cos(el) * (np.pi / rows) ** 2
    figure, (left, right) = _panels(2, (5.2, 3.0))
    extent = (-180, 180, -90, 90)
    for axes, values, title, label in (
        (left, gaze, "density [1/sr] of each direction", "1/sr"),
        (right, gaze * solid * 1e3, "share of each cell: density x solid angle", "thousandths"),
    ):
        shown = axes.imshow(values, extent=extent, cmap="inferno", vmin=0, aspect="auto")
        axes.set(title=title, xlabel="azimuth [degrees]", ylabel="elevation [degrees]")
        figure.colorbar(shown, ax=axes, label=label)
    figure.suptitle(f"sum over the sphere: {float((gaze * solid).sum()):.2f}", fontsize=10)
    return figure


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=360, help="pixels of a panel (360)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images", help="folder to write into")
    options = parser.parse_args(arguments)
    for path in draw(options.out, options.width):
        print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
