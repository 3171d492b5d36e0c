"""Voxels against NumPy in double precision, and compiled fields against the fields that they are made from."""

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.compilation import compile_density, occupancy_of_voxels
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.fields.voxels import BLOCK_EDGE, CELLS, VERTICES, VoxelArrays, VoxelGrid
from nerg_mi.formats.fields import load_radiance, save_radiance
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.transport.field_medium import FieldMedium, make_color_shader
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings, count_deferred
from tests.refusals import mentions

RESOLUTION = 24
BOX = Box((-1, -2, 0), (3, 2, 4))


def arrays(seed=0):
    """Random densities and masks in three blocks of a cube of 3 x 3 x 3 blocks."""
    rng = np.random.default_rng(seed)
    masks = np.packbits(rng.random((3, CELLS)) < 0.3, axis=1, bitorder="little").view("<u4")
    masks[1] = 0
    masks[1, 5] = 1 << 9  # A single cell
    return VoxelArrays(
        RESOLUTION, np.array([4, 13, 26], np.uint32), masks, rng.normal(size=(3, VERTICES)).astype(np.float16)
    )


def cells_with_matter(stored):
    """Bool array indexed [z, y, x], bit by bit."""
    n = stored.resolution // BLOCK_EDGE
    out = np.zeros((stored.resolution,) * 3, bool)
    for block, words in zip(stored.blocks.tolist(), stored.masks):
        z, y, x = np.unravel_index(block, (n, n, n))
        bits = np.array([words[c // 32] >> np.uint32(c % 32) & 1 for c in range(CELLS)], bool)
        first = BLOCK_EDGE * np.array([z, y, x])
        out[tuple(slice(a, a + BLOCK_EDGE) for a in first)] = bits.reshape((BLOCK_EDGE,) * 3)
    return out


def interpolate(stored, u):
    """Log densities (float64) at points of the unit cube that lie in stored blocks."""
    n, edge = stored.resolution // BLOCK_EDGE, BLOCK_EDGE + 1
    out = []
    for p in u * stored.resolution:
        cell = np.floor(p).astype(int)
        block = cell // BLOCK_EDGE
        index = np.flatnonzero(stored.blocks == block[0] + n * (block[1] + n * block[2]))[0]
        values = stored.log_density[index].astype(float).reshape(edge, edge, edge)
        (x, y, z), w = cell % BLOCK_EDGE, p - cell
        total = 0.0
        for k, j, i in np.ndindex(2, 2, 2):
            weight = (w[0] if i else 1 - w[0]) * (w[1] if j else 1 - w[1]) * (w[2] if k else 1 - w[2])
            total += weight * values[z + k, y + j, x + i]
        out.append(total)
    return np.array(out)


def points(stored, count=500, seed=1):
    """Points in cells with matter, and points anywhere."""
    rng = np.random.default_rng(seed)
    full = np.argwhere(cells_with_matter(stored))[:, ::-1]
    inside = (full[rng.integers(0, len(full), count)] + rng.uniform(0.01, 0.99, (count, 3))) / stored.resolution
    return inside, rng.uniform(0, 1, (count, 3))


def test_log_densities_are_trilinear():
    stored = arrays()
    grid = VoxelGrid(stored, ns)
    inside, anywhere = points(stored)
    value, matter = grid.evaluate(to_vector(ns.Array3f, inside))
    assert matter.numpy().all()
    np.testing.assert_allclose(value.numpy(), interpolate(stored, inside), atol=2e-5)
    cell = np.minimum((anywhere * RESOLUTION).astype(int), RESOLUTION - 1)
    expected = cells_with_matter(stored)[cell[:, 2], cell[:, 1], cell[:, 0]]
    assert np.array_equal(grid.evaluate(to_vector(ns.Array3f, anywhere))[1].numpy(), expected)
    assert 0 < expected.sum() < len(expected)
    # Beyond the cube, and on its faces, points belong to the nearest cell.
    assert grid.evaluate(ns.Array3f([1, 2, -1], [1, 2, -1], [1, 2, -1]))[1].numpy().shape == (3,)


def test_distances_are_lower_bounds_and_occupied_cells_are_exact():
    stored = arrays()
    grid, full = VoxelGrid(stored, ns), cells_with_matter(stored)
    z, y, x = np.indices(full.shape).reshape(3, -1)
    center = (np.stack([x, y, z], axis=1) + 0.5) / RESOLUTION
    distance = grid.distance_to_occupied(to_vector(ns.Array3f, center)).numpy().astype(int)
    occupied = np.argwhere(full)
    exact = np.array([np.abs(occupied - c).max(axis=1).min() for c in np.stack([z, y, x], axis=1)])
    assert np.array_equal(distance == 0, exact == 0) and np.all(distance <= exact)
    assert distance.max() > 4
    assert grid.occupied_fraction == full.mean()


def test_gradients_match_finite_differences():
    stored = arrays()
    grid, (inside, _) = VoxelGrid(stored, ns), points(stored, 50)
    u = to_vector(ns.Array3f, inside)
    dr.enable_grad(grid.log_density, u)
    value, _ = grid.evaluate(u)
    dr.backward(dr.sum(value))
    slope = np.array(dr.grad(u)).T if np.array(dr.grad(u)).shape[0] == 3 else np.array(dr.grad(u))
    h = 1e-6
    for axis in range(3):
        step = np.eye(3)[axis] * h
        expected = (interpolate(stored, inside + step) - interpolate(stored, inside - step)) / (2 * h)
        np.testing.assert_allclose(slope[:, axis], expected, rtol=2e-3, atol=2e-3)
    # The weights of the eight vertices of each point add up to 1.
    assert float(np.sum(dr.grad(grid.log_density).numpy(), dtype=np.float64)) == pytest.approx(len(inside), rel=2e-3)


@pytest.mark.parametrize(
    "change",
    [
        {"resolution": 25},
        {"resolution": 1 << 20},
        {"blocks": np.array([13, 4, 26], np.uint32)},
        {"blocks": np.array([4, 13, 27], np.uint32)},
        {"masks": np.zeros((2, 16), np.uint32)},
        {"log_density": np.full((3, VERTICES), np.nan, np.float16)},
    ],
)
def test_inconsistent_arrays_are_rejected(change):
    with pytest.raises(ValueError, match=r"voxels|blocks"):
        replace(arrays(), **change)


# ---- Compiled fields ----

CONFIG = RadianceConfig(
    HashGridConfig(levels=3, features=2, log2_rows=12, base=8, finest=16), width=16, color_hidden=1, geometry=4
)


def make_field(box=BOX, scale=1.0, offset=0.0, seed=0, occupancy=None, **kwargs):
    """A random field whose log density varies by several units; ``offset`` is added to it."""
    field = RadianceNetwork.random(
        replace(CONFIG, density_scale=float(np.exp(offset))), box, ns, seed, march_step=scale * 0.05, **kwargs
    )
    rng = np.random.default_rng(seed)
    table = field.parameters()["grid.table"]
    field.set_parameters({"grid.table": type(table)(rng.normal(size=len(table)).astype(np.float32))})
    field.occupancy = occupancy
    return field


def compiled(field, resolution):
    out = make_field(field.box)
    out.config = field.config
    out.set_parameters(field.parameters())
    out.march_step, out.occupancy = field.march_step, field.occupancy
    out.voxels = compile_density(field, resolution)
    return out


def sample_box(box, count=4000):
    return np.random.default_rng(3).uniform(box.lower, box.upper, (count, 3)).astype(np.float32)


def test_densities_converge_to_those_of_the_field():
    field, p = make_field(), to_vector(ns.Array3f, sample_box(BOX))
    expected, errors = field.density(p).numpy(), []
    for resolution in (32, 64, 128):
        grid = compile_density(field, resolution)
        value, matter = grid.evaluate(BOX.to_unit(p))
        assert matter.numpy()[expected * 0.05 > 2e-3].all()
        errors.append(np.median(np.abs(value.numpy() - np.log(expected / CONFIG.density_scale))))
    assert errors[2] < 0.6 * errors[1] < 0.36 * errors[0] and errors[2] < 0.05


def test_a_finer_search_starts_from_coarse_voxels():
    bits = np.zeros((8, 8, 8), bool)
    bits[2:4, 3:6, 1:3] = True
    field = make_field(occupancy=OccupancyGrid(bits, ns, 0.0))
    direct = compile_density(field, 64).to_arrays()
    started = compile_density(field, 64, compile_density(field, 32)).to_arrays()
    for name in ("blocks", "masks", "log_density"):
        assert np.array_equal(getattr(direct, name), getattr(started, name))
    # Cells outside the occupancy of the field have no matter.
    assert np.array_equal(cells_with_matter(direct), bits.repeat(8, 0).repeat(8, 1).repeat(8, 2))


def test_limits_are_checked():
    field = make_field()
    with pytest.raises(NergError, check=mentions("memory")):
        compile_density(field, 64, max_bytes=1e4)
    field.voxels = compile_density(field, 32)
    with pytest.raises(ValueError, match="compiled already"):
        compile_density(field, 32)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
@pytest.mark.parametrize("opaque", [False, True])
def test_depths_of_extreme_scenes(scale, opaque):
    """Scenes of a thousandth and of a hundred thousand units, of fog and of densities that are opaque over a cell."""
    box = Box(tuple(scale * np.array(BOX.lower)), tuple(scale * np.array(BOX.upper)))
    bits = np.zeros((16, 16, 16), bool)
    bits[:, :, 10:] = True
    field = make_field(box, scale, (20.0 if opaque else -1.0) - np.log(scale), occupancy=OccupancyGrid(bits, ns, 0.0))
    o = np.tile(scale * np.array([[-0.9, 0.1, 2.2]], np.float32), (64, 1))
    d = np.random.default_rng(0).normal((4, 0, 0), 0.7, (64, 3)).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    expected, opacity = trace_depth(FieldMedium(field), o, d, kind="expected")
    depth, compiled_opacity = trace_depth(FieldMedium(compiled(field, 128)), o, d, kind="expected")
    assert np.isfinite(depth).all() and opacity.mean() > (0.9 if opaque else 0.3)
    np.testing.assert_allclose(compiled_opacity, opacity, atol=0.03)
    np.testing.assert_allclose(depth, expected, atol=scale * 4 / 128)


def test_a_thin_sheet_is_found():
    """One layer of cells of the field's occupancy."""
    bits = np.zeros((32, 32, 32), bool)
    bits[:, :, 17] = True
    field = make_field(offset=8.0, occupancy=OccupancyGrid(bits, ns, 0.0))
    o, d = np.array([[-0.9, 0.1, 2.2]], np.float32), np.array([[1, 0, 0]], np.float32)
    for resolution in (32, 64, 256):
        depth, opacity = trace_depth(FieldMedium(compiled(field, resolution)), o, d, kind="median")
        assert opacity[0] > 0.99 and depth[0] == pytest.approx(17 / 32 * 4 - 0.1, abs=0.05)


def test_contracted_fields():
    box = ContractedBox(Box((-1, -1, -1), (1, 1, 1)), 16.0)
    bits = np.ones((5, 16, 16, 16), bool)
    bits[0, 4:12, 4:12, 4:12] = False
    field = make_field(box, march_growth=1 / 64, offset=1.0, occupancy=CascadeGrid(bits, 16.0, ns, 0.0))
    grid = compile_density(field, 128)
    p = to_vector(ns.Array3f, np.random.default_rng(0).uniform(-8, 8, (4000, 3)).astype(np.float32))
    expected = field.density(p).numpy()
    occupied = field.occupancy.distance_to_occupied(box.to_cube(p)).numpy() == 0
    field.voxels, cascades = grid, occupancy_of_voxels(field, grid)
    result = field.density(p).numpy()
    assert np.median(np.abs(np.log(result[occupied] / expected[occupied]))) < 0.05
    assert cascades is not None and np.all((result == 0) | (cascades.distance_to_occupied(box.to_cube(p)).numpy() == 0))


def test_files_and_updates(tmp_path):
    field = make_field()
    field.voxels = compile_density(field, 64)
    save_radiance(field, tmp_path / "a.safetensors", {})
    loaded, _ = load_radiance(tmp_path / "a.safetensors", ns)
    p = to_vector(ns.Array3f, sample_box(BOX))
    assert np.array_equal(loaded.density(p).numpy(), field.density(p).numpy())
    features = [f.numpy() for f in loaded.density_features(p)[1]]
    assert np.array_equal(features, [f.numpy() for f in field.density_features(p)[1]])
    loaded.set_parameters({"voxels.log_density": loaded.voxels.log_density})
    assert loaded.voxels is not None
    loaded.set_parameters({name: v for name, v in loaded.parameters().items() if name.startswith("density_net.")})
    assert loaded.voxels is None and not any("voxels" in name for name in loaded.parameters())


def test_a_scene_renders_differentiates_and_updates_compiled_fields(tmp_path):
    bits = np.zeros((16, 16, 16), bool)
    bits[4:12, 4:12, 4:12] = True
    field = make_field(offset=3.0, occupancy=OccupancyGrid(bits, ns, 0.0))
    save_radiance(field, tmp_path / "field.safetensors", {})
    field.voxels = compile_density(field, 128)
    save_radiance(field, tmp_path / "compiled.safetensors", {})

    def load(name):
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": {
                    "type": "nerg",
                    "field": {"type": "nerf", "filename": str(tmp_path / name)},
                    "aovs": "depth,opacity,color_evals,density_evals",
                },
                "sensor": {
                    "type": "perspective",
                    "fov": 60,
                    "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
                    "to_world": mi.ScalarTransform4f().look_at([-0.9, -1.9, 0.2], [1, 0, 2], [0, 0, 1]),
                },
            }
        )

    plain, scene = load("field.safetensors"), load("compiled.safetensors")
    expected, image = (np.array(mi.render(s, spp=1)) for s in (plain, scene))
    assert np.abs(image[..., :3] - expected[..., :3]).mean() < 0.01 and expected[..., 4].mean() > 0.2
    assert image[..., 5].mean() < expected[..., 5].mean()
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("voxels.log_density"))
    dr.enable_grad(params[key])
    dr.backward(dr.mean(mi.render(scene, params, spp=1)[..., 4].array))
    slope = dr.grad(params[key]).numpy().astype(float)
    assert np.isfinite(slope).all() and slope.max() > 0
    dr.disable_grad(params[key])
    params[key] = type(params[key])(np.full(len(params[key]), -20, np.float16))
    params.update()
    assert np.array(mi.render(scene, spp=1))[..., 4].max() < 1e-3
    # New weights of the density network are used in place of the voxels.
    weights = next(k for k in params.keys() if k.endswith("density_net.0"))
    params[weights] = 0.5 * params[weights]
    params.update()
    assert scene.integrator().medium.field.voxels is None


