"""``nerg draw``: Draw a figure: a gaze sphere, occlusion, a floor plan, a contact sheet, a difference.
``nerg demo``: Render the demo store: pictures of what a gaze field is.
``nerg scene``: Write a scene file for a field, a mesh, a gaze field or rays, with a camera and an observer.
``nerg view``: Show a place with its gaze in the browser, where the observer is dragged.
``nerg render``: Render a scene file to a picture or a video.
``nerg bake``: Put gaze on surfaces: how much of it each square metre receives, as colours and tables.
``nerg study``: Measure error against run time: a scene at many settings, compared with what is true.
``nerg report``: Write a report on a gaze field: one HTML file with a verdict, pictures, scores and the place in 3D.
``nerg stats``: Count attention on things, in rays and by a gaze field: numbers with intervals, and what if.
``nerg jobs``: Say what is done of a long job, what is left and what is stale.

What these commands take; their workflows run in the modules that are named at each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.ranges import (
    COORDINATES,
    LOG_DECADES,
    FIELDS_OF_VIEW,
    LENGTHS,
    RATES,
    RAYS,
    SECONDS,
    SEEDS,
    SPP,
    TIMES,
    POSITIVE_VALUES,
    ValidatedDataclass,
    Range,
)

from .base import argument, declare, extra, out
from .options import PartOptions, best_variant, coordinates, cpu_threads, definitions, option, parse_numbers

if TYPE_CHECKING:
    from nerg_mi.figures.overlay import Style


# ---- Pictures of a scene file ----


@dataclass(frozen=True, kw_only=True)
class PictureOptions(ValidatedDataclass):
    """How a scene file is rendered."""

    defaults: Mapping[str, str] | None = definitions()
    sensor: int = option(0, "Index of the sensor, counted from 0.", "-s", "--sensor", within=Range(0, 65535))
    mode: str | None = best_variant()
    spp: int = option(0, "Samples a pixel; 0: as the scene says.", within=Range(0, SPP.high))
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    threads: int = option(
        0, "Worker threads; 0: one a core.", "-t", "--threads", within=Range(0, 1024), changes_result=False
    )
    memory: float = option(
        1.0, "GB that rendering may take; larger pictures are made in bands.", within=Range(1e-6, 10**6)
    )
    overlay: str | None = option(
        None, "AOV to lay over the colour, with its scale (.png, .svg, .mp4): gaze, kde, depth or any other."
    )
    vmax: float | None = option(
        None, "Upper end of the overlay's scale, for gaze in 1/sr.  [default: the 99.5th percentile]", within=POSITIVE_VALUES
    )
    cmap: str | None = option(
        None, "Colour map of the overlay: inferno, magma, plasma, viridis, cividis.  [default: the overlay's own]"
    )
    log_decades: float = option(0.0, "Powers of ten that the overlay's scale spans; 0: a linear scale.", within=LOG_DECADES)
    hatching: bool = option(True, "Hatch the overlay where nothing is known.")
    frames: Path | None = option(
        None, "Render a sequence: CSV file whose header names <default>s, a line of values for each picture."
    )
    fps: float = option(25.0, "Pictures a second of an .mp4.", within=RATES)


@dataclass(frozen=True, kw_only=True)
class DemoOptions(ValidatedDataclass):
    """Which pictures the demo makes."""

    scene: Path | None = option(None, "Scene file.  [default: the demo store's]")
    defaults: Mapping[str, str] | None = definitions()
    width: int = option(600, "Width of a picture in pixels; pictures are 3:2.", within=Range(3, 16384))
    spp: int = option(8, "Samples a pixel.", within=Range(0, SPP.high))
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class FilmOptions(PictureOptions, PartOptions):
    """How a scene file is rendered, in one go or in parts."""


declare(
    "demo",
    "nerg_mi.workflows.demo:make_demo_to_look_at",
    "Render the demo store: colour, depth, gaze, visibility, the observer's gaze sphere, occlusion, EXR, a report.",
    options=DemoOptions,
    without=("scene",),
    out=extra(Path("out/demo"), "Folder to write into; it is made.", Path, "-o", "--out"),
)


# ---- Scene files for checkpoints and rays ----


@dataclass(frozen=True, kw_only=True)
class SceneOptions(ValidatedDataclass):
    """Who looks, and from where it is shown. Positions are in the coordinates of the place."""

    observer: tuple[float, ...] | None = coordinates(
        "Position of the observer's eye, x,y,z.  [default: where most rays are]"
    )
    person: str | None = option(None, "Person of the rays whose eye the observer's is, at --time or --times.")
    time: float | None = option(None, "When, in seconds of the rays' clock.", within=TIMES)
    time_range: tuple[float, ...] | None = option(
        None,
        "From when to when, A,B: also writes the frames of a walk, for nerg render --frames.",
        parse=parse_numbers,
        within=TIMES,
    )
    fps: float = option(10.0, "Frames a second of --times.", within=RATES)
    max_gap: float = option(0.5, "Seconds without a ray of that person that are bridged.", within=SECONDS)
    camera: tuple[float, ...] | None = coordinates(
        "Position of the camera, x,y,z.  [default: the best overview]", "--from"
    )
    target: tuple[float, ...] | None = coordinates("Point that it looks at, x,y,z.", "--to")
    first_person: bool = option(False, "The camera is the observer's own eye.")
    photos: Path | None = option(None, "Photos that the radiance field was trained on: the camera is one of theirs.")
    photo: str | None = option(None, "Which of them: its name, or its number from 0 on.  [default: the best]")
    allow_outside: bool = option(False, "Read files outside of --photos' folder too, where it names them.")
    fov: float | None = option(
        None, "Degrees between the left and right border of the picture.  [default: 70]", within=FIELDS_OF_VIEW
    )
    width: int = option(480, "Width of the picture in pixels.", within=Range(1, 16384))
    up: tuple[float, ...] | None = coordinates("Which way is up in the place, x,y,z.  [default: as its files say]")
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the rays' frame to the place's.  [default: the gaze field's]"
    )
    geometry: str | None = option(
        None, 'What rays alone are shown in: "hits", their hit points, or "none".  [default: hits if there are any]'
    )
    mode: str | None = best_variant()


declare(
    "scene",
    "nerg_mi.workflows.scene:write_scene",
    "Write a scene file for a place, a gaze field or rays, with a camera and an observer.",
    more="""A gaze field alone is shown in the place that it was trained in, which is found beside it. The scene is
