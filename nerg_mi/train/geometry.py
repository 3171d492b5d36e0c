"""Surfaces that gaze is tied to: of scenes, of meshes, and those made of hit points alone."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, translate_mitsuba_errors
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.meshes import READERS as MESHES
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import READERS, is_splat_file, read_splats, refuse_unsupported_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import AnyBox, Box, Similarity, intersect_box_numpy
from nerg_mi.ranges import LENGTHS, check_number
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.files import check_vol
from nerg_mi.rendering.scene import load_scene
from nerg_mi.surfaces.mesh import mitsuba_mesh
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium
from nerg_mi.transport.volume_medium import VolumeMedium

# ---- Hit extent ----
#
# How far a place made of hit points reaches, and how fine it is, so that its voxels stay within a stated number.
#
# Rays that leave through windows end tens of metres behind the room in which people are. A box around all of them would
# spend nearly every voxel on air. So the box gives up hit points where that saves most voxels for each of them; those
# beyond it are drawn where their rays leave it (its shell), in their true directions at too short a distance.

DEFAULT_VOXEL = 0.08  # Edge of a voxel in metres where none is asked for and the place is not too large for it

MAX_VOXELS = 1 << 24  # Voxels of a place: a file of 64 MiB, 8,600 cubic metres in voxels of the default edge

PADDING_VOXELS = 6  # Voxels around the points that a box holds

# Share of the hit points at either end of an axis that the box need not hold: a glance through a gap ends tens of
# metres behind the place. The same of the origins, where a box must be cut: a tracker that loses somebody puts them
# anywhere.
_OUTLIERS = 0.005
_KEPT = 0.75  # Share of the hit points that a box keeps at least, before voxels of a default edge become larger instead
_MARGIN = 1.0  # Metres around where people were that a box keeps at least: what is looked at most is near
_SAMPLE, _STEPS = 1 << 15, 512
# A box that is cut goes on being cut while one step, a 512th of the points, saves this share of the most voxels that
# may be.
_WORTH = 0.01


@dataclass(frozen=True)
class HitExtent:
    """Voxels of a place of hit points, in the rays' frame."""

    lower: np.ndarray  # Lower corner (3,) of the box in metres
    shape: tuple[int, int, int]  # Voxels along x, y and z
    voxel: float  # Their edge in metres
    is_cut: bool = False  # Whether hit points beyond the box stand on its shell
    outside_fraction: float = 0.0  # Their share of the hit points

    @property
    def upper(self) -> np.ndarray:
        """Upper corner (3,) of the box in metres."""
        return self.lower + np.array(self.shape) * self.voxel

    @property
    def shell(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box on which hit points beyond stand: inside of the padding."""
        return self.lower + PADDING_VOXELS * self.voxel, self.upper - PADDING_VOXELS * self.voxel

    def is_outside_shell(self, hits: np.ndarray) -> np.ndarray:
        """Which of ``hits`` (N, 3) stand on the shell, (N,) bool; none of a place that was not cut."""
        if not self.is_cut:
            return np.zeros(len(hits), bool)
        # A wall along which the box was cut is no more than half a voxel beyond it.
        low, high = self.shell[0] - 0.5 * self.voxel, self.shell[1] + 0.5 * self.voxel
        return np.logical_not(((hits >= low) & (hits <= high)).all(axis=1))


def compute_hit_extent(rays: Rays, voxel: float | None = None, max_voxels: int = MAX_VOXELS) -> HitExtent:
    """The box of a place of at most ``most`` voxels made from the hit points of ``rays``.

    It holds all origins and the hits but for half a percent at each end of each axis. Where these are too many voxels
    it is cut to where most of them are worth their room, at the least to where people were (all but half a percent at
    each end of each axis) and a metre around. Where that is not enough, or less than three quarters of the hit points
    would be left, voxels become larger; not so a ``voxel`` that was asked for.

    Raises `NergError` for rays without hit points and for a ``voxel`` that is too small or not positive.
    """
    if rays.hit is None or not (known := np.isfinite(rays.hit).all(axis=1)).any():
        raise NergError("these rays have no hit points to make a place from; give a radiance field instead (--field)")
    if voxel is not None:
        check_number(voxel, LENGTHS, "--voxel")
    hits = rays.hit[known]
    first, last = np.quantile(hits, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    low, high = np.minimum(first, rays.origin.min(axis=0)), np.maximum(last, rays.origin.max(axis=0))
    edge = DEFAULT_VOXEL if voxel is None else voxel
    if np.prod(_count(low, high, edge)) <= max_voxels:
        return _padded(low, high, edge)
    core = np.quantile(rays.origin, [_OUTLIERS, 1 - _OUTLIERS], axis=0) + [[-_MARGIN], [_MARGIN]]
    core = np.clip(core, low, high)
    rng = np.random.default_rng(0)
    pick = lambda points: points[rng.permutation(len(points))[:_SAMPLE]]
    points, sample = np.concatenate([pick(hits), pick(rays.origin)]), pick(hits)
    while True:
        box = _cut(low, high, core, points, edge, max_voxels)
        kept = 0.0 if box is None else ((sample >= box[0]) & (sample <= box[1])).all(axis=1).mean()
        if box is not None and (voxel is not None or kept >= _KEPT):
            extent = replace(_padded(*box, edge), is_cut=True)
            return replace(extent, outside_fraction=float(extent.is_outside_shell(hits).mean()))
        if voxel is not None:
            size = " x ".join(f"{s:.3g}" for s in core[1] - core[0])
            raise NergError(
                f"people were in {size} m, which is more than {max_voxels:,} voxels of {voxel:g} m; "
                "enlarge the voxel (--voxel) or leave it out"
            )
        edge *= 2 ** (1 / 3)  # Half as many voxels


def _count(low: np.ndarray, high: np.ndarray, voxel: float) -> np.ndarray:
    """Voxels along each axis of the box around ``low`` and ``high``, as floats: they may be too many for integers."""
    return np.ceil((high - (low - PADDING_VOXELS * voxel)) / voxel) + PADDING_VOXELS


def _padded(low: np.ndarray, high: np.ndarray, voxel: float) -> HitExtent:
    """The extent of the box around ``low`` and ``high``."""
    return HitExtent(low - PADDING_VOXELS * voxel, tuple(_count(low, high, voxel).astype(int).tolist()), voxel)


def _cut(
    low: np.ndarray, high: np.ndarray, core: np.ndarray, points: np.ndarray, voxel: float, most: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Corners of a box of at most ``most`` voxels, from ``low`` to ``high`` cut face by face down to ``core`` (2, 3) at
    the least: each time where giving up a 512th of ``points`` (N, 3) saves most. None where ``core`` is too large."""
    box = np.stack([low, high])
    step = max(1, len(points) // _STEPS)
    while True:
        points = points[((points >= box[0]) & (points <= box[1])).all(axis=1)]
        count = np.prod(_count(box[0], box[1], voxel))
        best, cut = 0.0, None
        for axis in range(3):
            along = np.sort(points[:, axis])
            for side in (0, 1):
                # As far as the next points reach, or as far as it may be cut if there are none.
                to = core[side, axis]
                if len(along) > step:
                    to = min(to, along[step]) if side == 0 else max(to, along[-1 - step])
                worth = abs(to - box[side, axis]) / (box[1, axis] - box[0, axis])
                if worth > best:
                    best, cut = worth, (side, axis, to)
        if count <= most and best * count < _WORTH * most:
            break
        if cut is None:
            return None
        box[cut[0], cut[1]] = cut[2]
    return box[0], box[1]


# ---- Hit geometry ----
#
# A place made from what people looked at, where there are no photos: the rays' hit points as a volume.
#
# Eye trackers in virtual reality record where each ray met the scene. Enough of these points outline what matters: the
# surfaces that are looked at. They become voxels, small holes are closed, and the result is a Mitsuba grid volume that
# depths are traced in and that the integrator ``nerg`` renders as its ``density``.

_TAU = 8.0  # Optical depth of a voxel: one is opaque
_CLOSING = 4  # Rounds of closing, each of which closes gaps of two voxels
_WALKED = 1 << 17  # Rays that are walked along to find empty space


def voxelise_hits(rays: Rays, voxel: float | None = None, extent: HitExtent | None = None) -> tuple[np.ndarray, Box]:
    """Density (z, y, x) in 1/metre, float32, and the box that it fills, both in the rays' frame.

    A voxel is solid where a ray ended. Gaps of up to eight voxels are closed (morphological closing), but not where a
    ray passed on its way to its hit; then voxels through which people put their heads, and their neighbours, are
    emptied. The box is ``extent``, by default the `hit_extent` of ``rays`` with voxels of edge ``voxel`` metres. Hits
    outside of it are left out; where it was cut, they stand where rays leave its shell. Raises as `hit_extent` does.
    """
    from scipy.ndimage import binary_closing, binary_dilation

    extent = extent or compute_hit_extent(rays, voxel)
    if rays.hit is None:
        raise NergError("these rays have no hit points to make a place from; give a radiance field instead (--field)")
    known = np.isfinite(rays.hit).all(axis=1)
    hits, origins = rays.hit[known], rays.origin[known]
    if extent.is_cut:
        far = extent.is_outside_shell(hits)
        hits[far] = _on_shell(origins[far], hits[far], extent)
        there = np.isfinite(hits).all(axis=1)
        hits, origins = hits[there], origins[there]
    hit, cube = _marked(extent, hits), np.ones((3, 3, 3), bool)
    solid = np.asarray(binary_closing(hit, cube, iterations=_CLOSING), bool)
    solid &= hit | ~_passed(origins, hits, extent)
    solid &= ~np.asarray(binary_dilation(_marked(extent, rays.origin), cube), bool)
    density = np.where(solid, np.float32(_TAU / extent.voxel), np.float32(0))
    return density, Box(tuple(extent.lower.tolist()), tuple(extent.upper.tolist()))


def _marked(extent: HitExtent, points: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Voxels (z, y, x) bool that hold one of ``points``, besides those that ``out`` has."""
    out = np.zeros(extent.shape[::-1], bool) if out is None else out
    inside = points[((points > extent.lower) & (points < extent.upper)).all(axis=1)]
    out[tuple(((inside - extent.lower) / extent.voxel).astype(int).T[::-1])] = True
    return out


def _on_shell(origins: np.ndarray, hits: np.ndarray, extent: HitExtent) -> np.ndarray:
    """Where rays to hits beyond the shell leave it, (N, 3); NaN for those that never are within it."""
    way = hits - origins
    enter, leave = intersect_box_numpy(origins, way, *extent.shell)
    passes = (leave > np.maximum(enter, 0)) & (leave <= 1)
    return np.where(passes[:, None], origins + way * np.where(passes, leave, 0)[:, None], np.nan)


def _passed(origins: np.ndarray, hits: np.ndarray, extent: HitExtent) -> np.ndarray:
    """Voxels that a ray crossed well before it ended."""
    which = np.random.default_rng(0).permutation(len(hits))[:_WALKED]
    origins, way = origins[which], hits[which] - origins[which]
    length = np.linalg.norm(way, axis=1)
    end = length - 2.5 * extent.voxel
    out = _marked(extent, origins[:0])
    if not len(length):
        return out
    # Nobody looks that far without a gap in the place; the few who seem to must not set the number of rounds.
    for t in np.arange(0, np.quantile(length, 0.99), 0.7 * extent.voxel):
        on = end > t
        _marked(extent, origins[on] + way[on] * (t / length[on, None]), out)
    return out


def make_volume_dict(path: str | Path) -> dict:
    """The Mitsuba plugin, as a dict, that shows what ``formats.surfaces.write_volume`` wrote of hit points.

    Without interpolation, which would bring every surface nearer by most of a voxel.
    """
    return {"type": "gridvolume", "filename": str(path), "use_grid_bbox": True, "filter_type": "nearest"}


# ---- Hit shading ----
#
# Colour for a place of hit points, of which nothing but the shape is known: greys by the way in which a surface faces,
# so that floors, walls and shelves can be told apart in a picture.


# Linear grey of surfaces that face along x, y and z, either way.
_GREY = np.array([0.34, 0.16, 0.55])
_CELL = 2
_SMOOTH = 1.2


def shade_hits(density: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour (z, y, x, 3), linear float32, in cells of 2 x 2 x 2 voxels of ``density`` (z, y, x), and the upper corner
    (3,) of the box that they fill, whose ``lower`` (3,) is the same; ``upper``: of the voxels'.

    A surface faces along the axis along which matter changes most, taken over some cells around it.
    """
    from scipy.ndimage import gaussian_filter

    shape = np.array(density.shape)
    pad = (-shape) % _CELL
    solid = np.pad(density > 0, [(0, p) for p in pad])
    cells = (shape + pad) // _CELL
    coarse = solid.reshape(cells[0], _CELL, cells[1], _CELL, cells[2], _CELL).mean(axis=(1, 3, 5), dtype=np.float32)
    # Nothing is beyond a place of one cell: it faces along that axis.
    thin = [(int(n == 1), int(n == 1)) for n in cells]
    padded = np.pad(coarse, thin)
    # Sheets have two sides, on which matter changes in opposite ways.
    slope = [gaussian_filter(np.abs(np.gradient(padded, axis=axis)), _SMOOTH) for axis in (2, 1, 0)]
    within = tuple(slice(before, before + n) for (before, _), n in zip(thin, cells))
    square = np.stack([s * s for s in slope], axis=-1)[within]
    total = square.sum(axis=-1)
    grey = np.divide(
        square @ _GREY.astype(np.float32), total, out=np.full_like(total, _GREY.mean()), where=total > 1e-9
    )
    edge = (np.asarray(upper) - lower) / shape[::-1]
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.float32), lower + cells[::-1] * _CELL * edge


# ---- Where people looked around: what a gaze field's depths are traced in, and the frame that it lives in ----

DEFAULT_DEPTH = 2.0  # How far away everything is taken to be where no geometry is known, in the field's units

_STRAY, _AROUND = 0.002, 0.02
"""Share of Gaussians that may lie beyond each side of the box of splats, and what is added around the others."""


@dataclass(frozen=True, eq=False)
class TrainingGeometry:
    """Where people looked around, and how their frame lies in it."""

    # What depths are traced in, in the field's frame (`transport.geometry.trace_depth`); None where nothing is known.
    medium: FieldMedium | VolumeMedium | SplatMedium | SceneGeometry | None
    box: AnyBox  # Where a gaze field lives, in that frame
    kind: str  # What it was made of: "field", "scene", "hits" or "none"
    metadata: dict = field(default_factory=dict)  # For the provenance (JSON): the file, and what it is
    align: Similarity = field(default_factory=Similarity)  # From the rays' frame, in metres, to the field's
    radiance: RadianceField | None = None  # The radiance field that the medium shows, where it is one
    # What its file holds that is not used, and what had to be guessed of it: a sentence each.
    notes: tuple[str, ...] = ()

    def points_to_field(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the rays' frame in the field's."""
        return points @ self.align.matrix[:3, :3].T + self.align.matrix[:3, 3]

    def directions_to_field(self, directions: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of the rays' frame in the field's."""
        return directions @ (self.align.matrix[:3, :3] / self.align.scale).T

    def directions_to_rays(self, directions: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of the field's frame in the rays'."""
        # The inverse of a rotation is its transpose.
        return directions @ (self.align.matrix[:3, :3] / self.align.scale)


def load_field_geometry(path: Path, ns: ModuleType) -> TrainingGeometry:
    """A trained radiance field, or Gaussian splats, read from ``path`` with arrays of the backend ``ns``."""
    if path.suffix.lower() in READERS:
        return _place_of_splats(path, ns)
    refuse_unsupported_splats(path)
    radiance, _ = load_radiance(path, ns)
    about = {"field_file": identify_file(path)}
    return TrainingGeometry(FieldMedium(radiance), radiance.box, "field", about, radiance=radiance)


def _place_of_splats(path: Path, ns: ModuleType) -> TrainingGeometry:
    splats = read_splats(path)
    # Of splats that photos have trained a few lie far outside of the place.
    lower, upper = np.quantile(splats.centers.astype(np.float64), (_STRAY, 1 - _STRAY), axis=0)
    pad = _AROUND * max(upper - lower) + float(splats.scales.max(axis=1).mean())
    box = Box(tuple(lower - pad), tuple(upper + pad))
    medium, about = SplatMedium(SplatArrays(splats, ns)), {"field_file": identify_file(path)}
    return TrainingGeometry(medium, box, "field", about, notes=(*splats.assumptions, *splats.notes))


def load_scene_geometry(path: Path) -> TrainingGeometry:
    """The shapes of a Mitsuba scene, and the field or volume of its integrator where that is a ``nerg``; or a mesh
    (.ply, .obj, .glb).

    Raises `NergError` for a scene with neither.
    """
    scene, notes = _scene_of_mesh(path) if path.suffix.lower() in MESHES else (load_scene(path), ())
    place = SceneGeometry(getattr(scene.integrator(), "medium", None), scene)
    bounds = place.bounds()
    if bounds is None:
        raise NergError(
            f'the scene "{path}" has neither shapes nor a field in which people could have looked around; '
            "name one that has"
        )
    lower, upper = bounds
    # A plane has no thickness, and a field needs some.
    pad = 0.01 * max(upper - lower)
    box, about = Box(tuple(lower - pad), tuple(upper + pad)), {"scene_file": identify_file(path)}
    return TrainingGeometry(place, box, "scene", about, notes=notes)


def _scene_of_mesh(path: Path) -> tuple[Any, tuple[str, ...]]:
    """A scene of the mesh in ``path``, and sentences on what of the file is not used."""
    import mitsuba as mi

    if path.suffix.lower() in READERS and is_splat_file(path):
        raise NergError(f'"{path}" holds Gaussian splats, which are a field: give it by --field')
    mesh = read_mesh_file(path)
    with translate_mitsuba_errors(path):
        return mi.load_dict({"type": "scene", "mesh": mitsuba_mesh(mesh.vertices, mesh.faces, "mesh")}), mesh.notes


def make_hit_geometry(rays: Rays, path: Path, voxel: float | None = None) -> TrainingGeometry:
    """A volume made of the rays' hit points, written to ``path`` (.vol); ``voxel``: edge of its voxels in metres, by
    default what `hit_extent` chooses."""
    extent = compute_hit_extent(rays, voxel)
    density, box = voxelise_hits(rays, extent=extent)
    write_volume(path, density, box.lower, box.upper)
    size = {
        "shape": list(extent.shape),
        "solid": round(float((density > 0).mean()), 4),
        "voxel": extent.voxel,
        "beyond": round(extent.outside_fraction, 4),
    }
    return load_volume_geometry(path, size)


def load_volume_geometry(path: Path, metadata: dict | None = None) -> TrainingGeometry:
    """A volume that ``place_of_hits`` has written. Raises `NergError` for one that is missing or damaged."""
    import mitsuba as mi

    if not path.exists():
        raise MissingFile(f'the place of hit points "{path}" does not exist; it is written beside the gaze field')
    check_vol(path)
    box = np.fromfile(path, "<f4", 6, offset=24)
    # Mitsuba makes some box of any six numbers.
    if not (np.isfinite(box).all() and (box[:3] < box[3:]).all()):
        raise NergError(f'the place of hit points "{path}" has no box with a lower and an upper corner; make it anew')
    with translate_mitsuba_errors(path):
        medium = VolumeMedium(mi.load_dict(make_volume_dict(path)))
    lower, upper = medium.bounds()
    return TrainingGeometry(
        medium,
        Box(tuple(lower.tolist()), tuple(upper.tolist())),
        "hits",
        {"geometry_file": {**identify_file(path), **(metadata or {})}},
    )


def no_geometry(origins: np.ndarray) -> TrainingGeometry:
    """No geometry: everything is ``NOWHERE`` away from whoever looks from one of ``origins`` (N, 3)."""
    lower, upper = origins.min(axis=0) - DEFAULT_DEPTH, origins.max(axis=0) + DEFAULT_DEPTH
    return TrainingGeometry(None, Box(tuple(lower.tolist()), tuple(upper.tolist())), "none", {"geometry": "none"})


def identify_file(path: Path) -> dict[str, str]:
    """Name and SHA-256 of a file, for the provenance (JSON)."""
    return {"file": path.name, "sha256": file_sha256(path)}