@pytest.mark.parametrize("rule", ["constant", "linear"])
@pytest.mark.parametrize("cutoff", [0.3, 0.1, 1e-3])
def test_shading_behind_the_march_changes_no_color(rule, cutoff):
    """A cut-off of 1e-3 allows more samples than are deferred, so that they are shaded in their steps."""
    bits = np.zeros((16, 16, 16), bool)
    bits[4:12, 4:12, 4:12] = True
    field = make_field(offset=2.0, occupancy=OccupancyGrid(bits, ns, 0.0))

    class Separate(FieldMedium):
        is_density_separate = True

    o = np.tile(np.array([[-0.9, 0.1, 2.2]], np.float32), (256, 1))
    d = np.random.default_rng(0).normal((4, 0, 0), 0.7, (256, 3)).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    colors, counts = [], []
    for medium in (FieldMedium(field), Separate(field)):
        ray = medium.ray_to_local(to_vector(mi.Point3f, o), to_vector(mi.Vector3f, d))
        settings = MarchSettings(step=0.05, color_cutoff=cutoff, quadrature=rule)
        shader = make_color_shader(medium, mi.Color3f)
        result = march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, True, settings, color=shader, count=True)
        colors.append(np.array(result.color))
        counts.append(result.color_evals.numpy())
    assert np.array_equal(*counts) and colors[0].max() > 0.2 and counts[0].max() > 1
    assert counts[0].max() <= (count_deferred(Separate(field), cutoff) or np.inf)
    assert [count_deferred(Separate(field), c) for c in (1, 0.3, 0.1, 0.099, 0)] == [0, 3, 9, 0, 0]
    np.testing.assert_allclose(colors[1], colors[0], atol=1e-6)
