"""Attention on areas and surfaces, reports, figures, scene files, the viewer, and exports."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.files.values import FilePath
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.radiance_commands import SceneExportOptions
from nerg_mi.workflows.scene_commands import BakeOptions, FilmOptions, ReportOptions, SceneOptions

from .arguments import check_output
from .calls import Progress, report_progress, show_figure
from .gaze import list_inputs
from .objects import as_file, as_scene_file, build_options, copy_from_session
from .scene import AnyEnvironment, Scene, make_scene
from .session import display_name, is_object, session_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nerg_mi.aoi.output import StatisticsResult
    from nerg_mi.workflows.bake import Bake
    from nerg_mi.workflows.bake_splats import SplatBake
    from nerg_mi.workflows.export_scene import SceneExport
    from nerg_mi.workflows.report import ReportResult


def statistics(
    inputs: object, areas: object = None, *, output: FilePath | None = None, progress: Progress = None, **options: Any
) -> StatisticsResult:
    """Compute attention statistics of areas of interest, from recordings and as predicted by a gaze field.

    Parameters
    ----------
    inputs : object or sequence of these
        Recordings (`Rays`, a file or a dataset), an environment (`nerg_mi.api.scene.AnyEnvironment`) and a gaze field,
        in memory or as files, in any order. A gaze field in memory knows the environment of its training.
    areas : mapping or path, optional
        Areas of interest by name: boxes (two corners), meshes of trimesh, or dicts as in a file of areas; or such a
        JSON file (docs/how-to/statistics.md).
    output : path, optional
        Folder for the tables.
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **options
        Options of `nerg stats` (`nerg_mi.aoi.options.StatisticsOptions`), such as ``resamples=200`` or ``align``.

    Returns
    -------
    StatisticsResult
        Tables as lists of dicts; ``to_dataframe`` returns them as data frames.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> eye, ahead = [[0.0, 0.0, 1.6]] * 3, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    >>> rays = nerg.Rays.from_arrays(eye, ahead, times=[0.0, 0.2, 0.4])
    >>> row = nerg.statistics(rays, {"shelf": [[2, -1, 0], [3, 1, 2]]}).aois[0]
    >>> row["aoi"], round(row["share"], 3), row["hit_ratio"], row["distance"]
    ('shelf', 0.667, 1.0, 2.0)
    """
    from nerg_mi.workflows.statistics import statistics as compute

    if areas is not None:
        options["aois"] = areas
    with report_progress(progress) as reporter:
        resolved = build_options(StatisticsOptions, "statistics", None, options)
        files = [item if isinstance(item, Rays) else as_scene_file(item, "inputs") for item in list_inputs(inputs)]
        return compute(files, None if output is None else Path(output), resolved, reporter)


def bake(
    surface: AnyEnvironment,
    outputs: FilePath | Sequence[FilePath] = (),
    *,
    rays: Rays | FilePath | None = None,
    options: BakeOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> Bake | SplatBake:
    """Compute the attention per area on a surface.

    Parameters
    ----------
    surface : AnyEnvironment
        A mesh, a scene, a radiance field or Gaussian splats, in memory or as a file.
    outputs : path or sequence of path
        Files to write (.ply, .glb, .csv, .json).
    rays : Rays or path, optional
        Recordings. With a gaze field they provide the positions of the observers; otherwise they are the gaze to bake.
    options : BakeOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.BakeOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``gaze`` (a field in memory or a file),
        ``observer=(4.4, 2.8, 1.6)`` or ``smooth=0.05``.

    Returns
    -------
    Bake or SplatBake
        Attention per square metre and its sums, for `export_scene` and ``draw("surface", ...)``.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> gaze = store / "shoppers.safetensors"
    >>> baked = nerg.bake(store / "twin.ply", gaze=gaze, observer=(4.4, 2.8, 1.6), max_edge=1.0)
    >>> 0.9 < baked.on_surface < 1, abs(baked.unaccounted) < 0.01
    (True, True)
    """
    from nerg_mi.workflows import bake as baking

    in_memory = rays if isinstance(rays, Rays) else None
    if rays is not None and in_memory is None:
        overrides = {**overrides, "rays": rays}
    files = [outputs] if isinstance(outputs, (str, Path)) or not isinstance(outputs, Sequence) else list(outputs)
    for file in files:
        check_output(file, "outputs")
    with report_progress(progress) as reporter:
        resolved = build_options(BakeOptions, "bake", options, overrides)
        surface_file, paths = as_file(surface, "surface"), [Path(str(file)) for file in files]
        return baking.bake_any(surface_file, paths, resolved, reporter, in_memory)


def report(
    inputs: object,
    output: FilePath | None = None,
    *,
    options: ReportOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> ReportResult:
    """Write a report on a gaze field: one HTML file with verdict, figures, scores and a 3D view.

    Parameters
    ----------
    inputs : object or sequence of these
        The gaze field and, in any order, recordings, its environment, in memory or as files, and folders of
        evaluations. A gaze field in memory knows the environment of its training.
    output : path, optional
        File to write (.html). Default: a temporary file, which is removed when the process ends.
    options : ReportOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.ReportOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``evaluate=True``, ``title="Store"`` or ``aois`` (areas as for
        `statistics`).

    Returns
    -------
    ReportResult
        The ``path`` of the file; a notebook shows the report.

    Raises
    ------
    NergError
        An option or an input is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> made = nerg.report(store / "shoppers.safetensors", folder / "report.html", width=24, spp=1, viewpoints=1)
    >>> made.path.name
    'report.html'
    """
    from nerg_mi.workflows.report import make_report

    check_output(output)
    with report_progress(progress) as reporter:
        resolved = build_options(ReportOptions, "report", options, overrides)
        path = session_folder() / f"report-{uuid4().hex[:12]}.html" if output is None else Path(output)
        files = [as_file(item, "inputs") for item in list_inputs(inputs)]
        if resolved.title is None and any(file.suffix == ".safetensors" and is_object(file) for file in files):
            resolved = replace(resolved, title="Gaze field")  # an object has no name
        return make_report(files, path, resolved, reporter)


def draw(
    kind: str, inputs: object, output: FilePath | None = None, *, progress: Progress = None, **options: Any
) -> Figure:
    """Draw a figure.

    Parameters
    ----------
    kind : str
        ``sphere`` or ``triptych`` of a scene, ``floor`` of rays, ``surface`` of a mesh that `bake` has written,
        ``sheet`` of images, or ``difference`` of two of them.
    inputs : object or sequence of these
        The scene, the rays or the files.
    output : path, optional
        File to write (.png or .svg).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **options
        Options of ``nerg draw KIND``.

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        The kind, an option or an input is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> figure = nerg.draw("sphere", files("nerg_mi.scenes.store") / "scene.xml", width=64, spp=1)
    >>> len(figure.axes) > 0
    True
    """
    from nerg_mi.workflows.draw import draw as draw_figure

    check_output(output)
    with report_progress(progress) as reporter:
        several = list(inputs) if isinstance(inputs, (list, tuple)) else [inputs]
        files = [as_file(item, "inputs") for item in several]
        if (scene := options.get("scene")) is not None:
            # Figures of a scene need the integrator, which an environment does not have.
            shown = scene if isinstance(scene, (str, os.PathLike, Scene)) else make_scene(scene)
            options["scene"] = as_file(shown, "scene")
        return show_figure(draw_figure(kind, files, output, reporter, **options))


def write_scene(
    inputs: object,
    output: FilePath,
    *,
    options: SceneOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> Scene:
    """Write a commented scene file with the best overview as its camera, and an observer.

    `make_scene` makes a scene without a file, and `Scene.save` writes it.

    Parameters
    ----------
    inputs : object or sequence of these
        An environment, a gaze field and recordings, or some of them, in memory or as files, in any order.
    output : path
        File to write (.xml).
    options : SceneOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.SceneOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``observer=(4.4, 2.8, 1.6)`` or ``width=960``.

    Returns
    -------
    Scene
        The scene of the file.

    Raises
    ------
    NergError
        An option or an input is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg, trimesh
    >>> room = trimesh.creation.box((4, 3, 2.5))
    >>> len(nerg.write_scene(room, folder / "room.xml", observer=(0, 0, 0), width=48).mitsuba.sensors())
    3
    """
    from nerg_mi.workflows.scene import write_scene as write

    check_output(output)
    output = Path(output)
    with report_progress(progress) as reporter:
        resolved = build_options(SceneOptions, "write_scene", options, overrides)
        files = [as_file(item, "inputs") for item in list_inputs(inputs)]
        for file in files:
            # The scene refers to it by name.
            copy_from_session(file, output.parent)
        local = [output.parent / file.name if (output.parent / file.name).exists() else file for file in files]
        write(local, output, resolved, reporter)
    return Scene.load(output)


def render_film(
    scene: Scene | FilePath,
    output: FilePath,
    *,
    options: FilmOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> Path:
    """Render a scene to an image file or a video, as ``nerg render`` does. `render` returns arrays.

    Parameters
    ----------
    scene : Scene or path
        The scene, or its file.
    output : path
        Image (.exr with all channels, .png; .svg needs ``overlay``) or video (.mp4, needs ``frames``) to write.
    options : FilmOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.FilmOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``overlay="gaze"``, ``spp=64`` or ``frames="walk.csv"``.

    Returns
    -------
    Path
        The file, of a sequence the first one.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> scene = nerg.Scene.load(files("nerg_mi.scenes.store") / "scene.xml", width=48, height=32)
    >>> nerg.render_film(scene, folder / "gaze.png", overlay="gaze", spp=1).name
    'gaze.png'
    """
    from nerg_mi.workflows.render import render_film as render_to_file

    check_output(output)
    with report_progress(progress) as reporter:
        resolved = build_options(FilmOptions, "render_film", options, overrides)
        return render_to_file(as_file(scene, "scene"), Path(output), resolved, reporter).path


def export_scene(
    scene: object,
    output: FilePath,
    rays: object = (),
    *,
    options: SceneExportOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> SceneExport:
    """Write a scene with its gaze for Rerun (.rrd) or OpenUSD (.usdc, .usda, .usd).

    Shapes, fields, splats and cameras of the scene are written, and the gaze of its observer as coloured points on
    surfaces and as a sphere around the observer.

    Parameters
    ----------
    scene : object or sequence of these
        A `Scene` of `make_scene`, an environment without gaze (`nerg_mi.api.scene.AnyEnvironment`), or a mesh that
        `bake` has written, in memory or as files, all in the same frame.
    output : path
        File to write. ``.rrd`` needs the extra ``rerun``, the others need the extra ``usd``.
    rays : Rays, path or sequence of these, optional
        Recordings in the frame of the scene, which are written as eyes, rays and fixations of each participant.
    options : SceneExportOptions, optional
        Base options (`nerg_mi.workflows.radiance_commands.SceneExportOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``max_rays=5000``, ``spp=16`` or ``up="y"``.

    Returns
    -------
    SceneExport
        The written file (``output``) and its contents (``scene``).

    Raises
    ------
    NergError
        An option or an input is invalid, or the scene contains nothing that can be exported.
    ImportError
        The library of the format is not installed.

    Examples
    --------
    >>> import nerg_mi as nerg, trimesh
    >>> room = trimesh.creation.box((4, 3, 2.5))
    >>> rays = nerg.Rays.from_arrays([[0, 0, 0]] * 3, [[1, 0, 0]] * 3, times=[0.0, 0.1, 0.2])
    >>> nerg.export_scene(room, folder / "room.usdc", rays)
    <SceneExport: room.usdc, 1 mesh, 3 rays, 1 fixation>
    """
    from nerg_mi.workflows.export_scene import export_scene as write

    check_output(output)
    with report_progress(progress) as reporter:
        resolved = build_options(SceneExportOptions, "export_scene", options, overrides)
        files = [
            as_file(item, name)
            for name, items in (("scene", scene), ("rays", rays))
            for item in (items if isinstance(items, (list, tuple)) else [items])
        ]
        return write(files, Path(output), resolved, reporter, names=[display_name(file) for file in files])
