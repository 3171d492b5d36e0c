"""References against closed forms and brute force."""

import math

import numpy as np
import pytest

from nerg_mi.evaluation import study_scenes
from nerg_mi.evaluation import study_truth as study_reference
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.evaluation.study_truth import errors
from tests.reference import march_numpy

NAMES = list(study_scenes.SCENES)


def rays(scene, count=24, seed=0):
    """Float64 rays from the scene's camera towards points of the cube, and one that misses."""
    rng = np.random.default_rng(seed)
    o = np.broadcast_to(np.asarray(scene.camera, float), (count, 3))
    d = rng.uniform(0.05, 0.95, (count, 3)) - o
    d[-1] = (0, -1, 0)
    return o, d / np.linalg.norm(d, axis=-1, keepdims=True)


def test_slab_is_the_closed_form():
    scene = study_scenes.SCENES["slab"]
    o, d = rays(scene)
    seen = study_reference.trace(scene, o, d)
    for i in range(len(o) - 1):
        near, far = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        alpha, expected, median = march_numpy.slab(study_scenes.SLAB_DENSITY, near, far)
        assert np.allclose((seen.opacity[i], seen.expected[i], seen.median[i]), (alpha, expected, median), rtol=1e-12)
    assert seen.opacity[-1] == seen.expected[-1] == seen.median[-1] == 0


@pytest.mark.parametrize("name", NAMES)
def test_references_are_the_limit_of_a_float64_march(name):
    scene = study_scenes.SCENES[name]
    o, d = rays(scene, 12)
    seen = study_reference.trace(scene, o, d)
    color = seen.color(o, d)
    for i in range(len(o) - 1):
        near, far = march_numpy.box(o[i], d[i], (0, 0, 0), (1, 1, 1))
        jumps = scene.breaks(o[i : i + 1], d[i : i + 1])[0]
        # Steps end at the jumps of density, so that midpoints do not straddle them.
        borders = np.unique(np.concatenate([np.linspace(near, far, 20001), jumps[(jumps > near) & (jumps < far)]]))
        tau, expected, median, total, _ = march_numpy.march(
            lambda p: scene.density(*p.T, study_scenes.NUMPY) + 0 * p[:, 0], o[i], d[i], borders, study_scenes.color
        )
        assert math.isclose(seen.tau[i], tau, rel_tol=1e-6)
        assert math.isclose(seen.expected[i], expected, rel_tol=1e-6) and math.isclose(
            seen.median[i], median, rel_tol=1e-6
        )
        assert np.allclose(color[i], total, atol=2e-5)


def test_a_trace_that_ends_is_the_front_of_a_whole_one():
    for scene in study_scenes.SCENES.values():
        o, d = rays(scene, 8)
        seen = study_reference.trace(scene, o, d)
        half = study_reference.trace(scene, o, d, seen.median)
        assert np.allclose(half.opacity, seen.opacity / 2, rtol=1e-9)


def test_the_point_looked_for_lies_on_the_face_of_a_solid_for_each_kind_of_depth():
    # A lift beyond the face would show a strip beyond the terminator, one short of it would hide a strip before it.
    subject = open_subject("sphere", "auto", 96, 64)
    t, visible = subject.exact(1)
    o, d = subject.rays(1)
    seen = study_reference.trace(subject.analytic, o, d)
    thick = np.isfinite(t) & (seen.tau > 12)
    for kind in ("expected", "median"):
        known = study_reference.compute_truth(
            subject.analytic,
            None,
            o,
            d,
            depth=kind,
            visibility="transmittance",
            falloff=0.1,
            tolerance=1e-9,
            surface_opacity=0.5,
        )
        assert thick.sum() > 100 and np.array_equal(known.visibility[thick] > 0.999, visible[thick]), kind


@pytest.mark.parametrize("visibility", ["depth", "transmittance"])
def test_what_is_no_surface_is_not_visible(visibility):
    scene = study_scenes.SCENES["ramp"]
    o, d = rays(scene, 64)
    known = study_reference.compute_truth(
        scene, None, o, d, depth="expected", visibility=visibility, falloff=0.1, tolerance=1e-3, surface_opacity=0.9
    )
    thin = known.opacity < 0.9
    assert 5 < thin.sum() < 60 and (known.opacity[thin] > 0.1).any() and known.opacity[-1] == 0
    assert (known.visibility[thin] == 0).all() and (known.visibility[~thin] > 0).any() and (known.gaze == 0).all()


@pytest.mark.parametrize("x", [0, 1e-300, 1e-6, 9.9e-3, 1.01e-2, 1, 50, 1e9])
def test_mean_share(x):
    value = study_reference.mean_share(np.array([x]))[0]
    if x < 1e-5:
        assert abs(value - 0.5) < 1e-6
    else:
        assert math.isclose(value, 1 / x - (1 / math.expm1(x) if x < 700 else 0), rel_tol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_integrator_agrees_with_the_reference(name):
    subject = open_subject(name, "auto", 12, 8)
    known = subject.truth(1, "expected", "depth")
    off = errors(
        subject.channels(subject.integrator({"depth": "expected", "step": subject.extent / 2048}), 1, 1), known
    )
    # Thin or hard matter is what steps of a finite length find late.
    bound = 1e-3 if subject.opaque else 2e-6
    assert off["depth_mae"] < bound and off["opacity_mae"] < bound and off["color_rmse"] < max(20 * bound, 1e-4)
    assert off["visibility_mae"] < 30 * bound and off["gaze_mae"] < 30 * bound


def test_a_grid_tends_to_its_density():
    subject = open_subject("fog", "auto", 12, 8)
    known = subject.truth(1, "expected", "depth")
    off = [
        errors(
            subject.channels(subject.integrator({"quadrature": "cells", "depth": "expected"}, resolution=r), 1, 1),
            known,
        )["depth_mae"]
        for r in (8, 32)
    ]
    assert off[1] < off[0] / 6 < 1e-2
