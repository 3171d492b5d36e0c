"""Tests of `nerg_mi.formats.surfaces`."""

import json
import math
import struct
import tracemalloc

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest
import trimesh

from nerg_mi.fields.extraction import FieldSampler, Lattice, surface_density
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.formats import surfaces
from nerg_mi.formats.surfaces import (
    extract_mesh,
    extract_points,
    sample_density_and_color,
    write_glb,
    write_ply,
    write_volume,
)
from nerg_mi.maths.geometry import Box

# ---- The ball ----

CENTER, RADIUS = np.array([1.2, 1.0, 0.9]), 0.6


class Ball:
    """Replacement for a radiance field: density in a ball with a speck next to it, and colour from position and
    direction.
    """

    def __init__(self, occupancy=None, speck=False, hole=False, color_space="srgb", sharp=200.0):
        self.box, self.occupancy, self.color_space = Box((0, 0, 0), (2.4, 2, 1.8)), occupancy, color_space
        self.ns = ns
        self.speck, self.hole, self.sharp = speck, hole, sharp

    def density(self, p, active=True):
        to = lambda c: dr.norm(p - ns.Array3f(*c))
        sigma = self.sharp * dr.exp(60 * (RADIUS - to(CENTER.tolist())))
        if self.speck:
            sigma += 1e3 * dr.exp(200 * (0.1 - to([0.2, 0.2, 0.2])))
        if self.hole:
            # A shaft along z around one line of lattice points.
            sigma = dr.select(dr.sqrt((p.x - 1.225) ** 2 + (p.y - 1.025) ** 2) < 0.02, 0, sigma)
        return dr.select(active & self.box.contains(p), dr.minimum(sigma, 1e4), 0)

    def density_features(self, p, active=True):
        return self.density(p, active), [p.x, p.y, p.z]

    def color(self, features, d):
        return ns.Array3f(features[0] / 2.4, 0.5 + 0.1 * d.z, 0.25)


# ---- Surfaces ----
#
# Meshes, points and voxels of a field with a known surface: a ball in front of an unobserved region.


def expected_radius(ball, threshold):
    return RADIUS - math.log(threshold / ball.sharp) / 60


def test01_mesh_is_on_surface():
    pytest.importorskip("skimage")
    ball = Ball()
    m = extract_mesh(ball, 48)
    threshold = math.log(2) / (2.4 / 48)
    assert m.report["threshold"] == pytest.approx(threshold) == surface_density(Lattice.for_field(ball, 48))
    r = np.linalg.norm(m.vertices - CENTER, axis=1)
    # Precision of the bisection of an edge: a 2^9th of a cell.
    assert np.abs(r - expected_radius(ball, threshold)).max() < 2.4 / 48 / 300
    body = trimesh.Trimesh(m.vertices, m.faces, process=False)
    assert body.is_watertight and body.volume > 0
    assert np.isclose(body.volume, 4 / 3 * math.pi * expected_radius(ball, threshold) ** 3, rtol=0.01)
    assert ((m.vertices - CENTER) / r[:, None] * m.normals).sum(1).min() > 0.95
    assert m.report["edges_of_holes"] == m.report["edges_at_the_box"] == 0
    # The direction-dependent part is the mean of the cosines over the normal and views at 45 degrees.
    share = (1 + 4 / math.sqrt(2)) / 5
    assert np.allclose(m.colors[:, 0], m.vertices[:, 0] / 2.4, atol=1e-5)
    assert np.allclose(m.colors[:, 1], 0.5 - 0.1 * share * m.normals[:, 2], atol=1e-5)


def test02_floaters_and_holes():
    pytest.importorskip("skimage")
    both, alone = (
        extract_mesh(Ball(speck=True), 48, min_piece_fraction=0),
        extract_mesh(Ball(speck=True), 48, min_piece_fraction=0.05),
    )
    assert both.report["pieces"] == both.report["pieces_kept"] == 2 and alone.report["pieces_kept"] == 1
    assert np.linalg.norm(alone.vertices - CENTER, axis=1).min() > 0.5
    assert alone.face_count == len(alone.faces)
    assert alone.report["floater_faces"] == len(both.faces) - len(alone.faces) > 0
    pierced, complete = extract_mesh(Ball(hole=True), 48, fill_cells=0), extract_mesh(Ball(hole=True), 48, fill_cells=1)
    euler = lambda m: trimesh.Trimesh(m.vertices, m.faces, process=False).euler_number
    assert (euler(pierced), euler(complete)) == (0, 2) and complete.report["cells_filled"] > 10


def test03_unseen_faces_are_removed():
    # Cells beyond the centre of the ball were never observed, so there is no surface at their border.
    pytest.importorskip("skimage")
    bits = np.zeros((24, 24, 24), bool)
    bits[:, :, :12] = True
    half = Ball(OccupancyGrid(bits, ns, 0.1))
    m, closed = extract_mesh(half, 48), extract_mesh(half, 48, keep_unseen=True)
    assert trimesh.Trimesh(closed.vertices, closed.faces, process=False).is_watertight
    r = np.linalg.norm(m.vertices - CENTER, axis=1)
    assert (r > 0.55).all() and (np.linalg.norm(closed.vertices - CENTER, axis=1) < 0.3).any()
    assert m.report["unseen_faces"] > 100 and m.report["edges_of_holes"] > 50 and m.vertices[:, 0].max() < 1.25
    cloud = extract_points(half, 48)
    assert (np.linalg.norm(cloud.vertices - CENTER, axis=1) > 0.55).all()


