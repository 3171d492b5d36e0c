"""The attention that observers of a scene direct at boxes, meshes and shapes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.environment.arrays import Floats, as_points
from nerg_mi.environment.contents import from_trimesh, is_trimesh, load_content, load_mesh, load_mesh_child
from nerg_mi.environment.queries import SceneObserver, resolve_observers
from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.files.dataframes import make_dataframe
from nerg_mi.files.html import Summary
from nerg_mi.files.values import FilePath
from nerg_mi.formats.boxes import Region
from nerg_mi.formats.meshes import READERS, MeshFile
from nerg_mi.progress import SILENT, Progress, Reporter, open_reporter
from nerg_mi.ranges import MAX_COORDINATE, Range, check_number

from .placed import MARGIN, Aoi, BoxAoi, ShapeAoi, aoi_from_shape, scene_from_shapes
from .shares import Shares, SummationRule, gaze_shares

if TYPE_CHECKING:
    from nerg_mi.transport.geometry import SceneGeometry

# An attention share is the fraction of the gaze whose first surface is in a box, or is a mesh or shape, summed over
# directions (`nerg_mi.aoi.shares`): the size of triangles does not matter, and each direction meets one surface.
# Statistics, reports and the viewer use this definition. The distribution on a mesh is the integral over its patches
# (`nerg_mi.environment.surface_attention`), scaled to the share.


DEFAULT_SUM_RULE = SummationRule()
"""Default accuracy of attention shares."""

PATCH_SIZE_RATIO = 4
"""Ratio of an observer's distance from a surface and the size of the patches into which it is divided."""

MAX_AUTO_DIVISIONS = 32
"""Maximum number of automatic divisions per side of a triangle."""


@dataclass(frozen=True, eq=False, repr=False)
class Attention(Summary):
    """Attention that an object receives from M observers.

    Attributes
    ----------
    share : ndarray of shape (M,)
        Attention share: fraction of each observer's gaze whose first surface is in the box, or is the mesh or shape.
        The denominator includes gaze that hits no surface.
    observers : ndarray of shape (M, 3)
        Positions of the observers in scene units.
    error : ndarray of shape (M,)
        Estimate of the maximum error of the share.
    escaped : ndarray of shape (M,)
        Fraction of the gaze that hits no surface.
    """

    share: Floats
    observers: Floats
    error: Floats
    escaped: Floats

    @property
    def mean(self) -> float:
        """Mean attention share of the observers."""
        return float(np.mean(self.share, dtype=np.float64))

    def to_dataframe(self, library: str | None = None) -> Any:
        """Return a data frame with one row for each observer: its position, and the ``share``, ``error`` and
        ``escaped``. ``library`` is as in `nerg_mi.files.dataframes.make_dataframe`."""
        columns = dict(zip("xyz", np.asarray(self.observers).T))
        return make_dataframe({**columns, "share": self.share, "error": self.error, "escaped": self.escaped}, library)

    def __repr__(self) -> str:
        return f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers>"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SurfaceAttention(Attention):
    """Attention that a surface, divided into K flat patches, receives from M observers.

    Attributes
    ----------
    density : ndarray of shape (M, K)
        Attention share per area, in 1 / (scene unit)²; ``density @ area`` equals ``share``, except where no centre of a
        patch is visible.
    points, normals : ndarray of shape (K, 3)
        Centres of the patches in scene units, and their outward unit normals.
    area : ndarray of shape (K,)
        Areas of the patches in (scene unit)².
    """

    density: Floats
    points: Floats
    normals: Floats
    area: Floats

    def __repr__(self) -> str:
        return (
            f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers "
            f"on {float(self.area.sum()):.4g} square units in {len(self.area):,} patches>"
        )


