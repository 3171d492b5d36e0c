"""The demo: images and figures of a gaze field, rendered from a scene with an observer.

The scene has three sensors: 0 is a camera that sees what is occluded from the observer, 1 is the observer's view, and 2
is the observer's sphere (a `panorama`). Its integrator is `nerg` with a gaze field, and it has the `<default>`s of
``scenes/store/scene.xml``. Equal seeds give bitwise equal images.
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nerg_mi.environment.bands import Channels, render_channels
from nerg_mi.environment.scene_loading import activate_mitsuba, list_library_versions, load_scene
from nerg_mi.environment.scene_writer import project_to_pixel
from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.evaluation.gaze_report import explain_verdict, read_results
from nerg_mi.figures import overlay as figures
from nerg_mi.figures.layers import describe_bases, describe_basis, describe_smoothing, smooth_gaze
from nerg_mi.figures.overlay import Heat, robust_max, srgb, write_png
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import Provenance, make_provenance, save
from nerg_mi.files.atomic import check_folder, file_sha256, write_bytes
from nerg_mi.files.images import write_bitmap_exr
from nerg_mi.files.tables import write_csv, write_json
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.interruption import Interruption
from nerg_mi.progress import Progress, Reporter, SilentReporter, open_reporter
from nerg_mi.ranges import SEEDS, SPP, Range, check_ranges
from nerg_mi.reports.inputs import RESULTS
from nerg_mi.reports.report import report
from nerg_mi.scenes.store import SCENE_FILE  # pyright: ignore[reportMissingImports] at the root of a checkout
from nerg_mi.surfaces.bake import bake
from nerg_mi.surfaces.settings import BakeSampling
from nerg_mi.transport.geometry import pixel_solid_angles
from nerg_mi.transport.observer import sensor_center

CAMERA, FIRST_PERSON, SPHERE = range(3)
"""Indices of the sensors."""

CHECKPOINTS = {"field": "store.safetensors", "gaze": "shoppers.safetensors"}
MAKE = "python -m nerg_mi.scenes.store.make"
REPORT_POINTS = 60_000
"""Number of points in the 3D view of the report."""

TRACKED = "shoppers.npz"
"""File with a tenth of each visit of the recorded gaze on which the store's gaze field was trained."""

REPORT_VIEWPOINTS = 24
"""Number of viewpoints of the report; small, to keep the demo short."""

STAGES = {
    "load": ("loading the store", 1),
    "camera": ("rendering the store from a camera", 8),
    "own view": ("rendering what the shopper sees", 11),
    "gaze sphere": ("rendering all directions around the shopper", 9),
    "without occlusion": ("rendering gaze that passes through shelves, for comparison", 10),
    "pictures": ("drawing figures", 9),
    "surfaces": ("computing gaze on the surfaces of the store", 4),
    "tracked gaze": ("copying recorded gaze", 1),
    "report": ("writing the report", 40),
}
"""What each stage does, and about how long it takes, relative to the others."""
OBJECTS, TWIN = "regions.json", "twin.ply"
"""Files with the AOIs and the mesh of the scene, next to the scene file."""


@dataclass(frozen=True)
class DemoResult:
    """Written ``files`` in the order of interest; ``seconds`` of each stage; ``report``, the content of run.json."""

    files: list[Path]
    seconds: dict[str, float]
    report: dict


@check_ranges
def make_demo(
    output: FilePath | None = None,
    *,
    width: Annotated[int, Range(12, 16384)] = 600,
    scene: FilePath | None = None,
    defaults: Mapping[str, str] | None = None,
    spp: Annotated[int, SPP] = 8,
    seed: Annotated[int, SEEDS] = 0,
    progress: Progress = None,
) -> DemoResult:
    """Render the demo store: colour, depth, gaze, visibility, the observer's gaze sphere, occlusion, an EXR file and a
    report.

    Parameters
    ----------
    output : path, optional
        Folder to write to; it is created. Default: out/demo.
    width : int
        Width of the images in pixels; their aspect ratio is 3:2.
    scene : path, optional
        Scene file. Default: the demo store.
    defaults : mapping, optional
        Values of its `<default>`s.
    spp : int
        Samples per pixel.
    seed : int
        Seed of the random numbers for sampling.
    progress : bool, Reporter or None
        Progress, which names each of `STAGES` when it starts, and messages.

    Returns
    -------
    DemoResult
        The written files.

    Raises
    ------
    NergError
        A checkpoint is missing, or the gaze is 0 in all images.
    KeyboardInterrupt
        Within a second after Ctrl-C.
    """
    output, values = Path("out/demo") if output is None else to_path(output), dict(defaults or {})
    check_folder(output)
    path = SCENE_FILE if scene is None else to_path(scene)
    inputs = _inputs(path, values)
    with open_reporter(progress) as reporter:
        reporter.message(
            f"The demo renders a small store and where a simulated shopper looks: {len(STAGES)} steps, about half a "
            "minute on two idle cores."
        )
        result = _render_demo(path, values, inputs, output, width, spp, seed, reporter)
        reporter.message(
            f"Report: {output / 'report.html'}. Pictures: {output / 'occlusion.png'}, {output / 'gaze.png'}."
        )
        reporter.message(f"Open it with: {_viewer(output / 'report.html')}")
    return result


