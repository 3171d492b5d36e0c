"""``nerg draw``: Draw a figure: a gaze sphere, occlusion, a floor plan, a contact sheet, a difference, a baked surface.
``nerg demo``: Render the demo store: images, figures and a report of a gaze field.
``nerg scene``: Write a scene file for a field, a mesh, a gaze field or rays, with a camera and an observer.
``nerg view``: Show a scene with its gaze in the browser, with a movable observer.
``nerg render``: Render a scene file to an image or a video.
``nerg bake``: Compute the gaze per unit area of surfaces, as colours and tables.
``nerg study``: Measure rendering error against run time over many settings of the integrator.
``nerg report``: Write an HTML report on a gaze field: verdict, figures, scores and a 3D view in one file.
``nerg stats``: Compute attention statistics of areas of interest, measured and predicted, with confidence intervals.
``nerg jobs``: Show the progress of jobs that run in parts, and what in their store is stale.

Options of these commands. Each declaration names the module of its workflow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.options import (
    ALIGN_HELP,
    ANALYSIS,
    DETAILS_OF_EVENTS,
    INPUT,
    MODEL,
    OUTPUT,
    PERFORMANCE,
    VIEW,
    EventOptions,
    PartOptions,
    best_variant,
    coordinates,
    cpu_threads,
    definitions,
    option,
    parse_numbers,
    random_seed,
    up_axis,
)
from nerg_mi.ranges import (
    COORDINATES,
    FIELDS_OF_VIEW,
    LENGTHS,
    LOG_DECADES,
    POSITIVE_VALUES,
    RATES,
    RAYS,
    SECONDS,
    SPP,
    TIMES,
    Range,
    ValidatedDataclass,
)

from .base import argument, declare, extra, out

if TYPE_CHECKING:
    from nerg_mi.figures.overlay import Style


def _samples(default: int) -> Any:
    """Declare the field ``spp``, of which 0 means the value of the scene file."""
    help = "Samples per pixel; 0: as in the scene file."
    return option(default, help, within=Range(0, SPP.high), group=PERFORMANCE)


def _sensor(help: str) -> Any:
    """Declare the field ``sensor``."""
    return option(0, help, "-s", "--sensor", within=Range(0, 65535), group=VIEW)


def _vmax(what: str) -> Any:
    """Declare the field ``vmax``: the upper end of ``what``, or None."""
    return option(None, f"Upper end of {what}.  [default: the 99.5th percentile]", within=POSITIVE_VALUES, group=VIEW)


def _log_decades(what: str) -> Any:
    """Declare the field ``log_decades`` of ``what``."""
    help = f"Number of decades that {what} spans if it is logarithmic; 0: linear."
    return option(0.0, help, within=LOG_DECADES, group=VIEW)


SMOOTHING = 1.0
"""Default smoothing of figures in degrees: about the fovea, and the error of eye trackers."""


def _smoothing() -> Any:
    """Declare the field ``smoothing``."""
    return option(
        SMOOTHING,
        "Standard deviation in degrees by which gaze is smoothed on surfaces before it is drawn; 0: as computed. "
        "Images of perspective cameras only; .exr files are not smoothed.",
        within=Range(0, 30),
        group=VIEW,
    )


# ---- Images of a scene file ----

_MAPS = "inferno, magma, plasma, viridis or cividis"


@dataclass(frozen=True, kw_only=True)
class PictureOptions(ValidatedDataclass):
    """How a scene file is rendered."""

    defaults: Mapping[str, str] | None = definitions()
    sensor: int = _sensor("Index of the sensor that is rendered, counted from 0.")
    mode: str | None = best_variant()
    spp: int = _samples(0)
    seed: int = random_seed("sampling")
    threads: int = option(
        0,
        "Number of CPU threads; 0: one per core.",
        "-t",
        "--threads",
        within=Range(0, 1024),
        changes_result=False,
        group=PERFORMANCE,
    )
    memory: float = option(
        1.0,
        "Memory limit of rendering in GB; larger images are rendered in bands.",
        within=Range(1e-6, 10**6),
        group=PERFORMANCE,
    )
    overlay: str | None = option(
        None,
        "Name of the AOV that is drawn over the colour, with a colour scale: gaze, kde, depth or any other. The output "
        "must be .png, .svg or .mp4.  [default: colour only]",
        group=VIEW,
    )
    vmax: float | None = _vmax("the overlay's colour scale, for gaze in 1/sr")
    cmap: str | None = option(None, f"Colour map of the overlay: {_MAPS}.  [default: depends on the AOV]", group=VIEW)
    log_decades: float = _log_decades("the overlay's colour scale")
    hatching: bool = option(True, "Hatch the overlay where its value is unknown.", group=VIEW)
    smoothing: float = _smoothing()
    frames: Path | None = option(
        None,
        "CSV file of an image sequence: the header names <default>s of the scene, each further line has their values "
        "for one frame; or a camera path of nerfstudio (.json).",
        group=INPUT,
    )
    fps: float = option(25.0, "Frame rate of an .mp4 video in frames per second.", within=RATES, group=OUTPUT)


@dataclass(frozen=True, kw_only=True)
class DemoOptions(ValidatedDataclass):
    """Options of ``nerg demo``."""

    scene: Path | None = option(None, "Scene file.  [default: the demo store]", group=INPUT)
    defaults: Mapping[str, str] | None = definitions()
    width: int = option(
        600, "Width of the images in pixels; their aspect ratio is 3:2.", within=Range(3, 16384), group=VIEW
    )
    spp: int = _samples(8)
    seed: int = random_seed("sampling")
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class FilmOptions(PictureOptions, PartOptions):
    """Options of ``nerg render``."""


declare(
    "demo",
    "nerg_mi.workflows.demo:make_demo_to_look_at",
    "Render the demo store: colour, depth, gaze, visibility, the observer's gaze sphere, occlusion, an EXR file and a "
    "report.",
    options=DemoOptions,
    without=("scene",),
    output=out("Folder to write to; it is created.", default=Path("out/demo")),
)


# ---- Scene files for checkpoints and rays ----


@dataclass(frozen=True, kw_only=True)
class SceneOptions(ValidatedDataclass):
    """Options of ``nerg scene``. Positions are in scene coordinates."""

    observer: tuple[float, ...] | None = coordinates(
        "Position of the observer's eye, x,y,z.  [default: where the density of rays is highest]"
    )
    person: str | None = option(
        None, "Person in the rays whose eye position the observer takes, at --time or over --time-range.", group=VIEW
    )
    time: float | None = option(None, "Time of that position in seconds of the rays' clock.", within=TIMES, group=VIEW)
    time_range: tuple[float, ...] | None = option(
        None,
        "Start and end A,B of a walk in seconds of the rays' clock; also writes a CSV file for nerg render --frames.",
        parse=parse_numbers,
        within=TIMES,
        group=VIEW,
    )
    fps: float = option(10.0, "Frame rate of --time-range in frames per second.", within=RATES, group=VIEW)
    max_gap: float = option(
        0.5, "Longest gap between rays of the person in seconds that is interpolated over.", within=SECONDS, group=VIEW
    )
    camera: tuple[float, ...] | None = coordinates("Position of the camera, x,y,z.  [default: the best overview]")
    target: tuple[float, ...] | None = coordinates(
        "Point that the camera at --camera looks at, x,y,z.  [default: the centre of what the observer looks at]"
    )
    first_person: bool = option(False, "Place the camera at the observer's eye.", group=VIEW)
    photos: Path | None = option(
        None, "Photos that the radiance field was trained on; the camera is that of a photo.", group=VIEW
    )
    photo: str | None = option(
        None, "Name or number (from 0) of that photo.  [default: the one with the best view]", group=VIEW
    )
    allow_outside: bool = option(
        False, "Also read files outside the folder of --photos if it refers to them.", group=INPUT
    )
    fov: float | None = option(
        None, "Horizontal field of view in degrees.  [default: 70]", within=FIELDS_OF_VIEW, group=VIEW
    )
    width: int = option(480, "Width of the image in pixels.", within=Range(1, 16384), group=VIEW)
    up: tuple[float, ...] | None = up_axis()
    align: Path | None = option(None, ALIGN_HELP, group=INPUT)
    geometry: str | None = option(
        None,
        'Geometry if gaze rays are shown without an environment model: "hits" (a volume of their hit points) or '
        '"none".  [default: hits if there are any]',
        group=INPUT,
    )
    mode: str | None = best_variant()


declare(
    "scene",
    "nerg_mi.workflows.scene:write_scene",
    "Write a Mitsuba scene file for a field, a mesh, a gaze field or rays, with a camera and an observer.",
    more="""A gaze field alone is shown in the scene that it was trained in, which must be in the same folder. The file
