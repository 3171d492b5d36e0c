"""Media: the protocol, radiance fields, volumes, empty cells, and features."""

import inspect
from dataclasses import replace
from types import FunctionType

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import OccupancyGrid, cascades_from_contracted
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork, mean_features
from nerg_mi.maths.geometry import Box, ContractedBox, Similarity
from nerg_mi.transport.field_medium import FeatureShader, FieldMedium, features_for_observer, make_color_shader
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import MAX_DENSITY, ColorShader, LocalRay, Medium, bound, clamp_density
from nerg_mi.transport.volume_medium import FrozenBound, VolumeMedium
from tests.maths.test_geometry import turn
from tests.transport.test_splat_medium import medium_of, stack

# ---- Cells ----
#
# The occupancy bound of a grid volume: its interpolant is zero in all empty cells.


@pytest.mark.parametrize("filter_type", ["nearest", "trilinear"])
@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("voxel", [(0, 3, 3), (7, 3, 3), (3, 0, 7), (4, 4, 4)])
def test_empty_cells_contain_no_density(rgb, wrap_mode, filter_type, voxel):
    """Also for a repeating grid, which shows its first voxel at its far side."""
    data = np.zeros((8, 8, 8), np.float32)
    data[voxel] = 1
    volume = rgb.load_dict(
        {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "wrap_mode": wrap_mode, "filter_type": filter_type}
    )
    cells = bound(data, ns)
    it = dr.zeros(rgb.Interaction3f)
    it.p = rgb.Point3f(np.random.default_rng(0).random((3, 100_000)).astype(np.float32))
    matter, away = volume.eval_1(it).numpy() > 0, cells.distance_to_occupied(it.p).numpy()
    assert matter.any() and not away[matter].any()
    # The bound holds for all wrap modes and still leaves most of the box empty.
    assert (away > 0).mean() > 0.8


@pytest.mark.parametrize("data", [np.ones((4, 4, 4)), np.pad([[[1.0]]], 1)])
def test_no_bound_without_empty_cells(data):
    assert bound(data, ns) is None


# ---- Sample shaders: the colour of the medium in the requested array type ----


@pytest.mark.parametrize("kind", ["Color3f", "Spectrum", "Vector3f"])
def test01_color_shader(rgb, kind):
    array_type = getattr(rgb, kind)
    data = np.broadcast_to(np.float32([0.2, 0.5, 0.8]), (2, 2, 2, 3)).copy()
    color = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True})
    medium, painter = (
        VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0}), color),
        ColorShader(array_type),
    )
    p, w = rgb.Point3f(0.5, 0.5, 0.5), rgb.Vector3f(0, 0, 1)
    result = painter.shade(medium, [], p, w, rgb.Bool(True))
    assert type(result) is type(painter.zero()) is array_type
    assert np.allclose(np.array(result).ravel(), [0.2, 0.5, 0.8], atol=1e-6)
    assert not np.array(painter.zero()).any()
    assert painter.resolve_color(medium, result, rgb.Float(0.5), medium.ray_to_local(p, w), rgb.Bool(True)) is result


# ---- All media implement the protocol, with valid densities ----

PROTOCOL = {name: what for name, what in vars(Medium).items() if isinstance(what, (FunctionType, property))}
PROTOCOL = {name: what for name, what in PROTOCOL.items() if not name.startswith("_")}


def media(mi):
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2), np.float32))}
    fog = {"type": "constvolume", "value": 2.0}
    return [
        FieldMedium(field()),
        VolumeMedium(mi.load_dict(fog)),
        VolumeMedium(mi.load_dict(grid), mi.load_dict(fog)),
        medium_of(stack([0.2, 0.8], [0.5, 0.5], scale=0.25)),
    ]


def test01_media_implement_the_protocol(rgb):
    assert len(PROTOCOL) > 15
    for medium in media(rgb):
        for name, what in PROTOCOL.items():
            result = getattr(medium, name)
            if isinstance(what, property):
                assert not callable(result), name
            else:
                wanted = list(inspect.signature(what).parameters)[1:]
                assert list(inspect.signature(result).parameters) == wanted, (type(medium), name)


