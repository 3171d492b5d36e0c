"""Tests of `nerg_mi.maths.sphere`."""

import drjit as dr
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.maths import sphere
from nerg_mi.maths.sphere import HARMONIC_DEGREES, eval_harmonics, fibonacci_directions, rotate_harmonics

# ---- Harmonics ----


@pytest.mark.parametrize("degree", HARMONIC_DEGREES.values())
def test_harmonics_match_drjit(degree):
    d = fibonacci_directions(50)
    theirs = dr.sh_eval(dr.llvm.Array3f(d.T.astype(np.float32)), degree)
    assert (
        np.abs(eval_harmonics(d, degree) - np.stack(np.broadcast_arrays(*map(np.array, theirs)), axis=1)).max() < 1e-6
    )


def test_harmonics_are_orthonormal():
    y = eval_harmonics(fibonacci_directions(20_000), 3)
    assert np.abs(y.T @ y * (4 * np.pi / len(y)) - np.eye(16)).max() < 1e-3


def test_rotated_coefficients_give_a_rotated_function():
    rng = np.random.default_rng(0)
    c, d = rng.normal(size=(5, 16, 3)), fibonacci_directions(100)
    turn = Rotation.random(random_state=rng).as_matrix()
    turned = rotate_harmonics(c, turn)
    at = lambda c, d: np.einsum("dk,nkc->ndc", eval_harmonics(d, 3), c)
    assert np.abs(at(turned, d) - at(c, d @ turn)).max() < 1e-12


# ---- Sphere ----


def test_fibonacci_directions_have_equal_area():
    x = sphere.fibonacci_directions(4096)
    assert np.allclose(np.linalg.norm(x, axis=1), 1, atol=1e-15)
    # Spherical harmonics up to degree 2 integrate to zero.
    a, b, c = x.T
    for y in (a, b, c, a * b, b * c, a * c, 3 * c * c - 1, a * a - b * b):
        assert abs(y.mean()) < 1e-3
    # Even spacing: the nearest neighbour is at the distance of equal areas.
    near = np.sort(x[:200] @ x.T, axis=1)[:, -2]
    assert np.all(np.abs(np.arccos(near) / np.sqrt(4 * np.pi / 4096) - 1) < 0.3)
    with pytest.raises(ValueError, match="at least one"):
        sphere.fibonacci_directions(0)


@pytest.mark.parametrize("count", [1, 7, 1 << 17])
def test_fibonacci_directions_jit_match_numpy(rgb, count):
    ours = np.array(sphere.fibonacci_directions_jit(count)).reshape(3, count).T
    # Near the poles float32 limits the height.
    assert np.abs(ours - sphere.fibonacci_directions(count)).max() < 5e-5
    assert np.abs(np.linalg.norm(ours, axis=1) - 1).max() < 1e-6


def test_uniform_directions_are_isotropic():
    x = sphere.sample_uniform_directions(100_000, np.random.default_rng(1))
    assert np.abs(x.mean(axis=0)).max() < 0.01
    assert np.allclose(np.cov(x.T), np.eye(3) / 3, atol=0.01)


def test_latlong_grid_covers_the_sphere():
    x, w = sphere.latlong_grid(48, 24)
    assert np.isclose(w.sum(), 4 * np.pi, rtol=1e-14)
    assert np.isclose(np.sum(w * x[:, 1] ** 2), 4 * np.pi / 3, rtol=5e-3)
    up, _ = sphere.latlong_grid(48, 24, sphere.Z_UP)
    assert up[0, 2] > 0.99 and up[-1, 2] < -0.99


def test_latlong_matches_mitsuba_envmap(rgb):
    mi = rgb
    # A map that stores its own directions: the emitter shows the direction of the ray.
    width, height = 64, 33
    u = (np.arange(width) + 0.5) / width
    v = np.arange(height) / (height - 1)  # an envmap's rows include the poles
    V, U = np.meshgrid(v, u, indexing="ij")
    stored = 0.5 + 0.5 * sphere.latlong_to_direction(U, V)
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(stored.astype(np.float32))})
    x, _ = sphere.latlong_grid(16, 8)
    si = dr.zeros(mi.SurfaceInteraction3f, len(x))
    si.wi = -mi.Vector3f(x.T.astype(np.float32))
    shown = 2 * np.array(emitter.eval(si)).T - 1
    assert np.abs(shown - x).max() < 0.01  # bilinear interpolation of 64 columns


def test_morton_order_keeps_neighbours_close():
    order = sphere.morton_order(2048)
    assert np.array_equal(np.sort(order), np.arange(2048))
    d = sphere.fibonacci_directions(2048)
    difference = lambda d: np.degrees(np.arccos(np.clip((d[1:] * d[:-1]).sum(axis=1), -1, 1))).mean()
    # Neighbours are 4.5 degrees apart; along the spiral the next direction is on the other side.
    assert difference(d[order]) < 9 < 90 < difference(d)


@pytest.mark.parametrize("angle", [1e-3, 0.2, 1.7, 3.1, np.pi])
def test_indices_in_a_cone_match_their_directions(angle):
    d = sphere.fibonacci_directions(5000)
    for axis in np.concatenate([np.eye(3), -np.eye(3), d[[17]]]):
        numbers = sphere.indices_in_cone(5000, axis, angle)
        assert np.array_equal(numbers, np.flatnonzero(d @ axis >= np.cos(angle)))
        assert np.array_equal(sphere.fibonacci_directions(5000, numbers), d[numbers])