is commented, and each <default> in it can be set when it is rendered (nerg render -D).""",
    options=SceneOptions,
    files=argument(
        "A scene (radiance field, splats, mesh, .xml, .vol), a gaze field and rays, or some of them, in any order.",
        list[Path],
        metavar="FILES",
    ),
    output=out("Scene file to write (.xml)."),
)


# ---- The viewer ----


@dataclass(frozen=True, kw_only=True)
class ViewOptions(ValidatedDataclass):
    """Options of ``nerg view``."""

    host: str = option(
        "127.0.0.1",
        "Address to serve at. With an address other than the loopback address, the page needs a token.",
        group=OUTPUT,
    )
    port: int = option(8080, "Port to serve at; 0: any free port.", within=Range(0, 65535), group=OUTPUT)
    hostnames: tuple[str, ...] = option(
        (), "Further host name under which the page may be requested; repeatable.", "--hostname", group=OUTPUT
    )
    width: int = option(720, "Width of a refined image in pixels.", within=Range(16, 8192), group=VIEW)
    spp: int = _samples(0)
    observer: tuple[float, ...] | None = coordinates(
        "Initial position of the observer's eye, x,y,z.  [default: as in the scene file]"
    )
    up: tuple[float, ...] | None = up_axis()
    aois: Path | None = option(None, "JSON file of areas of interest (AOIs): boxes with names.", group=INPUT)
    align: Path | None = option(None, ALIGN_HELP, group=INPUT)
    geometry: str | None = option(
        None,
        'Geometry if gaze rays are shown without an environment model: "hits" (a volume of their hit points) or '
        '"none".  [default: hits if there are any]',
        group=INPUT,
    )
    open: bool = option(False, "Open the page in the browser of this machine.", group=OUTPUT)
    compile: bool = option(
        True,
        "Compile the radiance field in the background, for faster pictures, and keep the result next to it as "
        "NAME.compiled.safetensors for the next time.",
        group=PERFORMANCE,
    )
    mode: str | None = best_variant()


declare(
    "view",
    "nerg_mi.viewer.serve:view_files",
    more="The page is served to this machine only, until Ctrl-C, and loads nothing from other servers. With another "
    "--host, its address contains a token.",
    options=ViewOptions,
    files=argument(
        "A scene (.xml), or a radiance field, splats, mesh or .vol, a gaze field and rays, in any order; or "
        "their folder.",
        list[Path],
        metavar="FILES",
    ),
)


declare(
    "render",
    "nerg_mi.workflows.render:render_film",
    "Render a scene file to an image or a video, with the integrator of the scene.",
    more="""An EXR file holds all channels, including AOVs, in float32. A PNG file holds the sRGB colour, or an overlay
