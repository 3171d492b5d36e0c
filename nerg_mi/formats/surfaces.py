"""Export of a radiance field as meshes and points (PLY, glTF), and as Mitsuba grid volumes (``gridvolume``)."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, import_extra, parameter
from nerg_mi.fields.extraction import FieldSampler, Lattice, cell_opacity, find_crossings, surface_density
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.files.atomic import check_writable, write_bytes
from nerg_mi.files.html import Summary
from nerg_mi.maths.color import decode_srgb, encode_srgb

from .gltf import Attribute, encode_unlit_glb
from .ply import write_columns

# ---- Meshes by marching cubes, and point clouds ----


@dataclass(repr=False)
class Surface(Summary):
    """Surface of a radiance field.

    Attributes
    ----------
    vertices
        Positions (V, 3) in the units of the field.
    faces
        Vertex indices (F, 3), counter-clockwise from outside; None for points.
    normals
        Unit normals (V, 3).
    colors
        sRGB colours (V, 3) in 0..1.
    report
        Statistics of the extraction by name.
    """

    vertices: np.ndarray
    faces: np.ndarray | None
    normals: np.ndarray
    colors: np.ndarray
    report: dict
    up: str = "z"  # axis that points up, y or z

    def save(self, path: str | Path) -> None:
        """Write the surface (.ply, .glb). Raises `NergError` for another suffix, or if the file cannot be written."""
        check_writable(path := Path(path), ".ply", ".glb")
        if path.suffix.lower() == ".ply":
            write_ply(self, path)
        else:
            write_glb(self, path, self.up)

    @property
    def face_count(self) -> int:
        """Number of faces; 0 for points."""
        return 0 if self.faces is None else len(self.faces)


def extract_mesh(
    field: RadianceNetwork,
    resolution: int = 256,
    threshold: float | None = None,
    fill_cells: int = 1,
    min_piece_fraction: float = 0.001,
    keep_unseen: bool = False,
) -> Surface:
    """Extract the isosurface of the density as a mesh by marching cubes. Needs scikit-image.

    Parameters
    ----------
    field
        The radiance field.
    resolution
        Cells along the longest edge.
    threshold
        Density at the surface. Default: ``surface_density``.
    fill_cells
        Holes and cracks of up to twice this number of cells are closed first.
    min_piece_fraction
        Connected pieces with less than this fraction of the area of the largest piece are removed.
    keep_unseen
        Keep faces at the border of the occupancy grid inside of dense matter: backs of walls and interiors of objects,
        which no image shows.
    """
    measure = import_extra("skimage.measure", "a mesh needs scikit-image", "mesh")
    import trimesh

    sampler, lattice = FieldSampler(field), Lattice.for_field(field, resolution)
    threshold = surface_density(lattice) if threshold is None else threshold
    density = sampler.density_on(lattice)
    level = float(cell_opacity(np.array(threshold), lattice))
    volume, filled = _close_holes(cell_opacity(density, lattice), level, fill_cells)
    if not volume.min() < level < volume.max():
        raise NergError(
            f"the density does not cross {threshold:g} per unit (its range is {density.min():g} .. "
            f"{density.max():g} on {lattice.shape} points): choose another {parameter('density_threshold')}"
        )
    index, faces, _, _ = measure.marching_cubes(volume.transpose(2, 1, 0), level, allow_degenerate=False)
    index, is_hidden = find_crossings(sampler, lattice, index.astype(np.float64), threshold)
    vertices, total = lattice.points(index), len(faces)
    if not keep_unseen:
        faces = faces[is_hidden[faces].sum(1) < 2]
        if len(faces) == 0:
            raise NergError(
                "no face of this surface has free space in front of it: the occupancy grid ends inside of the "
                f"surface everywhere; keep all faces with {parameter('keep_unseen', True)}"
            )
    num_visible = len(faces)
    body = trimesh.Trimesh(
        vertices, faces[:, ::-1] if _is_inside_out(vertices, faces, sampler) else faces, process=False
    )
    body, pieces, num_kept = _remove_floaters(body, min_piece_fraction)
    normals = np.array(body.vertex_normals)
    edges, open_edges = _count_open_edges(body, lattice)
    report = {
        "threshold": threshold,
        "cell": lattice.step,
        "lattice": lattice.shape,
        "cells_filled": int(filled),
        "pieces": int(pieces),
        "pieces_kept": int(num_kept),
        "floater_faces": num_visible - len(body.faces),
        "unseen_faces": total - num_visible,
        "edges_at_the_box": edges,
        "edges_of_holes": open_edges,
    }
    return Surface(
        np.array(body.vertices),
        np.array(body.faces),
        normals,
        _sample_srgb(field, sampler, body.vertices, normals),
        report,
    )


def _close_holes(volume: np.ndarray, level: float, cells: int) -> tuple[np.ndarray, int]:
    """Close holes of up to ``2 cells`` in opacities. Returns the opacities, otherwise unchanged, and the number
    of filled cells.
    """
    if cells < 1:
        return volume, 0
    from scipy.ndimage import grey_closing

    closed = grey_closing(volume, 2 * cells + 1, mode="nearest")
    holes = (volume < level) & (closed >= level)
    return np.where(holes, closed, volume), int(np.count_nonzero(holes))


def _is_inside_out(vertices, faces, sampler: FieldSampler) -> bool:
    """Return whether normals point towards higher density, by the majority of sampled faces."""
    sampled_faces = faces[:: max(len(faces) // 2000, 1)]
    a, b, c = (vertices[sampled_faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n *= np.sqrt(np.maximum(length, 1e-30)) / np.maximum(length, 1e-30)
    middle = (a + b + c) / 3
    return float(np.mean(np.sign(sampler.density(middle + n) - sampler.density(middle - n)))) > 0


def _remove_floaters(body, keep: float):
    """Remove small connected pieces of the mesh. Returns ``(mesh, number of pieces, number of remaining pieces)``."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = body.faces[:, [0, 1]], body.faces[:, [1, 2]]
    pairs = np.concatenate(edges)
    count = len(body.vertices)
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (count, count))
    _, label = connected_components(graph, directed=False)
    piece = label[body.faces[:, 0]]
    areas = np.bincount(piece, body.area_faces)
    good = areas >= keep * areas.max()
    body.update_faces(good[piece])
    body.remove_unreferenced_vertices()
    return body, np.count_nonzero(np.bincount(piece)), np.count_nonzero(good)


