"""Voxels of a field: what they hold, and that Mitsuba shows them where they belong."""

import math
import tracemalloc

import drjit as dr
import numpy as np

from nerg_mi.fields.extraction import Sampler
from nerg_mi.formats import surfaces
from nerg_mi.formats.surfaces import density_and_color, write_volume
from tests.formats.ball import Ball


def test_voxels_render_as_the_field(rgb, tmp_path):
    ball = Ball()
    density, color, lower, upper = density_and_color(ball, 24, samples=3)
    assert density.shape == (18, 20, 24) and np.allclose(lower, 0) and np.allclose(upper, ball.box.upper)
    cell = 0.1
    points_of = lambda x, y, z: (
        (np.stack(np.meshgrid(*[(np.arange(3) + 0.5) / 3] * 3), -1).reshape(-1, 3) + [x, y, z]) * cell
    )
    for x, y, z in ((6, 9, 8), (5, 9, 8), (5, 8, 8), (8, 9, 8)):
        share = np.mean(-np.expm1(-Sampler(ball).density(points_of(x, y, z)) * cell))
        assert np.isclose(density[z, y, x], min(-math.log(max(1 - share, 1e-9)), 5) / cell, rtol=1e-3)
    # On the surface, from the side that the surface faces: its green depends on z of the direction alone.
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


def test_a_full_field_takes_a_few_bytes_a_voxel(monkeypatch):
    """Every voxel of it has a colour: they are looked for in blocks, as if all at once."""
    fog = Ball()
    fog.density = lambda p, active=True: dr.select(active, 1 + p.x, 0)
    whole = density_and_color(fog, 48, samples=1)
    monkeypatch.setattr(surfaces, "_BLOCK", 2500)
    tracemalloc.start()
    try:
        blocks = density_and_color(fog, 48, samples=1)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert all(np.array_equal(a, b) for a, b in zip(whole, blocks)) and blocks[1].min() > 0
    # Of them 16 are the result's own, and 12 tell which surface is nearest.
    assert peak < 60 * blocks[0].size


def test_an_empty_field_has_no_colour():
    density, color, _, _ = density_and_color(Ball(sharp=0.0), 6, samples=1)
    assert not color.any() and np.abs(density).max() < 1e-6
    assert density_and_color(Ball(), 6, color=False, samples=1)[1] is None
