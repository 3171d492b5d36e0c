"""Tests of `nerg_mi.transport.observer_batch`."""

from __future__ import annotations

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.fields.gaze_base import make_prior_table, table_directions
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.transport import observer_batch
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_batch import evaluate_densities
from nerg_mi.transport.observer_gaze import GazeFieldInstance
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.evaluation.gaze_fields import GRID, KINDS, made
from tests.plugins import fields

BOX = Box((-1, -1, -1), (1, 1, 1))
SETTINGS = ObserverSettings(march=MarchSettings(0.02), directions=1 << 14)
EYES = np.array([(0.1, -0.2, 0.3), (-0.4, 0.3, -0.1), (0.7, 0.1, 0.2)])


def lid(mi):
    """A room without a ceiling, and a block in it."""
    turn = mi.ScalarTransform4f
    floor = {"type": "rectangle", "to_world": turn().translate([0, 0, -0.9]).scale(0.9)}
    wall = {"type": "rectangle", "to_world": turn().translate([-0.9, 0, 0]).rotate([0, 1, 0], 90).scale(0.9)}
    block = {"type": "cube", "to_world": turn().translate([0.35, -0.4, 0.0]).scale(0.15)}
    return SceneGeometry(None, mi.load_dict({"type": "scene", "a": floor, "b": wall, "c": block}))