def test02_media_return_consistent_values(rgb):
    for medium in media(rgb):
        assert medium.color_space in ("srgb", "linear", "spectrum") and medium.length_scale > 0
        assert medium.default_step is None or 0 < medium.default_step < medium.length_scale
        lower, upper = medium.bounds()
        assert lower.shape == upper.shape == (3,) and (upper > lower).all()
        o, d = rgb.Point3f(0.4, 0.6, -1), rgb.Vector3f(0, 0, 1)
        ray = medium.ray_to_local(o, d)
        assert isinstance(ray, LocalRay) and 0 < ray.t_near[0] < ray.t_far[0] < 10
        assert medium.refresh() is None and medium.parameters()
        if medium.hits is not None:
            continue
        p = medium.to_local(rgb.Point3f(0.4, 0.6, 0.5))
        sigma, features = medium.density_features(p, True)
        assert sigma[0] == medium.density(p, True)[0] > 0 and len(features) == medium.feature_count
        if medium.has_color:
            color = np.array(medium.color(features, p, ray.w, True)).ravel()
            assert color.shape == (3,) and (color >= 0).all()


@pytest.mark.parametrize("wrong, right", [(-1, 0), (np.nan, 0), (np.inf, MAX_DENSITY), (3e38, MAX_DENSITY), (2.5, 2.5)])
def test03_densities_are_finite_and_not_negative(wrong, right):
    assert clamp_density(ns.Float(wrong))[0] == np.float32(right)


# ---- A radiance field in the scene: scale, rotation, and its bounds ----

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = Box((0, 0, 0), (1, 1, 2))


def field(**kwargs):
    f = RadianceNetwork.random(
        RadianceConfig(GRID, width=16, geometry=3, sh_degree=2), BOX, ns, march_step=0.05, **kwargs
    )
    f.set_parameters(
        {"grid.table": ns.Float(np.random.default_rng(0).normal(size=len(f.grid.table)).astype(np.float32))}
    )
    return f


def gather(mi, medium, o, d, scale):
    ray = medium.ray_to_local(mi.Point3f(o.tolist()), mi.Vector3f(d.tolist()))
    t0 = dr.maximum(ray.t_near, 0)
    result = march(medium, ray, t0, ray.t_far, True, MarchSettings(0.05 * scale), color=ColorShader(mi.Color3f))
    return result.opacity.numpy()[0], result.expected_depth.numpy()[0], np.array(result.color).ravel()


def test01_scaling_scene_and_camera_keeps_opacity(rgb):
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
        # The direction of view-dependent colour rotates with the field.
        assert np.allclose(got[2], plain[2], rtol=1e-3)
        assert np.isclose(moved.default_step, 0.05 * scale) and np.isclose(moved.length_scale, 6**0.5 * scale)


def test02_bounding_box_in_the_scene(rgb):
    m = turn(2.0)
    medium = FieldMedium(field(), Similarity(m))
    corners = np.array([m[:3] @ [x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 2)])
    lower, upper = medium.bounds()
    assert np.allclose(lower, corners.min(0)) and np.allclose(upper, corners.max(0))
    # The unit cube of the occupancy grid contains the field's box: its longest edge spans it.
    p = rgb.Point3f(*map(float, (m @ [0.25, 0.5, 2, 1])[:3]))
    assert np.allclose(np.array(medium.to_unit(medium.to_local(p))).ravel(), [0.375, 0.5, 1], atol=1e-6)
    v = medium.vector_to_unit(rgb.Vector3f(0, 0, 1))
    assert np.allclose(np.array(v).ravel(), [0, 0, 0.5])


