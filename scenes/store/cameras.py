"""Camera placement in the demo store, so that every visible surface is seen often and from many sides.

Rooms seen from inside are difficult for radiance fields, because most views see most surfaces from afar and from one
side. The views are therefore selected greedily among many candidates by exact ray casts. Poses are camera-to-world
matrices with OpenGL axes (x right, y up, z back), metres, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from nerg_mi.scenes.store import twin
from nerg_mi.scenes.store.layout import ROOM, StoreLayout

SECTORS = 6  # viewing directions are classified by their azimuth about the surface normal
HEIGHTS = (0.6, 2.4)
CLEARANCE = 0.35


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera without distortion; the principal point is the centre."""

    width: int = 160
    height: int = 120
    fov_x: float = 78.0  # degrees, horizontal

    @property
    def focal(self) -> float:
        return 0.5 * self.width / np.tan(np.radians(0.5 * self.fov_x))

    def directions(self) -> np.ndarray:
        """Unit directions (height, width, 3) through the pixels' centres in the camera's own OpenGL axes."""
        u = (np.arange(self.width) + 0.5 - 0.5 * self.width) / self.focal
        v = (np.arange(self.height) + 0.5 - 0.5 * self.height) / self.focal
        d = np.stack(np.broadcast_arrays(u[None, :], -v[:, None], -1.0), axis=-1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def project(self, pose: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project world points (N, 3) to pixel coordinates (N, 2), with (0.5, 0.5) in the centre of the first pixel.

        Also returns whether the points are in front of the camera and inside the picture.
        """
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        depth = np.maximum(-local[:, 2], 1e-9)
        uv = np.stack([local[:, 0], -local[:, 1]], axis=-1) / depth[:, None] * self.focal
        uv += (0.5 * self.width, 0.5 * self.height)
        inside = (local[:, 2] < -1e-6) & np.all((uv >= 0) & (uv < (self.width, self.height)), axis=-1)
        return uv, inside


def pose_from_angles(position, yaw: float, pitch: float) -> np.ndarray:
    """Return the upright camera-to-world (4, 4) at a position with azimuth ``yaw`` and elevation ``pitch``
    (radians)."""
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(right, forward), -forward, position
    return pose


def sample_free_positions(
    layout: StoreLayout, rng, count: int, heights=HEIGHTS, clearance: float = CLEARANCE
) -> np.ndarray:
    """Sample uniform positions (count, 3) with at least ``clearance`` metres to all solids."""
    positions = np.empty((0, 3))
    for _ in range(1000):
        p = rng.uniform((0, 0, heights[0]), (ROOM[0], ROOM[1], heights[1]), (4 * count, 3))
        positions = np.concatenate([positions, p[layout.compute_clearance(p) >= clearance]])
        if len(positions) >= count:
            return positions[:count]
    raise ValueError(f"no positions have a clearance of {clearance} m; use a smaller clearance")


def sample_surface_points(layout: StoreLayout, rng, count: int, scene=None) -> tuple[np.ndarray, np.ndarray]:
    """Sample points (N, 3) uniformly by area on surfaces visible from free space, with their normals (N, 3).

    Free space is where cameras may be (`HEIGHTS`, `CLEARANCE`). ``count`` points are drawn; those behind goods, under
    low boards and in joints are removed.
    """
    a, b, d = layout.quads[:, 0], layout.quads[:, 1], layout.quads[:, 3]
    cross = np.cross(b - a, d - a)
    area = np.linalg.norm(cross, axis=1)
    k = rng.choice(len(area), count, p=area / area.sum())
    s, t = rng.random((2, count, 1))
    normals = cross[k] / area[k, None]
    points = a[k] + s * (b[k] - a[k]) + t * (d[k] - a[k]) + 2e-3 * normals
    viewpoints = sample_free_positions(layout, rng, 400)
    is_seen = np.zeros(count, bool)
    for chunk in np.array_split(viewpoints, 10):
        unseen = np.flatnonzero(~is_seen)
        offset = chunk[:, None] - points[None, unseen]
        facing = np.einsum("enk,nk->en", offset, normals[unseen]) > 0.05 * np.linalg.norm(offset, axis=-1)
        e, n = np.nonzero(facing)
        hit = twin.is_visible(chunk[e], points[unseen[n]], scene)
        is_seen[unseen[n[hit]]] = True
    return points[is_seen], normals[is_seen]


def find_visible_points(camera: Pinhole, poses, points, normals, scene=None):
    """Find which view sees which surface point: arrays (pose index, point index, cosine of view, distance, sector)."""
    parts = []
    for i, pose in enumerate(poses):
        to_eye = pose[:3, 3] - points
        distance = np.linalg.norm(to_eye, axis=1)
        cosine = np.einsum("nk,nk->n", to_eye, normals) / distance
        n = np.flatnonzero(camera.project(pose, points)[1] & (cosine > 0.08))
        parts.append(np.stack([np.full(len(n), i), n]))
    i, n = np.concatenate(parts, axis=1)
    origins = np.stack([p[:3, 3] for p in poses])[i]
    is_visible = twin.is_visible(origins, points[n], scene)
    i, n, origins = i[is_visible], n[is_visible], origins[is_visible]
    to_eye = origins - points[n]
    distance = np.linalg.norm(to_eye, axis=1)
    cosine = np.einsum("nk,nk->n", to_eye, normals[n]) / distance
    # an arbitrary but fixed tangent frame of each axis-aligned normal
    axis = np.argmax(np.abs(normals[n]), axis=1)
    a = np.take_along_axis(to_eye, ((axis + 1) % 3)[:, None], 1)[:, 0]
    b = np.take_along_axis(to_eye, ((axis + 2) % 3)[:, None], 1)[:, 0]
    sector = np.floor((np.arctan2(b, a) / (2 * np.pi) % 1.0) * SECTORS).astype(int) % SECTORS
    return i, n, cosine, distance, sector


def choose_views(layout: StoreLayout, camera: Pinhole, count: int, held_out: int, seed: int = 0, scene=None):
    """Choose training poses (count, 4, 4) and held-out poses (held_out, 4, 4).

    Training views are selected greedily: each next view is the candidate that sees most of what was seen rarely, or
    only from one side; near and frontal views count more. Held-out views are those of a shopper: at eye height, nearly
    level, looking into open space.
    """
    rng = np.random.default_rng([seed, 0xCA])
    candidates = 30 * (count + held_out)
    positions = sample_free_positions(layout, rng, candidates)
    yaw = rng.uniform(0, 2 * np.pi, candidates)
    pitch = np.radians(np.clip(rng.normal(-6, 20, candidates), -50, 40))
    poses = np.stack([pose_from_angles(*v) for v in zip(positions, yaw, pitch)])
    points, normals = sample_surface_points(layout, rng, 6000, scene)
    i, n, cosine, distance, sector = find_visible_points(camera, poses, points, normals, scene)
    value = np.minimum(1.0, cosine / 0.3) * np.minimum(1.0, 1.2 / distance)
    visibility_count = np.zeros(len(points))
    sides = np.zeros((len(points), SECTORS))
    selected: list[int] = []
    bounds = np.searchsorted(i, np.arange(candidates + 1))
    for _ in range(count):
        gain = value * (1.0 / (1.0 + visibility_count[n]) ** 2 + 0.5 / (1.0 + sides[n, sector]) ** 2)
        total = np.bincount(i, gain, candidates)
        total[selected] = -1.0
        best = int(np.argmax(total))
        selected.append(best)
        visible = slice(bounds[best], bounds[best + 1])
        np.add.at(visibility_count, n[visible], value[visible])
        np.add.at(sides, (n[visible], sector[visible]), value[visible])

    return poses[selected], _choose_held_out_views(layout, rng, held_out, scene)


def _choose_held_out_views(layout: StoreLayout, rng, count: int, scene) -> np.ndarray:
    """Choose poses (count, 4, 4) that differ in position and direction; a close-up of one product would test little."""
    positions = sample_free_positions(layout, rng, 400, (1.2, 1.9))
    yaw, pitch = rng.uniform(0, 2 * np.pi, 400), np.radians(rng.uniform(-18, 8, 400))
    poses = np.stack([pose_from_angles(*v) for v in zip(positions, yaw, pitch)])
    probe = Pinhole(16, 12).directions().reshape(-1, 3)
    distances = np.stack([twin.cast_rays(p[:3, 3], probe @ p[:3, :3].T, scene) for p in poses])
    is_open = (np.median(distances, axis=1) > 1.8) & (np.quantile(distances, 0.1, axis=1) > 0.6)
    poses, positions, yaw = poses[is_open], positions[is_open], yaw[is_open]
    selected = [0]
    while len(selected) < min(count, len(poses)):
        far = np.linalg.norm(positions[:, None] - positions[selected][None], axis=-1)
        turn = 1.0 - np.cos(yaw[:, None] - yaw[selected][None])
        selected.append(int(np.argmax((far + 0.5 * turn).min(axis=1))))
    return poses[selected[:count]]


def measure_coverage(layout: StoreLayout, camera: Pinhole, poses, seed: int = 1, scene=None) -> dict:
    """Measure how well poses see the store: fractions of new surface points seen by a number of views.

    "area": points uniform by area on surfaces visible from free space, including slits behind and above goods. "sight":
    hits of uniform directions from uniform positions in free space. Also the fraction of the area seen by two views at
    least 30 degrees apart, and the median numbers of views.
    """
    rng = np.random.default_rng([seed, 0xC0])
    points, normals = sample_surface_points(layout, rng, 4000, scene)
    i, n, _, _, _ = find_visible_points(camera, poses, points, normals, scene)
    count = np.bincount(n, minlength=len(points))
    to_eye = np.stack([p[:3, 3] for p in poses])[i] - points[n]
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    order = np.argsort(n, kind="stable")
    starts = np.searchsorted(n[order], np.arange(len(points) + 1))
    is_wide = np.zeros(len(points), bool)
    for k in range(len(points)):
        v = to_eye[order[starts[k] : starts[k + 1]]]
        is_wide[k] = len(v) > 1 and (v @ v.T).min() < np.cos(np.radians(30))

    origins = sample_free_positions(layout, rng, 4000)
    directions = rng.normal(size=origins.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = origins + (twin.cast_rays(origins, directions, scene) - 2e-3)[:, None] * directions
    sight = np.zeros(len(hits))
    for pose in poses:
        k = np.flatnonzero(camera.project(pose, hits)[1])
        sight[k] += twin.is_visible(pose[:3, 3], hits[k], scene)

    out = {}
    for name, views in (("area", count), ("sight", sight)):
        out |= {f"{name}: seen by {m} or more views": float((views >= m).mean()) for m in (1, 3, 5, 10)}
        out[f"{name}: median views"] = float(np.median(views))
    return out | {"area: seen from directions 30 degrees apart": float(is_wide.mean())}
