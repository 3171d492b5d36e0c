"""A radiance field as surfaces and volumes: meshes and points (PLY, glTF), and Mitsuba grid volumes
(``gridvolume``)."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, import_extra
from nerg_mi.fields.extraction import Lattice, FieldSampler, find_crossings, cell_opacity, surface_density
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import write_bytes
from nerg_mi.maths.color import decode_srgb, encode_srgb

from .gltf import Attribute, encode_unlit_glb
from .ply import write_columns

# ---- Surfaces ----
#
# Surfaces of a radiance field as files: a mesh by marching cubes, a point cloud (PLY, glTF).


@dataclass
class Surface:
    """``vertices`` (V, 3) in the field's units, ``faces`` (F, 3) counter-clockwise from outside (None: points), unit
    ``normals`` (V, 3), ``colors`` (V, 3) sRGB in 0..1, and ``report``: what was done, by name."""

    vertices: np.ndarray
    faces: np.ndarray | None
    normals: np.ndarray
    colors: np.ndarray
    report: dict

    @property
    def face_count(self) -> int:
        """F, which is 0 of points."""
        return 0 if self.faces is None else len(self.faces)


def extract_mesh(
    field: RadianceField,
    resolution: int = 256,
    threshold: float | None = None,
    fill_cells: int = 1,
    min_piece_fraction: float = 0.001,
    keep_unseen: bool = False,
) -> Surface:
    """The surface where density crosses ``threshold`` (default: ``surface_density``), by marching cubes.

    ``fill``: holes and cracks of up to twice so many cells are closed first; ``keep``: connected pieces with less
    than this share of the area of the largest are dropped; ``unseen``: keep faces where the occupancy grid ends and the
    density does not (backs of walls, insides of things: nothing that a picture shows). Needs scikit-image.
    """
    measure = import_extra("skimage.measure", "a mesh needs scikit-image", "mesh")
    import trimesh

    sampler, lattice = FieldSampler(field), Lattice.for_field(field, resolution)
    threshold = surface_density(lattice) if threshold is None else threshold
    density = sampler.density_on(lattice)
    level = float(cell_opacity(np.array(threshold), lattice))
    volume, filled = _closed(cell_opacity(density, lattice), level, fill_cells)
    if not volume.min() < level < volume.max():
        raise NergError(
            f"density crosses {threshold:g} per unit nowhere (it lies in {density.min():g} .. {density.max():g} on "
            f"{lattice.shape} points): choose another --density"
        )
    index, faces, _, _ = measure.marching_cubes(volume.transpose(2, 1, 0), level, allow_degenerate=False)
    index, hidden = find_crossings(sampler, lattice, index.astype(np.float64), threshold)
    vertices, total = lattice.points(index), len(faces)
    if not keep_unseen:
        faces = faces[hidden[faces].sum(1) < 2]
        if len(faces) == 0:
            raise NergError(
                "no face of this surface has free space in front of it: the occupancy grid ends in it everywhere; "
                "keep all faces with --unseen"
            )
    left = len(faces)
    body = trimesh.Trimesh(vertices, faces[:, ::-1] if _inside_out(vertices, faces, sampler) else faces, process=False)
    body, pieces, kept = _without_floaters(body, min_piece_fraction)
    normals = np.array(body.vertex_normals)
    edges, open_edges = _open_edges(body, lattice)
    report = {
        "threshold": threshold,
        "cell": lattice.step,
        "lattice": lattice.shape,
        "cells_filled": int(filled),
        "pieces": int(pieces),
        "pieces_kept": int(kept),
        "floater_faces": left - len(body.faces),
        "unseen_faces": total - left,
        "edges_at_the_box": edges,
        "edges_of_holes": open_edges,
    }
    return Surface(
        np.array(body.vertices), np.array(body.faces), normals, _srgb(field, sampler, body.vertices, normals), report
    )


def _closed(volume: np.ndarray, level: float, cells: int) -> tuple[np.ndarray, int]:
    """Opacities with holes of up to ``2 cells`` closed, the rest unchanged, and the number of cells that were
    filled."""
    if cells < 1:
        return volume, 0
    from scipy.ndimage import grey_closing

    closed = grey_closing(volume, 2 * cells + 1, mode="nearest")
    holes = (volume < level) & (closed >= level)
    return np.where(holes, closed, volume), int(np.count_nonzero(holes))


def _inside_out(vertices, faces, sampler: FieldSampler) -> bool:
    """Whether normals point towards higher density, by the majority of some faces."""
    some = faces[:: max(len(faces) // 2000, 1)]
    a, b, c = (vertices[some[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n *= np.sqrt(np.maximum(length, 1e-30)) / np.maximum(length, 1e-30)
    middle = (a + b + c) / 3
    return float(np.mean(np.sign(sampler.density(middle + n) - sampler.density(middle - n)))) > 0


def _without_floaters(body, keep: float):
    """The mesh without small connected pieces: ``(mesh, number of pieces, number kept)``."""
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


def _open_edges(body, lattice: Lattice) -> tuple[int, int]:
    """Edges with one face only: where the box cuts the surface, and elsewhere."""
    edges = np.sort(body.edges, axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    single = unique[counts == 1]
    middle = body.vertices[single].mean(1)
    first, last = lattice.points(np.zeros(3)), lattice.points(np.array(lattice.shape) - 1)
    near = np.any((middle < first + 0.01 * lattice.step) | (middle > last - 0.01 * lattice.step), axis=1)
    return int(near.sum()), int((~near).sum())


def extract_points(
    field: RadianceField, resolution: int = 256, threshold: float | None = None, count: int | None = None, seed: int = 0
) -> Surface:
    """Points where the edges of a lattice cross the surface, with normals down the density's gradient; at most
    ``count``."""
    sampler, lattice = FieldSampler(field), Lattice.for_field(field, resolution)
    threshold = surface_density(lattice) if threshold is None else threshold
    dense = sampler.density_on(lattice).transpose(2, 1, 0) >= threshold
    index = []
    for axis in range(3):
        low, high = (np.moveaxis(dense, axis, 0)[part] for part in (slice(None, -1), slice(1, None)))
        found = np.argwhere(np.moveaxis(low != high, 0, axis)).astype(np.float64)
        found[:, axis] += 0.5
        index.append(found)
    index = np.concatenate(index)
    if len(index) == 0:
        raise NergError(
            f"density crosses {threshold:g} per unit nowhere on {lattice.shape} points: choose another --density"
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
    return Surface(p, None, normals, _srgb(field, sampler, p, normals), report)


def _srgb(field: RadianceField, sampler: FieldSampler, p, normals) -> np.ndarray:
    c = np.clip(sampler.diffuse_color(np.asarray(p), np.asarray(normals)), 0, 1)
    return encode_srgb(c) if field.color_space == "linear" else c


# ---- Files ----


def write_ply(surface: Surface, path: str | Path) -> None:
    """Binary PLY: positions, normals, 8-bit sRGB colours, and faces if there are any."""
    places = np.hstack([surface.vertices, surface.normals]).T
    colors = np.rint(surface.colors * 255).astype(np.uint8).T
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    columns: dict[str, np.ndarray] = dict(zip(names, [*places, *colors]))
    write_columns(path, columns, surface.faces)


def write_glb(surface: Surface, path: str | Path, up: str = "z") -> None:
    """Binary glTF 2.0 with linear 16-bit vertex colours that are shown unlit: a field's colours hold its light.

    ``up``: axis of the field that is up; glTF's is y, and the node is turned for z.
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