def _render_demo(
    scene: Path,
    defaults: Mapping[str, str],
    inputs: Sequence[Path],
    output: Path,
    width: int,
    spp: int,
    seed: int,
    reporter: Reporter,
) -> DemoResult:
    mode = str(activate_mitsuba().variant())
    clock = _Clock(reporter)
    sizes = {"width": width, "height": 2 * width // 3, "sphere_width": width // 2 * 2, "sphere_height": width // 2}
    values = {k: str(v) for k, v in sizes.items()} | {**defaults}
    values |= {"aovs": "depth,opacity,gaze,visibility"}

    with Interruption() as stop:
        clock.start("load")
        seen = load_scene(scene, values)
        unoccluded = load_scene(
            scene, values | {"occlusion": "false", "radiance": "false", "aovs": "depth,opacity,gaze"}
        )
        if len(seen.sensors()) < 3:
            raise NergError(
                f'"{scene}" has {len(seen.sensors())} sensor(s): it needs a camera, the observer\'s view and a panorama'
            )

        def report_strip(done: int, total: int) -> None:
            stop.check()
            clock.progress(done / total)

        def render(loaded: Any, index: int) -> Channels:
            with translate_mitsuba_errors():
                return render_channels(loaded, loaded.sensors()[index], spp, seed, report_strip)

        clock.start("camera")
        camera = render(seen, CAMERA)
        clock.start("own view")
        own_view = render(seen, FIRST_PERSON)
        clock.start("gaze sphere")
        sphere = render(seen, SPHERE)
        clock.start("without occlusion")
        without = render(unoccluded, CAMERA)
        stop.check()

    clock.start("pictures")
    record = make_provenance("nerg demo", inputs, seed, {"spp": spp, "mode": mode, **sizes, "defaults": defaults})
    pictures = {
        "own": smooth_gaze(own_view, seen, seen.sensors()[FIRST_PERSON]),
        "without": smooth_gaze(without, unoccluded, unoccluded.sensors()[CAMERA]),
        "camera": smooth_gaze(camera, seen, seen.sensors()[CAMERA]),
        "sphere": sphere,
    }
    # All images of gaze share one colour scale.
    tops = [robust_max(r.aovs["gaze"], r.mask) for r in pictures.values() if np.any(r.aovs["gaze"] > 0)]
    if not tops:
        raise NergError(f'the gaze is 0 in all images: move the observer of "{scene}", or train its gaze field longer')
    heat = Heat(max(tops))
    files = _write_pictures(output, pictures, heat, observer_pixel(seen), describe_basis(seen), record)
    for key, value in (record.text() | describe_bases(seen)).items():
        camera.bitmap.metadata()[key] = value
    write_bitmap_exr(output / "scene.exr", camera.bitmap)
    files.append(output / "scene.exr")
    clock.start("surfaces")
    eye = tuple(float(v) for v in np.ravel(np.array(sensor_center(seen.sensors()[FIRST_PERSON]))))
    if (scene.parent / TWIN).is_file():
        coarse = BakeSampling(max_angle=5.0)
        baked = bake(scene.parent / TWIN, gaze=inputs[2], observer=eye, max_edge=0.2, sampling=coarse, seed=seed)
        files.append(baked.save(output / "heatmap.glb"))
    clock.start("tracked gaze")
    tracked = []
    if scene == SCENE_FILE and inputs[2] == scene.parent / CHECKPOINTS["gaze"]:
        tracked = [write_recording(output / TRACKED)]
        files += tracked
    clock.start("report")
    # The AOIs are next to the scene file.
    objects = scene.parent / OBJECTS
    rendered = {"camera": camera, "own": own_view, "sphere": sphere}
    evaluation = find_evaluation(scene, inputs[2])
    made = report(
        [*inputs[1:], *tracked, *evaluation],
        aois=objects if objects.is_file() else None,
        observer=eye,
        **_camera_of(seen.sensors()[CAMERA]),
        viewpoints=REPORT_VIEWPOINTS,
        width=min(max(width, 24), 1200),
        max_points=REPORT_POINTS,
        seed=seed,
        title="The demo store and its shoppers" if scene == SCENE_FILE else None,
        rendered=rendered,
        progress=_StageReporter(clock),
    )
    files.append(made.save(output / "report.html"))
    if made.run.observed_objects:
        rows = [{"object": o.name, "observer_share": round(o.predicted.mean, 6)} for o in made.run.observed_objects]
        write_csv(output / "aoi.csv", rows)
        files.append(output / "aoi.csv")
    clock.stop()

    summary = {
        "command": "nerg demo",
        "versions": list_library_versions(mode),
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
    write_json(output / "run.json", summary)
    files.append(output / "run.json")
    for path in files:
        reporter.message(f"wrote {path}")
    for results, verdict in made.run.verdicts:
        reporter.message(explain_verdict(verdict, results.split))
    return DemoResult(files, clock.seconds, summary)


def _viewer(page: Path) -> str:
    """Return the command that shows ``page`` on this machine."""
    opener = "open" if sys.platform == "darwin" else "xdg-open"
    if shutil.which(opener):
        return f"{opener} {page}"
    # Without a desktop: any browser with network access to this machine.
    return f"python3 -m http.server --bind 127.0.0.1 --directory {page.parent} 8000, then http://127.0.0.1:8000/{page.name}"


# ----------------------------------------------------------------------------
# Rendering
# ----------------------------------------------------------------------------


def _inputs(scene: Path, defaults: Mapping[str, str]) -> list[Path]:
    if not scene.is_file():
        raise NergError(f'there is no scene file "{scene}"')
    paths = [scene]
    for name, file in CHECKPOINTS.items():
        path = scene.parent / defaults.get(name, file)  # an absolute path stays as it is
        if not path.is_file():
            raise NergError(f'the {name} checkpoint "{path}" is missing: create it with "{MAKE}" (about 20 minutes)')
        paths.append(path)
    return paths


def find_evaluation(scene: Path, gaze: Path) -> list[Path]:
    """Return the evaluation next to ``scene`` if it is one of this ``gaze`` field."""
    path = scene.parent / RESULTS
    return [path] if path.is_file() and read_results(path).sha256 == file_sha256(gaze) else []


def write_recording(path: Path) -> Path:
    """Write the store's sample of recorded gaze to the rays file ``path``."""
    write_bytes(path, (SCENE_FILE.parent / TRACKED).read_bytes())
    return path


def _camera_of(sensor) -> dict:
    """Return position, target and field of view of a perspective ``sensor`` as options of a report."""
    import mitsuba as mi

    pose = sensor.world_transform()
    at, ahead = (np.ravel(np.array(pose @ mi.Point3f(*p), np.float64)) for p in ((0, 0, 0), (0, 0, 1)))
    fov = float(np.ravel(np.array(mi.traverse(sensor)["x_fov"]))[0])
    return {"camera": tuple(at.tolist()), "target": tuple(ahead.tolist()), "fov": fov}


def observer_pixel(scene) -> tuple[float, float] | None:
    """Return the pixel (x, y) of the observer of ``scene`` in the camera's image, or None if it is outside.

    Pixels are counted from the centre of the first one.
    """
    return project_to_pixel(scene.sensors()[CAMERA], sensor_center(scene.sensors()[FIRST_PERSON]))


def sphere_integral(sphere: Channels) -> float:
    """Return the integral of the gaze density over the observer's sphere: 1 for a normalised density."""
    height, width = sphere.aovs["gaze"].shape
    return float((sphere.aovs["gaze"].astype(np.float64) * pixel_solid_angles(width, height)).sum())


# ----------------------------------------------------------------------------
# Writing
# ----------------------------------------------------------------------------


def _write_pictures(
    output: Path,
    pictures: Mapping[str, Channels],
    heat: Heat,
    marker: tuple[float, float] | None,
    note: str,
    record: Provenance,
) -> list[Path]:
    """Write the figures of the images "own", "without" and "camera", whose gaze is smoothed, and of the "sphere"."""
    smoothed = describe_smoothing(note)
    camera, sphere = pictures["camera"], pictures["sphere"]
    parts = [(seen.color, seen.aovs["gaze"], seen.mask) for seen in pictures.values()]
    total = sphere_integral(sphere)
    drawn = {
        "occlusion": lambda: figures.occlusion_figure(
            parts[0], (camera.color, *parts[1][1:]), parts[2], heat, marker, True, smoothed
        ),
        "gaze": lambda: figures.gaze_figure(
            *parts[2], heat, "Where the observer looks", marker=marker, unknown=~camera.mask, note=smoothed
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
        files.append(output / f"{name}.png")
        save(draw(), files[-1], record)
    files.append(output / "color.png")
    write_png(files[-1], srgb(camera.color), record.text())
    return files


class _Clock:
    """Measures the seconds of consecutive stages."""

    def __init__(self, reporter: Reporter):
        self.seconds: dict[str, float] = {}
        self._reporter, self._name, self._since = reporter, "", 0.0

    def start(self, name: str) -> None:
        self.stop()
        self._name, self._since = name, time.perf_counter()
        self._reporter.message(f"{list(STAGES).index(name) + 1} of {len(STAGES)}: {STAGES[name][0]}")
        self.progress(0.0)

    def progress(self, fraction: float) -> None:
        """Report the completed ``fraction`` of the present stage."""
        before = sum(weight for _, weight in list(STAGES.values())[: list(STAGES).index(self._name)])
        total = sum(weight for _, weight in STAGES.values())
        self._reporter.progress((before + fraction * STAGES[self._name][1]) / total, self._name)

    def stop(self) -> None:
        if self._name:
            self.seconds[self._name] = time.perf_counter() - self._since
            self._name = ""


class _StageReporter(SilentReporter):
    """Passes on the progress of a function as that of the present stage."""

    def __init__(self, clock: _Clock):
        self._clock = clock

    def progress(self, fraction: float, text: str = "") -> None:
        self._clock.progress(fraction)