commented; each of its defaults can be set when it is rendered (nerg render -D).""",
    options=SceneOptions,
    files=argument(
        "In any order: a place (radiance field, splats, mesh, .xml scene, .vol), a gaze field, rays.",
        list[Path],
        metavar="FILES",
    ),
    output=out("Scene file to write (.xml)."),
)


# ---- The viewer ----


@dataclass(frozen=True, kw_only=True)
class ViewOptions(ValidatedDataclass):
    """Where the page is, how fine its pictures are, and what is shown first."""

    host: str = option("127.0.0.1", "Address to serve at; another than this machine's own asks pages for a token.")
    port: int = option(8080, "Port to serve at; 0: any that is free.", within=Range(0, 65535))
    hostnames: tuple[str, ...] = option((), "Name by which others reach this machine, beside its address.", "--name")
    width: int = option(720, "Width of a refined picture in pixels.", within=Range(16, 8192))
    spp: int = option(0, "Samples a pixel of it; 0: as the scene says.", within=Range(0, SPP.high))
    observer: tuple[float, ...] | None = coordinates("Position of the observer's eye, x,y,z.  [default: the scene's]")
    up: tuple[float, ...] | None = coordinates("Which way is up in the place, x,y,z.  [default: as its files say]")
    aois: Path | None = option(None, "JSON file of areas of interest: boxes with names.")
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the rays' frame to the place's.  [default: the gaze field's]"
    )
    geometry: str | None = option(
        None, 'What rays alone are shown in: "hits", their hit points, or "none".  [default: hits if there are any]'
    )
    open: bool = option(False, "Open the page in this machine's browser.")
    mode: str | None = best_variant()


declare(
    "view",
    "nerg_mi.viewer.serve:view_files",
    more="The page is served to this machine alone, until Ctrl-C; nothing is fetched from anywhere else. At another "
    "--host its address has a token.",
    options=ViewOptions,
    files=argument(
        "A scene, or a place (radiance field, splats, mesh, .vol), a gaze field, rays; a folder.",
        list[Path],
        metavar="FILES",
    ),
)


declare(
    "render",
    "nerg_mi.workflows.render:render_film",
    "Render a scene file to a picture or a video, with the integrator that the scene names.",
    more="""An EXR file holds all channels in float32, those of the AOVs among them; a PNG file holds the colour,
