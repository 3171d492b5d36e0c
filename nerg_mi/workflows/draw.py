"""Figures of existing files (contact sheets, differences, gaze on a mesh), and drawing a figure of any kind."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, parameter
from nerg_mi.figures.overlay import (
    Heat,
    Overlay,
    OverlayLayers,
    difference_figure,
    find_channel_overlay,
    gaze_figure,
    robust_max,
    shared_limits,
)
from nerg_mi.figures.style import FORMATS, contact_sheet, figure_of, find_colormap, make_provenance, save, shrink
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.images import read_exr, read_exr_attributes
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.ply import parse_ply
from nerg_mi.formats.splats import is_splat_file
from nerg_mi.maths.arrays import to_vector
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rendering.bands import SURFACE_OPACITY
from nerg_mi.rendering.scene import activate_variant
from nerg_mi.surfaces.mesh import Mesh
from nerg_mi.transport.mitsuba_mesh import make_mesh

from .base import import_function
from .draw_scenes import Drawing
from .scene_cameras import check_point
from .scene_commands import KINDS, BakedFigureOptions, DifferenceOptions, FigureKind, SheetOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# ---- Images in files: colour and AOVs ----


EXR = ".exr"


def shared_note(names: Sequence[str], basis: Sequence[str]) -> str:
    """Return a line on the data behind several images: once if it is the same, else by their names."""
    if len(set(basis)) == 1:
        return basis[0]
    return "; ".join(f"{name}: {words or 'unknown'}" for name, words in zip(names, basis))


def read_stored(path: Path, overlay: Overlay) -> OverlayLayers:
    """Read the AOV of ``overlay`` from the EXR file ``path``.

    Without an opacity channel, all pixels count as surfaces. Raises `NergError` for other files, and if there is no
    such channel.
    """
    if path.suffix.lower() != EXR:
        raise NergError(f'"{path}" is not an EXR file and has no AOVs; give one that "nerg render" has written')
    channels = read_exr(path, "picture")
    values = next((channels[name] for name in channels if overlay.name in (name, name.partition(".")[0])), None)
    if values is None:
        raise NergError(f'"{path}" has no channel "{overlay.name}"; it has {", ".join(channels)}')
    color = [channels[name] for name in "RGB"] if {"R", "G", "B"} <= set(channels) else [np.zeros_like(values)] * 3
    opacity = channels.get("opacity.Y")
    mask = np.ones(values.shape, bool) if opacity is None else opacity >= SURFACE_OPACITY
    as_floats = lambda array: np.nan_to_num(np.asarray(array, np.float32))
    part = overlay.quantity.data_source
    basis = read_exr_attributes(path, "picture").get(f"{part}.basis", "") if part else ""
    return OverlayLayers(as_floats(np.stack(color, axis=-1)), np.asarray(values, np.float32), mask, support_note=basis)


# ---- Difference of an AOV between two images ----


def difference(files: Sequence[Path], options: DifferenceOptions, reporter: Reporter) -> Drawing:
    """Draw the first of two files minus the second."""
    find_colormap(options.cmap, "diverging")
    if options.vmax is not None and not (np.isfinite(options.vmax) and options.vmax > 0):
        raise NergError(f"{parameter('vmax')} must be positive, got {options.vmax}")
    if len(files) != 2:
        raise NergError(f"a difference needs two images, got {len(files)}; name two .exr files")
    overlay = find_channel_overlay(options.channel)
    if overlay.display.kind == "categorical":
        raise NergError(f'"{overlay.name}" is categorical and has no difference; choose another {parameter("channel")}')
    first, second = (read_stored(path, overlay) for path in files)
    if first.values.shape != second.values.shape:
        sizes = " and ".join(f"{v.shape[1]} x {v.shape[0]}" for v in (first.values, second.values))
        raise NergError(f"images of {sizes} pixels cannot be compared; render both in the same size")
    mask, unit = first.mask & second.mask, overlay.quantity.unit
    title = f"{files[0].stem} minus {files[1].stem}"
    label = f"difference of {overlay.name}" + (f" [{unit}]" if unit else "")
    note = shared_note([path.stem for path in files], [first.support_note, second.support_note])
    figure = difference_figure(first.values, second.values, mask, title, label, options.vmax, options.cmap, note)
    return Drawing(figure, list(files))


# ---- Contact sheets: several images on one page, with a common colour scale for an overlay ----


def sheet(files: Sequence[Path], options: SheetOptions, reporter: Reporter) -> Drawing:
    """Draw the images of ``files`` on one page, with their file names."""
    pictures = []
    names = [path.stem for path in files]
    if options.overlay is None:
        for k, path in enumerate(files):
            reporter.progress(k / len(files), path.name)
            pictures.append(shrink(_display(path), options.max_width))
        return Drawing(contact_sheet(pictures, names, options.columns), list(files))
    overlay = find_channel_overlay(options.overlay)
    style = options.style(kind=overlay.colormap_kind)
    limits, notes = [], []
    for path in files:
        stored = read_stored(path, overlay)
        notes.append(stored.support_note)
        limits.append(overlay.limits(stored))
    ends = shared_limits(limits, options.vmax)
    overlay.check_limits(ends)
    explained, hatched = [], False
    for k, path in enumerate(files):
        reporter.progress(k / len(files), path.name)
        stored = read_stored(path, overlay)
        seen = stored.mask & np.isfinite(stored.values)
        unknown = ~seen if style.hatch_unknown else None
        hatched = hatched or (unknown is not None and bool(unknown.any()))
        pictures.append(shrink(overlay.paint(stored, ends, style, unknown), options.max_width))
        # Two extreme values are enough for a scale.
        outermost = [stored.values[seen].min(), stored.values[seen].max()] if seen.any() else []
        explained.append(OverlayLayers(stored.color, np.array(outermost), np.ones(len(outermost), bool)))
    scale = lambda sheet: overlay.add_scale(sheet, explained, ends, style, hatched)
    note = shared_note(names, notes)
    return Drawing(contact_sheet(pictures, names, options.columns, scale, note), list(files))


def _display(path: Path) -> np.ndarray:
    """Return the image as displayed (h, w, 3), in 0..1."""
    from nerg_mi.figures.overlay import srgb
    from nerg_mi.photos.images import read_image
    from nerg_mi.rendering.scene import activate_variant

    if path.suffix.lower() == EXR:
        from nerg_mi.files.images import read_exr

        channels = read_exr(path, "picture")
        if {"R", "G", "B"} <= set(channels):
            return srgb(np.stack([channels[name] for name in "RGB"], axis=-1))
    activate_variant(None)
    image = read_image(path)
    shown = image / np.iinfo(image.dtype).max if image.dtype.kind == "u" else np.asarray(image, np.float64)
    if shown.shape[2] == 4:
        shown = shown[..., :3] * shown[..., 3:] + 1 - shown[..., 3:]
    return shown[..., :3]


# ---- Baked surfaces: gaze on a mesh, with its colour scale ----


_HEADER = 1 << 16
_BARE, _LIT, _PAPER = 0.18, 0.3, 1.0
_FRAME = 1.04


@dataclass(frozen=True, eq=False)
class BakedSurface:
    """A mesh with gaze.

    ``values`` (V,) belong to its vertices, ``label`` names the quantity with its unit, and ``gaze_files`` the input
    files.
    """

    mesh: Mesh
    values: np.ndarray
    label: str
    gaze_files: tuple[str, ...]


def surface(files: Sequence[Path], options: BakedFigureOptions, reporter: Reporter) -> Drawing:
    """Draw a surface that `nerg bake` has written."""
    style = options.style()
    (path,) = files
    activate_variant(options.mode)
    baked = read_baked(path)
    up = _unit(check_point(options.up, parameter("up")), np.array([0.0, 0, 1]), parameter("up"))
    mesh, values = baked.mesh, baked.values
    if options.clip_above is not None:
        below = (mesh.vertices[mesh.faces] @ up).min(axis=1) < options.clip_above
        if not below.any():
            raise NergError(
                f'no triangle of "{path}" is below {options.clip_above:g}; give a larger {parameter("clip_above")}'
            )
        mesh = Mesh(mesh.vertices, mesh.faces[below])
    value, shade, hit = _trace_mesh(mesh, values, up, options)
    if not hit.any():
        raise NergError(
            f'no part of "{path}" is in the image; give another {parameter("camera")} or {parameter("target")}'
        )
    grey = np.where(hit, _BARE + _LIT * shade, _PAPER)
    heat = Heat(options.vmax or robust_max(value, hit), style.colormap or "inferno", decades=style.decades)
    title = options.title or baked.label.partition("[")[0].strip().capitalize()
    note = f"data: {', '.join(baked.gaze_files)}" if baked.gaze_files else ""
    color = np.repeat(grey[..., None], 3, axis=2)
    # Pixels without a surface are not unknown: they are white and not hatched.
    return Drawing(gaze_figure(color, value, hit, heat, title, baked.label, note=note), [path])


def read_baked(path: Path) -> BakedSurface:
    """Read a mesh with gaze from a PLY file of `nerg bake`. Raises `NergError` for any other file."""
    if path.suffix.lower() != ".ply":
        raise NergError(f'"{path}" is not a baked mesh; give the .ply file that "nerg bake" writes')
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    if is_splat_file(path):
        raise NergError(
            f'"{path}" holds Gaussian splats, whose colours show the gaze already: create a scene with nerg scene '
            f"{path} -o a.xml, and view it with nerg view a.xml"
        )
    body = read_mesh_file(path)
    with translate_read_errors(path, "baked surface"):
        with path.open("rb") as file:
            head = file.read(_HEADER).partition(b"end_header")[0].decode("utf-8", "replace").splitlines()
        columns = parse_ply(np.fromfile(path, np.uint8)).tables["vertex"].columns
        if "value" not in columns:
            raise NergError(
                f'the vertices of "{path}" have no property "value"; give a .ply file that "nerg bake" has written'
            )
        values = columns["value"]().astype(np.float64)
        mesh = Mesh(body.vertices, body.faces)
    comments = {key: rest for key, _, rest in (line.removeprefix("comment ").partition(" ") for line in head)}
    label = comments.get("value:", "value")
    try:
        inputs = json.loads(comments.get("nerg_mi", "{}")).get("inputs", {})
    except ValueError as error:
        raise NergError(f'the header of "{path}" is damaged ({error}); bake it again') from error
    return BakedSurface(mesh, values, label, tuple(inputs))


def _trace_mesh(mesh: Mesh, values: np.ndarray, up: np.ndarray, options: BakedFigureOptions) -> tuple[np.ndarray, ...]:
    """Return value, shading and whether there is a surface (h, w), for the centre of each pixel."""
    import mitsuba as mi

    w, h = options.width, options.height
    eye, across, rise, ahead = _camera(mesh, up, options)
    half = np.tan(np.radians(options.fov) / 2)
    x, y = np.meshgrid((np.arange(w) + 0.5) / w * 2 - 1, (1 - (np.arange(h) + 0.5) / h * 2) * h / w)
    d = (ahead + half * (x[..., None] * across + y[..., None] * rise)).reshape(-1, 3)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    mesh_shape = make_mesh(mesh.vertices, mesh.faces, "surface")
    scene: mi.Scene = mi.load_dict({"type": "scene", "surface": mesh_shape})
    ray = mi.Ray3f(mi.Point3f(*eye.tolist()), to_vector(mi.Vector3f, d))
    intersection = scene.ray_intersect_preliminary(ray)
    hit = np.array(intersection.is_valid(), bool)
    face = mesh.faces[np.where(hit, np.array(intersection.prim_index, np.int64), 0)]
    # Undefined for rays without a hit.
    u, v = np.where(hit, np.array(intersection.prim_uv), 0).astype(np.float64)
    weights = np.stack([1 - u - v, u, v], axis=1)
    a, b, c = (mesh.vertices[face[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    # Two-sided lighting, more from above than from the camera, so that floors and walls differ.
    shade = 0.6 * np.abs((normal * d).sum(axis=1)) + 0.4 * np.abs(normal @ up)
    value = np.where(hit, (weights * values[face]).sum(axis=1), 0.0)
    return value.reshape(h, w), shade.reshape(h, w), hit.reshape(h, w)


def _camera(mesh: Mesh, up: np.ndarray, options: BakedFigureOptions) -> tuple[np.ndarray, ...]:
    """Return position and axes (right, up, forward) of the camera. Raises `NergError` for a degenerate camera."""
    corners = mesh.vertices[np.unique(mesh.faces)]
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    target = check_point(options.target, parameter("target"))
    target = (lower + upper) / 2 if target is None else target
    eye = check_point(options.camera, parameter("camera"))
    if eye is None:
        side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
        back = np.cross(side, up)
        offset = 0.9 * up - 0.8 * side / np.linalg.norm(side) + 0.4 * back / np.linalg.norm(back)
        eye = target + offset
    ahead = _unit(target - eye, None, f"the vector from {parameter('camera')} to {parameter('target')}")
    across = np.cross(ahead, up)
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(ahead, np.roll(up, 1))
    across /= np.linalg.norm(across)
    rise = np.cross(across, ahead)
    if options.camera is None:
        half = np.tan(np.radians(options.fov) / 2)
        x, y, z = ((corners - target) @ np.stack([across, rise, ahead], axis=1)).T
        away = np.maximum(np.abs(x) / half, np.abs(y) / (half * options.height / options.width)) - z
        eye = target - _FRAME * away.max() * ahead
    return eye, across, rise, ahead


def _unit(vector: np.ndarray | None, otherwise: np.ndarray | None, name: str) -> np.ndarray:
    vector = otherwise if vector is None else vector
    assert vector is not None
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise NergError(f"{name} must not be of length 0")
    return vector / length


# ---- Any kind of figure, drawn and written ----

FileName = str | os.PathLike


def find_kind(name: str) -> FigureKind:
    """Return the kind of figure ``name``. Raises `NergError` for an unknown one."""
    if name not in KINDS:
        raise NergError(f'there is no figure "{name}"; choose one of {", ".join(KINDS)}')
    return KINDS[name]


def draw(
    kind: str,
    files: FileName | Sequence[FileName],
    output: FileName | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> Figure:
    """Draw the figure of ``nerg draw KIND FILES`` as a matplotlib figure, in the active Mitsuba variant.

    Parameters
    ----------
    kind
        Kind of the figure, such as "sphere".
    files
        Input file or files.
    output
        File to write (.png or .svg), or None.
    reporter
        Receives messages and progress.
    options
        Options of the command as keywords.

    Raises
    ------
    NergError
        For an unknown kind or option, and for unsuitable files.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> figure = nerg.draw("sphere", files("nerg_mi.scenes.store") / "scene.xml", width=64, spp=1)
    >>> len(figure.axes) > 0  # a figure of matplotlib, which a notebook shows by itself
    True
    """
    import mitsuba as mi

    figure_kind = find_kind(kind)
    types = {f.name: str(f.type) for f in fields(figure_kind.options)}
    if "mode" in types and mi.variant() is not None:
        options.setdefault("mode", mi.variant())
    unknown = next((name for name in options if name not in types), None)
    if unknown is not None:
        raise NergError(f'the figure "{kind}" has no option "{unknown}"; it has {", ".join(types)}')
    options = {k: Path(v) if isinstance(v, str) and "Path" in types[k] else v for k, v in options.items()}
    several = [files] if isinstance(files, (str, os.PathLike)) else files
    return draw_kind(
        figure_kind,
        [Path(f) for f in several],
        None if output is None else Path(output),
        figure_kind.options(**options),
        reporter,
    )


def draw_files(files: Path | list[Path], output: Path, options: Any, reporter: Reporter) -> None:
    """Draw the figure whose kind has these ``options``, and write it to ``output``."""
    kind = next(kind for kind in KINDS.values() if kind.options is type(options))
    draw_kind(kind, files if isinstance(files, list) else [files], output, options, reporter)


def draw_kind(
    kind: FigureKind, files: Sequence[Path], output: Path | None, options: Any, reporter: Reporter = SILENT
) -> Any:
    """Draw a figure of ``kind``; write it with its provenance to ``output`` if that is given."""
    if output is not None:
        check_writable(output, *FORMATS)
    if not 1 <= len(files) <= kind.max_files:
        raise NergError(f'the figure "{kind.name}" takes 1 to {kind.max_files} files, got {len(files)}')
    for path in files:
        if not path.exists():
            raise MissingFile(f'there is no file "{path}"')
    drawing = import_function(kind.function)(files, options, reporter)
    figure = figure_of(drawing.drawn)
    if output is not None:
        record = make_provenance(f"nerg draw {kind.name}", _inputs(drawing.inputs, options), drawing.seed, options)
        save(figure, output, record)
        reporter.message(f"Wrote {output} ({' x '.join(f'{v:.0f}' for v in figure.bbox.size)}).")
    return figure


def _inputs(paths: Sequence[Path], options: Any) -> list[Path]:
    """Return the input files, including those that a scene refers to."""
    from nerg_mi.rendering.scene import list_scene_files

    inputs: list[Path] = []
    for path in paths:
        if path.suffix.lower() == ".xml":
            inputs += list_scene_files(path, getattr(options, "defaults", None))
        else:
            inputs.append(path)
    return inputs
