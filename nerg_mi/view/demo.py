"""The demo: every picture that shows what a gaze field is, rendered from a scene with an observer.

The scene has three sensors: 0 a camera that sees behind what hides it from the observer, 1 the observer's own view, 2
the observer's sphere (a `panorama`); its integrator is `nerg` with a gaze field, and it has the `<default>`s of
``scenes/store/scene.xml``. Equal seeds give equal pictures, byte for byte.
"""

from __future__ import annotations

import hashlib
import platform
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi import __version__, llvm
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_folder
from nerg_mi.files.exr import write_bitmap_exr
from nerg_mi.files.tables import write_json
from nerg_mi.interruption import Interruption
from nerg_mi.rendering.bands import render_bands
from nerg_mi.rendering.pictures import activate, load_scene

from . import figures
from .overlay import Heat, top_of
from .tonemap import srgb, write_png

CAMERA, OWN, SPHERE = range(3)
SURFACE = 0.5
"""Opacity from which on a pixel shows a surface, as the integrator has it."""

CHECKPOINTS = {"field": "store.safetensors", "gaze": "shoppers.safetensors"}
MAKE = "python -m nerg_mi.scenes.store.make"

STAGES = ("load", "camera", "own view", "gaze sphere", "without occlusion", "pictures")


@dataclass(frozen=True)
class Render:
    """A render taken apart: ``color`` (h, w, 3) linear, ``aovs`` each (h, w), ``bitmap`` with all channels."""

    color: np.ndarray
    aovs: dict[str, np.ndarray]
    bitmap: object

    @property
    def mask(self) -> np.ndarray:
        """Where there is a surface (h, w), bool."""
        return self.aovs["opacity"] >= SURFACE


@dataclass(frozen=True)
class DemoResult:
    """``files`` written, in the order of interest; ``seconds`` of each stage; ``report``: what run.json holds."""

    files: list[Path]
    seconds: dict[str, float]
    report: dict


