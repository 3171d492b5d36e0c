"""Where the cameras of the demo store stand: a plan that lets every visible surface be seen often and from many sides.

Rooms seen from inside are hard for radiance fields because most views see most surfaces from afar and from one side. So
the views are chosen greedily among many candidates by exact ray casts. Poses are camera-to-world matrices with OpenGL
axes (x right, y up, z back), metres, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from nerg_mi.scenes.store import twin
from nerg_mi.scenes.store.layout import ROOM, StoreLayout

SECTORS = 6  # directions of view are told apart by their azimuth about the surface normal
HEIGHTS = (0.6, 2.4)
CLEARANCE = 0.35


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera without distortion: size in pixels, focal length in pixels, the centre in the middle."""

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
        """Pixel coordinates (N, 2) of world points (N, 3), (0.5, 0.5) in the centre of the first pixel, and whether
        they lie in front of the camera and inside of the picture."""
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        depth = np.maximum(-local[:, 2], 1e-9)
        uv = np.stack([local[:, 0], -local[:, 1]], axis=-1) / depth[:, None] * self.focal
        uv += (0.5 * self.width, 0.5 * self.height)
        inside = (local[:, 2] < -1e-6) & np.all((uv >= 0) & (uv < (self.width, self.height)), axis=-1)
        return uv, inside


def pose_from_angles(position, yaw: float, pitch: float) -> np.ndarray:
    """Camera-to-world (4, 4) at a position, looking along azimuth ``yaw`` and elevation ``pitch`` (radians),
    upright."""
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(right, forward), -forward, position
    return pose


def sample_free_positions(layout: StoreLayout, rng, count: int, heights=HEIGHTS, clearance: float = CLEARANCE) -> np.ndarray:
    """Uniform positions (count, 3) at least ``clearance`` metres away from everything solid."""
    found = np.empty((0, 3))
    for _ in range(1000):
        p = rng.uniform((0, 0, heights[0]), (ROOM[0], ROOM[1], heights[1]), (4 * count, 3))
        found = np.concatenate([found, p[layout.compute_clearance(p) >= clearance]])
        if len(found) >= count:
            return found[:count]
    raise ValueError(f"No room for a clearance of {clearance} m; ask for less.")


def sample_surface_points(layout: StoreLayout, rng, count: int, scene=None) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3), uniform by area on the surfaces that a camera in free space can see, and their normals (N, 3).

    Free space is where cameras may stand (`HEIGHTS`, `CLEARANCE`). ``count`` is how many are drawn; those behind goods,
    under low boards and inside of joints drop out.
    """
    a, b, d = layout.quads[:, 0], layout.quads[:, 1], layout.quads[:, 3]
    cross = np.cross(b - a, d - a)
    area = np.linalg.norm(cross, axis=1)
    k = rng.choice(len(area), count, p=area / area.sum())
    s, t = rng.random((2, count, 1))
    normals = cross[k] / area[k, None]
    points = a[k] + s * (b[k] - a[k]) + t * (d[k] - a[k]) + 2e-3 * normals
    eyes = sample_free_positions(layout, rng, 400)
    seen = np.zeros(count, bool)
    for chunk in np.array_split(eyes, 10):
        rest = np.flatnonzero(~seen)
        towards = chunk[:, None] - points[None, rest]
        facing = np.einsum("enk,nk->en", towards, normals[rest]) > 0.05 * np.linalg.norm(towards, axis=-1)
        e, n = np.nonzero(facing)
        hit = twin.is_visible(chunk[e], points[rest[n]], scene)
        seen[rest[n[hit]]] = True
    return points[seen], normals[seen]


def find_visible_points(camera: Pinhole, poses, points, normals, scene=None):
    """Which view sees which surface point: arrays (pose index, point index, cosine of view, distance, sector)."""
    parts = []
    for i, pose in enumerate(poses):
        to_eye = pose[:3, 3] - points
        distance = np.linalg.norm(to_eye, axis=1)
        cosine = np.einsum("nk,nk->n", to_eye, normals) / distance
        n = np.flatnonzero(camera.project(pose, points)[1] & (cosine > 0.08))
        parts.append(np.stack([np.full(len(n), i), n]))
    i, n = np.concatenate(parts, axis=1)
    origins = np.stack([p[:3, 3] for p in poses])[i]
    keep = twin.is_visible(origins, points[n], scene)
    i, n, origins = i[keep], n[keep], origins[keep]
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
    """Training poses (count, 4, 4) and held-out poses (held_out, 4, 4).

    Greedy: each next view is the candidate that sees most of what was seen seldom, or from one side only, until now;
    views from near and face on count for more. Held-out views are a shopper's: at eye height, nearly level, looking
    into the open.
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
    seen = np.zeros(len(points))
    sides = np.zeros((len(points), SECTORS))
    chosen: list[int] = []
    bounds = np.searchsorted(i, np.arange(candidates + 1))
    for _ in range(count):
        gain = value * (1.0 / (1.0 + seen[n]) ** 2 + 0.5 / (1.0 + sides[n, sector]) ** 2)
        total = np.bincount(i, gain, candidates)
        total[chosen] = -1.0
        best = int(np.argmax(total))
        chosen.append(best)
        mine = slice(bounds[best], bounds[best + 1])
        np.add.at(seen, n[mine], value[mine])
        np.add.at(sides, (n[mine], sector[mine]), value[mine])

    return poses[chosen], _held_out_views(layout, rng, held_out, scene)


