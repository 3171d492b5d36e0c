"""A radiance field in the scene: what scale and rotation do to it, and what it is asked for outside of a march."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import OccupancyGrid
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import ColorPainter
from tests.maths.test_geometry import turn

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = Box((0, 0, 0), (1, 1, 2))


def field(**kwargs):
    f = RadianceField.random(
        RadianceConfig(GRID, width=16, geometry=3, sh_degree=2), BOX, ns, march_step=0.05, **kwargs
    )
    f.set_parameters(
        {"grid.table": ns.Float(np.random.default_rng(0).normal(size=len(f.grid.table)).astype(np.float32))}
    )
    return f


def gather(mi, medium, o, d, scale):
    ray = medium.local(mi.Point3f(o.tolist()), mi.Vector3f(d.tolist()))
    t0 = dr.maximum(ray.t_near, 0)
    result = march(medium, ray, t0, ray.t_far, True, MarchSettings(0.05 * scale), color=ColorPainter(mi.Color3f))
    return result.opacity.numpy()[0], result.expected_depth.numpy()[0], np.array(result.color).ravel()


def test01_scaling_place_and_camera_changes_no_opacity(rgb):
    f = field()
    o, d = np.array([0.4, 0.3, -1.0]), np.array([0.1, 0.05, 1.0])
    d /= np.linalg.norm(d)
    plain = gather(rgb, FieldMedium(f), o, d, 1)
    assert 0.2 < plain[0] < 0.999
    for scale in (1e-3, 1e3):
        m = turn(scale)
        moved = FieldMedium(f, Similarity(m))
        got = gather(rgb, moved, (m @ [*o, 1])[:3], m[:3, :3] @ d / scale, scale)
        assert np.isclose(got[0], plain[0], rtol=1e-4) and np.isclose(got[1], plain[1] * scale, rtol=1e-4)
        # The direction that colour depends on turns with the field.
        assert np.allclose(got[2], plain[2], rtol=1e-3)
        assert np.isclose(moved.step, 0.05 * scale) and np.isclose(moved.length_scale, 6**0.5 * scale)


def test02_its_box_in_the_scene(rgb):
    m = turn(2.0)
    medium = FieldMedium(field(), Similarity(m))
    corners = np.array([m[:3] @ [x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 2)])
    lower, upper = medium.bounds()
    assert np.allclose(lower, corners.min(0)) and np.allclose(upper, corners.max(0))
    # The unit cube of the occupancy grid holds the field's box: its longest edge spans it.
    p = rgb.Point3f(*map(float, (m @ [0.25, 0.5, 2, 1])[:3]))
    assert np.allclose(np.array(medium.to_unit(medium.to_local(p))).ravel(), [0.375, 0.5, 1], atol=1e-6)
    v = medium.vector_to_unit(rgb.Vector3f(0, 0, 1))
    assert np.allclose(np.array(v).ravel(), [0, 0, 0.5])


@pytest.mark.parametrize("scale", [0.5, 4.0])
def test03_density_is_that_of_a_scene_unit(rgb, scale):
    f = field()
    medium = FieldMedium(f, Similarity(np.diag([scale, scale, scale, 1])))
    p = ns.Array3f([0.2, 0.7], [0.3, 0.1], [0.4, 1.9])
    sigma, features = medium.density_features(p, True)
    assert np.allclose(sigma.numpy(), f.density(p).numpy() / scale, rtol=1e-6)
    assert np.array_equal(sigma.numpy(), medium.density(p, True).numpy())
    assert len(features) == medium.feature_count == 3


def test04_empty_cells_hold_nothing_also_where_no_march_has_looked(rgb):
    bits = np.zeros((4, 4, 4), bool)
    bits[0, 0, 0] = True
    medium = FieldMedium(field(occupancy=OccupancyGrid(bits, ns, 0.01)))
    # The longest edge of the box, two units, spans the four cells, and the others lie in the middle of them.
    p = ns.Array3f([0.1, 0.1, 0.9], [0.1, 0.1, 0.9], [0.1, 1.9, 1.0])
    found, inside = medium.occupied_density(p, True).numpy(), medium.density(p, True).numpy()
    occupied = medium.occupancy.empty_cells(medium.to_unit(p)).numpy() == 0
    assert (inside > 0).all() and np.array_equal(found, np.where(occupied, inside, 0))


def test05_weights_are_read_whenever_it_is_asked(rgb):
    f = field()
    medium, p = FieldMedium(f), ns.Array3f(0.4, 0.3, 1.2)
    before = medium.density(p, True).numpy()
    f.set_parameters({"grid.table": dr.full(ns.Float, 0.5, len(f.grid.table))})
    medium.refresh()
    assert not np.allclose(medium.density(p, True).numpy(), before)