@pytest.mark.parametrize("scale", [0.5, 4.0])
def test03_density_is_per_scene_unit(rgb, scale):
    f = field()
    medium = FieldMedium(f, Similarity(np.diag([scale, scale, scale, 1])))
    p = ns.Array3f([0.2, 0.7], [0.3, 0.1], [0.4, 1.9])
    sigma, features = medium.density_features(p, True)
    assert np.allclose(sigma.numpy(), f.density(p).numpy() / scale, rtol=1e-6)
    assert np.array_equal(sigma.numpy(), medium.density(p, True).numpy())
    assert len(features) == medium.feature_count == 3


def test04_density_in_occupied_cells(rgb):
    bits = np.zeros((4, 4, 4), bool)
    bits[0, 0, 0] = True
    medium = FieldMedium(field(occupancy=OccupancyGrid(bits, ns, 0.01)))
    # The longest edge of the box, two units, spans the four cells; the others are centred.
    p = ns.Array3f([0.1, 0.1, 0.9], [0.1, 0.1, 0.9], [0.1, 1.9, 1.0])
    result, inside = medium.density_in_occupied_cells(p, True).numpy(), medium.density(p, True).numpy()
    occupied = medium.occupancy.distance_to_occupied(medium.to_unit(p)).numpy() == 0
    assert (inside > 0).all() and np.array_equal(result, np.where(occupied, inside, 0))


def test05_weights_are_read_on_each_evaluation(rgb):
    f = field()
    medium, p = FieldMedium(f), ns.Array3f(0.4, 0.3, 1.2)
    before = medium.density(p, True).numpy()
    f.set_parameters({"grid.table": dr.full(ns.Float, 0.5, len(f.grid.table))})
    medium.refresh()
    assert not np.allclose(medium.density(p, True).numpy(), before)


# ---- An unbounded field: rays through contracted space against float64 integrals ----

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
ENDLESS = ContractedBox(Box((-1, -2, -2), (3, 2, 2)), 64)
GROWTH = 1 / 128
SCALE = 0.1


def plain_field(**kwargs):
    """A field whose density net returns 0: σ = SCALE / m², m the maximum norm in half edges (2 units) from (1, 0, 0),
    at least 1."""
    config = RadianceConfig(GRID, width=16, geometry=3, sh_degree=2, density_scale=SCALE)
    field = RadianceNetwork.random(config, ENDLESS, ns, march_step=0.02, march_growth=GROWTH, **kwargs)
    field.set_parameters({k: dr.zeros(type(v), v.shape) for k, v in field.parameters().items() if "density" in k})
    return field


def by_sums(o, d, stop, count=100_000):
    """Optical depth and mean distance of absorption up to the distance ``stop``, by float64 sums."""
    edges = np.concatenate([[0], np.geomspace(1e-3, stop, count)])
    t = 0.5 * (edges[1:] + edges[:-1])
    m = np.maximum(np.abs((o + t[:, None] * d - ENDLESS.center) / 2).max(axis=1), 1)
    tau = np.concatenate([[0], np.cumsum(SCALE / m**2 * np.diff(edges))])
    weight = np.exp(-tau[:-1]) - np.exp(-tau[1:])
    return tau[-1], float(weight @ t / weight.sum())