def attention(
    scene: Scene | FilePath,
    surface: ArrayLike | os.PathLike[str] | str | Mapping[str, Any] | object,
    observers: ArrayLike | None = None,
    *,
    margin: float = MARGIN,
    tolerance: float = DEFAULT_SUM_RULE.rtol,
    divisions: int | None = None,
    two_sided: bool = False,
    progress: Progress = None,
) -> Attention:
    """Compute which fraction of their gaze observers direct at an object.

    Parameters
    ----------
    scene : Scene or path
        The scene, or a scene file; it needs a gaze field.
    surface : array_like of shape (2, 3), str, path, mapping or mi.Mesh
        A box, as its lower and upper corner in scene units; the id of a mesh of the scene; a mesh file (.ply, .obj,
        .glb); a dict for ``mi.load_dict``; or a Mitsuba mesh.
    observers : array_like of shape (M, 3) or (3,), optional
        Positions of the observers in scene units. Default: the observer of the scene.
    margin : float
        Boxes only: a surface counts if it is at most this far outside the box along the ray, in scene units.
    tolerance : float
        Directions are added until the error of the share is below this fraction of it, or below 1e-5, or until 16
        million directions are used (a million for areas all around the observer).
    divisions : int, optional
        Meshes only: number of parts per side into which each triangle is divided for the distribution on the surface.
        The share does not depend on it. Default: patches of at most a quarter of the distance to the nearest observer,
        at most 32 parts.
    two_sided : bool
        Meshes only: count both sides of an open surface. Otherwise only the side with counterclockwise vertices counts.
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.

    Returns
    -------
    Attention
        For a mesh, a `SurfaceAttention`, which contains the distribution on the surface.

    Raises
    ------
    NergError
        An argument is invalid, or the scene has no gaze field or observer.

    Notes
    -----
    A box contains the gaze that ends on any surface inside it: a larger box never has a smaller share, and a box in
    empty space has none. With ``margin=0``, the shares of boxes that fill space without overlap, and whose faces do not
    coincide with surfaces, sum to 1 together with ``escaped``.

    The shares of all meshes of a closed room sum to 1 (with ``two_sided=True`` if faces are seen from behind).

    A mesh that is not part of the scene is treated as if it were there: the scene occludes it, and it occludes only
    itself. The fall-off of the scene is ignored: an occluded point receives no attention.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors", falloff=0.05)
    >>> shelf = [(3.79, 5.4, 0.0), (5.31, 6.0, 1.9)]
    >>> result = nerg.attention(scene, shelf, observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)])
    >>> result.share.shape, bool((result.share > 0).all() and (result.error < 0.1 * result.share).all())
    ((2,), True)
    """
    import drjit as dr

    from nerg_mi.environment.surface_attention import make_patches

    scene = Scene.coerce(scene)
    _check_has_gaze(scene)
    check_number(margin, Range(0, MAX_COORDINATE), "margin")
    check_number(tolerance, Range(1e-9, 1), "tolerance")
    rule = SummationRule(rtol=float(tolerance))
    if (region := _as_box(surface)) is not None:
        if divisions is not None or two_sided:
            raise NergError("divisions and two_sided apply to meshes only, but the surface is a box; omit them")
        with open_reporter(progress) as reporter:
            positions = resolve_observers(scene, observers, reporter)
            shares = compute_box_shares(scene, [region], positions, margin=float(margin), rule=rule, reporter=reporter)
        return Attention(**_first_shares(shares), observers=positions)
    is_integer = isinstance(divisions, (int, np.integer)) and not isinstance(divisions, bool)
    if not (divisions is None or (is_integer and 1 <= divisions <= 4096)):
        raise NergError(f"divisions must be an integer from 1 to 4,096, got {divisions!r}")
    densities = []
    with open_reporter(progress) as reporter, translate_mitsuba_errors(), dr.suspend_grad():
        positions = resolve_observers(scene, observers, reporter)
        mesh = _as_mesh(scene, surface)
        pieces = make_patches(mesh, _choose_divisions(mesh, positions) if divisions is None else int(divisions))
        arrays_of_patches = pieces.area, pieces.p, pieces.n
        area, centers, normals = (np.ascontiguousarray(np.array(v, np.float32).T) for v in arrays_of_patches)
        geometry = scene.geometry if _is_part(scene, mesh) else _add_mesh(scene, mesh)
        for number, position in enumerate(positions):
            densities.append(_compute_density(scene, geometry, position, pieces, two_sided))
            reporter.progress((number + 1) / len(positions), f"observer {number + 1} of {len(positions)}")
        density = np.stack(densities)
        sums = density.astype(np.float64) @ area.astype(np.float64)
        if not np.isfinite(sums).all():
            raise NergError("the attention on this mesh is not finite; check the scale of mesh and observers")
        aoi = _make_mesh_aoi(scene, mesh, two_sided)
        shares = _first_shares(compute_shares(scene, [aoi], positions, margin=0.0, rule=rule, geometry=geometry))
        if not two_sided and all((((eye - centers) * normals).sum(axis=1) <= 0).all() for eye in positions):
            reporter.warn(
                "the attention is 0, since the observers are behind all faces of the mesh (in front, vertices are "
                "counterclockwise); add two_sided=True to count both sides, as of a room seen from inside"
            )
    density *= np.divide(shares["share"], sums, out=np.zeros(len(sums)), where=sums > 0)[:, None].astype(np.float32)
    return SurfaceAttention(**shares, observers=positions, density=density, points=centers, normals=normals, area=area)