tonemapped to sRGB, or an overlay with its scale, which an SVG file can hold, too. Pictures of a sequence have a number
added to their names, or are the frames of an MP4 file.

With --store or --scheduler each picture is kept when it is done, and the same command goes on where it ended.""",
    options=FilmOptions,
    scene=argument("Mitsuba scene file (.xml)."),
    output=out("Picture to write: .exr (all channels), .png; .svg, .mp4."),
)


# ---- One more is a `Kind` in the table, and the function that draws it ----


@dataclass(frozen=True)
class FigureKind:
    """``name`` and ``summary`` for people; ``takes``: what its files are; ``most``: how many of them at most;
    ``options``: a dataclass, frozen and of keywords alone, whose fields ``option`` makes (`nerg_mi.workflows.options`);
    ``function``: what draws it from ``(files, options, reporter)``, as "MODULE:NAME"."""

    name: str
    summary: str
    inputs: str
    max_files: int
    options: type
    function: str


@dataclass(frozen=True, kw_only=True)
class ColorOptions(ValidatedDataclass):
    """The colours of a figure's values."""

    vmax: float | None = option(
        None, "Upper end of the scale, in its unit.  [default: the 99.5th percentile]", within=POSITIVE_VALUES
    )
    cmap: str | None = option(None, "Colour map: inferno, magma, plasma, viridis, cividis.  [default: inferno]")
    log_decades: float = option(0.0, "Powers of ten that the scale spans; 0: a linear scale.", within=LOG_DECADES)

    def style(self, title: str | None = None, kind: str = "sequential") -> Style:
        """How overlays are drawn by these options, with colour maps of that ``kind`` (`find_colors`). Raises
        `NergError` for what cannot be drawn."""
        from nerg_mi.figures.overlay import Style
        from nerg_mi.figures.style import find_colormap

        if self.cmap is not None:
            find_colormap(self.cmap, kind)
        return Style(self.cmap, self.log_decades, False, title)


@dataclass(frozen=True, kw_only=True)
class ScaleOptions(ColorOptions):
    """The same of a figure that can be hatched."""

    hatching: bool = option(True, "Hatch where nothing is known.")

    def style(self, title: str | None = None, kind: str = "sequential") -> Style:
        """How overlays are drawn by these options, with colour maps of that ``kind`` (`find_colors`). Raises
        `NergError` for what cannot be drawn."""
        return replace(super().style(title, kind), hatch_unknown=self.hatching)


@dataclass(frozen=True, kw_only=True)
class SceneFigureOptions(ScaleOptions):
    """How a scene file is rendered for a figure."""

    defaults: Mapping[str, str] | None = definitions()
    spp: int = option(0, "Samples a pixel; 0: as the scene says.", within=Range(0, SPP.high))
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class FloorOptions(ValidatedDataclass):
    """What a floor plan shows."""

    scene: Path | None = option(None, "Scene file of the place, whose walls and furniture are drawn.")
    defaults: Mapping[str, str] | None = definitions()
    cut_height: float = option(1.2, "Height at which the place is cut, metres above its floor.", within=COORDINATES)
    floor_height: float = option(0.0, "Height of the floor (z).", within=COORDINATES)
    paths: bool = option(True, "Draw where people walked.")
    num_rays: int = option(0, "Draw so many rays, from the eye to what was looked at.", within=Range(0, 20000))
    num_views: int = option(0, "Draw so many fields of view of each person.", within=Range(0, 1000))
    fov: float = option(60.0, "Degrees that a field of view is wide.", within=Range(1, 180))
    participants: str | None = option(None, "Draw these people alone: names with commas between them.")
    mode: str | None = best_variant()