def _held_out_views(layout: StoreLayout, rng, count: int, scene) -> np.ndarray:
    """Poses (count, 4, 4) far from each other in place and direction; a picture of one good from 40 cm would test
    little."""
    positions = sample_free_positions(layout, rng, 400, (1.2, 1.9))
    yaw, pitch = rng.uniform(0, 2 * np.pi, 400), np.radians(rng.uniform(-18, 8, 400))
    poses = np.stack([pose_from_angles(*v) for v in zip(positions, yaw, pitch)])
    probe = Pinhole(16, 12).directions().reshape(-1, 3)
    ahead = np.stack([twin.cast_rays(p[:3, 3], probe @ p[:3, :3].T, scene) for p in poses])
    open_ = (np.median(ahead, axis=1) > 1.8) & (np.quantile(ahead, 0.1, axis=1) > 0.6)
    poses, positions, yaw = poses[open_], positions[open_], yaw[open_]
    picked = [0]
    while len(picked) < min(count, len(poses)):
        far = np.linalg.norm(positions[:, None] - positions[picked][None], axis=-1)
        turn = 1.0 - np.cos(yaw[:, None] - yaw[picked][None])
        picked.append(int(np.argmax((far + 0.5 * turn).min(axis=1))))
    return poses[picked[:count]]


def measure_coverage(layout: StoreLayout, camera: Pinhole, poses, seed: int = 1, scene=None) -> dict:
    """How well poses see the place: fractions of fresh surface points seen by so many views.

    "area": points uniform by area on what a camera in free space can see at all, slits behind and above goods included.
    "sight": points as they meet the eye, hits of uniform directions from uniform positions in free space.
    Also the fraction of the area seen by two views at least 30 degrees apart, and the median numbers of views.
    """
    rng = np.random.default_rng([seed, 0xC0])
    points, normals = sample_surface_points(layout, rng, 4000, scene)
    i, n, _, _, _ = find_visible_points(camera, poses, points, normals, scene)
    count = np.bincount(n, minlength=len(points))
    to_eye = np.stack([p[:3, 3] for p in poses])[i] - points[n]
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    order = np.argsort(n, kind="stable")
    starts = np.searchsorted(n[order], np.arange(len(points) + 1))
    wide = np.zeros(len(points), bool)
    for k in range(len(points)):
        v = to_eye[order[starts[k] : starts[k + 1]]]
        wide[k] = len(v) > 1 and (v @ v.T).min() < np.cos(np.radians(30))

    eyes = sample_free_positions(layout, rng, 4000)
    directions = rng.normal(size=eyes.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    met = eyes + (twin.cast_rays(eyes, directions, scene) - 2e-3)[:, None] * directions
    sight = np.zeros(len(met))
    for pose in poses:
        k = np.flatnonzero(camera.project(pose, met)[1])
        sight[k] += twin.is_visible(pose[:3, 3], met[k], scene)

    out = {}
    for name, views in (("area", count), ("sight", sight)):
        out |= {f"{name}: seen by {m} or more views": float((views >= m).mean()) for m in (1, 3, 5, 10)}
        out[f"{name}: median views"] = float(np.median(views))
    return out | {"area: seen from directions 30 degrees apart": float(wide.mean())}
