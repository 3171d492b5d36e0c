"""Surfaces with gaze that `nerg_mi.surfaces.bake.bake` has written, and their figure."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import MissingFile, NergError, parameter
from nerg_mi.figures.overlay import Heat, find_overlay, gaze_figure, robust_max
from nerg_mi.figures.settings import Style
from nerg_mi.figures.style import changed_arguments, check_figure, existing_files, finish_figure
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.ply import parse_ply
from nerg_mi.formats.splats import is_splat_file
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import Figure
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import COORDINATES, POSITIVE_VALUES, Range, check_ranges
from nerg_mi.transport.mitsuba_mesh import make_mesh

from .bake import Bake
from .mesh import Mesh

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

    @classmethod
    def from_bake(cls, baked: Bake) -> BakedSurface:
        """Return the surface of a bake in memory."""
        return cls(baked.mesh, baked.density, baked.content.unit, tuple(baked.content.provenance.inputs))


@check_ranges
def draw_surface(
    surface: FilePath | Bake,
    output: FilePath | None = None,
    *,
    camera: Annotated[Sequence[float], COORDINATES] | None = None,
    target: Annotated[Sequence[float], COORDINATES] | None = None,
    up: Annotated[Sequence[float], COORDINATES] | None = None,
    clip_above: Annotated[float, COORDINATES] | None = None,
    fov: Annotated[float, Range(1.0, 170.0)] = 50.0,
    width: Annotated[int, Range(16, 4096)] = 960,
    height: Annotated[int, Range(16, 4096)] = 640,
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    style: Style = Style(),
    progress: Progress = None,
) -> Figure:
    """Draw gaze on a mesh, with its colour scale. Positions are in the units of the mesh.

    Parameters
    ----------
    surface : path or Bake
        Mesh that nerg bake has written (.ply).
    output : path, optional
        Figure to write (.png, .svg or .pdf).
    camera : sequence of float, optional
        Position of the camera, x,y,z. Default: above the surface, with all of it in view.
    target : sequence of float, optional
        Point that the camera looks at, x,y,z. Default: the centre.
    up : sequence of float, optional
        Up direction, x,y,z. Default: 0,0,1.
    clip_above : float, optional
        Height along the up direction above which the mesh is not drawn, for instance to remove a ceiling. Default: no
        limit.
    fov : float
        Horizontal field of view in degrees.
    width : int
        Width of the image in pixels.
    height : int
        Height of the image in pixels.
    vmax : float, optional
        Upper end of the colour scale, in the unit of the values. Default: the 99.5th percentile.
    style : Style
        Colours (`nerg_mi.figures.settings.Style`); nothing is hatched.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    matplotlib.figure.Figure
        The figure, which a notebook shows.

    Raises
    ------
    NergError
        An argument is invalid, or the camera sees nothing.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> gaze = store / "shoppers.safetensors"
    >>> baked = nerg.bake(store / "twin.ply", gaze=gaze, observer=(4.4, 2.8, 1.6), max_edge=1.0)
    >>> len(nerg.draw_surface(baked, clip_above=2.4, width=48, height=32).axes)
    2
    """
    changed = changed_arguments(draw_surface, locals())
    check_figure(output)
    find_overlay("gaze").check_style(style)
    upward = _normalize(_to_point((0.0, 0.0, 1.0) if up is None else up, "up"), parameter("up"))
    activate_mitsuba()
    with open_reporter(progress) as reporter:
        baked = BakedSurface.from_bake(surface) if isinstance(surface, Bake) else read_baked(to_path(surface))
        mesh, name = baked.mesh, "the surface" if isinstance(surface, Bake) else f'"{surface}"'
        if clip_above is not None:
            below = (mesh.vertices[mesh.faces] @ upward).min(axis=1) < clip_above
            if not below.any():
                raise NergError(
                    f"no triangle of {name} is below {clip_above:g}; give a larger {parameter('clip_above')}"
                )
            mesh = Mesh(mesh.vertices, mesh.faces[below])
        view = _place_camera(mesh, upward, camera, target, fov, width, height)
        value, shade, hit = _trace_mesh(mesh, baked.values, upward, view)
        if not hit.any():
            raise NergError(
                f"no part of {name} is in the image; give another {parameter('camera')} or {parameter('target')}"
            )
        color = np.repeat(np.where(hit, _BARE + _LIT * shade, _PAPER)[..., None], 3, axis=2)
        heat = Heat(vmax or robust_max(value, hit), style.cmap or "inferno", decades=style.log_decades)
        # Pixels without a surface are not unknown: they are white and not hatched.
        figure = gaze_figure(
            color,
            value,
            hit,
            heat,
            style.title or baked.label.partition("[")[0].strip().capitalize(),
            baked.label,
            note=f"data: {', '.join(baked.gaze_files)}" if baked.gaze_files else "",
        )
        return finish_figure(figure, output, "nerg draw surface", existing_files(surface), None, changed, reporter)


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


def _trace_mesh(mesh: Mesh, values: np.ndarray, up: np.ndarray, view: _View) -> tuple[np.ndarray, ...]:
    """Return value, shading and whether there is a surface (h, w), for the centre of each pixel."""
    import mitsuba as mi

    w, h = view.width, view.height
    x, y = np.meshgrid((np.arange(w) + 0.5) / w * 2 - 1, (1 - (np.arange(h) + 0.5) / h * 2) * h / w)
    d = (view.ahead + view.half * (x[..., None] * view.across + y[..., None] * view.rise)).reshape(-1, 3)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    mesh_shape = make_mesh(mesh.vertices, mesh.faces, "surface")
    scene: mi.Scene = mi.load_dict({"type": "scene", "surface": mesh_shape})
    ray = mi.Ray3f(mi.Point3f(*view.eye.tolist()), to_vector(mi.Vector3f, d))
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


@dataclass(frozen=True, eq=False)
class _View:
    """A camera: position ``eye``, axes (right, up, forward), tangent of half the field of view, and image size."""

    eye: np.ndarray
    across: np.ndarray
    rise: np.ndarray
    ahead: np.ndarray
    half: float
    width: int
    height: int


def _place_camera(
    mesh: Mesh,
    up: np.ndarray,
    camera: Sequence[float] | None,
    target: Sequence[float] | None,
    fov: float,
    width: int,
    height: int,
) -> _View:
    """Return the camera, by default one with all of ``mesh`` in view. Raises `NergError` for a degenerate camera."""
    corners = mesh.vertices[np.unique(mesh.faces)]
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    aim = (lower + upper) / 2 if target is None else _to_point(target, "target")
    if camera is None:
        side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
        back = np.cross(side, up)
        offset = 0.9 * up - 0.8 * side / np.linalg.norm(side) + 0.4 * back / np.linalg.norm(back)
        eye = aim + offset
    else:
        eye = _to_point(camera, "camera")
    ahead = _normalize(aim - eye, f"the vector from {parameter('camera')} to {parameter('target')}")
    across = np.cross(ahead, up)
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(ahead, np.roll(up, 1))
    across /= np.linalg.norm(across)
    rise, half = np.cross(across, ahead), np.tan(np.radians(fov) / 2)
    if camera is None:
        x, y, z = ((corners - aim) @ np.stack([across, rise, ahead], axis=1)).T
        away = np.maximum(np.abs(x) / half, np.abs(y) / (half * height / width)) - z
        eye = aim - _FRAME * away.max() * ahead
    return _View(eye, across, rise, ahead, half, width, height)


def _to_point(values: Sequence[float], name: str) -> np.ndarray:
    """Return the three numbers of the parameter ``name`` (3,). Raises `NergError` for another count."""
    if len(values) != 3:
        raise NergError(f"{parameter(name)} must be three numbers x,y,z, got {','.join(f'{v:g}' for v in values)}")
    return np.array(values, float)


def _normalize(vector: np.ndarray, name: str) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise NergError(f"{name} must not be of length 0")
    return vector / length
