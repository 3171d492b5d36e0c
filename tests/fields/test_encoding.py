"""Tests of `nerg_mi.fields.encoding`."""

import gc

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGrid, HashGridConfig, encode_direction
from nerg_mi.threads import set_thread_count
from tests.reference import fields_numpy as reference
from tests.reference import hashgrid_numpy as reference_hashgrid

# ---- Direction encoding against the formulas of spherical harmonics ----


def directions(n=200):
    d = np.random.default_rng(0).normal(size=(n, 3))
    d = np.concatenate([d, np.eye(3), -np.eye(3), [[1, 1, 0], [0, -1, 1]]])
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test01_harmonics_match_scipy_values(degree):
    d = directions()
    out = encode_direction(ns.Array3f(d.T), degree)
    assert len(out) == degree**2
    for i, (o, e) in enumerate(zip(out, reference.harmonics(d).T)):
        got = np.broadcast_to(o.numpy() if hasattr(o, "numpy") else o, e.shape)
        assert np.allclose(got, e, atol=1e-6), i


@pytest.mark.parametrize("degree", [0, -1, 11])
def test03_degree_out_of_range(degree):
    with pytest.raises(ValueError, match="1..10"):
        encode_direction(ns.Array3f(0, 0, 1), degree)


# ---- The hash grid against a reference of torch-ngp's kernel, its published sizes, and central differences ----

SMALL = HashGridConfig(levels=4, log2_rows=12, base=4, finest=64)


def spec(config):
    return dict(
        levels=config.levels,
        features=config.features,
        log2_rows=config.log2_rows,
        base=config.base,
        finest=config.finest,
    )


def random_grid(config, seed=0):
    table = np.random.default_rng(seed).normal(size=(config.offsets()[-1], config.features)).astype(np.float32)
    return table, HashGrid(config, ns.Float(table.ravel()))


def evaluate(grid, points):
    points = np.asarray(points, np.float32)
    return np.stack([f.numpy() for f in grid(ns.Array3f(points.T))], -1)


# The paper's NeRF is 2048 x bound, its gaze grid 256 x bound.
@pytest.mark.parametrize(
    "finest, rows",
    [(2048, 6_119_864), (4096, 6_328_848), (10240, 6_589_272), (256, 4_555_440), (512, 5_291_984), (1280, 5_842_848)],
)
def test01_sizes_match_torch_ngp(finest, rows):
    config = HashGridConfig(finest=finest)
    assert config.offsets()[-1] == rows
    assert config.level_rows() == reference_hashgrid.rows_of_levels(16, 16, finest, 19)
    assert np.array_equal(config.level_scales(), np.array(reference_hashgrid.scales_of_levels(16, 16, finest)))
    assert all(r % 8 == 0 for r in config.level_rows()) and config.size == 32


@pytest.mark.parametrize("finest, dense", [(2048, 5), (4096, 5), (10240, 4), (256, 9), (512, 7), (1280, 6)])
def test02_dense_levels(finest, dense):
    # Level 6 of finest 512 has a table of 66^3 rows and a stride of 65, and is dense.
    config = HashGridConfig(finest=finest)
    grid = HashGrid.__new__(HashGrid)
    grid.config = config
    grid._scales, grid._rows = config.level_scales(), config.level_rows()
    assert [grid.is_hashed(level) for level in range(16)] == [False] * dense + [True] * (16 - dense)


@pytest.mark.parametrize(
    "config",
    [
        SMALL,
        HashGridConfig(levels=4, features=4, log2_rows=10, base=5, finest=81),
        HashGridConfig(levels=1, log2_rows=12, base=8, finest=8),
        HashGridConfig(levels=6, log2_rows=12, base=16, finest=512),
        HashGridConfig(levels=3, log2_rows=12, base=16, finest=10240),
    ],
)
def test03_equals_the_kernel(config):
    table, grid = random_grid(config)
    points = np.random.default_rng(1).random((60, 3)).astype(np.float32)
    expected = reference_hashgrid.features(points, table, **spec(config))
    assert np.abs(evaluate(grid, points) - expected).max() <= 1e-6 * np.abs(table).max()


def test04_paper_size_equals_the_kernel_on_every_level():
    # Level 6 and others of NeRG's bound 2 are sized by float64 and indexed by float32 resolutions.
    config = HashGridConfig(finest=512)
    table, grid = random_grid(config)
    points = np.random.default_rng(2).random((12, 3)).astype(np.float32)
    points[0], points[1] = 0, 1
    expected = reference_hashgrid.features(points, table, **spec(config))
    assert np.abs(evaluate(grid, points) - expected).max() <= 1e-6 * np.abs(table).max()