def rays(count=24):
    rng = np.random.default_rng(3)
    d = rng.normal(size=(count, 3))
    return ENDLESS.center + rng.uniform(-3, 3, (count, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


def absorbed(mi, medium, o, d, settings):
    ray = medium.ray_to_local(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    result = march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, settings)
    return ray.t_far.numpy(), result.tau.numpy(), result.expected_depth.numpy()


# Steps of a fraction γ of their distance use the density at their middle: an error of order γ², plus the rounding of
# single precision over hundreds of steps.
@pytest.mark.parametrize("growth, tolerance", [(1 / 16, 2e-3), (1 / 128, 5e-5)])
def test_rays_through_the_contracted_part(rgb, growth, tolerance):
    medium, (o, d) = FieldMedium(plain_field()), rays()
    far, tau, depth = absorbed(rgb, medium, o, d, MarchSettings(medium.default_step, dt_gamma=growth))
    wanted = [by_sums(*ray, stop) for *ray, stop in zip(o, d, far)]
    np.testing.assert_allclose(tau, [w[0] for w in wanted], rtol=tolerance)
    np.testing.assert_allclose(depth, [w[1] for w in wanted], rtol=tolerance)
    assert depth.max() > 2 * ENDLESS.side


def test_contracted_depths_are_in_scene_units(rgb):
    (o, d), field = rays(20), plain_field()
    _, tau, depth = absorbed(rgb, FieldMedium(field), o, d, MarchSettings(0.02, dt_gamma=GROWTH))
    m = turn(10.0)
    moved = FieldMedium(field, Similarity(m))
    assert np.isclose(moved.default_step, 0.2) and moved.default_dt_gamma == GROWTH
    at, along = o @ m[:3, :3].T + m[:3, 3], d @ m[:3, :3].T / 10
    _, tau_m, depth_m = absorbed(rgb, moved, at, along, MarchSettings(0.2, dt_gamma=GROWTH))
    np.testing.assert_allclose(tau_m, tau, rtol=1e-4)
    np.testing.assert_allclose(depth_m, 10 * depth, rtol=1e-4)


def test_contracted_empty_cells_are_skipped(rgb):
    """One shell of distant cells, all others empty: absorption lies there."""
    r = 32
    bits = np.zeros((r, r, r), bool)
    bits[:, :, -3] = True
    cascades = cascades_from_contracted(bits, 64, ns, 0.01)
    near, far = (ENDLESS.from_unit(ns.Array3f((r - k) / r, 0.5, 0.5)).x.numpy()[0] for k in (3, 2))
    o, d = np.array([[1.0, 0.1, 0.2]]), np.array([[1.0, 0.0, 0.0]])
    settings = MarchSettings(0.02, dt_gamma=GROWTH)
    _, tau, depth = absorbed(rgb, FieldMedium(plain_field(occupancy=cascades)), o, d, settings)
    # Along x from the centre: the integral of SCALE / (x / 2)² over the shell, and over the larger cells of the
    # cascades.
    shell = SCALE * 4 * (1 / (near - 1) - 1 / (far - 1))
    assert shell * 0.95 < tau[0] < 1.6 * shell and near - 1 < depth[0] < 1.2 * far
    behind = absorbed(rgb, FieldMedium(plain_field(occupancy=cascades)), o, -d, settings)
    assert behind[1][0] == 0


def test_bounded_field_has_uniform_steps(rgb):
    config = RadianceConfig(GRID, width=16, geometry=3, sh_degree=2)
    assert FieldMedium(RadianceNetwork.random(config, ENDLESS.core, ns, march_step=0.02)).default_dt_gamma == 0


# ---- Mitsuba volumes as media: errors, skipped cells, and changes of their data ----


def test01_volume_without_extent_is_refused(rgb):
    class Endless(rgb.Volume):
        def __init__(self, lower, upper):
            super().__init__(rgb.Properties())
            self.box = rgb.ScalarBoundingBox3f(lower, upper)

        def bbox(self):
            return self.box

    for lower, upper in (([-np.inf] * 3, [np.inf] * 3), ([0, 0, 0], [1, 1, 0])):
        with pytest.raises(ValueError, match='"density".*to_world'):
            VolumeMedium(Endless(lower, upper))


def test02_volume_values(rgb):
    density = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.array([[[-3.0, 5.0]]], np.float32))})
    medium = VolumeMedium(density)
    p = rgb.Point3f([0.1, 0.9], 0.5, 0.5)
    # Negative density would create light.
    assert np.allclose(medium.density(p, True).numpy(), [0, 5]) and not medium.has_color and medium.occupancy is None
    assert np.isclose(medium.length_scale, 3**0.5)
    ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, -2), rgb.Vector3f(0, 0, 1))
    assert (ray.t_near.numpy()[0], ray.t_far.numpy()[0]) == (2, 3)


def corner(n=8):
    """Density in one voxel only."""
    data = np.zeros((n, n, n), np.float32)
    data[0, 0, 0] = 2
    return data