with its colour scale, which can also be written as SVG. The images of a sequence get numbered names, or become the
frames of an MP4 file.

With --store or --scheduler each finished image is stored; running the command again continues with the next one.""",
    options=FilmOptions,
    without=("worker_wait",),
    scene=argument("Mitsuba scene file (.xml)."),
    output=out("Image (.exr with all channels, .png; .svg needs --overlay) or video (.mp4, needs --frames) to write."),
)


# ---- Figures: another kind needs an entry in the table, and the function that draws it ----


@dataclass(frozen=True)
class FigureKind:
    """A kind of figure.

    Parameters
    ----------
    name, summary
        Name of the command and its help.
    inputs
        Description of the input files.
    max_files
        Maximum number of input files.
    options
        Dataclass of options, see `nerg_mi.options.option`.
    function
        What draws the figure from ``(files, options, reporter)``, as "MODULE:NAME".
    """

    name: str
    summary: str
    inputs: str
    max_files: int
    options: type
    function: str


@dataclass(frozen=True, kw_only=True)
class ColorOptions(ValidatedDataclass):
    """The colour scale of a figure."""

    vmax: float | None = _vmax("the colour scale, in the unit of the values")
    cmap: str | None = option(None, f"Colour map: {_MAPS}.  [default: inferno]", group=VIEW)
    log_decades: float = _log_decades("the colour scale")

    def style(self, title: str | None = None, kind: str = "sequential") -> Style:
        """Return the style of overlays, with a colour map of that ``kind`` (`find_colormap`).

        Raises `NergError` for an unknown colour map.
        """
        from nerg_mi.figures.overlay import Style
        from nerg_mi.figures.style import find_colormap

        if self.cmap is not None:
            find_colormap(self.cmap, kind)
        return Style(self.cmap, self.log_decades, False, title)


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(ColorOptions):
    """The colour scale of a figure with unknown values."""

    hatching: bool = option(
        True,
        "Hatch areas whose value is unknown: no surface or, for gaze, far from all recorded positions.",
        group=VIEW,
    )

    def style(self, title: str | None = None, kind: str = "sequential") -> Style:
        """Return the style of overlays, see `ColorOptions.style`."""
        return replace(super().style(title, kind), hatch_unknown=self.hatching)


@dataclass(frozen=True, kw_only=True)
class SceneFigureOptions(ScaleOptions):
    """How a scene file is rendered for a figure."""

    defaults: Mapping[str, str] | None = definitions()
    spp: int = _samples(0)
    seed: int = random_seed("sampling")
    smoothing: float = _smoothing()
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class FloorOptions(ValidatedDataclass):
    """Options of ``nerg draw floor``."""

    scene: Path | None = option(
        None, "Scene file whose walls and furniture are drawn.  [default: none are drawn]", group=INPUT
    )
    defaults: Mapping[str, str] | None = definitions()
    cut_height: float = option(
        1.2, "Height above the floor in metres at which the scene is cut.", within=COORDINATES, group=VIEW
    )
    floor_height: float = option(0.0, "Height of the floor (z) in scene units.", within=COORDINATES, group=VIEW)
    paths: bool = option(True, "Draw the paths of the participants.", group=VIEW)
    num_rays: int = option(
        0,
        "Number of recorded rays to draw, evenly selected, from the eye to the hit point (or a point ahead where no "
        "hit point is recorded).",
        within=Range(0, 20000),
        group=VIEW,
    )
    num_views: int = option(
        0, "Number of fields of view to draw for each participant.", within=Range(0, 1000), group=VIEW
    )
    fov: float = option(60.0, "Width of these fields of view in degrees.", within=Range(1, 180), group=VIEW)
    participants: str | None = option(
        None, "Comma-separated names of the participants to draw.  [default: all]", group=INPUT
    )
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class SphereOptions(SceneFigureOptions):
    """Options of ``nerg draw sphere``."""

    sensor: int = _sensor("Index of the sensor whose position is used if the scene has no observer, counted from 0.")
    projection: str = option("mollweide", "Map projection: mollweide (equal-area) or equirectangular.", group=VIEW)
    width: int = option(
        800, "Width of the map in pixels; its height is half of it.", within=Range(64, 2896), group=VIEW
    )


@dataclass(frozen=True, kw_only=True)
class ScanpathOptions(EventOptions):
    """Options of ``nerg draw scanpath``."""

    scene: Path | None = option(None, "Scene file, in the coordinates of the rays; required.", group=INPUT)
    defaults: Mapping[str, str] | None = definitions()
    participants: str | None = option(
        None, "Comma-separated names of the participants to draw.  [default: the first one]", group=INPUT
    )
    start: float | None = option(None, "First time in seconds.  [default: the first]", within=TIMES, group=INPUT)
    end: float | None = option(None, "Last time in seconds.  [default: the last]", within=TIMES, group=INPUT)
    dispersion_threshold: float | None = option(
        None,
        "Dispersion in degrees, to detect fixations by it (I-DT).  [default: fixations as in nerg rays events]",
        within=Range(1e-3, 90),
        group=INPUT,
    )
    max_fixations: int = option(
        40, "Maximum number of fixations of a participant; the first ones are drawn.", within=Range(1, 1000), group=VIEW
    )
    sensor: int = _sensor("Index of the camera, counted from 0.")
    spp: int = _samples(0)
    seed: int = random_seed("sampling")
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class TriptychOptions(SceneFigureOptions):
    """Options of ``nerg draw triptych``."""

    sensor: int = _sensor("Index of the second camera, counted from 0.")


@dataclass(frozen=True, kw_only=True)
class DifferenceOptions(ValidatedDataclass):
    """Options of ``nerg draw difference``."""

    channel: str = option("gaze", "Name of the channel, which both files must have.", group=INPUT)
    vmax: float | None = _vmax("the colour scale, which is symmetric about 0")
    cmap: str = option("RdBu_r", "Diverging colour map: RdBu_r, PuOr_r, BrBG_r or PRGn_r.", group=VIEW)


@dataclass(frozen=True, kw_only=True)
class SheetOptions(ScaleOptions):
    """Options of ``nerg draw sheet``."""

    overlay: str | None = option(
        None,
        "AOV of .exr files drawn over their colour, with a common colour scale: gaze, kde, depth or any other.  "
        "[default: colour only]",
        group=VIEW,
    )
    columns: int | None = option(
        None, "Number of images in a row.  [default: about the number of rows]", within=Range(1, 1000), group=VIEW
    )
    max_width: int = option(
        480, "Maximum width of an image in pixels; larger ones are reduced.", within=Range(16, 4096), group=VIEW
    )


@dataclass(frozen=True, kw_only=True)
class BakedFigureOptions(ColorOptions):
    """Options of ``nerg draw surface``. Positions are in the units of the mesh."""

    camera: tuple[float, ...] | None = coordinates(
        "Position of the camera, x,y,z.  [default: above the surface, with all of it in view]"
    )
    target: tuple[float, ...] | None = coordinates("Point that the camera looks at, x,y,z.  [default: the centre]")
    up: tuple[float, ...] | None = coordinates("Up direction, x,y,z.  [default: 0,0,1]")
    clip_above: float | None = option(
        None,
        "Height along the up direction above which the mesh is not drawn, for instance to remove a ceiling.  [default: "
        "no limit]",
        within=COORDINATES,
        group=VIEW,
    )
    fov: float = option(50.0, "Horizontal field of view in degrees.", within=Range(1.0, 170.0), group=VIEW)
    width: int = option(960, "Width of the image in pixels.", within=Range(16, 4096), group=VIEW)
    height: int = option(640, "Height of the image in pixels.", within=Range(16, 4096), group=VIEW)
    title: str | None = option(None, "Title of the figure.  [default: the quantity]", group=VIEW)
    mode: str | None = best_variant()


_SCENE, _FILES = "nerg_mi.workflows.draw_scenes", "nerg_mi.workflows.draw"
_TABLE = (
    FigureKind(
        "sphere",
        "Draw the gaze of an observer over all directions.",
        "scene file (.xml)",
        1,
        SphereOptions,
        f"{_SCENE}:sphere",
    ),
    FigureKind(
        "triptych",
        "Draw three views of a gaze that show its occlusion.",
        "scene file (.xml)",
        1,
        TriptychOptions,
        f"{_SCENE}:triptych",
    ),
    FigureKind(
        "scanpath",
        "Draw numbered fixations over a view of the scene.",
        "file of rays (.npz)",
        1,
        ScanpathOptions,
        f"{_SCENE}:scanpath",
    ),
    FigureKind(
        "floor",
        "Draw the floor plan of rays in their scene.",
        "file of rays (.npz)",
        1,
        FloorOptions,
        f"{_SCENE}:floor",
    ),
    FigureKind(
        "sheet",
        "Draw several images on one page, with a common colour scale.",
        "images (.png, .jpg, .exr)",
        400,
        SheetOptions,
        f"{_FILES}:sheet",
    ),
    FigureKind(
        "difference",
        "Draw the difference of a channel between two images.",
        "two images (.exr), the second is subtracted from the first",
        2,
        DifferenceOptions,
        f"{_FILES}:difference",
    ),
    FigureKind(
        "surface",
        "Draw gaze on a mesh, with its colour scale.",
        "mesh that nerg bake has written (.ply)",
        1,
        BakedFigureOptions,
        f"{_FILES}:surface",
    ),
)
KINDS = {kind.name: kind for kind in _TABLE}
"""The kinds of figures, in the order in which they are listed."""


for _kind in KINDS.values():
    declare(
        f"draw {_kind.name}",
        "nerg_mi.workflows.draw:draw_files",
        _kind.summary,
        options=_kind.options,
        without=DETAILS_OF_EVENTS,
        files=argument(f"{_kind.inputs[:1].upper()}{_kind.inputs[1:]}.", list[Path] if _kind.max_files > 1 else Path),
        output=out("Figure to write (.png or .svg)."),
    )


# ---- Gaze on surfaces ----


@dataclass(frozen=True, kw_only=True)
class BakeOptions(PartOptions):
    """Options of ``nerg bake``."""

    gaze: Path | None = option(
        None,
        "Gaze field (.safetensors). Required unless the surface is a scene (.xml) whose integrator has a gaze field, "
        "or --rays gives the gaze.  [default: the gaze field of that scene]",
        group=INPUT,
    )
    rays: Path | None = option(
        None, "Rays file or dataset: positions of the observers, or the gaze itself.", group=INPUT
    )
    source: str | None = option(
        None,
        "Source of the gaze: field (evaluate the gaze field) or rays (the recorded rays).  [default: field with "
        "--gaze, or if the scene has a gaze field and --rays is not given; else rays]",
        group=INPUT,
    )
    observer: tuple[float, ...] | None = coordinates(
        "Position x,y,z of a single observer in scene coordinates, in place of those of --rays.", group=INPUT
    )
    observer_file: Path | None = option(
        None,
        "CSV file of observers with columns x, y, z in scene coordinates and, optionally, weight: the relative weight "
        "of the observer's gaze in the sum over observers, 0 or more, in every row if the column exists. Without the "
        "column all weights are equal. Without the file, observers are those of --observer or --rays.",
        group=INPUT,
    )
    num_observers: int = option(
        64,
        "Number of weighted observers that represent the recorded positions of --rays.",
        within=Range(1, 100_000),
        group=ANALYSIS,
    )
    ray_weights: str = option(
        "time",
        "Weights of the rays: time (duration of each ray), person (duration, with equal totals for all participants) "
        "or equal (the same for each ray).",
        group=ANALYSIS,
    )
    align: Path | None = option(None, ALIGN_HELP, group=INPUT)
    shapes: tuple[str, ...] = option(
        (),
        "Name of a shape of the scene that receives gaze, while the other shapes only occlude; repeatable.  [default: "
        "all shapes]",
        "--shape",
        group=INPUT,
    )
    cone: float | None = option(
        None,
        "Standard deviation in degrees of the gaze cone, for tracker error and the fovea.  [default: 1.5 for rays, 0 "
        "for a field]",
        within=Range(0, 30),
        group=ANALYSIS,
    )
    cone_samples: int = option(
        16, "Number of sample rays in the gaze cone of a recorded ray.", within=Range(1, 1024), group=ANALYSIS
    )
    smooth: float = option(
        0.0,
        "Standard deviation in metres of smoothing along the surface; 0: no smoothing.",
        within=Range(0, 10**6),
        group=ANALYSIS,
    )
    max_edge: float | None = option(
        None,
        "Maximum edge length of a triangle in metres; longer edges are split.  [default: a length that "
        "yields about 100,000 triangles]",
        within=LENGTHS,
        group=ANALYSIS,
    )
    max_angle: float = option(
        2.0,
        "Maximum angle in degrees under which an observer sees a surface element; smaller is more accurate.",
        within=Range(0.2, 30),
        group=PERFORMANCE,
    )
    unit: str = option(
        "share",
        "Unit of the values: share (fraction of the gaze, 1/m²) or seconds (of the rays, s/m²).",
        group=ANALYSIS,
    )
    split_half: bool = option(
        False, "Report the agreement between two halves of the participants (for rays).", group=ANALYSIS
    )
    texture_size: int | None = option(
        None,
        "Width and height in pixels of a texture in .glb files.  [default: vertex colours, no texture]",
        within=Range(64, 8192),
        group=OUTPUT,
    )
    vmax: float | None = _vmax("the colour scale, in the unit of --unit")
    cmap: str = option("inferno", f"Colour map: {_MAPS}.", group=VIEW)
    log_decades: float = _log_decades("the colour scale")
    resolution: int = option(
        256,
        "Number of grid cells along the longest edge of a radiance field, for extracting its mesh.",
        within=Range(8, 2048),
        group=MODEL,
    )
    max_samples: int | None = option(
        None,
        "Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with --seed.  "
        "[default: no limit]",
        within=RAYS,
        group=INPUT,
    )
    seed: int = random_seed("subsampling, observers and cones")
    threads: int | None = cpu_threads()
    mode: str | None = best_variant()


declare(
    "bake",
    "nerg_mi.workflows.bake:bake_any",
    "Compute how much gaze each square metre of a surface receives, from a gaze field or from recorded rays.",
    options=BakeOptions,
    without=("worker_wait", "cone_samples"),
    surface=argument("Mesh (.ply, .obj, .glb), scene (.xml), radiance field (.safetensors) or Gaussian splats."),
    output=out(
        "File to write, repeatable: .ply, .glb (with colours), .csv (table of faces), .json (summary); for Gaussian "
        "splats .ply and .json.",
        list[Path],
    ),
)


# ---- Studies, reports and statistics ----


@dataclass(frozen=True, kw_only=True)
class StudyOptions(PartOptions):
    """Options of ``nerg study``."""

    scene_kind: str = option(
        "auto", "Kind of SCENE: analytic (a built-in scene), file, or auto (file if there is one).", group=INPUT
    )
    width: int = option(192, "Width of the images in pixels.", within=Range(1, 16384), group=VIEW)
    height: int = option(128, "Height of the images in pixels.", within=Range(1, 16384), group=VIEW)
    repeats: int = option(
        5, "Number of timed renders of each setting; the median is reported.", within=Range(1, 10000), group=ANALYSIS
    )
    quick: bool = option(False, "Run a small subset of the settings, each timed once.", group=ANALYSIS)
    only: str = option(
        "",
        "Regular expression: run only the default and settings whose names match.  [default: all settings]",
        metavar="REGEX",
        group=ANALYSIS,
    )
    defaults: Mapping[str, str] | None = definitions()
    mode: str | None = best_variant()


declare(
    "study",
    "nerg_mi.workflows.study:run_study",
    "Measure rendering error against run time: render a scene with many settings, compare with a reference, and plot.",
    more="""Writes study.csv (one row per setting), study.md (grouped by parameter), scaling.csv, study.json and two
