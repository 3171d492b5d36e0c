"""Figures: of files that were rendered or baked before (contact sheets, differences, gaze on a mesh), and drawing and
writing one of any kind."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.figures.overlay import (
    Heat,
    Overlay,
    OverlayLayers,
    difference_figure,
    find_channel_overlay,
    gaze_figure,
    shared_limits,
    robust_max,
)
from nerg_mi.figures.style import FORMATS, contact_sheet, find_colormap, make_provenance, save, shrink
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.images import read_exr, read_exr_attributes
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.ply import parse_ply
from nerg_mi.formats.splats import is_splat_file
from nerg_mi.maths.arrays import to_vector
from nerg_mi.rendering.bands import SURFACE_OPACITY
from nerg_mi.rendering.scene import activate_variant
from nerg_mi.surfaces.mesh import Mesh, mitsuba_mesh

from .base import SILENT, Reporter, import_function
from .draw_scenes import Drawing
from .scene_cameras import check_point
from .scene_commands import KINDS, BakedFigureOptions, DifferenceOptions, FigureKind, SheetOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# ---- Pictures in files: colour, and quantities that were rendered with it ----


EXR = ".exr"


def shared_note(names: Sequence[str], basis: Sequence[str]) -> str:
    """A line on what several pictures rest on: once where it is the same, otherwise by their names."""
    if len(set(basis)) == 1:
        return basis[0]
    return "; ".join(f"{name}: {words or 'not known'}" for name, words in zip(names, basis))


def read_stored(path: Path, overlay: Overlay) -> OverlayLayers:
    """The EXR file ``path`` with the quantity of ``overlay``; without opacity there are surfaces everywhere, and
    nothing rests on rays where the file does not say so. Raises `NergError` for other files and for one that has no
    such channel."""
    if path.suffix.lower() != EXR:
        raise NergError(f'"{path}" holds no quantities, which an EXR file does; give one that "nerg render" wrote')
    found = read_exr(path, "picture")
    values = next((found[name] for name in found if overlay.name in (name, name.partition(".")[0])), None)
    if values is None:
        raise NergError(f'"{path}" has no "{overlay.name}"; it has {", ".join(found)}')
    color = [found[name] for name in "RGB"] if {"R", "G", "B"} <= set(found) else [np.zeros_like(values)] * 3
    opacity = found.get("opacity.Y")
    mask = np.ones(values.shape, bool) if opacity is None else opacity >= SURFACE_OPACITY
    as_floats = lambda array: np.nan_to_num(np.asarray(array, np.float32))
    part = overlay.quantity.data_source
    basis = read_exr_attributes(path, "picture").get(f"{part}.basis", "") if part else ""
    return OverlayLayers(as_floats(np.stack(color, axis=-1)), np.asarray(values, np.float32), mask, support_note=basis)


# ---- How two pictures differ in a quantity: the first less the second ----


def difference(files: Sequence[Path], options: DifferenceOptions, reporter: Reporter) -> Drawing:
    """The first of two files less the second."""
    find_colormap(options.cmap, "diverging")
    if options.vmax is not None and not (np.isfinite(options.vmax) and options.vmax > 0):
        raise NergError(f"--top must be positive, got {options.vmax}")
    if len(files) != 2:
        raise NergError(f"a difference is of two pictures, and {len(files)} were given; name two .exr files")
    overlay = find_channel_overlay(options.channel)
    if overlay.display.kind == "categorical":
        raise NergError(f'"{overlay.name}" names classes, which have no difference; choose another --channel')
    first, second = (read_stored(path, overlay) for path in files)
    if first.values.shape != second.values.shape:
        sizes = " and ".join(f"{v.shape[1]} x {v.shape[0]}" for v in (first.values, second.values))
        raise NergError(f"pictures of {sizes} pixels cannot be compared; render both with one size")
    mask, unit = first.mask & second.mask, overlay.quantity.unit
    title = f"{files[0].stem} less {files[1].stem}"
    label = f"difference of {overlay.name}" + (f" [{unit}]" if unit else "")
    note = shared_note([path.stem for path in files], [first.support_note, second.support_note])
    figure = difference_figure(first.values, second.values, mask, title, label, options.vmax, options.cmap, note)
    return Drawing(figure, list(files))


# ---- A contact sheet: several pictures on one page, with one scale where a quantity lies over them ----


def sheet(files: Sequence[Path], options: SheetOptions, reporter: Reporter) -> Drawing:
    """The pictures of ``files``, named by their files."""
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
        # Of all values the outermost are enough for a scale.
        outermost = [stored.values[seen].min(), stored.values[seen].max()] if seen.any() else []
        explained.append(OverlayLayers(stored.color, np.array(outermost), np.ones(len(outermost), bool)))
    scale = lambda sheet: overlay.add_scale(sheet, explained, ends, style, hatched)
    note = shared_note(names, notes)
    return Drawing(contact_sheet(pictures, names, options.columns, scale, note), list(files))


def _display(path: Path) -> np.ndarray:
    """The picture as it is shown (h, w, 3), in 0..1."""
    from nerg_mi.figures.overlay import srgb
    from nerg_mi.photos.images import read_image
    from nerg_mi.rendering.scene import activate_variant

    if path.suffix.lower() == EXR:
        from nerg_mi.files.images import read_exr

        found = read_exr(path, "picture")
        if {"R", "G", "B"} <= set(found):
            return srgb(np.stack([found[name] for name in "RGB"], axis=-1))
    activate_variant(None)
    image = read_image(path)
    shown = image / np.iinfo(image.dtype).max if image.dtype.kind == "u" else np.asarray(image, np.float64)
    if shown.shape[2] == 4:
        shown = shown[..., :3] * shown[..., 3:] + 1 - shown[..., 3:]
    return shown[..., :3]


# ---- A baked surface: gaze on a mesh, with its scale ----


_HEADER = 1 << 16
_BARE, _LIT, _PAPER = 0.18, 0.3, 1.0
_FRAME = 1.04


@dataclass(frozen=True, eq=False)
class BakedSurface:
    """``mesh`` with ``values`` (V,) of its vertices; ``label``: what they are, with their unit; ``made_of``: the names
    of the files of its gaze."""

    mesh: Mesh
    values: np.ndarray
    label: str
    gaze_files: tuple[str, ...]


def surface(files: Sequence[Path], options: BakedFigureOptions, reporter: Reporter) -> Drawing:
    """The picture of the surface that `nerg bake` has written."""
    style = options.style()
    (path,) = files
    activate_variant(options.mode)
    baked = read_baked(path)
    up = _unit(check_point(options.up, "--up"), np.array([0.0, 0, 1]), "--up")
    mesh, values = baked.mesh, baked.values
    if options.clip_above is not None:
        kept = (mesh.vertices[mesh.faces] @ up).min(axis=1) < options.clip_above
        if not kept.any():
            raise NergError(f'nothing of "{path}" is below {options.clip_above:g}; give a larger --below')
        mesh = Mesh(mesh.vertices, mesh.faces[kept])
    value, shade, met = _seen(mesh, values, up, options)
    if not met.any():
        raise NergError(f'nothing of "{path}" is in the picture; give another --camera or --target')
    grey = np.where(met, _BARE + _LIT * shade, _PAPER)
    heat = Heat(options.vmax or robust_max(value, met), style.colormap or "inferno", decades=style.decades)
    title = options.title or baked.label.partition("[")[0].strip().capitalize()
    note = f"made of {', '.join(baked.gaze_files)}" if baked.gaze_files else ""
    color = np.repeat(grey[..., None], 3, axis=2)
    # Beside the surface there is nothing that could be known: it is paper, and not hatched.
    return Drawing(gaze_figure(color, value, met, heat, title, baked.label, note=note), [path])


def read_baked(path: Path) -> BakedSurface:
    """A mesh with values in a PLY file, as `nerg bake` writes it. Raises `NergError` for any other file."""
    if path.suffix.lower() != ".ply":
        raise NergError(f'"{path}" is no baked surface that is drawn; give the .ply that "nerg bake" writes')
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    if is_splat_file(path):
        raise NergError(
            f'"{path}" holds Gaussian splats, which show their gaze as they are: nerg scene {path} -o a.xml'
        )
    body = read_mesh_file(path)
    with translate_read_errors(path, "baked surface"):
        with path.open("rb") as file:
            head = file.read(_HEADER).partition(b"end_header")[0].decode("utf-8", "replace").splitlines()
        columns = parse_ply(np.fromfile(path, np.uint8)).tables["vertex"].columns
        if "value" not in columns:
            raise NergError(f'the vertices of "{path}" have no property value; give a .ply that "nerg bake" wrote')
        values = columns["value"]().astype(np.float64)
        mesh = Mesh(body.vertices, body.faces)
    said = {key: rest for key, _, rest in (line.removeprefix("comment ").partition(" ") for line in head)}
    label = said.get("value:", "value")
    try:
        inputs = json.loads(said.get("nerg_mi", "{}")).get("inputs", {})
    except ValueError as error:
        raise NergError(f'the header of "{path}" is damaged ({error}); bake it again') from error
    return BakedSurface(mesh, values, label, tuple(inputs))


def _seen(mesh: Mesh, values: np.ndarray, up: np.ndarray, options: BakedFigureOptions) -> tuple[np.ndarray, ...]:
    """Value, shade and whether there is a surface (h, w) for each pixel's middle."""
    import mitsuba as mi

    w, h = options.width, options.height
    eye, across, rise, ahead = _camera(mesh, up, options)
    half = np.tan(np.radians(options.fov) / 2)
    x, y = np.meshgrid((np.arange(w) + 0.5) / w * 2 - 1, (1 - (np.arange(h) + 0.5) / h * 2) * h / w)
    d = (ahead + half * (x[..., None] * across + y[..., None] * rise)).reshape(-1, 3)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    ours = mitsuba_mesh(mesh.vertices, mesh.faces, "surface")
    scene: mi.Scene = mi.load_dict({"type": "scene", "surface": ours})
    ray = mi.Ray3f(mi.Point3f(*eye.tolist()), to_vector(mi.Vector3f, d))
    found = scene.ray_intersect_preliminary(ray)
    met = np.array(found.is_valid(), bool)
    face = mesh.faces[np.where(met, np.array(found.prim_index, np.int64), 0)]
    # Of rays that met nothing they hold anything.
    u, v = np.where(met, np.array(found.prim_uv), 0).astype(np.float64)
    weights = np.stack([1 - u - v, u, v], axis=1)
    a, b, c = (mesh.vertices[face[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    # Both sides are lit, from above more than from the camera, so that floors and walls differ.
    shade = 0.6 * np.abs((normal * d).sum(axis=1)) + 0.4 * np.abs(normal @ up)
    value = np.where(met, (weights * values[face]).sum(axis=1), 0.0)
    return value.reshape(h, w), shade.reshape(h, w), met.reshape(h, w)


def _camera(mesh: Mesh, up: np.ndarray, options: BakedFigureOptions) -> tuple[np.ndarray, ...]:
    """Where the camera is, and its axes: to the right, up and ahead. Raises `NergError` for one that sees nothing."""
    corners = mesh.vertices[np.unique(mesh.faces)]
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    target = check_point(options.target, "--target")
    target = (lower + upper) / 2 if target is None else target
    eye = check_point(options.camera, "--camera")
    if eye is None:
        side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
        back = np.cross(side, up)
        way = 0.9 * up - 0.8 * side / np.linalg.norm(side) + 0.4 * back / np.linalg.norm(back)
        eye = target + way
    ahead = _unit(target - eye, None, "--target, which has to be elsewhere than --camera,")
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
    """The kind ``name``. Raises `NergError` for one that is not known."""
    if name not in KINDS:
        raise NergError(f'there is no figure "{name}"; there are {", ".join(KINDS)}')
    return KINDS[name]


def draw(
    kind: str,
    files: FileName | Sequence[FileName],
    output: FileName | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> Figure:
    """The figure of matplotlib that the command ``nerg draw KIND FILES`` draws, with its options as keywords, in the
    Mitsuba variant that is set.

    ``output``: where it is written, too (.png or .svg). Raises `NergError` for another kind or option, and for files
    that it cannot be drawn of.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> figure = nerg.draw("sphere", files("nerg_mi.scenes.store") / "scene.xml", width=64, spp=1)
    >>> len(figure.axes) > 0  # a figure of matplotlib, which a notebook shows by itself
    True
    """
    import mitsuba as mi

    chosen = find_kind(kind)
    types = {f.name: str(f.type) for f in fields(chosen.options)}
    if "mode" in types and mi.variant() is not None:
        options.setdefault("mode", mi.variant())
    unknown = next((name for name in options if name not in types), None)
    if unknown is not None:
        raise NergError(f'a figure "{kind}" has no option "{unknown}"; it has {", ".join(types)}')
    options = {k: Path(v) if isinstance(v, str) and "Path" in types[k] else v for k, v in options.items()}
    several = [files] if isinstance(files, (str, os.PathLike)) else files
    return draw_kind(
        chosen,
        [Path(f) for f in several],
        None if output is None else Path(output),
        chosen.options(**options),
        reporter,
    )


def draw_files(files: Path | list[Path], output: Path, options: Any, reporter: Reporter) -> None:
    """The figure of the kind whose ``options`` these are, written to ``output``."""
    kind = next(kind for kind in KINDS.values() if kind.options is type(options))
    draw_kind(kind, files if isinstance(files, list) else [files], output, options, reporter)


def draw_kind(kind: FigureKind, files: Sequence[Path], output: Path | None, options: Any, reporter: Reporter = SILENT) -> Any:
    """The figure of ``kind`` of ``files``, with an object of its ``options``; written to ``output``, with its
    provenance, where that is given."""
    if output is not None:
        check_writable(output, *FORMATS)
    if not 1 <= len(files) <= kind.max_files:
        raise NergError(f'a figure "{kind.name}" is drawn of 1 to {kind.max_files} files, and {len(files)} were given')
    for path in files:
        if not path.exists():
            raise MissingFile(f'there is no file "{path}"')
    made = import_function(kind.function)(files, options, reporter)
    if output is not None:
        about = make_provenance(f"nerg draw {kind.name}", _inputs(made.inputs, options), made.seed, options)
        save(made.figure, output, about)
        reporter.message(f"Wrote {output} ({' x '.join(f'{v:.0f}' for v in made.figure.bbox.size)}).")
    return made.figure


def _inputs(paths: Sequence[Path], options: Any) -> list[Path]:
    """The files that were read: of a scene those that it names, too."""
    from nerg_mi.rendering.scene import list_scene_files

    found: list[Path] = []
    for path in paths:
        if path.suffix.lower() == ".xml":
            found += list_scene_files(path, getattr(options, "defaults", None))
        else:
            found.append(path)
    return found