def grid_of(mi, data):
    return mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(data)})


def test03_grid_is_skipped_and_its_default_step_fits_its_voxels(rgb):
    medium = VolumeMedium(grid_of(rgb, corner()))
    assert medium.occupancy is not None and medium.occupancy.occupied_fraction < 0.1
    assert medium.default_step == pytest.approx(min(3**0.5 / 1024, 0.5 / 8)) and medium.cells.min_edge == pytest.approx(
        1 / 8
    )
    assert VolumeMedium(grid_of(rgb, np.ones((200, 2, 2), np.float32))).default_step == pytest.approx(3**0.5 / 1024)
    fog = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0}))
    assert fog.occupancy is None and fog.cells is None and fog.default_step is None


def test04_no_skipping_with_gradients(rgb):
    volume = grid_of(rgb, corner())
    medium, params = VolumeMedium(volume), rgb.traverse(volume)
    dr.enable_grad(params["data"])
    params.update()
    medium.refresh()
    assert medium.occupancy is None
    params["data"] = dr.detach(params["data"])
    params.update()
    medium.refresh()
    assert medium.occupancy is not None


def test05_refresh_reads_changed_voxels_only(rgb, monkeypatch):
    from nerg_mi.transport import volume_medium as module

    volume, read = grid_of(rgb, corner()), []
    read_grid_volume = module.read_grid_volume
    monkeypatch.setattr(module, "read_grid_volume", lambda v: read.append(1) or read_grid_volume(v))
    medium, params = VolumeMedium(volume), rgb.traverse(volume)
    first = medium.occupancy
    medium.refresh()
    assert len(read) == 1 and medium.occupancy is first
    medium.refresh(force=True)
    assert len(read) == 2
    moved = np.ascontiguousarray(corner()[::-1, ::-1, ::-1])
    params["data"] = rgb.TensorXf(moved[..., None])
    params.update()
    medium.refresh()
    far = rgb.Point3f(0.97, 0.97, 0.97)
    assert len(read) == 3
    assert medium.density(far, True).numpy()[0] > 0 and medium.occupancy.distance_to_occupied(far).numpy()[0] == 0


def test06_non_finite_voxels_are_refused(rgb):
    data = np.ones((3, 3, 3), np.float32)
    data[2, 0, 1] = np.nan
    with pytest.raises(NergError, match=r"1 values that are not finite.*\(2, 0, 1\)"):
        VolumeMedium(grid_of(rgb, data))
    with pytest.raises(NergError, match="2 channels"):
        VolumeMedium(grid_of(rgb, np.ones((3, 2, 4, 2), np.float32)))


def test07_volume_uses_scene_coordinates(rgb):
    to_world = rgb.ScalarTransform4f().translate([1, 2, 3]).scale([1, 2, 4])
    medium = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0, "to_world": to_world}))
    lower, upper = medium.bounds()
    assert lower.tolist() == [1, 2, 3] and upper.tolist() == [2, 4, 7]
    p = rgb.Point3f(1.5, 3, 4)
    assert medium.to_local(p) is p
    assert np.allclose(np.array(medium.to_unit(p)).ravel(), [0.5, 0.5, 0.25])
    assert np.allclose(np.array(medium.vector_to_unit(rgb.Vector3f(1, 1, 1))).ravel(), [1, 0.5, 0.25])


def test08_frozen_bound_can_be_replaced(rgb):
    """Like a frozen function, which replaces variables by its arguments."""
    medium = VolumeMedium(grid_of(rgb, corner()))
    expected = FrozenBound(medium)
    selected, expected.bound = expected.bound, None
    assert selected is not None and medium.occupancy is None
    expected.bound = selected
    assert medium.occupancy is selected


# ---- Features for a gaze field: at a point, or composited along a ray ----

O, D = np.array([0.1, -0.2, -3.0]), np.array([0.0, 0.1, 1.0]) / np.hypot(0.1, 1)