plots. A full study takes up to half an hour.""",
    options=StudyOptions,
    without=("worker_wait",),
    scene=argument("Scene file (.xml), or a built-in scene: slab, sphere, sheets, fog or ramp.", str),
    output=out("Folder to write to; it is created."),
)


@dataclass(frozen=True, kw_only=True)
class ReportOptions(ValidatedDataclass):
    """Options of ``nerg report``. Positions are in scene coordinates."""

    aois: Path | None = option(
        None,
        'JSON file of areas of interest (AOIs), boxes with names: {"shelf": [[x0, y0, z0], [x1, y1, z1]], ...}.',
        group=INPUT,
    )
    evaluate: bool = option(
        False, "Score the field on the rays held out of its training (about a minute per split).", group=ANALYSIS
    )
    show_names: bool = option(False, "Show the names of participants. Without it, they are numbered.", group=OUTPUT)
    min_participants: int = option(
        1,
        "Minimum number of participants who could see an AOI; values of other AOIs are hidden.",
        within=Range(1, 10**6),
        group=OUTPUT,
    )
    paths: bool = option(
        True, "Draw the paths of participants in the 3D view. Movement patterns can identify a person.", group=OUTPUT
    )
    title: str | None = option(None, "Title of the report.  [default: the name of the gaze field]", group=OUTPUT)
    observer: tuple[float, ...] | None = coordinates(
        "Position of the observer in the images, x,y,z.  [default: where the density of rays is highest]"
    )
    camera: tuple[float, ...] | None = coordinates("Position of the camera, x,y,z.  [default: the best overview]")
    target: tuple[float, ...] | None = coordinates(
        "Point that the camera at --camera looks at, x,y,z.  [default: the centre of what the observer looks at]"
    )
    fov: float | None = option(
        None, "Horizontal field of view in degrees.  [default: 70]", within=FIELDS_OF_VIEW, group=VIEW
    )
    viewpoints: int = option(
        200,
        "Number of recorded positions from which the attention on AOIs is evaluated.",
        within=Range(1, 10_000),
        group=ANALYSIS,
    )
    max_points: int = option(
        80_000, "Maximum number of points in the 3D view.", within=Range(100, 100_000), group=OUTPUT
    )
    width: int = option(480, "Width of the images in pixels.", within=Range(24, 1200), group=VIEW)
    spp: int = option(2, "Samples per pixel.", within=SPP, group=PERFORMANCE)
    seed: int = random_seed("sampling")
    threads: int | None = cpu_threads()
    mode: str | None = best_variant()


declare(
    "report",
    "nerg_mi.workflows.report:make_report",
    "Write a report on a gaze field: one HTML file that opens from disk and needs no network.",
    more="""The report shows the scene, the data, recorded positions, the gaze, areas of interest, scores next to