def test05_faces_edges_and_corners_do_not_alias():
    table, grid = random_grid(SMALL)
    axis = [0.0, 0.5, 1.0, float(np.nextafter(np.float32(1), np.float32(0)))]
    points = np.array([(x, y, z) for x in axis for y in axis for z in axis])
    expected = reference_hashgrid.features(points, table, **spec(SMALL))
    got = evaluate(grid, points)
    assert np.abs(got - expected).max() <= 1e-6 * np.abs(table).max()
    # The last vertex of a dense level is not the first of the next line.
    r = int(np.ceil(SMALL.level_scales()[0])) + 2
    assert r == 5 and np.abs(got[15, 0] - got[0, 0]) > 1e-3


@pytest.mark.parametrize(
    "point",
    [
        (-1e-7, 0.5, 0.5),
        (0.5, 1.0000001, 0.5),
        (0.5, 0.5, -3e9),
        (1e30, 0.5, 0.5),
        (np.inf, 0.5, 0.5),
        (0.5, -np.inf, 0.5),
        (np.nan, 0.5, 0.5),
        (-0.1, -0.1, -0.1),
    ],
)
def test06_zero_outside_with_zero_gradient(point):
    _, grid = random_grid(SMALL)
    dr.enable_grad(grid.table)
    features = grid(ns.Array3f(ns.Float([0.5, point[0]]), ns.Float([0.5, point[1]]), ns.Float([0.5, point[2]])))
    assert all(f.numpy()[1] == 0 for f in features) and any(f.numpy()[0] != 0 for f in features)
    dr.backward(dr.gather(ns.Float, features[0], ns.UInt32(1)))
    assert not np.any(dr.grad(grid.table).numpy())


def test07_masked_lanes_are_zero():
    _, grid = random_grid(SMALL)
    out = grid(ns.Array3f(0.3, 0.4, ns.Float([0.5, 0.5])), ns.Bool([True, False]))
    assert out[0].numpy()[0] != 0 and all(f.numpy()[1] == 0 for f in out)


@pytest.mark.parametrize("mode", [dr.ReduceMode.Auto, dr.ReduceMode.Direct])
def test08_table_gradient_equals_the_interpolation_weights(mode):
    # Features are linear in the table: the gradient of a sum is exact by two evaluations of the reference.
    table, grid = random_grid(SMALL)
    points = np.random.default_rng(3).random((20, 3)).astype(np.float32)
    mix = np.random.default_rng(4).normal(size=(20, SMALL.size)).astype(np.float32)
    dr.enable_grad(grid.table)
    grid.mode = mode
    out = grid(ns.Array3f(points.T))
    dr.backward(dr.sum(sum(o * ns.Float(m) for o, m in zip(out, mix.T))))
    gradient = dr.grad(grid.table).numpy().reshape(table.shape)
    touched = np.argwhere(gradient)
    assert 100 < len(touched) < gradient.size
    base = (reference_hashgrid.features(points, table, **spec(SMALL)) * mix).sum()
    for row, feature in touched[:: len(touched) // 8]:
        moved = table.astype(np.float64)
        moved[row, feature] += 1
        difference = (reference_hashgrid.features(points, moved, **spec(SMALL)) * mix).sum() - base
        assert np.isclose(gradient[row, feature], difference, rtol=1e-4, atol=1e-6)


def test09_position_gradient_equals_central_differences():
    table, grid = random_grid(SMALL)
    p = np.array([[0.31, 0.62, 0.47], [0.11, 0.9, 0.77]], np.float32)
    x = ns.Array3f(p.T)
    dr.enable_grad(x)
    dr.backward(dr.sum(sum(grid(x))))
    gradient = np.array(dr.grad(x)).T
    h = 1e-4  # in float32 of the reference's position; piecewise trilinear, so exact inside a cell
    for axis in range(3):
        step = np.zeros(3, np.float32)
        step[axis] = h
        up, down = (reference_hashgrid.features(p + s * step, table, **spec(SMALL)).sum(-1) for s in (1, -1))
        width = ((p + step) - (p - step))[:, axis].astype(float)
        assert np.allclose(gradient[:, axis], (up - down) / width, rtol=5e-3, atol=0.05)


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(levels=0), "levels=0"),
        (dict(base=0), "base=0"),
        (dict(finest=8), "finest=8"),
        (dict(features=3), "features must be 2 or 4"),
        (dict(log2_rows=2), "log2_rows"),
        (dict(log2_rows=27), "log2_rows"),
    ],
)
def test11_wrong_sizes_are_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        HashGridConfig(**wrong)


def test12_table_of_wrong_length_is_refused():
    with pytest.raises(ValueError, match="has 10 entries"):
        HashGrid(SMALL, dr.zeros(ns.Float, 10))