@pytest.fixture
def place(rgb):
    """A field of the cube [-1, 1]³, at twice the size."""
    config = RadianceConfig(HashGridConfig(levels=2, log2_rows=10, base=4, finest=8), width=16, geometry=3, sh_degree=2)
    field, rng = RadianceNetwork.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 0), np.random.default_rng(0)
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    return SceneGeometry(FieldMedium(field, Similarity(np.diag([2.0, 2, 2, 1])))), field


def evaluate_medium(rgb, place, kind, p, active=True):
    vector = lambda make, v: make(*map(float, v))
    settings = MarchSettings(1 / 128, stop=0.0, color_cutoff=1e-2)
    result = features_for_observer(
        kind, place, vector(rgb.Point3f, p), vector(rgb.Point3f, O), vector(rgb.Vector3f, D), rgb.Bool(active), settings
    )
    return None if result is None else np.array([f[0] for f in result])


def features(field, p):
    """Density and features of scene points (N, 3); the scene's unit is half of the field's."""
    sigma, f = field.density_features(ns.Array3f(np.ascontiguousarray((p / 2).T, np.float32)))
    return sigma.numpy() / 2, np.stack([x.numpy() for x in f], axis=1)


def test_features_at_a_point(rgb, place):
    place, field = place
    p = np.array([0.3, 0.5, 0.2])
    assert np.allclose(evaluate_medium(rgb, place, "snapshot", p), features(field, p[None])[1][0], atol=1e-5)
    assert (
        not evaluate_medium(rgb, place, "snapshot", p, active=False).any()
        and evaluate_medium(rgb, place, "", p) is None
    )


def test_composited_features(rgb, place):
    place, field = place
    t = np.linspace(0, 6, 6001)
    p = O + D * (0.5 * (t[:-1] + t[1:]))[:, None]
    sigma, f = features(field, p)
    tau = sigma * np.diff(t) * (np.abs(p).max(axis=1) < 2)
    weight = np.exp(-(np.cumsum(tau) - tau)) * -np.expm1(-tau)
    result = evaluate_medium(rgb, place, "accumulated", (0.3, 0.5, 0.2))
    assert result.shape == (3,) and np.allclose(result, weight @ f, atol=5e-3 * np.abs(f).max())
    assert not evaluate_medium(rgb, place, "accumulated", (0.3, 0.5, 0.2), active=False).any()
    assert np.abs(result - evaluate_medium(rgb, place, "snapshot", (0.3, 0.5, 0.2))).max() > 0.01


def test_deferred_color_uses_composited_features(rgb, place):
    """With features or without; those of another medium from its samples."""
    kinds = []
    for deferred in (False, True):
        field = place[1]
        config = replace(field.config, deferred=deferred)
        medium = FieldMedium(RadianceNetwork(config, field.box, field.grid, field.density_net, field.color_net))
        ray = medium.ray_to_local(rgb.Point3f(0.1, -0.2, -3), rgb.Vector3f(*map(float, D)))
        one, both = make_color_shader(medium, rgb.Color3f), make_color_shader(medium, rgb.Color3f, with_features=True)
        kinds.append(type(one))
        result = []
        for painter in (one, both):
            r = march(medium, ray, ray.t_near, ray.t_far, True, MarchSettings(1 / 64, color_cutoff=0.0), color=painter)
            result.append(np.array(painter.resolve_color(medium, r.color, r.opacity, ray, rgb.Bool(True))).ravel())
            hidden = painter.resolve_color(medium, r.color, r.opacity, ray, rgb.Bool(False))
            assert not deferred or not np.array(hidden).any()
        sums = both.features(r.color)
        assert len(sums) == 3 and np.allclose(result[0], result[1], atol=1e-6) and result[0].max() > 0.01
        if deferred:
            means = mean_features(sums, r.opacity)
            want = np.array(r.opacity * medium.field.color(means, ray.w)).ravel()
            assert np.allclose(result[0], want, atol=1e-6)
    assert kinds == [ColorShader, FeatureShader]
    assert FeatureShader(medium).resolve_color(medium, r.color, r.opacity, ray, True) is None
