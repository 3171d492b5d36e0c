"""Attention shares of all meshes of random closed rooms, compared with sums over directions in float64."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.aoi.attention import SurfaceAttention, compute_shares, make_shape_aois
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.transport.mitsuba_mesh import make_mesh
from nerg_mi.viewer.shares import iter_attention_shares
from tests.plugins import fields

NUM_REFERENCE_DIRECTIONS = 1 << 16
FACES = np.array([(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)])
SIDES = np.array([(0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])


def box_corners(low, high) -> np.ndarray:
    return np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)], float)


def make_room(rng) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Walls of two triangles each, furniture of twelve, a leg a millimetre thick, and thin triangles: by name the
    vertices and the faces, whose orientation is random."""
    size = rng.uniform((3, 3, 2.4), (9, 7, 4))
    corners = box_corners(np.zeros(3), size)
    all_faces = np.concatenate([FACES, SIDES])
    meshes = {f"wall {k}": (corners, all_faces[2 * k : 2 * k + 2]) for k in range(6)}
    for k in range(rng.integers(2, 7)):
        low = rng.uniform(0, 0.7, 3) * size * (1, 1, 0)
        meshes[f"box {k}"] = (box_corners(low, np.minimum(low + rng.uniform(0.05, 2, 3), size)), all_faces)
    at = rng.uniform(0.1, 0.9, 3) * size * (1, 1, 0)
    meshes["leg"] = (box_corners(at, at + (0.001, 0.001, 1.5)), all_faces)
    meshes["sliver"] = (rng.uniform(0.1, 0.9) * size + rng.normal(size=(3, 3)) * (1, 0.01, 0.2), np.array([(0, 1, 2)]))
    flip = rng.random(len(meshes)) < 0.5
    return {n: (v, f[:, ::-1] if turned else f) for (n, (v, f)), turned in zip(meshes.items(), flip)}


def first_meshes(meshes, eye, d) -> tuple[np.ndarray, np.ndarray]:
    """The index of the first mesh in each direction, and its distance (Möller and Trumbore 1997)."""
    index, distance = np.full(len(d), -1), np.full(len(d), np.inf)
    for k, (vertices, faces) in enumerate(meshes.values()):
        for a, b, c in vertices[faces]:
            p = np.cross(d, c - a)
            determinant = p @ (b - a)
            determinant = np.where(determinant == 0, np.nan, determinant)
            q = np.cross(eye - a, b - a)
            u, v, t = p @ (eye - a) / determinant, d @ q / determinant, q @ (c - a) / determinant
            is_nearer = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < distance)
            index[is_nearer], distance[is_nearer] = k, t[is_nearer]
    return index, distance


def is_free(meshes, eye) -> bool:
    boxes = [v for name, (v, _) in meshes.items() if "wall" not in name]
    return all((eye < v.min(0) - 0.05).any() or (eye > v.max(0) + 0.05).any() for v in boxes)


@pytest.fixture(scope="module", params=[pytest.param(k, marks=[pytest.mark.nightly] * (k != 3)) for k in range(8)])
def room(request, tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    rng = np.random.default_rng(request.param)
    meshes = make_room(rng)
    gaze = tmp_path_factory.mktemp("room") / "gaze.safetensors"
    fields.gaze(gaze, seed=request.param)
    scene = nerg.make_scene(gaze=gaze, shapes={n: make_mesh(v, f, n) for n, (v, f) in meshes.items()})
    size = meshes["wall 0"][0].max(0)
    # Also 2 cm from a wall, whose two triangles then fill half of the view.
    away, near = rng.uniform(0.05, 0.95, (2, 40, 3)) * size
    near[:, 0] = 0.02
    eyes = np.float32([next(eye for eye in part if is_free(meshes, eye)) for part in (away, near)])
    return meshes, scene, eyes


def reference(meshes, scene, eye) -> tuple[np.ndarray, np.ndarray]:
    """The shares of all meshes, and three standard errors if the directions were random."""
    d = fibonacci_directions(NUM_REFERENCE_DIRECTIONS)
    index, distance = first_meshes(meshes, eye.astype(float), d)
    assert (index >= 0).all()
    gaze = nerg.observe(scene, eye + d * distance[:, None], eye, "gaze").gaze[0].astype(float)
    gaze /= gaze.sum()
    bound = 3 * np.sqrt(np.maximum(np.bincount(index, gaze**2, len(meshes)), gaze.max() ** 2))
    return np.bincount(index, gaze, len(meshes)), bound


@pytest.mark.slow
def test_shares_of_a_closed_room_are_right_within_the_error(room):
    meshes, scene, eyes = room
    names = list(meshes)
    shares = compute_shares(scene, make_shape_aois(scene, names), eyes)
    assert (shares.error <= 0.01 * shares.share + 1e-5).all(), "the error is bounded"
    total_error = shares.error.sum(axis=1)
    assert (np.abs(shares.share.sum(axis=1) - 1) < total_error).all() and total_error.max() < 0.01
    assert (shares.escaped < 1e-4).all()
    for e, eye in enumerate(eyes):
        expected, bound = reference(meshes, scene, eye)
        assert (np.abs(shares.share[e] - expected) < shares.error[e] + bound).all()
    # The function of the package, whatever the number of patches.
    for name in ("wall 1", "leg"):
        for divisions in (1, 3):
            result = nerg.attention(scene, name, eyes, two_sided=True, divisions=divisions)
            assert isinstance(result, SurfaceAttention)
            assert np.allclose(result.share, shares.share[:, names.index(name)], rtol=0, atol=2 * result.error)
            is_spread = result.density.any(axis=1)
            assert np.allclose((result.density @ result.area)[is_spread], result.share[is_spread], rtol=1e-4)
    # The viewer: first preliminary, then within its accuracy.
    steps = list(iter_attention_shares(scene, eyes[0], [], names))
    first, last = (
        {n: s for part in half for n, s in part.items()}
        for half in (steps[: len(steps) // 2], steps[len(steps) // 2 :])
    )
    assert first.keys() == last.keys() == meshes.keys()
    assert all(s.is_final for s in last.values()) and not all(s.is_final for s in first.values())
    for k, name in enumerate(names):
        for s in (first[name], last[name]):
            assert s.share == pytest.approx(shares.share[0, k], abs=s.error + shares.error[0, k])
    assert sum(s.share for s in last.values()) == pytest.approx(1, abs=sum(s.error for s in last.values()))