def _first_shares(shares: Shares) -> dict[str, Floats]:
    """Return share, error and escaped gaze (M,) of the first area."""
    columns = {"share": shares.share[:, 0], "error": shares.error[:, 0], "escaped": shares.escaped}
    return {name: np.ascontiguousarray(values, np.float32) for name, values in columns.items()}


def compute_shares(
    scene: Scene,
    aois: Sequence[Aoi],
    observers: Floats,
    *,
    margin: float = MARGIN,
    rule: SummationRule = DEFAULT_SUM_RULE,
    reporter: Reporter = SILENT,
    geometry: SceneGeometry | None = None,
) -> Shares:
    """Compute the attention shares of N areas for M observers: the function behind `attention` and the viewer.

    Parameters
    ----------
    scene : Scene
        The scene, with a gaze field.
    aois : sequence of Aoi
        The areas.
    observers : ndarray of shape (M, 3)
        Positions in scene units.
    margin, reporter
        As for `attention`.
    rule : SummationRule
        Accuracy of the sum over directions.
    geometry : SceneGeometry, optional
        What rays hit. Default: that of the scene.

    Returns
    -------
    Shares
        Shares of shape (M, N).
    """
    from nerg_mi.transport.observer_gaze import make_gaze_evaluator

    _check_has_gaze(scene)
    i, environment, count = scene.integrator, geometry or scene.geometry, len(observers)
    on_progress = lambda done: reporter.progress(done / count, f"observer {done} of {count}")
    with translate_mitsuba_errors():
        return gaze_shares(
            lambda eye: make_gaze_evaluator(i.gaze, environment, i.observer_settings, eye),
            observers,
            aois,
            [(k,) for k in range(len(aois))],
            margin,
            rule,
            on_progress,
        )


def compute_box_shares(scene: Scene, regions: Sequence[Region], observers: Floats, **options: Any) -> Shares:
    """Compute the attention shares of N boxes, which may be rotated; ``options`` are those of `compute_shares`."""
    return compute_shares(scene, [BoxAoi(region) for region in regions], observers, **options)


def make_shape_aois(scene: Scene, names: Sequence[str]) -> list[Aoi]:
    """Return the meshes of the scene with these ids as areas, which are hit from both sides."""
    _check_has_gaze(scene)
    with translate_mitsuba_errors():
        return [_make_mesh_aoi(scene, _as_mesh(scene, name), two_sided=True) for name in names]