@dataclass(frozen=True, kw_only=True)
class SphereOptions(SceneFigureOptions):
    """How an observer's sphere is drawn."""

    sensor: int = option(
        0, "Where no observer is: whose place it is, counted from 0.", "-s", "--sensor", within=Range(0, 65535)
    )
    projection: str = option("mollweide", "Projection: mollweide (equal areas) or equirectangular.")
    width: int = option(800, "Width of the map in pixels; it is half as high.", within=Range(64, 2896))


@dataclass(frozen=True, kw_only=True)
class TriptychOptions(SceneFigureOptions):
    """How occlusion is shown."""

    sensor: int = option(0, "The other camera, counted from 0.", "-s", "--sensor", within=Range(0, 65535))


@dataclass(frozen=True, kw_only=True)
class DifferenceOptions(ValidatedDataclass):
    """How a difference is drawn."""

    channel: str = option("gaze", "Channel of both files.")
    vmax: float | None = option(None, "Both ends of the scale.  [default: the 99.5th percentile]", within=POSITIVE_VALUES)
    cmap: str = option("RdBu_r", "Colour map: RdBu_r, PuOr_r, BrBG_r, PRGn_r.")


@dataclass(frozen=True, kw_only=True)
class SheetOptions(ScaleOptions):
    """How pictures are put together."""

    overlay: str | None = option(
        None, "AOV of .exr files to lay over their colour, with one scale: gaze, kde, depth or any other."
    )
    columns: int | None = option(None, "Pictures in a row.  [default: about as many as rows]", within=Range(1, 1000))
    max_width: int = option(480, "Pixels that a picture is wide at most; larger ones are shrunk.", within=Range(16, 4096))


@dataclass(frozen=True, kw_only=True)
class BakedFigureOptions(ColorOptions):
    """From where a baked surface is drawn; positions in its own units."""

    camera: tuple[float, ...] | None = coordinates(
        "Position of the camera, x,y,z.  [default: where all of it is seen from above]"
    )
    target: tuple[float, ...] | None = coordinates("What the camera looks at, x,y,z.  [default: the middle]")
    up: tuple[float, ...] | None = coordinates("Which way is up, x,y,z.  [default: 0,0,1]")
    clip_above: float | None = option(
        None, "Leave out what is higher than this along up: a ceiling, for instance.", within=COORDINATES
    )
    fov: float = option(50.0, "Degrees that the picture is wide.", within=Range(1.0, 170.0))
    width: int = option(960, "Width of the picture in pixels.", within=Range(16, 4096))
    height: int = option(640, "Height of the picture in pixels.", within=Range(16, 4096))
    title: str | None = option(None, "Title.  [default: what its values are]")
    mode: str | None = best_variant()


