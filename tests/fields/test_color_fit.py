"""Stored colours against NumPy in double precision, and against the networks that they are fitted to."""

import copy

import drjit as dr
import drjit.llvm.ad as ns
import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.environment.tensors import render_tensor
from nerg_mi.fields.color_fit import fit_colors
from nerg_mi.fields.compilation import attach_voxels, compile_density
from nerg_mi.fields.encoding import encode_direction
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.fields.voxels import COLOR_NUMBERS, VoxelColors, VoxelGrid
from nerg_mi.formats.fields import load_radiance, save_radiance
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.train.compile import _compute_psnr, _make_rays, _render, compile_field
from tests.fields.test_voxels import arrays, make_field, points
from tests.plugins.fields import radiance
from tests.recorder import Recorder

EDGE = 4


def random_colors(edge=EDGE, blocks=3, harmonics=9):
    rng = np.random.default_rng(5)
    numbers = rng.integers(0, 256, (blocks, (edge + 1) ** 3, COLOR_NUMBERS), np.uint8)
    basis = rng.normal(0, 1e-3, (3 * COLOR_NUMBERS + 3, harmonics)).astype(np.float32)
    basis[-3:, 0] += 1.5
    return numbers, basis


def test_colors_are_trilinear_and_linear_in_harmonics():
    stored, (numbers, basis) = arrays(), random_colors()
    grid = VoxelGrid(stored, ns, VoxelColors(EDGE, numbers, basis, ns))
    inside, anywhere = points(stored)
    d = np.random.default_rng(2).normal(size=inside.shape)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    v = to_vector(ns.Array3f, d)
    q = grid.color_numbers(to_vector(ns.Array3f, inside))
    result = np.stack([c.numpy() for c in grid.colors.decode(q, ns.Float(1), v)], axis=1)
    n = stored.resolution // 8
    expected = np.empty((len(inside), COLOR_NUMBERS))
    for row, p in enumerate(inside * n):
        block = p.astype(int)
        x = (p - block) * EDGE
        cell = np.minimum(x.astype(int), EDGE - 1)
        lattice = numbers[np.flatnonzero(stored.blocks == block @ [1, n, n * n])[0]].reshape((EDGE + 1,) * 3 + (-1,))
        corners = lattice[cell[2] : cell[2] + 2, cell[1] : cell[1] + 2, cell[0] : cell[0] + 2].astype(float)
        for w in (x - cell)[::-1]:
            corners = (1 - w) * corners[0] + w * corners[1]
        expected[row] = corners
    np.testing.assert_allclose(np.stack([c.numpy() for c in q], axis=1), expected, atol=2e-3)
    y = np.stack([np.broadcast_to(c.numpy(), len(d)) for c in encode_direction(v, 3)], axis=1)
    matrix = basis.astype(float).reshape(COLOR_NUMBERS + 1, 3, 9)
    color = np.einsum("kch,nh,nk->nc", matrix, y, np.c_[expected, np.ones(len(d))])
    np.testing.assert_allclose(result, np.clip(color, 0, 1), atol=1e-4)
    assert 0.1 < np.mean((color > 0) & (color < 1))
    # Blocks without matter have no colours.
    empty = ~np.isin((anywhere * n).astype(int) @ [1, n, n * n], stored.blocks)
    outside = np.stack([c.numpy() for c in grid.color_numbers(to_vector(ns.Array3f, anywhere))])
    assert empty.any() and not outside[:, empty].any() and outside[:, ~empty].any()


@pytest.mark.parametrize(
    "change",
    [
        lambda edge, numbers, basis: (3, numbers, basis),
        lambda edge, numbers, basis: (edge, numbers[:, 1:], basis),
        lambda edge, numbers, basis: (edge, numbers.astype(np.float32), basis),
        lambda edge, numbers, basis: (edge, numbers, basis[:, :8]),
        lambda edge, numbers, basis: (edge, numbers, basis * np.float32(np.nan)),
        lambda edge, numbers, basis: (edge, numbers[:2], basis),
    ],
)
def test_inconsistent_colors_are_rejected(change):
    with pytest.raises(ValueError, match=r"colours"):
        VoxelGrid(arrays(), ns, VoxelColors(*change(EDGE, *random_colors()), ns))


def block_field(**kwargs):
    bits = np.zeros((16, 16, 16), bool)
    bits[4:12, 4:12, 4:12] = True
    return make_field(offset=4.0, occupancy=OccupancyGrid(bits, ns, 0.0), **kwargs)


def with_colors(field, edge, resolution=32):
    out = attach_voxels(field, compile_density(field, resolution))
    out.voxels.colors = fit_colors(out, edge)
    return out


def test_fitted_colors_converge_and_depend_on_the_direction():
    field = block_field()
    compiled = attach_voxels(field, compile_density(field, 32))
    rays, psnr = _make_rays(compiled), []
    reference = _render(compiled, rays)[0]
    for edge in (2, 4, 8):
        stored = copy.copy(compiled)
        stored.voxels = copy.copy(compiled.voxels)
        stored.voxels.colors = fit_colors(stored, edge)
        psnr.append(_compute_psnr(reference, _render(stored, rays)[0]))
        assert np.array_equal(_render(stored, rays)[0][:, 3:], reference[:, 3:])
    assert psnr[0] < psnr[1] < psnr[2] and psnr[2] > 38
    # Without the part that depends on the direction the error is larger.
    basis = stored.voxels.colors.net.weights[0].numpy().copy()
    basis[:, 1:] = 0
    stored.voxels.replace("color_basis", ns.TensorXf(basis))
    assert _compute_psnr(reference, _render(stored, rays)[0]) < psnr[2] - 3