def run_demo(
    out: str | Path,
    *,
    scene: str | Path | None = None,
    defaults: Mapping[str, str] | None = None,
    width: int = 600,
    spp: int = 8,
    seed: int = 0,
    variant: str | None = None,
    on_stage: Callable[[str], None] | None = None,
) -> DemoResult:
    """Render all pictures of the demo into the folder ``out``, which is made.

    ``scene``: another file than the store's scene.xml; ``defaults``: values for its `<default>`s; ``width`` in pixels
    of a picture (3:2; the sphere's is 2:1 and as wide); ``spp``: samples a pixel; ``variant`` None: the best that
    works; ``on_stage`` is told the name of each of `STAGES` as it begins. Raises NergError where a checkpoint is
    missing, and KeyboardInterrupt, between two steps of less than a second, after Ctrl-C.
    """
    if width < 12 or spp < 1:
        raise NergError(f"the demo needs pictures of at least 12 pixels and 1 sample a pixel, got {width} and {spp}.")
    out = Path(out)
    check_folder(out)
    scene = store_scene() if scene is None else Path(scene)
    inputs = _inputs(scene, defaults or {})
    active = activate(variant)
    import mitsuba as mi

    clock = _Clock(on_stage)
    sizes = {"width": width, "height": 2 * width // 3, "sphere_width": width // 2 * 2, "sphere_height": width // 2}
    values = {k: str(v) for k, v in sizes.items()} | dict(defaults or {})
    values |= {"aovs": "depth,opacity,gaze,visibility"}

    with Interruption() as stop:
        clock.start("load")
        seen = load_scene(scene, values)
        unhidden = load_scene(scene, values | {"occlusion": "false", "radiance": "false", "aovs": "opacity,gaze"})
        if len(seen.sensors()) < 3:
            raise NergError(
                f'"{scene}" has {len(seen.sensors())} sensor(s): give it a camera, the own view and a panorama.'
            )
        clock.start("camera")
        camera = _render(mi, seen, CAMERA, spp, seed, stop.check)
        clock.start("own view")
        own = _render(mi, seen, OWN, spp, seed, stop.check)
        clock.start("gaze sphere")
        sphere = _render(mi, seen, SPHERE, spp, seed, stop.check)
        clock.start("without occlusion")
        without = _render(mi, unhidden, CAMERA, spp, seed, stop.check)
        stop.check()

    clock.start("pictures")
    versions = _versions(active)
    header = {"Software": f"nerg_mi {__version__}", "Comment": f"seed {seed}, {spp} samples a pixel, {active}"}
    # One scale for all pictures of gaze, so that a colour means the same in each of them.
    tops = [top_of(r.aovs["gaze"], r.mask) for r in (own, camera, sphere, without) if np.any(r.aovs["gaze"] > 0)]
    if not tops:
        raise NergError(
            f'the gaze is 0 in every picture: move the eye of "{scene}", or train its gaze field for longer.'
        )
    heat = Heat(max(tops))
    marker = _pixel_of_observer(mi, seen)
    files = _write_pictures(out, camera, own, sphere, without, heat, marker, header)
    camera.bitmap.metadata()["seed"] = seed
    write_bitmap_exr(out / "scene.exr", camera.bitmap)
    files.append(out / "scene.exr")
    clock.stop()

    report = {
        "command": "nerg demo",
        "versions": versions,
        "variant": active,
        "seed": seed,
        "spp": spp,
        **sizes,
        "defaults": dict(defaults or {}),
        "gaze_scale_top_per_sr": heat.top,
        "gaze_sphere_integral": _integral(sphere),
        "seconds": {k: round(v, 2) for k, v in clock.seconds.items()},
        "inputs": {p.name: checksum(p) for p in inputs},
        "outputs": {p.name: checksum(p) for p in files},
    }
    write_json(out / "run.json", report)
    return DemoResult([*files, out / "run.json"], clock.seconds, report)


def store_scene() -> Path:
    """The demo store's scene.xml, as installed."""
    from nerg_mi import scenes

    return Path(scenes.__file__).resolve().parent / "store" / "scene.xml"


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


# ----------------------------------------------------------------------------
# Rendering
# ----------------------------------------------------------------------------


def _inputs(scene: Path, defaults: Mapping[str, str]) -> list[Path]:
    if not scene.is_file():
        raise NergError(f'there is no scene file "{scene}".')
    paths = [scene]
    for name, file in CHECKPOINTS.items():
        path = scene.parent / defaults.get(name, file)  # an absolute name stays as it is
        if not path.is_file():
            raise NergError(f'the {name} checkpoint "{path}" is missing: make it with "{MAKE}" (about 20 minutes).')
        paths.append(path)
    return paths


def _render(mi, scene, index: int, spp: int, seed: int, check: Callable[[], None] | None = None) -> Render:
    """``check`` is called between two steps, and may raise."""
    names = scene.integrator().aov_names()
    on_strip = None if check is None else lambda done, total: check()
    (band,) = render_bands(scene, scene.sensors()[index], spp=spp, seed=seed, on_strip=on_strip)
    pixels = np.array(band.film.develop())
    color = pixels[..., : pixels.shape[2] - len(names)]
    aovs = {n.split(".")[0]: pixels[..., color.shape[2] + k] for k, n in enumerate(names)}
    # Mono variants render one channel.
    return Render(np.broadcast_to(color[..., :3], (*color.shape[:2], 3)), aovs, band.film.bitmap())


def _pixel_of_observer(mi, scene):
    """Where the observer stands in the picture of the camera, in pixels (x, y); None outside of it."""
    from nerg_mi.transport.observer.viewpoint import center

    camera = scene.sensors()[CAMERA]
    film = camera.film()
    fov = mi.traverse(camera)["x_fov"]
    local = camera.world_transform().inverse() @ center(scene.sensors()[OWN])
    clip = camera.near_clip(), camera.far_clip()
    screen = mi.perspective_projection(film.size(), film.crop_size(), film.crop_offset(), fov, *clip)
    x, y, _ = (float(v[0]) for v in np.array(screen @ local).reshape(3, -1))
    depth = float(np.array(local).reshape(3, -1)[2, 0])
    if depth <= 0 or not (0 < x < 1 and 0 < y < 1):
        return None
    width, height = film.crop_size()
    return x * width - 0.5, y * height - 0.5  # imshow counts from the first pixel's centre


def _integral(sphere: Render) -> float:
    """What the gaze density adds up to over the observer's sphere: 1 for a density that is one."""
    from nerg_mi.transport.panorama import pixel_solid_angles

    height, width = sphere.aovs["gaze"].shape
    return float((sphere.aovs["gaze"].astype(np.float64) * pixel_solid_angles(width, height)).sum())


# ----------------------------------------------------------------------------
# Writing
# ----------------------------------------------------------------------------


def _write_pictures(out: Path, camera, own, sphere, without, heat: Heat, marker, header) -> list[Path]:
    total = _integral(sphere)
    drawn = {
        "occlusion": lambda: figures.occlusion_figure(
            (own.color, own.aovs["gaze"], own.mask),
            (camera.color, without.aovs["gaze"], without.mask),
            (camera.color, camera.aovs["gaze"], camera.mask),
            heat,
            marker,
        ),
        "gaze": lambda: figures.gaze_figure(
            camera.color, camera.aovs["gaze"], camera.mask, heat, "Where the observer looks"
        ),
        "gaze_sphere": lambda: figures.sphere_figure(
            sphere.color,
            sphere.aovs["gaze"],
            sphere.mask,
            heat,
            f"The gaze sphere of the observer; its integral is {total:.3f}",
        ),
        "depth": lambda: figures.depth_figure(camera.aovs["depth"], camera.mask),
        "visibility": lambda: figures.visibility_figure(camera.color, camera.aovs["visibility"], camera.mask),
    }
    files = []
    for name, draw in drawn.items():
        files.append(out / f"{name}.png")
        figures.save(draw(), files[-1], header)
    files.append(out / "color.png")
    write_png(files[-1], srgb(camera.color), header)
    return files


def _versions(variant: str) -> dict[str, str]:
    import drjit
    import mitsuba

    versions = {
        "nerg_mi": __version__,
        "mitsuba": mitsuba.__version__,
        "drjit": drjit.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    library = llvm.current()
    if variant.startswith("llvm") and library is not None:
        versions["libLLVM"] = ".".join(map(str, library.version))
    if variant.startswith("cuda"):
        versions["cuda"] = ".".join(map(str, drjit.detail.cuda_version()))
    return versions


class _Clock:
    """Seconds of one stage after the other."""

    def __init__(self, on_stage):
        self.seconds: dict[str, float] = {}
        self._on_stage, self._name, self._since = on_stage, None, 0.0

    def start(self, name: str) -> None:
        self.stop()
        self._name, self._since = name, time.perf_counter()
        if self._on_stage is not None:
            self._on_stage(name)

    def stop(self) -> None:
        if self._name is not None:
            self.seconds[self._name] = time.perf_counter() - self._since
            self._name = None


def look(out: str | Path) -> str:
    """The command with which this machine shows the pictures in ``out``."""
    first = Path(out) / "occlusion.png"
    opener = "open" if sys.platform == "darwin" else "xdg-open"
    if shutil.which(opener):
        return f"{opener} {first}"
    # A machine without a desktop: any browser that reaches it will do.
    return f"python3 -m http.server --bind 127.0.0.1 --directory {out} 8000, then http://127.0.0.1:8000/{first.name}"