_SCENE, _FILES = "nerg_mi.workflows.draw_scenes", "nerg_mi.workflows.draw"
_TABLE = (
    FigureKind(
        "sphere",
        "The gaze of an observer over all directions.",
        "scene file (.xml)",
        1,
        SphereOptions,
        f"{_SCENE}:sphere",
    ),
    FigureKind(
        "triptych", "Occlusion: three views of a gaze.", "scene file (.xml)", 1, TriptychOptions, f"{_SCENE}:triptych"
    ),
    FigureKind("floor", "The floor plan of rays in their place.", "file of rays (.npz)", 1, FloorOptions, f"{_SCENE}:floor"),
    FigureKind(
        "sheet",
        "Several pictures on one page, with one scale.",
        "pictures (.png, .jpg, .exr)",
        400,
        SheetOptions,
        f"{_FILES}:sheet",
    ),
    FigureKind(
        "difference",
        "A quantity of one picture less that of another.",
        "two pictures (.exr)",
        2,
        DifferenceOptions,
        f"{_FILES}:difference",
    ),
    FigureKind(
        "surface",
        "Gaze on a mesh, with its scale.",
        "a baked surface (.ply)",
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
        files=argument(f"{_kind.inputs[:1].upper()}{_kind.inputs[1:]}.", list[Path] if _kind.max_files > 1 else Path),
        output=out("Picture to write: .png or .svg."),
    )


# ---- Gaze on surfaces ----


@dataclass(frozen=True, kw_only=True)
class BakeOptions(PartOptions):
    """Whose gaze is put on which surfaces, and how."""

    gaze: Path | None = option(None, "Gaze field (.safetensors).  [default: that of a scene file]")
    rays: Path | None = option(None, "Rays of attention, a file or a dataset: where people were, and looked.")
    source: str | None = option(
        None, "Whose gaze: of the field, or of the rays themselves.  [default: the field's if there is one]", "--from"
    )
    observer: tuple[float, ...] | None = coordinates(
        "One observer's eye, x,y,z in the place, in place of the people of the rays."
    )
    observer_file: Path | None = option(
        None, "Observers one by one: a CSV file with columns x, y, z in the place and, if they differ, weight."
    )
    num_observers: int = option(
        64, "Observers that stand for all places of the people of --rays.", within=Range(1, 100_000)
    )
    ray_weights: str = option("time", "What rays count by: time, person (all people alike), or equal (all rays alike).")
    align: Path | None = option(
        None, "JSON file with the 4x4 similarity from the rays' frame to the place's.  [default: the gaze field's]"
    )
    shapes: tuple[str, ...] = option(
        (), "Only this shape of a scene receives gaze, the others hide it; repeatable.", "--shape"
    )
    cone: float | None = option(
        None,
        "Degrees (standard deviation) of the cone of a look: error of the tracker and fovea.  "
        "[default: 1.5 of rays, 0 of a field]",
        within=Range(0, 30),
    )
    cone_samples: int = option(16, "Rays that stand for the cone of a tracked one.", within=Range(1, 1024))
    smooth: float = option(
        0.0, "Metres (standard deviation) of smoothing along the surface; 0: none.", within=Range(0, 10**6)
    )
    max_edge: float | None = option(
        None,
        "Longest edge of a triangle in metres; longer ones are cut.  [default: about 100,000 triangles]",
        within=LENGTHS,
    )
    max_angle: float = option(
        2.0,
        "Degrees under which an observer sees a piece of a surface at most: less is exacter.",
        within=Range(0.2, 30),
    )
    unit: str = option("share", "Values are: share (of gaze, 1/m²), or seconds (of the rays, s/m²).")
    split_half: bool = option(False, "Say how well two halves of the people agree (of rays).")
    texture_size: int | None = option(
        None, "Pixels a side of a texture in .glb, in place of colours of vertices.", within=Range(64, 8192)
    )
    vmax: float | None = option(
        None, "Upper end of the colours' scale.  [default: the 99.5th percentile]", within=POSITIVE_VALUES
    )
    cmap: str = option("inferno", "Colour map: inferno, magma, plasma, viridis, cividis.")
    log_decades: float = option(0.0, "Powers of ten that the colours' scale spans; 0: a linear scale.", within=LOG_DECADES)
    resolution: int = option(
        256, "Of a radiance field, whose mesh is made: cells along its box's longest edge.", within=Range(8, 2048)
    )
    max_samples: int | None = option(None, "Rays of a dataset at most; of more, a sample by --seed.", within=RAYS)
    seed: int = option(0, "Seed of what is drawn at random.", within=SEEDS)
    threads: int | None = cpu_threads()
    mode: str | None = best_variant()


declare(
    "bake",
    "nerg_mi.workflows.bake:bake_any",
    "Put gaze on surfaces: how much of it each square metre receives, from a gaze field or from tracked rays.",
    options=BakeOptions,
    surface=argument("Mesh (.ply, .obj, .glb), scene (.xml), radiance field (.safetensors), or Gaussian splats."),
    output=out(
        "Files to write, repeatable: .ply, .glb (with colours), .csv (of faces), .json (summary); of Gaussian splats "
        ".ply and .json.",
        list[Path],
    ),
)


# ---- Studies, reports and statistics ----


@dataclass(frozen=True, kw_only=True)
class StudyOptions(PartOptions):
    """What a study renders, and how often."""

    scene_kind: str = option("auto", "What SCENE is: auto, analytic or file.")
    width: int = option(192, "Width of a picture in pixels.", within=Range(1, 16384))
    height: int = option(128, "Height of a picture in pixels.", within=Range(1, 16384))
    repeats: int = option(5, "Timed renders of each setting; their median counts.", within=Range(1, 10000))
    quick: bool = option(False, "A few settings only, each timed once.")
    only: str = option("", "Only the default, and settings whose name matches.", metavar="REGEX")
    defaults: Mapping[str, str] | None = definitions()
    mode: str | None = best_variant()


declare(
    "study",
    "nerg_mi.workflows.study:run_study",
    "Measure error against run time: render a scene at many settings, compare each with what is true, and plot it.",
    more="""Writes study.csv (a row a setting), study.md (the same by factor), scaling.csv, study.json and two plots. A
full study takes up to half an hour.""",
    options=StudyOptions,
    scene=argument("Scene file (.xml), or slab, sphere, sheets, fog or ramp.", str),
    out=extra(..., "Folder to write into; it is made.", Path, "-o", "--out"),
)


@dataclass(frozen=True, kw_only=True)
class ReportOptions(ValidatedDataclass):
    """What a report shows. Positions are in the coordinates of the place."""

    aois: Path | None = option(None, 'JSON file of named objects: {"shelf": [[x0, y0, z0], [x1, y1, z1]], ...}.')
    evaluate: bool = option(
        False, "Score the field on the rays that were held out of its training (about a minute a split)."
    )
    show_names: bool = option(False, "Show the names of people. Without it they are numbered.")
    min_participants: int = option(1, "Hide shares of objects that fewer people could see.", within=Range(1, 10**6))
    paths: bool = option(True, "Draw people's paths in 3D. How somebody walks can tell who it is.")
    title: str | None = option(None, "Title.  [default: the gaze field's name]")
    observer: tuple[float, ...] | None = coordinates(
        "Position of the observer in the pictures, x,y,z.  [default: where most rays are]"
    )
    camera: tuple[float, ...] | None = coordinates(
        "Position of the camera, x,y,z.  [default: the best overview]", "--from"
    )
    target: tuple[float, ...] | None = coordinates("Point that it looks at, x,y,z.", "--to")
    fov: float | None = option(
        None, "Degrees between the left and right border of its picture.  [default: 70]", within=FIELDS_OF_VIEW
    )
    viewpoints: int = option(200, "Places of people from which objects are looked for.", within=Range(1, 10_000))
    max_points: int = option(80_000, "Points of the 3D scene at most.", within=Range(100, 100_000))
    width: int = option(480, "Width of the pictures in pixels.", within=Range(24, 1200))
    spp: int = option(2, "Samples a pixel.", within=SPP)
    seed: int = option(0, "Seed of the random numbers.", within=SEEDS)
    threads: int | None = cpu_threads()
    mode: str | None = best_variant()


declare(
    "report",
    "nerg_mi.workflows.report:make_report",
    "Write a report on a gaze field: one HTML file that opens from disk and needs no network.",
    more="""It shows the place, the data, where people were, the gaze, named objects, the scores beside their baselines
with a verdict in a sentence, uncertainty, settings, limits, provenance and the place in 3D. What is missing is left
out, and said so.""",
    options=ReportOptions,
    files=argument(
        "In any order: a gaze field, and what there is of its place, rays, evaluations (gaze.json, or the folder of "
        "nerg eval gaze); a folder stands for what lies in it.",
        list[Path],
        metavar="RUN",
    ),
    output=out("File to write (.html).", default=Path("report.html")),
)


declare(
    "stats",
    "nerg_mi.workflows.statistics:statistics",
    "Count attention on things: in rays, and as a gaze field predicts it, with intervals over people.",
    more="""Share, dwell, reach, first looks, returns, distance, what could be seen; by cohort, time and zone;
differences, moves from thing to thing, what if something stood elsewhere. --visibility tells what can be seen from
where.""",
    options=StatisticsOptions,
    files=argument("Rays or a dataset, a scene, a gaze field, a place; in any order.", list[Path]),
    output=out("Folder for tables and pictures."),
)


declare(
    "jobs",
    "nerg_mi.workflows.parts:account_for_store",
    "Say what is done of the jobs in a store, what is left, what it takes in bytes, and what is stale.",
    more="Stale is what no job asks for any more as it was started last, and what was made of files that have changed "
    "since.",
    folder=argument("Store of a job: what was given as --store, or OUTPUT.tasks."),
    remove=extra(False, "Take out what no job asks for any more, and what is left over.", bool, "--remove-stale"),
)