@pytest.mark.parametrize("kind", ["deferred", "contracted"])
def test_colors_of_other_fields(kind, tmp_path):
    """Of deferred shading, whose network adds to the logits of a diffuse colour, and of an unbounded scene."""
    if kind == "deferred":
        field = radiance(tmp_path / "f.safetensors", density_scale=20.0, deferred=True)
    else:
        box = ContractedBox(Box((-1, -1, -1), (1, 1, 1)), 16.0)
        bits = np.ones((5, 16, 16, 16), bool)
        bits[0, 4:12, 4:12, 4:12] = False
        field = make_field(box, march_growth=1 / 64, offset=3.0, occupancy=CascadeGrid(bits, 16.0, ns, 0.0))
    compiled = attach_voxels(field, compile_density(field, 64))
    rays = _make_rays(compiled)
    reference = _render(compiled, rays)[0]
    compiled.voxels.colors = fit_colors(compiled, 4)
    stored = _render(compiled, rays)[0]
    # Of one colour for all rays, the error is the standard deviation.
    assert _compute_psnr(reference, stored) > 6 - 20 * np.log10(reference[:, :3].std(axis=0).mean())
    assert not np.array_equal(reference[:, :3], stored[:, :3])


def test_scenes_read_differentiate_and_discard_colors(tmp_path):
    field = with_colors(block_field(), 4)
    save_radiance(field, tmp_path / "a.safetensors", {})
    loaded, _ = load_radiance(tmp_path / "a.safetensors", ns)
    assert np.array_equal(loaded.voxels.colors.numbers, field.voxels.colors.numbers)

    def load(**kwargs):
        volume = {"type": "nerf", "filename": str(tmp_path / "a.safetensors")}
        look = mi.ScalarTransform4f().look_at([-0.9, -1.9, 0.2], [1, 0, 2], [0, 0, 1])
        film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
        sensor = {"type": "perspective", "fov": 60, "film": film, "to_world": look}
        return mi.load_dict({"type": "scene", "integrator": {"type": "nerg", "field": volume, **kwargs}, "s": sensor})

    scene = load(color_cutoff=0)
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("color_basis"))
    image = np.array(mi.render(scene, params, spp=1))
    # A scene that shows features composites them, with the same colours.
    features = np.array(mi.render(load(color_cutoff=0, aovs="features"), spp=1))
    np.testing.assert_allclose(features[..., :3], image[..., :3], atol=2e-3)
    assert image.std() > 0.02
    rng, basis = np.random.default_rng(0), params[key].numpy().copy()
    direction = (rng.normal(size=basis.shape) * np.abs(basis)).astype(np.float32)

    def evaluate(scale):
        params[key] = mi.TensorXf(basis + np.float32(scale) * direction)
        params.update()
        return float(np.mean(np.array(mi.render(scene, params, spp=64), np.float64)))

    # Derivatives are rendered with other samples.
    expected = (evaluate(0.01) - evaluate(-0.01)) / 0.02
    # Replayed images use the current functions of the direction.
    for scale in (0.01, 0.02, 0.03, 0.04):
        mean = evaluate(scale)
        assert np.mean(render_tensor(scene, spp=64).numpy(), dtype=np.float64) == pytest.approx(mean, rel=1e-6)
    params[key] = mi.TensorXf(basis)
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.mean(mi.render(scene, params, spp=64).array))
    assert float(np.sum(dr.grad(params[key]).numpy() * direction)) == pytest.approx(expected, rel=0.03)
    dr.disable_grad(params[key])
    # New weights of the colour network are used in place of the stored colours.
    weights = next(k for k in params.keys() if k.endswith("color_net.0"))
    params[weights] = 0.5 * params[weights]
    params.update()
    assert scene.integrator().medium.field.voxels is None


def test_networks_are_kept_where_colors_are_not_accurate_or_too_large(tmp_path):
    radiance(tmp_path / "f.safetensors", density_scale=5.0)
    recorder = Recorder()

    def compile_colors(memory, min_psnr=20.0):
        return compile_field(
            tmp_path / "f.safetensors", resolution=96, color=True, min_psnr=min_psnr, memory=memory, progress=recorder
        )

    plain = compile_field(tmp_path / "f.safetensors", resolution=96)
    size = plain.provenance["compiled"]["size"] / 1e6
    large = compile_colors(1.05 * size)
    assert large.network.voxels.colors is None and "memory" in recorder.warnings[-1]
    accurate = compile_colors(1.2 * size, 100)
    assert accurate.network.voxels.colors is None and "stored_color" not in accurate.provenance
    assert "min_psnr" in recorder.warnings[-1] and "networks" in recorder.warnings[-1]
    count = len(recorder.warnings)
    stored = compile_colors(1.2 * size)
    facts, colors = stored.provenance["stored_color"], stored.network.voxels.colors
    assert facts["resolution"] == 96 * colors.edge // 8 and colors.size == facts["size"] <= 0.2 * size * 1e6
    assert len(recorder.warnings) == count and f"{facts['psnr']:.1f} dB" in recorder.messages[-1]
    stored.save(tmp_path / "g.safetensors")
    assert load_radiance(tmp_path / "g.safetensors", ns)[0].voxels.colors.edge == colors.edge