# ---- Volumes ----
#
# A radiance field as Mitsuba grid volumes (``gridvolume``): density and colour in voxels.


# Optical depth of a voxel at most, and the opacity from which on it has a colour.
_DEEPEST, _FAINT = 5.0, 1e-3
# Voxels whose colour is looked for at a time.
_BLOCK = 1 << 18


def write_volume(path: str | Path, data: np.ndarray, lower, upper) -> None:
    """Mitsuba's .vol format, version 3: ``data`` (z, y, x) or (z, y, x, channels) as float32, and the box it fills.

    A ``gridvolume`` with ``use_grid_bbox`` set to true reads it, and fills that box.
    """
    data = np.asarray(data, "<f4")
    data = data[..., None] if data.ndim == 3 else data
    nz, ny, nx, channels = data.shape
    head = struct.pack("<3sBiiiii6f", b"VOL", 3, 1, nx, ny, nz, channels, *map(float, lower), *map(float, upper))
    write_bytes(path, head, np.ascontiguousarray(data).data)


def sample_density_and_color(field: RadianceField, resolution: int = 256, color: bool = True, samples: int = 2):
    """``(density (z, y, x), colour (z, y, x, 3) or None, lower, upper)`` of voxels, ``resolution`` along the longest
    edge.

    Density, in 1/unit, is what gives a voxel the mean opacity of its ``samples``³ points, at most 5 mean free paths a
    voxel: interpolation would blow up surfaces further. Colour is linear and that of the surface in or before the
    voxel, seen head on and at 45 degrees, for a grid has no view; voxels about the dense ones have their neighbour's.
    """
    from scipy.ndimage import distance_transform_edt

    sampler, lattice = FieldSampler(field), Lattice.for_field(field, resolution)
    alpha = sampler.opacity_on(lattice, samples)
    density = -np.log(np.maximum(1 - alpha, math.exp(-_DEEPEST))) / lattice.step
    lower = np.array(lattice.lower)
    upper = lower + np.array(lattice.shape) * lattice.step
    if not color:
        return density, None, lower, upper
    out = np.zeros((*density.shape, 3), np.float32)
    filled = np.flatnonzero(alpha > _FAINT)
    if len(filled) == 0:
        return density, out, lower, upper
    for start in range(0, len(filled), _BLOCK):
        at = np.stack(np.unravel_index(filled[start : start + _BLOCK], alpha.shape), 1)
        normals = -_slope(alpha, at)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        p = _to_the_surface(sampler, lattice, lattice.points(at[:, ::-1]), normals)
        # Where density is even there is no normal, and any direction will do.
        normals[np.linalg.norm(normals, axis=1) < 0.5] = [0, 0, 1]
        c = sampler.diffuse_color(p, normals)
        out[tuple(at.T)] = decode_srgb(c) if field.color_space == "srgb" else c
    del filled
    nearest: Any = distance_transform_edt(alpha <= _FAINT, return_distances=False, return_indices=True)
    y, x = np.ogrid[: alpha.shape[1], : alpha.shape[2]]
    for z in range(len(out)):
        layer = out[z]
        squared = (nearest[0, z] - z) ** 2 + (nearest[1, z] - y) ** 2 + (nearest[2, z] - x) ** 2
        near = (squared > 0) & (squared < 2.5**2)
        layer[near] = out[tuple(nearest[:, z][:, near])]
    return density, out, lower, upper


