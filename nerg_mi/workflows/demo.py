"""The demo: every picture that shows what a gaze field is, rendered from a scene with an observer.

The scene has three sensors: 0 a camera that sees behind what hides it from the observer, 1 the observer's own view, 2
the observer's sphere (a `panorama`); its integrator is `nerg` with a gaze field, and it has the `<default>`s of
``scenes/store/scene.xml``. Equal seeds give equal pictures, byte for byte.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.evaluation.gaze_report import read_results
from nerg_mi.figures import overlay as figures
from nerg_mi.figures.overlay import Heat, srgb, robust_max, write_png
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import Provenance, make_provenance, save
from nerg_mi.files.atomic import check_folder, file_sha256, write_bytes
from nerg_mi.files.images import write_bitmap_exr
from nerg_mi.files.tables import write_csv, write_json
from nerg_mi.interruption import Interruption
from nerg_mi.rendering.bands import Channels, render_channels
from nerg_mi.rendering.scene import activate_variant, load_scene
from nerg_mi.rendering.scene_writer import project_to_pixel
from nerg_mi.transport.geometry import pixel_solid_angles
from nerg_mi.transport.observer import sensor_center

from .bake import bake
from .base import SILENT, Reporter, versions
from .render import describe_bases, describe_basis
from .report import RESULTS, make_report
from .scene_commands import BakeOptions, DemoOptions, ReportOptions

CAMERA, OWN, SPHERE = range(3)
"""Index of each sensor."""

CHECKPOINTS = {"field": "store.safetensors", "gaze": "shoppers.safetensors"}
MAKE = "python -m nerg_mi.scenes.store.make"
REPORT_POINTS = 60_000
"""Points of the report's 3D scene."""

TRACKED = "shoppers.npz"
"""A tenth of each visit of the tracked gaze that the store's field was trained on."""

REPORT_VIEWPOINTS = 24
"""Places of people that the report looks from: few, since a demo must be quick."""

STAGES = (
    *("load", "camera", "own view", "gaze sphere", "without occlusion", "pictures", "surfaces", "tracked gaze"),
    "report",
)
OBJECTS, TWIN = "regions.json", "twin.ply"
"""Files of named objects and of the place as a mesh, where they stand beside the scene."""


@dataclass(frozen=True)
class DemoResult:
    """``files`` written, in the order of interest; ``seconds`` of each stage; ``report``: what run.json holds."""

    files: list[Path]
    seconds: dict[str, float]
    report: dict