def _count_open_edges(body, lattice: Lattice) -> tuple[int, int]:
    """Count the edges with only one face: at the border of the box, and elsewhere."""
    edges = np.sort(body.edges, axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    single = unique[counts == 1]
    middle = body.vertices[single].mean(1)
    first, last = lattice.points(np.zeros(3)), lattice.points(np.array(lattice.shape) - 1)
    near = np.any((middle < first + 0.01 * lattice.step) | (middle > last - 0.01 * lattice.step), axis=1)
    return int(near.sum()), int((~near).sum())


def extract_points(
    field: RadianceNetwork,
    resolution: int = 256,
    threshold: float | None = None,
    count: int | None = None,
    seed: int = 0,
) -> Surface:
    """Extract points where lattice edges cross the isosurface, with normals along the negative density gradient.

    Parameters
    ----------
    field
        The radiance field.
    resolution
        Cells along the longest edge.
    threshold
        Density at the surface. Default: ``surface_density``.
    count
        Maximum number of points, which are drawn at random.
    seed
        Seed of the random selection.
    """
    sampler, lattice = FieldSampler(field), Lattice.for_field(field, resolution)
    threshold = surface_density(lattice) if threshold is None else threshold
    dense = sampler.density_on(lattice).transpose(2, 1, 0) >= threshold
    index = []
    for axis in range(3):
        low, high = (np.moveaxis(dense, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        edge_index = np.argwhere(np.moveaxis(low != high, 0, axis)).astype(np.float64)
        edge_index[:, axis] += 0.5
        index.append(edge_index)
    index = np.concatenate(index)
    if len(index) == 0:
        raise NergError(
            f"the density does not cross {threshold:g} per unit on {lattice.shape} points: choose another "
            f"{parameter('density_threshold')}"
        )
    if count is not None and count < len(index):
        index = index[np.sort(np.random.default_rng(seed).choice(len(index), count, replace=False))]
    index, hidden = find_crossings(sampler, lattice, index, threshold)
    p = lattice.points(index[~hidden])
    h = 0.5 * lattice.step
    slope = np.stack(
        [
            cell_opacity(sampler.density(p - h * e), lattice) - cell_opacity(sampler.density(p + h * e), lattice)
            for e in np.eye(3)
        ],
        1,
    )
    normals = slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    report = {"threshold": threshold, "cell": lattice.step, "lattice": lattice.shape}
    return Surface(p, None, normals, _sample_srgb(field, sampler, p, normals), report)


def _sample_srgb(field: RadianceNetwork, sampler: FieldSampler, p, normals) -> np.ndarray:
    c = np.clip(sampler.diffuse_color(np.asarray(p), np.asarray(normals)), 0, 1)
    return encode_srgb(c) if field.color_space == "linear" else c


# ---- Files ----


def write_ply(surface: Surface, path: str | Path) -> None:
    """Write a binary PLY file: positions, normals, 8-bit sRGB colours, and faces, if any."""
    places = np.hstack([surface.vertices, surface.normals]).T
    colors = np.rint(surface.colors * 255).astype(np.uint8).T
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    columns: dict[str, np.ndarray] = dict(zip(names, [*places, *colors]))
    write_columns(path, columns, surface.faces)


def write_glb(surface: Surface, path: str | Path, up: str = "z") -> None:
    """Write a binary glTF 2.0 file with linear 16-bit vertex colours.

    The material is unlit, because the colours of a field include its lighting. ``up``: axis of the field that points
    up. The up axis of glTF is y; for z, the node is rotated.
    """
    linear = decode_srgb(surface.colors)
    rgba = np.full((len(linear), 4), 65535, "<u2")
    rgba[:, :3] = np.rint(linear * 65535)
    attributes: list[Attribute] = [
        ("POSITION", surface.vertices.astype("<f4"), False),
        ("NORMAL", surface.normals.astype("<f4"), False),
        ("COLOR_0", rgba, True),
    ]
    write_bytes(path, *encode_unlit_glb(attributes, surface.faces, up))


# ---- Mitsuba grid volumes (``gridvolume``): density and colour in voxels ----

# Maximum optical depth of a voxel, and the minimum opacity of a voxel with a colour.
_MAX_OPTICAL_DEPTH, _MIN_OPACITY = 5.0, 1e-3
# Voxels per chunk of the colour evaluation.
_BLOCK = 1 << 18


def write_volume(path: str | Path, data: np.ndarray, lower, upper) -> None:
    """Write Mitsuba's .vol format, version 3.

    A ``gridvolume`` with ``use_grid_bbox`` set to true reads the file and fills the box.

    Parameters
    ----------
    path
        The file.
    data
        Values (z, y, x) or (z, y, x, channels), stored as float32.
    lower, upper
        Corners of the box.
    """
    data = np.asarray(data, "<f4")
    data = data[..., None] if data.ndim == 3 else data
    nz, ny, nx, channels = data.shape
    head = struct.pack("<3sBiiiii6f", b"VOL", 3, 1, nx, ny, nz, channels, *map(float, lower), *map(float, upper))
    write_bytes(path, head, np.ascontiguousarray(data).data)


def sample_density_and_color(field: RadianceNetwork, resolution: int = 256, color: bool = True, samples: int = 2):
    """Sample density and colour on a grid of voxels.

    The density gives a voxel the mean opacity of its ``samples``³ points, with an optical depth of at most 5 per voxel,
    since interpolation would otherwise widen surfaces. Because a grid cannot depend on the direction, the colour is
    that of the surface in front of or inside the voxel, averaged over views along the normal and at 45 degrees. Voxels
    around dense ones get the colour of their neighbour.

    Parameters
    ----------
    field
        The radiance field.
    resolution
        Voxels along the longest edge.
    color
        Whether to compute the colour.
    samples
        Samples per voxel and axis.

    Returns
    -------
    density
        Density (z, y, x) in 1/unit.
    color
        Linear colour (z, y, x, 3), or None.
    lower, upper
        Corners (3,) of the grid.
    """
    from scipy.ndimage import distance_transform_edt

    sampler, lattice = FieldSampler(field), Lattice.for_field(field, resolution)
    alpha = sampler.opacity_on(lattice, samples)
    density = -np.log(np.maximum(1 - alpha, math.exp(-_MAX_OPTICAL_DEPTH))) / lattice.step
    lower = np.array(lattice.lower)
    upper = lower + np.array(lattice.shape) * lattice.step
    if not color:
        return density, None, lower, upper
    out = np.zeros((*density.shape, 3), np.float32)
    filled = np.flatnonzero(alpha > _MIN_OPACITY)
    if len(filled) == 0:
        return density, out, lower, upper
    for start in range(0, len(filled), _BLOCK):
        at = np.stack(np.unravel_index(filled[start : start + _BLOCK], alpha.shape), 1)
        normals = -_compute_gradient(alpha, at)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        p = _move_to_surface(sampler, lattice, lattice.points(at[:, ::-1]), normals)
        # Where the density is constant there is no normal, and any direction is suitable.
        normals[np.linalg.norm(normals, axis=1) < 0.5] = [0, 0, 1]
        c = sampler.diffuse_color(p, normals)
        out[tuple(at.T)] = decode_srgb(c) if field.color_space == "srgb" else c
    del filled
    nearest: Any = distance_transform_edt(alpha <= _MIN_OPACITY, return_distances=False, return_indices=True)
    y, x = np.ogrid[: alpha.shape[1], : alpha.shape[2]]
    for z in range(len(out)):
        layer = out[z]
        squared = (nearest[0, z] - z) ** 2 + (nearest[1, z] - y) ** 2 + (nearest[2, z] - x) ** 2
        near = (squared > 0) & (squared < 2.5**2)
        layer[near] = out[tuple(nearest[:, z][:, near])]
    return density, out, lower, upper


def _compute_gradient(values: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """Compute central differences (N, 3), along x, y and z, of a grid (z, y, x) at ``voxels`` (N, 3); one-sided
    at the border.
    """
    slopes = []
    for axis in (2, 1, 0):
        before, after = voxels.copy(), voxels.copy()
        before[:, axis] = np.maximum(voxels[:, axis] - 1, 0)
        after[:, axis] = np.minimum(voxels[:, axis] + 1, values.shape[axis] - 1)
        slopes.append((values[tuple(after.T)] - values[tuple(before.T)]) / (after - before)[:, axis])
    return np.stack(slopes, 1)


def _move_to_surface(sampler: FieldSampler, lattice: Lattice, p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Move points along ``normals`` to the surface, out of or into the matter, if it is within two voxels."""
    threshold, max_distance = surface_density(lattice), 2 * lattice.step
    dense = sampler.density(p) >= threshold
    signed_distance = max_distance * np.where(dense, 1.0, -1.0)
    crosses = dense != (sampler.density(p + signed_distance[:, None] * normals) >= threshold)
    a, b = np.zeros(len(p)), signed_distance
    for _ in range(8):
        midpoint = 0.5 * (a + b)
        is_same_side = (sampler.density(p + midpoint[:, None] * normals) >= threshold) == dense
        a, b = np.where(is_same_side, midpoint, a), np.where(is_same_side, b, midpoint)
    # The end of the interval that is inside the matter.
    return p + (np.where(crosses, np.where(dense, a, b), 0))[:, None] * normals
