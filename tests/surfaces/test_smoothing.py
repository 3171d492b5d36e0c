"""Heat on surfaces against closed forms: a plane's Gaussian, a sphere's harmonics; and what it never does."""

import numpy as np
import pytest
import trimesh

from nerg_mi.surfaces.laplacian import Smoother
from nerg_mi.surfaces.mesh import Mesh, weld
from tests.surfaces.meshes import box, joined, plate


def spike(mesh, at=(0, 0, 0)):
    out = np.zeros(len(mesh.vertices))
    out[np.argmin(np.linalg.norm(mesh.vertices - at, axis=1))] = 1
    return out


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test01_on_a_plane_a_point_becomes_a_gaussian(jitter):
    mesh, s = joined(plate(61, jitter)), 0.07
    start = spike(mesh)
    origin = mesh.vertices[start > 0][0]
    exact = np.exp(-((mesh.vertices - origin) ** 2).sum(1) / (2 * s * s)) / (2 * np.pi * s * s) * mesh.vertex_area
    errors = [np.abs(Smoother(mesh, s, steps)(start) - exact).sum() for steps in (4, 16, 64)]
    assert errors[0] > 2 * errors[1] > 3 * errors[2] and errors[2] < 0.03
    for k in (0, 1):
        variance = (Smoother(mesh, s)(start) * (mesh.vertices - origin)[:, k] ** 2).sum()
        assert abs(variance / s**2 - 1) < (0.02 if jitter else 1e-3)


@pytest.mark.parametrize("degree", [1, 2, 4])
def test02_on_a_sphere_harmonics_decay(degree):
    ball = trimesh.creation.icosphere(4)
    mesh, s, steps = Mesh(np.array(ball.vertices), np.array(ball.faces)), 0.3, 8
    wave = np.polynomial.legendre.Legendre.basis(degree)(mesh.vertices[:, 2])
    found = Smoother(mesh, s, steps)(wave * mesh.vertex_area)
    left = (found * wave).sum() / (wave * wave * mesh.vertex_area).sum()
    rate = degree * (degree + 1) * s * s / 2
    # Of steps backwards in time exactly, of heat to their order.
    assert np.isclose(left, (1 + rate / steps) ** -steps, rtol=6e-3)
    assert np.isclose(left, np.exp(-rate), rtol=rate**2 / steps + 6e-3)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test03_nothing_crosses_a_gap_of_5_cm(scale):
    """Two plates 5 cm apart: what is on one stays there, all of it, and exactly nothing comes to the other."""
    v, f = plate(20, 0.3)
    mesh, _, _ = weld(scale * np.concatenate([v, v + [0, 0, 0.05]]), np.concatenate([f, f + len(v)]))
    upper = mesh.vertices[:, 2] > 0.02 * scale
    start = np.where(upper, 0, np.random.default_rng(0).random(len(upper)))
    found = Smoother(mesh, 0.3 * scale)(start)
    assert (found[upper] == 0).all() and np.isclose(found.sum(), start.sum(), rtol=1e-10)
    assert found[~upper].min() > 0


def test04_a_uniform_density_stays_and_none_becomes_negative_on_bad_meshes():
    needles = joined(box((0, 0, 0), (3, 1e-3, 1)), box((1, 2, 0), (4, 2 + 1e-7, 1e-4)))
    for mesh in (needles, joined(plate(12, 0.49))):
        smoother = Smoother(mesh, 0.2)
        assert np.allclose(smoother(mesh.vertex_area), mesh.vertex_area, rtol=1e-6)
        for k in range(0, len(mesh.vertices), 7):
            start = np.zeros(len(mesh.vertices))
            start[k] = 1.0
            found = smoother(start)
            assert found.min() >= 0 and np.isclose(found.sum(), 1, rtol=1e-9)
        assert not smoother(np.zeros(len(mesh.vertices))).any()


@pytest.mark.parametrize("length, steps", [(0.0, 8), (np.nan, 8), (0.1, 0)])
def test05_lengths_that_are_none(length, steps):
    with pytest.raises(ValueError, match="positive length"):
        Smoother(joined(plate(3)), length, steps)