def test04_points_and_the_box():
    ball = Ball()
    cloud = extract_points(ball, 48, threshold=100.0)
    r = np.linalg.norm(cloud.vertices - CENTER, axis=1)
    assert np.abs(r - expected_radius(ball, 100.0)).max() < 2.4 / 48 / 300 and cloud.faces is None
    assert cloud.face_count == 0
    assert ((cloud.vertices - CENTER) / r[:, None] * cloud.normals).sum(1).min() > 0.97
    assert len(extract_points(ball, 48, count=100).vertices) == 100
    with pytest.raises(ValueError, match="does not cross"):
        extract_points(ball, 48, threshold=1e6)
    pytest.importorskip("skimage")
    with pytest.raises(ValueError, match="does not cross.*density"):
        extract_mesh(ball, 48, threshold=1e6)
    ball.box = Box((0, 0, 0), (1.2, 2, 1.8))
    assert extract_mesh(ball, 36).report["edges_at_the_box"] > 20


def test05_files(tmp_path):
    cloud = extract_points(Ball(color_space="linear"), 24)
    triangles = cloud.__class__(
        cloud.vertices[:30], np.arange(30).reshape(10, 3), cloud.normals[:30], cloud.colors[:30], {}
    )
    write_ply(triangles, tmp_path / "m.ply")
    body = trimesh.load(tmp_path / "m.ply", process=False)
    assert np.allclose(body.vertices, triangles.vertices, atol=1e-6) and np.array_equal(body.faces, triangles.faces)
    assert np.abs(body.visual.vertex_colors[:, :3] / 255 - triangles.colors).max() < 0.51 / 255
    write_ply(cloud, tmp_path / "c.ply")
    assert len(trimesh.load(tmp_path / "c.ply").vertices) == len(cloud.vertices)
    for up in ("z", "y"):
        write_glb(triangles, tmp_path / "m.glb", up)
        shown = trimesh.load(tmp_path / "m.glb", force="mesh")
        v = triangles.vertices
        assert np.allclose(shown.vertices, v if up == "y" else np.stack([v[:, 0], v[:, 2], -v[:, 1]], 1), atol=1e-6)
    raw = (tmp_path / "m.glb").read_bytes()
    size = struct.unpack("<I", raw[12:16])[0]
    document = json.loads(raw[20 : 20 + size])
    view = document["bufferViews"][2]
    rgba = np.frombuffer(raw, "<u2", view["byteLength"] // 2, 28 + size + view["byteOffset"]).reshape(-1, 4) / 65535
    # The colours of the ball are linear, as in glTF.
    assert (
        np.allclose(rgba[:, 0], triangles.vertices[:, 0] / 2.4, atol=1e-4)
        and len(raw) == struct.unpack("<I", raw[8:12])[0]
    )


# ---- Voxels of a field: values, and position in Mitsuba ----


def test_voxels_render_like_field(rgb, tmp_path):
    ball = Ball()
    density, color, lower, upper = sample_density_and_color(ball, 24, samples=3)
    assert density.shape == (18, 20, 24) and np.allclose(lower, 0) and np.allclose(upper, ball.box.upper)
    cell = 0.1
    points_of = lambda x, y, z: (
        (np.stack(np.meshgrid(*[(np.arange(3) + 0.5) / 3] * 3), -1).reshape(-1, 3) + [x, y, z]) * cell
    )
    for x, y, z in ((6, 9, 8), (5, 9, 8), (5, 8, 8), (8, 9, 8)):
        share = np.mean(-np.expm1(-FieldSampler(ball).density(points_of(x, y, z)) * cell))
        assert np.isclose(density[z, y, x], min(-math.log(max(1 - share, 1e-9)), 5) / cell, rtol=1e-3)
    # On the surface, seen along the normal: green depends only on z of the direction.
    assert np.allclose(color[8, 9, 6, 0], ((1.2 - 0.6) / 2.4 / 1.055 + 0.055 / 1.055) ** 2.4, atol=0.01)
    assert np.allclose(color[8, 9, 6, 1], ((0.5 + 0.055) / 1.055) ** 2.4, atol=0.01)
    assert np.array_equal(color[8, 9, 3], color[8, 9, 4]) and not color[0, 0, 0].any()
    write_volume(tmp_path / "d.vol", density, lower, upper)
    write_volume(tmp_path / "c.vol", color, lower, upper)
    for name, data in (("d", density), ("c", color)):
        volume = rgb.load_dict(
            {"type": "gridvolume", "filename": str(tmp_path / f"{name}.vol"), "use_grid_bbox": True, "raw": True}
        )
        assert np.allclose(volume.bbox().max, upper)
        it = dr.zeros(rgb.Interaction3f)
        it.p = rgb.Point3f(*((np.array([6, 9, 8]) + 0.5) * cell).tolist())
        got = np.ravel(volume.eval_1(it) if name == "d" else volume.eval_3(it))
        assert np.allclose(got, data[8, 9, 6], rtol=1e-4)


def test_dense_field_takes_few_bytes_per_voxel(monkeypatch):
    """All voxels have a colour. They are computed in blocks, with the same result as at once."""
    fog = Ball()
    fog.density = lambda p, active=True: dr.select(active, 1 + p.x, 0)
    field_bytes = sample_density_and_color(fog, 48, samples=1)
    monkeypatch.setattr(surfaces, "_BLOCK", 2500)
    tracemalloc.start()
    try:
        blocks = sample_density_and_color(fog, 48, samples=1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert all(np.array_equal(a, b) for a, b in zip(field_bytes, blocks)) and blocks[1].min() > 0
    # The result takes 16 of them, and the nearest surface indices take 12.
    assert peak < 60 * blocks[0].size


def test_an_empty_field_has_no_colour():
    density, color, _, _ = sample_density_and_color(Ball(sharp=0.0), 6, samples=1)
    assert not color.any() and np.abs(density).max() < 1e-6
    assert sample_density_and_color(Ball(), 6, color=False, samples=1)[1] is None