@pytest.mark.parametrize("dimensions, features", [(3, 2), (3, 4), (2, 2)])
def test_attached_features_have_the_derivatives_of_the_evaluation(dimensions, features):
    rng = np.random.default_rng(3)
    config = HashGridConfig(levels=4, features=features, log2_rows=8, base=4, finest=32, dimensions=dimensions)
    grid = HashGrid.random(config, ns, rng)
    start = grid.table
    direction = ns.Float(rng.normal(size=len(start)).astype(np.float32))
    # The last point is outside.
    points = np.append(rng.random((dimensions, 99)), np.full((dimensions, 1), 2.0), axis=1)
    p = ns.Array3f(points) if dimensions == 3 else ns.Array2f(points)
    weights = [ns.Float(rng.normal(size=100).astype(np.float32)) for _ in range(config.size)]
    values = grid.evaluate_eagerly(p)
    backward, forward = [], []
    for rows in (lambda: grid(p), lambda: grid.attach(values, p)):
        grid.table = ns.Float(start)
        dr.enable_grad(grid.table)
        dr.backward(dr.sum(sum(w * row for w, row in zip(weights, rows()))))
        backward.append(dr.grad(grid.table).numpy())
        grid.table = ns.Float(start)
        dr.enable_grad(grid.table)
        result = rows()
        dr.set_grad(grid.table, direction)
        dr.enqueue(dr.ADMode.Forward, grid.table)
        dr.traverse(dr.ADMode.Forward)
        forward.append([np.array(dr.grad(row)) for row in result])
    assert np.abs(backward[0]).max() > 0 and np.allclose(*backward, rtol=1e-4, atol=1e-5)
    assert np.abs(forward[0]).max() > 0 and np.allclose(*forward, rtol=1e-4, atol=1e-5)


def test_derivatives_of_several_threads_are_added_once():
    """Dr.Jit keeps a copy of a sum for each thread; to add the copies of all levels after each level took longer than
    the rest of a training step."""
    rng, threads = np.random.default_rng(3), dr.thread_count()
    config = HashGridConfig(levels=4, features=2, log2_rows=8, base=4, finest=32)
    grid = HashGrid(config, HashGrid.random(config, ns, rng).table, dr.ReduceMode.Expand)
    p = ns.Array3f(rng.random((3, 100)))
    gradients = [ns.Float(rng.normal(size=100).astype(np.float32)) for _ in range(config.size)]
    dr.eval(p, gradients)
    try:
        set_thread_count(2)
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.eval(grid.scatter(p, gradients))
            additions = [k["size"] for k in dr.kernel_history() if k["type"] == dr.KernelType.BlockReduce]
    finally:
        set_thread_count(threads)
    assert 0 < sum(additions) <= len(grid.table)


def test13_evaluation_leaves_no_reference_cycles():
    """Arrays in a reference cycle stay until garbage collection, which is rare for so few objects."""
    _, grid = random_grid(SMALL)
    evaluate(grid, np.zeros((4, 3)))
    gc.disable()
    try:
        cycles = []
        for count in (1, 5):
            gc.collect()
            for _ in range(count):
                evaluate(grid, np.zeros((4, 3)))
            cycles.append(gc.collect())
        # Garbage of other threads does not grow with the evaluations.
        assert cycles[1] < 5 or cycles[1] <= cycles[0]
    finally:
        gc.enable()


# ---- Configurations in files: with and without a kind, and of unknown kinds ----

CONFIG = HashGridConfig(levels=2, log2_rows=6, base=2, finest=4)


def test_configuration_without_kind_is_a_hash_grid():
    assert HashGridConfig.from_dict(CONFIG.to_dict()) == CONFIG and "kind" not in CONFIG.to_dict()
    assert HashGridConfig.from_dict({"kind": "hashgrid", **CONFIG.to_dict()}) == CONFIG
    assert HashGridConfig.from_dict({}) == HashGridConfig()


@pytest.mark.parametrize("kind", ["permutohedral", 3, None, ["hashgrid"]])
def test_unknown_kind_is_named(kind):
    with pytest.raises(ValueError, match="version does not know"):
        HashGridConfig.from_dict({"kind": kind})


def test_encoding_from_configuration():
    grid = HashGrid.random(CONFIG, ns, np.random.default_rng(1))
    same = HashGrid.random(CONFIG, ns, np.random.default_rng(1))
    assert np.array_equal(grid.table.numpy(), same.table.numpy())
    parameters = {"behind.table": grid.table, "grid.table": grid.table * 0}
    result = HashGrid.from_parameters(CONFIG, parameters, "behind", dr.ReduceMode.Expand)
    assert result.table is grid.table and result.mode == dr.ReduceMode.Expand
    assert not HashGrid.from_parameters(CONFIG, parameters).table.numpy().any()