def _make_mesh_aoi(scene: Scene, mesh: Any, two_sided: bool) -> ShapeAoi:
    """Return ``mesh`` as an area, with the tolerance of `transport.occlusion`."""
    from nerg_mi.transport.occlusion import shape_tolerance

    part_of = scene.mitsuba if _is_part(scene, mesh) else None
    tolerance = shape_tolerance(scene.geometry, scene.integrator.observer_settings, mesh)
    return aoi_from_shape(mesh.id(), mesh, part_of, two_sided=two_sided, tolerance=tolerance)


def _is_part(scene: Scene, mesh: Any) -> bool:
    return any(shape is mesh for shape in scene.mitsuba.shapes())


def _add_mesh(scene: Scene, mesh: Any) -> SceneGeometry:
    """Return the geometry of the scene with ``mesh``."""
    from nerg_mi.transport.geometry import SceneGeometry

    shapes = {str(k): shape for k, shape in enumerate([*scene.mitsuba.shapes(), mesh])}
    return SceneGeometry(scene.geometry.medium, scene_from_shapes(shapes))


def _check_has_gaze(scene: Scene) -> None:
    activate_mitsuba()
    if not scene.has_gaze:
        raise NergError("attention needs a scene with a gaze field; pass gaze= to make_scene")


def _compute_density(scene: Scene, geometry: SceneGeometry, position: Floats, pieces: Any, two_sided: bool) -> Floats:
    """Compute the attention per area (K,) of ``pieces`` for the observer at ``position`` (3,), up to a factor."""
    from nerg_mi.environment.surface_attention import attention_per_area

    observer = SceneObserver(scene, position, geometry)
    settings = observer.integrator.observer_settings
    density = attention_per_area(
        geometry, observer.eval_gaze, observer.center, pieces.p, pieces.n, 0.0, settings, two_sided
    )
    return np.array(density, np.float32)


def _choose_divisions(mesh: Any, positions: Floats) -> int:
    """Choose a power of two, so that meshes of different sizes share kernels."""
    from nerg_mi.transport.mitsuba_mesh import is_mesh, read_triangles

    if not is_mesh(mesh):
        return 1  # an error is raised later
    vertices, faces = read_triangles(mesh)
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    distances = np.maximum(np.maximum(corners.min((0, 1)) - positions, positions - corners.max((0, 1))), 0)
    nearest = np.linalg.norm(distances, axis=1).min()
    divisions = PATCH_SIZE_RATIO * longest / nearest if nearest > 0 else np.inf
    return int(2 ** np.ceil(np.log2(np.clip(divisions, 1, MAX_AUTO_DIVISIONS))))


def _as_box(surface: Any) -> Region | None:
    """Return ``surface`` as a box; None if it is a mesh."""
    import mitsuba as mi

    if isinstance(surface, Region):
        return surface
    if isinstance(surface, (str, os.PathLike, Mapping, mi.Object)) or is_trimesh(surface):
        return None
    corners = as_points(surface, "the corners of a box").astype(np.float64)
    if len(corners) != 2 or not np.all(corners[0] < corners[1]):
        raise NergError(f"a box must be a lower and an upper corner, got {corners.tolist()}")
    return Region.create("box", *corners)


def _as_mesh(scene: Scene, surface: Any) -> Any:
    """Return ``surface`` as a Mitsuba mesh."""
    if isinstance(surface, str) and Path(surface).suffix.lower() not in READERS:
        by_id = {shape.id(): shape for shape in scene.mitsuba.shapes()}
        if surface not in by_id:
            available = f"its shapes are {', '.join(by_id)}" if by_id else "it has no shapes"
            raise NergError(f'the scene has no shape "{surface}"; {available}')
        return by_id[surface]
    if isinstance(surface, (str, os.PathLike)):
        surface = load_mesh_child(surface)
    elif is_trimesh(surface):
        meshes = from_trimesh(surface, "surface")
        if len(meshes) > 1:
            raise NergError(f"the surface is a trimesh.Scene of {len(meshes)} meshes; pass one of them")
        surface = next(iter(meshes.values()))
    if isinstance(surface, MeshFile):
        surface = load_mesh(surface, "surface")
    return load_content(surface) if isinstance(surface, Mapping) else surface
