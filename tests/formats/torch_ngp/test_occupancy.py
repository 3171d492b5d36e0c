"""torch-ngp's bits of occupancy, in Morton order, against a restatement of its kernels, and back again."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.formats.torch_ngp import bitfield, morton_order, read_torch_ngp
from tests.formats.torch_ngp.test_fields import save
from tests.reference import torch_ngp_numpy as reference

pytestmark = pytest.mark.usefixtures("torch")


@pytest.mark.parametrize("bound", [1, 2, 5, 2.7])
def test_marching_sees_the_kernels_bits(tmp_path, bound):
    rng = np.random.default_rng(4)
    state = reference.nerf_state(bound, rng, filled=0.02)
    field, _ = read_torch_ngp(save(tmp_path / "ngp.pth", state), ns)
    p = rng.uniform(-bound, bound, (20000, 3)).astype(np.float32)
    k = field.occupancy.empty_cells(field.box.to_unit(ns.Array3f(p.T))).numpy()
    # Points within rounding of a cell's face may fall on either side of it: 128 is the finest, 0.5 b the largest cell.
    cells = (p[:, :, None] / np.minimum(2.0 ** np.arange(4), bound) + 1) * 64
    clear = np.abs(cells - np.round(cells)).min((1, 2)) > 1e-4
    assert clear.mean() > 0.95
    assert np.array_equal((k == 0)[clear], reference.occupied(state["density_bitfield"], bound, p)[clear])
    assert np.isclose(field.occupancy.fraction, 0.02, rtol=0.05)


@pytest.mark.parametrize("bound", [2, 5])
def test_what_may_be_leapt_over_is_empty(tmp_path, bound):
    # Cells less than k away, of the grid that marching sees, hold nothing.
    rng = np.random.default_rng(5)
    state = reference.nerf_state(bound, rng, filled=2e-6)
    grid = read_torch_ngp(save(tmp_path / "ngp.pth", state), ns)[0].occupancy
    p = rng.uniform(-bound, bound, (3000, 3)).astype(np.float32)
    u = ((p + bound) / (2 * bound)).astype(np.float32)
    k, n = grid.empty_cells(ns.Array3f(u.T)).numpy().astype(int), grid.cells[0]
    assert (k > 20).mean() > 0.3 and n == 128 * bound
    low = np.floor(u.astype(np.float64) * n) - (k[:, None] - 1)
    for _ in range(40):
        inside = (low + rng.random((len(p), 3)) * (2 * k[:, None] - 1)) / n
        inside = np.clip(inside, 1e-6, 1 - 1e-6)
        q = ((inside * 2 - 1) * bound).astype(np.float32)
        assert not reference.occupied(state["density_bitfield"], bound, q)[k > 0].any()


def test_morton_order():
    z, y, x = np.indices((128, 128, 128)).reshape(3, -1)
    assert np.array_equal(morton_order(), reference.morton(x, y, z))


def test_a_density_grid_without_its_bits(tmp_path):
    rng = np.random.default_rng(8)
    state = reference.nerf_state(1, rng)
    bits = np.unpackbits(state["density_bitfield"], bitorder="little").astype(bool)
    state["density_grid"] = np.where(bits, 5 + rng.random(bits.size), rng.random(bits.size) - 0.5).astype(np.float32)[
        None
    ]
    expected = read_torch_ngp(save(tmp_path / "a.pth", state), ns)[0].occupancy
    assert 0.49 < expected.threshold <= 0.5
    del state["density_bitfield"]
    got = read_torch_ngp(save(tmp_path / "b.pth", state), ns)[0].occupancy
    # min(mean, 10): the mean of the grid, which lies between both kinds of cells here.
    assert np.array_equal(got.bits, expected.bits)
    del state["density_grid"]
    assert read_torch_ngp(save(tmp_path / "c.pth", state), ns)[0].occupancy is None


def test_a_plain_grid_becomes_cascades(tmp_path):
    # Every cell of a cascade that overlaps an occupied one is set, and no other.
    bits = np.zeros((6, 6, 6), bool)
    bits[1, 2, 3] = bits[5, 5, 0] = True
    packed = bitfield(OccupancyGrid(bits, ns, 0.1), 2.0)
    p = np.random.default_rng(1).uniform(-2, 2, (20000, 3)).astype(np.float32)
    cell = np.clip((p / 4 + 0.5) * 6, 0, 5).astype(int)
    true = bits[cell[:, 2], cell[:, 1], cell[:, 0]]
    got = reference.occupied(packed, 2, p)
    assert np.all(got[true]) and true.any() and (got & ~true).mean() < 0.02


def test_cascades_are_packed_as_they_are():
    bits = np.random.default_rng(2).random((2, 128, 128, 128)) < 0.01
    packed = bitfield(CascadeGrid(bits, 2.0, ns, 0.1), 2.0)
    assert packed.dtype == np.uint8 and packed.size * 8 == bits.size
    ordered = np.unpackbits(packed, bitorder="little").reshape(2, -1)[:, morton_order()]
    assert np.array_equal(ordered.reshape(bits.shape), bits)
    assert bitfield(None, 2.0).min() == 255
    with pytest.raises(NergError, match="16.*no torch-ngp form"):
        bitfield(CascadeGrid(bits[:, :16, :16, :16], 2.0, ns, 0.1), 2.0)
