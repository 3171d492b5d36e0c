"""Gaussian splats as a medium: arrays, placement, the next hits in order, and the tree."""

from __future__ import annotations

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.fields.splats import Splats, harmonics_from_colors
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import eval_harmonics
from nerg_mi.transport.medium import LastHit
from nerg_mi.transport.splat_medium import GROUP_SIZE, SplatArrays, SplatMedium, build_tree, count_levels
from tests.formats.splats.writers import random_splats
from tests.reference.splats import peaks

# ---- Small scenes of Gaussian splats, and rays through them ----


def medium_of(splats: Splats, to_world: Similarity | None = None) -> SplatMedium:
    return SplatMedium(SplatArrays(splats, ns), to_world)


def stack(depths, opacities, scale=0.1, colors=None) -> Splats:
    """Spheres on the z axis."""
    n = len(depths)
    centers = np.stack([np.zeros(n), np.zeros(n), np.asarray(depths, float)], axis=1)
    colors = np.full((n, 3), 0.5) if colors is None else colors
    return Splats(centers, np.full((n, 3), scale), [[1, 0, 0, 0]] * n, opacities, harmonics_from_colors(colors))


def rays(count: int, seed: int = 0, size: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    """Origins in a cube and unit directions, float32."""
    rng = np.random.default_rng(seed)
    o, d = rng.uniform(-size, size, (count, 3)), rng.normal(size=(count, 3))
    return o.astype(np.float32), (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


# ---- Arrays ----


def test_peaks_and_colors_match_float64():
    splats = random_splats(30, degree=3)
    arrays = SplatArrays(splats, ns)
    o, d = rays(200)
    index = np.random.default_rng(0).integers(0, 30, 200)
    t, absorbed, distance = arrays.find_peak(ns.UInt32(index), ns.Array3f(o.T), ns.Array3f(d.T), True)
    wanted = [v[np.arange(200), index] for v in peaks(splats, o, d, extent=np.inf)]
    assert np.allclose(t, wanted[0], atol=1e-5) and np.allclose(absorbed, wanted[1], atol=1e-5)
    assert np.allclose(np.minimum(splats.opacities[index] * np.exp(-0.5 * np.array(distance)), 0.9999), wanted[1])
    color = np.stack([np.array(c) for c in arrays.color(ns.UInt32(index), ns.Array3f(d.T), True)], axis=1)
    seen = np.einsum("rk,rkc->rc", eval_harmonics(d, 3), splats.harmonics[index].astype(float)) + 0.5
    assert np.allclose(color, np.maximum(seen, 0), atol=1e-5)


def test_parameter_changes_are_packed():
    arrays = SplatArrays(random_splats(5, degree=0), ns)
    before, colors = arrays.lower.copy(), arrays.colors
    arrays.centers = arrays.centers + 1
    arrays.pack()
    assert np.allclose(arrays.lower, before + 1, atol=1e-6) and next(iter(arrays.parameters())) == "centers"
    assert dr.width(colors) == 4 * 5 and dr.width(arrays.shapes) == 16 * 5
    # Of any length: only the direction of a quaternion matters.
    turned = np.array(arrays.shapes)
    arrays.rotations = arrays.rotations * 3
    arrays.pack()
    assert np.allclose(arrays.shapes, turned, rtol=1e-5, atol=1e-5)


# ---- Medium ----


def test_placed_medium_matches_transformed_splats(rgb):
    splats, (o, d) = random_splats(20, degree=2), rays(50)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2.5 * Rotation.random(random_state=np.random.default_rng(1)).as_matrix(), [1, 0, 2]
    to_world = Similarity(matrix)
    placed, moved = medium_of(splats, to_world), medium_of(splats.transform(to_world))
    assert np.isclose(placed.default_step, moved.default_step, rtol=1e-5)
    # A rotated box has a larger bounding box.
    (low, high), (minimum, maximum) = placed.bounds(), moved.bounds()
    assert (low <= minimum + 1e-5).all() and (maximum <= high + 1e-5).all()
    make = []
    for medium in (placed, moved):
        ray = medium.ray_to_local(rgb.Point3f((2.5 * o).T), rgb.Vector3f(d.T))
        index = rgb.UInt32(np.arange(50) % 20)
        t, share = medium.hits.reevaluate(ray, index, True)
        color = medium.color([index], None, ray.w, True)
        make.append(np.stack([np.array(v) for v in (t, share, *color)]))
    assert np.allclose(make[0], make[1], rtol=1e-3, atol=1e-4)


def test_density_is_refused(rgb):
    medium = medium_of(stack([1], [0.5]))
    for ask in (medium.density, medium.density_features):
        with pytest.raises(ValueError, match="along rays"):
            ask(rgb.Point3f(0), True)
    assert medium.background(None, None) is None and medium.refresh() is None and len(medium.parameters()) == 2
    assert np.allclose(medium.to_unit(medium.to_local(rgb.Point3f(0, 0, 1))), 0.5)
    assert np.allclose(medium.vector_to_unit(rgb.Vector3f(0.6, 0, 0)), [[1], [0], [0]], atol=1e-5)


# ---- Nearest ----


def test_groups_follow_the_global_order(rgb):
    splats = random_splats(80, degree=0, size=0.3)
    medium, (o, d) = medium_of(splats), rays(300)
    ray = medium.ray_to_local(rgb.Point3f(o.T), rgb.Vector3f(d.T))
    all_t, share = peaks(splats, o, d)
    wanted = np.sort(np.where((share > 0) & (all_t > 0), all_t, np.inf), axis=1)
    after, everywhere = LastHit(rgb.Float(0), rgb.UInt32(0)), dr.full(rgb.Bool, True, 300)
    # Light is never used up: three groups contain the first hits, without repetition.
    for group in range(3):
        result = medium.hits.find_next(ray, after, ray.t_far, rgb.Float(1), rgb.Float(0), everywhere)
        dr.eval(result.t, result.absorbed, result.index)
        t = np.stack([np.array(v) for v in result.t], axis=1)
        part = wanted[:, group * GROUP_SIZE : (group + 1) * GROUP_SIZE]
        has_surface = np.isfinite(part)
        assert np.array_equal(np.isfinite(t), has_surface) and np.allclose(t[has_surface], part[has_surface], atol=1e-5)
        after = LastHit(result.t[-1], result.index[-1])
        everywhere = everywhere & dr.isfinite(result.t[-1])
    again = medium.hits.reevaluate(ray, result.index[0], dr.isfinite(result.t[0]))
    first = np.isfinite(t[:, 0])
    assert np.array_equal(np.array(again[0])[first], t[first, 0])
    assert np.array_equal(np.array(again[1])[first], np.array(result.absorbed[0])[first])


def test_hits_follow_changes_of_the_parameters(rgb):
    medium, (o, d) = medium_of(random_splats(80, degree=0, size=0.3)), rays(300)
    after, everywhere = LastHit(rgb.Float(0), rgb.UInt32(0)), dr.full(rgb.Bool, True, 300)
    for seed in range(3):
        splats = random_splats(80, degree=0, seed=seed, size=0.3)
        for name in ("centers", "scales", "rotations", "opacities"):
            setattr(medium.arrays, name, rgb.Float(getattr(splats, name).ravel()))
        medium.arrays.pack()
        ray = medium.ray_to_local(rgb.Point3f(o.T), rgb.Vector3f(d.T))
        result = medium.hits.find_next(ray, after, ray.t_far, rgb.Float(1), rgb.Float(0), everywhere)
        t, share = peaks(splats, o, d)
        wanted = np.where((share > 0) & (t > 0), t, np.inf).min(axis=1)
        np.testing.assert_allclose(result.t[0], wanted, atol=1e-5)


def test_coincident_peaks_are_all_returned(rgb):
    count = 2 * GROUP_SIZE + 3
    medium = medium_of(stack([1.0] * count, np.full(count, 0.1)))
    ray = medium.ray_to_local(rgb.Point3f(0, 0, 0), rgb.Vector3f(0, 0, 1))
    after, seen = LastHit(rgb.Float(0), rgb.UInt32(0)), []
    for _ in range(3):
        result = medium.hits.find_next(ray, after, ray.t_far, rgb.Float(1), rgb.Float(0), rgb.Bool(True))
        dr.eval(result.t, result.absorbed, result.index)
        seen += [i[0] for i, t in zip(result.index, result.t) if np.isfinite(t[0])]
        after = LastHit(result.t[-1], result.index[-1])
    assert sorted(seen) == list(range(count))


def test_opaque_hits_end_the_traversal(rgb):
    medium = medium_of(stack(np.arange(1, 65), [0.9999] * 64))
    ray = medium.ray_to_local(rgb.Point3f(0, 0, 0), rgb.Vector3f(0, 0, 1))
    look = lambda stop: medium.hits.find_next(
        ray, LastHit(rgb.Float(0), rgb.UInt32(0)), ray.t_far, rgb.Float(1), rgb.Float(stop), rgb.Bool(True)
    )
    assert look(1e-3).evals[0] <= 2 < look(0).evals[0]
    assert look(1e-3).t[0][0] == 1


# ---- BoxTree ----


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 1000])
def test_boxes_are_in_one_leaf_and_its_ancestors(count):
    rng = np.random.default_rng(count)
    lower = rng.normal(size=(count, 3))
    upper = lower + rng.uniform(0, 0.3, (count, 3))
    tree = build_tree(lower, upper)
    leaves = 1 << count_levels(count)
    assert len(tree.nodes) == 2 * leaves and count <= leaves < 2 * count + (count == 1)
    is_held = tree.nodes[leaves:, 0] < 1e29
    assert sorted(tree.boxes[is_held]) == list(range(count))
    for node, i in zip(np.flatnonzero(is_held) + leaves, tree.boxes[is_held]):
        while node:
            assert (tree.nodes[node, :3] <= lower[i]).all() and (upper[i] <= tree.nodes[node, 3:6]).all()
            node //= 2


def test_coincident_boxes():
    tree = build_tree(np.zeros((9, 3)), np.ones((9, 3)))
    assert sorted(tree.boxes)[-9:] == list(range(9)) and tree.nodes[1, :6].round(3).tolist() == [0, 0, 0, 1, 1, 1]


def test_empty_nodes_are_never_hit():
    tree = build_tree(np.zeros((5, 3)), np.ones((5, 3)))
    empty = tree.nodes[8:][tree.nodes[8:, 0] >= 1]
    assert len(empty) == 3 and (empty[:, :6] == np.float32(1e30)).all()


def test_nodes_split_along_the_longest_side():
    x = np.arange(8.0)
    lower = np.stack([0 * x, x[::-1], 0 * x], axis=1)
    tree = build_tree(lower, lower)
    assert tree.nodes[1, 6] == 1 and tree.boxes.tolist() == list(range(7, -1, -1))