baselines with a verdict, uncertainty, settings, limits, provenance, and a 3D view. Sections without data are left out,
with a note.""",
    options=ReportOptions,
    files=argument(
        "A gaze field and, in any order, its scene, rays and evaluations (gaze.json, or the folder of nerg eval gaze); "
        "or a folder with these files.",
        list[Path],
        metavar="RUN",
    ),
    output=out("File to write (.html).", default=Path("report.html")),
)


declare(
    "stats",
    "nerg_mi.workflows.statistics:statistics",
    "Compute attention statistics of areas of interest (AOIs): measured from rays, and predicted by a gaze field, with "
    "confidence intervals over participants.",
    more="""Reports attention share, dwell time, hit ratio, time to first visit, revisits, viewing distance and
visibility, by cohort, time window and zone; differences between AOIs, transitions, and the effect of changes to the
scene.""",
    options=StatisticsOptions,
    without=("worker_wait", "aoi_samples", "directions", "cell_size", "glance_duration"),
    files=argument("Rays or a dataset, a scene (.xml), a radiance field and a gaze field, in any order.", list[Path]),
    output=out("Folder for tables and figures."),
)


declare(
    "jobs",
    "nerg_mi.workflows.parts:account_for_store",
    "Show which parts of the jobs in a store are finished, which remain, how many bytes they take, and which are "
    "stale.",
    more="Stale parts are those that the last run of no job uses, and those whose input files have changed since.",
    folder=argument("Store of a job: the folder given as --store, or OUTPUT.tasks."),
    remove=extra(False, "Remove stale parts and leftovers of interrupted runs.", bool, "--remove-stale", group=OUTPUT),
)