def make_demo(out: str | Path, options: DemoOptions | None = None, reporter: Reporter = SILENT) -> DemoResult:
    """Render all pictures of the demo into the folder ``out``, which is made.

    The reporter's progress names each of `STAGES` as it begins. Raises `NergError` where a checkpoint is missing, and
    ``KeyboardInterrupt``, between two steps of less than a second, after Ctrl-C.
    """
    options = options or DemoOptions()
    width, spp, seed = options.width, options.spp, options.seed
    if width < 12 or spp < 1:
        raise NergError(f"the demo needs pictures of at least 12 pixels and 1 sample a pixel, got {width} and {spp}")
    out = Path(out)
    check_folder(out)
    scene = find_store_scene() if options.scene is None else Path(options.scene)
    defaults = dict(options.defaults or {})
    inputs = _inputs(scene, defaults)
    mode = activate_variant(options.mode)
    clock = _Clock(reporter)
    sizes = {"width": width, "height": 2 * width // 3, "sphere_width": width // 2 * 2, "sphere_height": width // 2}
    values = {k: str(v) for k, v in sizes.items()} | defaults
    values |= {"aovs": "depth,opacity,gaze,visibility"}

    with Interruption() as stop:
        clock.start("load")
        seen = load_scene(scene, values)
        unhidden = load_scene(scene, values | {"occlusion": "false", "radiance": "false", "aovs": "opacity,gaze"})
        if len(seen.sensors()) < 3:
            raise NergError(
                f'"{scene}" has {len(seen.sensors())} sensor(s): give it a camera, the own view and a panorama'
            )

        def render(of: Any, index: int) -> Channels:
            with translate_mitsuba_errors():
                return render_channels(of, of.sensors()[index], spp, seed, lambda done, total: stop.check())

        clock.start("camera")
        camera = render(seen, CAMERA)
        clock.start("own view")
        own = render(seen, OWN)
        clock.start("gaze sphere")
        sphere = render(seen, SPHERE)
        clock.start("without occlusion")
        without = render(unhidden, CAMERA)
        stop.check()

    clock.start("pictures")
    about = make_provenance("nerg demo", inputs, seed, {"spp": spp, "mode": mode, **sizes, "defaults": defaults})
    # One scale for all pictures of gaze, so that a colour means the same in each of them.
    tops = [robust_max(r.aovs["gaze"], r.mask) for r in (own, camera, sphere, without) if np.any(r.aovs["gaze"] > 0)]
    if not tops:
        raise NergError(
            f'the gaze is 0 in every picture: move the eye of "{scene}", or train its gaze field for longer'
        )
    heat = Heat(max(tops))
    pictures = {"own": own, "without": without, "camera": camera, "sphere": sphere}
    files = _write_pictures(out, pictures, heat, observer_pixel(seen), describe_basis(seen), about)
    for key, value in (about.text() | describe_bases(seen)).items():
        camera.bitmap.metadata()[key] = value
    write_bitmap_exr(out / "scene.exr", camera.bitmap)
    files.append(out / "scene.exr")
    clock.start("surfaces")
    eye = tuple(float(v) for v in np.ravel(np.array(sensor_center(seen.sensors()[OWN]))))
    if (scene.parent / TWIN).is_file():
        files.append(_bake(scene.parent / TWIN, inputs[2], eye, out / "heatmap.glb", mode, seed))
    clock.start("tracked gaze")
    tracked = []
    if scene == find_store_scene() and inputs[2] == scene.parent / CHECKPOINTS["gaze"]:
        tracked = [write_recording(out / TRACKED)]
        files += tracked
    clock.start("report")
    # Named by the scene, or that beside it of which the demo is made.
    objects = scene.parent / OBJECTS
    shown = ReportOptions(
        aois=objects if objects.is_file() else None,
        observer=eye,
        **_camera_of(seen.sensors()[CAMERA]),
        viewpoints=REPORT_VIEWPOINTS,
        width=min(max(width, 24), 1200),
        max_points=REPORT_POINTS,
        seed=seed,
        mode=mode,
        title="The demo store and its shoppers" if options.scene is None else None,
    )
    rendered = {"camera": camera, "own": own, "sphere": sphere}
    evaluation = find_evaluation(scene, inputs[2])
    made = make_report([*inputs[1:], *tracked, *evaluation], out / "report.html", shown, rendered=rendered)
    files.append(made.path)
    if made.run.observed_objects:
        rows = [{"object": o.name, "observer_share": round(o.predicted.mean, 6)} for o in made.run.observed_objects]
        write_csv(out / "aoi.csv", rows)
        files.append(out / "aoi.csv")
    clock.stop()

    report = {
        "command": "nerg demo",
        "versions": versions(mode),
        "variant": mode,
        "seed": seed,
        "spp": spp,
        **sizes,
        "defaults": defaults,
        "gaze_scale_top_per_sr": heat.vmax,
        "gaze_sphere_integral": sphere_integral(sphere),
        "seconds": {k: round(v, 2) for k, v in clock.seconds.items()},
        "inputs": {p.name: file_sha256(p) for p in [*inputs, *evaluation]},
        "outputs": {p.name: file_sha256(p) for p in files},
    }
    write_json(out / "run.json", report)
    files.append(out / "run.json")
    for path in files:
        reporter.message(f"wrote {path}")
    for _, verdict in made.run.verdicts:
        reporter.message(verdict.sentence)
    return DemoResult(files, clock.seconds, report)


def make_demo_to_look_at(out: Path, options: DemoOptions, reporter: Reporter) -> None:
    """`make_demo`, and how its pictures are looked at."""
    make_demo(out, options, reporter)
    reporter.message(f"Look at them with: {_viewer(out)}")


def _viewer(out: Path) -> str:
    """The command with which this machine shows the pictures in ``out``."""
    first = out / "occlusion.png"
    opener = "open" if sys.platform == "darwin" else "xdg-open"
    if shutil.which(opener):
        return f"{opener} {first}"
    # A machine without a desktop: any browser that reaches it will do.
    return f"python3 -m http.server --bind 127.0.0.1 --directory {out} 8000, then http://127.0.0.1:8000/{first.name}"


def find_store_scene() -> Path:
    """The demo store's scene.xml, as installed."""
    import nerg_mi.scenes as scenes  # pyright: ignore[reportMissingImports] which lies at the root of a checkout

    return Path(scenes.__path__[0]).resolve() / "store" / "scene.xml"


# ----------------------------------------------------------------------------
# Rendering
# ----------------------------------------------------------------------------


def _inputs(scene: Path, defaults: Mapping[str, str]) -> list[Path]:
    if not scene.is_file():
        raise NergError(f'there is no scene file "{scene}"')
    paths = [scene]
    for name, file in CHECKPOINTS.items():
        path = scene.parent / defaults.get(name, file)  # an absolute name stays as it is
        if not path.is_file():
            raise NergError(f'the {name} checkpoint "{path}" is missing: make it with "{MAKE}" (about 20 minutes)')
        paths.append(path)
    return paths


def find_evaluation(scene: Path, gaze: Path) -> list[Path]:
    """The evaluation that stands beside ``scene``, if it is of this ``gaze`` field."""
    path = scene.parent / RESULTS
    return [path] if path.is_file() and read_results(path).sha256 == file_sha256(gaze) else []


def write_recording(path: Path) -> Path:
    """Write the store's sample of the tracked gaze that its field was trained on as the file ``path`` of rays."""
    write_bytes(path, (find_store_scene().parent / TRACKED).read_bytes())
    return path


def _bake(twin: Path, gaze: Path, eye: tuple[float, ...], output: Path, mode: str, seed: int) -> Path:
    """Write the gaze of the observer at ``eye`` on the mesh ``twin`` as ``output``, as fine as a glance at it needs."""
    options = BakeOptions(gaze=gaze, observer=eye, max_angle=5.0, max_edge=0.2, mode=mode, seed=seed)
    bake(twin, [output], options)
    return output


def _camera_of(sensor) -> dict:
    """Where a perspective ``sensor`` is, what it looks at and how wide, as options of a report."""
    import mitsuba as mi

    pose = sensor.world_transform()
    at, ahead = (np.ravel(np.array(pose @ mi.Point3f(*p), np.float64)) for p in ((0, 0, 0), (0, 0, 1)))
    fov = float(np.ravel(np.array(mi.traverse(sensor)["x_fov"]))[0])
    return {"camera_from": tuple(at.tolist()), "camera_to": tuple(ahead.tolist()), "fov": fov}


def observer_pixel(scene) -> tuple[float, float] | None:
    """Where the observer of ``scene`` stands in the camera's picture: (x, y) in pixels, counted from the first one's
    centre; None outside of it."""
    return project_to_pixel(scene.sensors()[CAMERA], sensor_center(scene.sensors()[OWN]))


def sphere_integral(sphere: Channels) -> float:
    """What the gaze density adds up to over the observer's sphere: 1 for a density that is one."""
    height, width = sphere.aovs["gaze"].shape
    return float((sphere.aovs["gaze"].astype(np.float64) * pixel_solid_angles(width, height)).sum())


# ----------------------------------------------------------------------------
# Writing
# ----------------------------------------------------------------------------


def _write_pictures(
    out: Path,
    pictures: Mapping[str, Channels],
    heat: Heat,
    marker: tuple[float, float] | None,
    note: str,
    about: Provenance,
) -> list[Path]:
    """Write the ``pictures`` "own", "without" and "camera" of `figures.occlusion_figure`, and the "sphere"."""
    camera, sphere = pictures["camera"], pictures["sphere"]
    parts = [(seen.color, seen.aovs["gaze"], seen.mask) for seen in pictures.values()]
    total = sphere_integral(sphere)
    drawn = {
        "occlusion": lambda: figures.occlusion_figure(
            parts[0], (camera.color, *parts[1][1:]), parts[2], heat, marker, True, note
        ),
        "gaze": lambda: figures.gaze_figure(
            *parts[2], heat, "Where the observer looks", marker=marker, unknown=~camera.mask, note=note
        ),
        "gaze_sphere": lambda: sphere_figure(
            *parts[3],
            heat,
            f"The gaze sphere of the observer; its integral is {total:.3f}",
            unknown=~sphere.mask,
            note=note,
        ),
        "depth": lambda: figures.depth_figure(camera.aovs["depth"], camera.mask),
        "visibility": lambda: figures.visibility_figure(camera.color, camera.aovs["visibility"], camera.mask),
    }
    files = []
    for name, draw in drawn.items():
        files.append(out / f"{name}.png")
        save(draw(), files[-1], about)
    files.append(out / "color.png")
    write_png(files[-1], srgb(camera.color), about.text())
    return files


class _Clock:
    """Seconds of one stage after the other."""

    def __init__(self, reporter: Reporter):
        self.seconds: dict[str, float] = {}
        self._reporter, self._name, self._since = reporter, "", 0.0

    def start(self, name: str) -> None:
        self.stop()
        self._name, self._since = name, time.perf_counter()
        self._reporter.progress(STAGES.index(name) / len(STAGES), name)

    def stop(self) -> None:
        if self._name:
            self.seconds[self._name] = time.perf_counter() - self._since
            self._name = ""
