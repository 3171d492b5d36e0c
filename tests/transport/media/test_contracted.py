"""A field without an end in the scene: rays through the contracted part against integrals in float64."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import contracted_cascades
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.maths.geometry import Box, ContractedBox, Similarity
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from tests.maths.test_geometry import turn

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = ContractedBox(Box((-1, -2, -2), (3, 2, 2)), 64)
GROWTH = 1 / 128
SCALE = 0.1


def plain_field(**kwargs):
    """One whose density net returns 0: σ = SCALE / m², m the largest coordinate in half edges (2 units) from (1, 0, 0),
    at least 1."""
    config = RadianceConfig(GRID, width=16, geometry=3, sh_degree=2, density_scale=SCALE)
    field = RadianceField.random(config, BOX, ns, march_step=0.02, march_growth=GROWTH, **kwargs)
    field.set_parameters({k: dr.zeros(type(v), v.shape) for k, v in field.parameters().items() if "density" in k})
    return field


def reference(o, d, stop, count=100_000):
    """Optical depth and mean distance of absorption up to the distance ``stop``, by sums in float64."""
    edges = np.concatenate([[0], np.geomspace(1e-3, stop, count)])
    t = 0.5 * (edges[1:] + edges[:-1])
    m = np.maximum(np.abs((o + t[:, None] * d - BOX.center) / 2).max(axis=1), 1)
    tau = np.concatenate([[0], np.cumsum(SCALE / m**2 * np.diff(edges))])
    weight = np.exp(-tau[:-1]) - np.exp(-tau[1:])
    return tau[-1], float(weight @ t / weight.sum())


def rays(count=24):
    rng = np.random.default_rng(3)
    d = rng.normal(size=(count, 3))
    return BOX.center + rng.uniform(-3, 3, (count, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


def gather(mi, medium, o, d, settings):
    ray = medium.local(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    found = march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, settings)
    return ray.t_far.numpy(), found.tau.numpy(), found.expected_depth.numpy()


# Steps of a share γ of their distance see the density of their middle: an error of the order of γ², and that of single
# precision over hundreds of steps.
@pytest.mark.parametrize("growth, tolerance", [(1 / 16, 2e-3), (1 / 128, 5e-5)])
def test_rays_through_the_contracted_part(rgb, growth, tolerance):
    medium, (o, d) = FieldMedium(plain_field()), rays()
    far, tau, depth = gather(rgb, medium, o, d, MarchSettings(medium.step, dt_gamma=growth))
    wanted = [reference(*ray, stop) for *ray, stop in zip(o, d, far)]
    np.testing.assert_allclose(tau, [w[0] for w in wanted], rtol=tolerance)
    np.testing.assert_allclose(depth, [w[1] for w in wanted], rtol=tolerance)
    assert depth.max() > 2 * BOX.side


def test_depths_are_those_of_the_scene_wherever_it_is_placed(rgb):
    (o, d), field = rays(20), plain_field()
    _, tau, depth = gather(rgb, FieldMedium(field), o, d, MarchSettings(0.02, dt_gamma=GROWTH))
    m = turn(10.0)
    moved = FieldMedium(field, Similarity(m))
    assert np.isclose(moved.step, 0.2) and moved.growth == GROWTH
    at, along = o @ m[:3, :3].T + m[:3, 3], d @ m[:3, :3].T / 10
    _, tau_m, depth_m = gather(rgb, moved, at, along, MarchSettings(0.2, dt_gamma=GROWTH))
    np.testing.assert_allclose(tau_m, tau, rtol=1e-4)
    np.testing.assert_allclose(depth_m, 10 * depth, rtol=1e-4)


def test_empty_cells_are_passed_over_and_full_ones_are_not(rgb):
    """One shell of cells far out, all else empty: what is absorbed lies there."""
    r = 32
    bits = np.zeros((r, r, r), bool)
    bits[:, :, -3] = True
    cascades = contracted_cascades(bits, 64, ns, 0.01)
    near, far = (BOX.from_unit(ns.Array3f((r - k) / r, 0.5, 0.5)).x.numpy()[0] for k in (3, 2))
    o, d = np.array([[1.0, 0.1, 0.2]]), np.array([[1.0, 0.0, 0.0]])
    settings = MarchSettings(0.02, dt_gamma=GROWTH)
    _, tau, depth = gather(rgb, FieldMedium(plain_field(occupancy=cascades)), o, d, settings)
    # Along x from the centre: the integral of SCALE / (x / 2)² over the shell, and over what its cells of the cascades
    # are larger by.
    shell = SCALE * 4 * (1 / (near - 1) - 1 / (far - 1))
    assert shell * 0.95 < tau[0] < 1.6 * shell and near - 1 < depth[0] < 1.2 * far
    behind = gather(rgb, FieldMedium(plain_field(occupancy=cascades)), o, -d, settings)
    assert behind[1][0] == 0


def test_the_medium_of_a_bounded_field_does_not_grow(rgb):
    config = RadianceConfig(GRID, width=16, geometry=3, sh_degree=2)
    assert FieldMedium(RadianceField.random(config, BOX.core, ns, march_step=0.02)).growth == 0