def rays(count=60, seed=0):
    """Rays (N, 3) whose origins are `EYES`, in random order."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    return EYES[rng.permutation(np.arange(count) % len(EYES))], d / np.linalg.norm(d, axis=1, keepdims=True)


def one_by_one(mi, instance, geometry, settings, origins, directions):
    """The densities (members, N) of the rays, each by an evaluation of its own observer."""
    columns = []
    for o, d in zip(origins, directions):
        p_o = mi.Point3f(*map(float, np.float32(o)))
        members = instance.for_observers([p_o], geometry, settings).evaluate_members_along(
            p_o, mi.Vector3f(np.float32(d)[:, None])
        )
        columns.append([float(np.ravel(m)[0]) for m in members])
    return np.array(columns).T


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("tolerance", [0.05, 2e-3])
def test_densities_are_those_of_single_observers(rgb, kind, tolerance):
    settings = replace(SETTINGS, integral_tolerance=tolerance)
    instance, geometry, (o, d) = GazeFieldInstance(made(kind, BOX)), lid(rgb), rays()
    result = evaluate_densities(instance, geometry, settings, o, d)
    assert result.shape == (len(instance.field.members), len(o)) and result.dtype == np.float32
    expected = one_by_one(rgb, instance, geometry, settings, o, d)
    assert np.ptp(expected) > 0.1 * expected.max()
    np.testing.assert_allclose(result, expected, rtol=1e-5)


@pytest.mark.parametrize("kind", ["default recipe", "ensemble"])
def test_escaped_rays_take_the_depths_of_their_neighbours(rgb, kind):
    instance, geometry = GazeFieldInstance(made(kind, BOX, escaped="nearest")), lid(rgb)
    o, d = rays(12)
    result = evaluate_densities(instance, geometry, SETTINGS, o, d)
    np.testing.assert_allclose(result, one_by_one(rgb, instance, geometry, SETTINGS, o, d), rtol=1e-4)
    outside = np.full((1, 3), 1e3)
    # Without any surface there is no depth to interpolate.
    far = evaluate_densities(instance, geometry, SETTINGS, outside, np.array([[1.0, 0, 0]]))
    assert np.isfinite(far).all()


def test_blocks_and_launches_do_not_change_densities(rgb, monkeypatch):
    instance, geometry, (o, d) = GazeFieldInstance(made("ensemble", BOX, escaped="nearest")), lid(rgb), rays(24)
    settings = replace(SETTINGS, integral_tolerance=5e-3)
    whole = evaluate_densities(instance, geometry, settings, o, d)
    monkeypatch.setattr(observer_batch, "_OBSERVERS_PER_BLOCK", 2)
    monkeypatch.setattr(observer_batch, "RAYS_PER_LAUNCH", 7)
    seen = []
    parts = evaluate_densities(instance, geometry, settings, o, d, lambda *done: seen.append(done))
    np.testing.assert_allclose(parts, whole, rtol=1e-5)
    assert seen == [(2, 3), (3, 3)]


@pytest.mark.parametrize("kind", ["normalised", "default recipe", "ensemble"])
def test_densities_integrate_to_one(rgb, kind):
    d = fibonacci_directions(1 << 13)
    instance, geometry = GazeFieldInstance(made(kind, BOX)), lid(rgb)
    o, every = np.repeat(EYES, len(d), axis=0), np.tile(d, (len(EYES), 1))
    density = evaluate_densities(instance, geometry, replace(SETTINGS, integral_tolerance=2e-3), o, every)
    integrals = density.reshape(-1, len(EYES), len(d)).mean(axis=2) * 4 * np.pi
    np.testing.assert_allclose(integrals, 1, atol=5e-3)


@pytest.mark.parametrize("surfaces", ["surface", "none"])
def test_constant_factors_leave_the_prior(rgb, surfaces):
    """With weights of zero the density is the prior, of which the closed form is known, everywhere."""
    kappa, rows, axis = 4.0, 64, np.array([0.6, 0.0, 0.8])
    von_mises_fisher = lambda d: kappa / (4 * np.pi * np.sinh(kappa)) * np.exp(kappa * d @ axis)
    table = make_prior_table(von_mises_fisher(table_directions(rows)), rows, ns, fibonacci_directions(1 << 15))
    config = LogGazeConfig(grid=GRID, width=16, prior=rows, heads=(BOX.lower, BOX.upper), geometry=surfaces)
    field = LogGazeField.random(config, BOX, ns, 0, table)
    field.set_parameters({k: 0 * v for k, v in field.parameters().items() if k != "prior"})
    o, d = rays(30)
    geometry = lid(rgb) if surfaces == "surface" else SceneGeometry(None)
    density = evaluate_densities(GazeFieldInstance(field), geometry, SETTINGS, o, d)[0]
    # A thousandth of the prior is uniform.
    expected = 0.999 * von_mises_fisher(d) + 0.001 / (4 * np.pi)
    np.testing.assert_allclose(density, expected, rtol=5e-3)


def test_densities_move_turn_and_scale_with_the_scene(rgb):
    matrix = np.array([[0, -2, 0, 1.0], [2, 0, 0, -2], [0, 0, 2, 0.5], [0, 0, 0, 1]])
    field, (o, d) = made("linear", BOX), rays(20)
    local = GazeFieldInstance(field)
    world = GazeFieldInstance(field, Similarity(matrix))
    empty = SceneGeometry(None)
    turned = d @ (matrix[:3, :3] / 2).T
    moved = o @ matrix[:3, :3].T + matrix[:3, 3]
    result = evaluate_densities(world, empty, SETTINGS, moved, turned)
    np.testing.assert_allclose(result, evaluate_densities(local, empty, SETTINGS, o, d), rtol=1e-3)


@pytest.mark.parametrize("semantic", ["snapshot", "accumulated"])
def test_semantic_features_are_those_of_each_observer(rgb, tmp_path, semantic):
    fields.radiance(tmp_path / "field.safetensors", density_scale=30.0)
    geometry = SceneGeometry(Environment.open(tmp_path / "field.safetensors").medium)
    instance, (o, d) = GazeFieldInstance(made("linear", BOX, semantic=semantic)), rays(12)
    result = evaluate_densities(instance, geometry, SETTINGS, o, d)
    np.testing.assert_allclose(result, one_by_one(rgb, instance, geometry, SETTINGS, o, d), rtol=1e-4)


def test_rough_integrals_march_in_longer_steps(rgb, tmp_path):
    fields.radiance(tmp_path / "field.safetensors", density_scale=30.0)
    geometry = SceneGeometry(Environment.open(tmp_path / "field.safetensors").medium)
    instance, (o, d) = GazeFieldInstance(made("default recipe", BOX)), rays(12)
    settings = replace(SETTINGS, integral_tolerance=0.02)
    result = evaluate_densities(instance, geometry, settings, o, d)
    expected = one_by_one(rgb, instance, geometry, settings, o, d)
    np.testing.assert_allclose(result, expected, rtol=0.02)
    assert np.abs(result / expected - 1).max() > 1e-6


def test_rough_integrals_keep_the_steps_of_voxels(rgb):
    """Longer steps would pass over this sheet of one voxel."""
    data = np.zeros((32, 32, 32, 1), np.float32)
    data[:, :, 24] = 500
    box = rgb.ScalarTransform4f().translate([-1, -1, -1]).scale([2, 2, 2])
    sheet = {"type": "gridvolume", "data": rgb.TensorXf(data), "filter_type": "nearest", "to_world": box}
    geometry = SceneGeometry(VolumeMedium(rgb.load_dict(sheet)))
    instance, (o, d) = GazeFieldInstance(made("default recipe", BOX)), rays(12)
    march = default_march_settings(geometry)
    settings = replace(
        SETTINGS, integral_tolerance=0.02, march=replace(march, step=0.5 * geometry.medium.cells.min_edge)
    )
    result = evaluate_densities(instance, geometry, settings, o, d)
    np.testing.assert_allclose(result, one_by_one(rgb, instance, geometry, settings, o, d), rtol=1e-4)