def _slope(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Central differences (N, 3), along x, y and z, of a grid (z, y, x) at the voxels ``at`` (N, 3) of it; one-sided on
    its faces."""
    slopes = []
    for axis in (2, 1, 0):
        before, after = at.copy(), at.copy()
        before[:, axis] = np.maximum(at[:, axis] - 1, 0)
        after[:, axis] = np.minimum(at[:, axis] + 1, values.shape[axis] - 1)
        slopes.append((values[tuple(after.T)] - values[tuple(before.T)]) / (after - before)[:, axis])
    return np.stack(slopes, 1)


def _to_the_surface(sampler: FieldSampler, lattice: Lattice, p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Points moved out of (or into) the matter along ``normals`` to where it begins, if that is within two voxels."""
    threshold, reach = surface_density(lattice), 2 * lattice.step
    dense = sampler.density(p) >= threshold
    far = reach * np.where(dense, 1.0, -1.0)
    crosses = dense != (sampler.density(p + far[:, None] * normals) >= threshold)
    a, b = np.zeros(len(p)), far
    for _ in range(8):
        middle = 0.5 * (a + b)
        same = (sampler.density(p + middle[:, None] * normals) >= threshold) == dense
        a, b = np.where(same, middle, a), np.where(same, b, middle)
    # The side that is matter.
    return p + (np.where(crosses, np.where(dense, a, b), 0))[:, None] * normals
