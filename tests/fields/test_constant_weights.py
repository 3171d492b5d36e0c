"""Which fields have constant weights, and when they are in the way."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields import mlp
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import GazeEnsemble
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import MLP, evaluate, set_constant_weights
from nerg_mi.fields.radiance import Background, BackgroundConfig, RadianceConfig, RadianceField
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.jit import no_collection

GRID = HashGridConfig(levels=2, log2_rows=8, base=2, finest=8)
BOX = Box((0, 0, 0), (1, 1, 1))


def points(n=64):
    return ns.Array3f(np.random.default_rng(1).uniform(0, 1, (3, n)).astype(np.float32))


def directions(n=64):
    return dr.normalize(ns.Array3f(np.random.default_rng(2).normal(size=(3, n)).astype(np.float32)))


def gaze_log(seed=0):
    return LogGazeField.random(LogGazeConfig(grid=GRID), BOX, ns, seed)


def radiance():
    return RadianceField.random(RadianceConfig(grid=GRID, width=16), BOX, ns)


def said_by(field):
    """All that evaluations return (rows of numbers)."""
    p, d = points(), directions()
    if isinstance(field, RadianceField):
        sigma, features = field.density_features(p)
        return np.array([sigma, field.density(p), *features, *field.color(features, d)])
    return np.array(field.unnormalized(p, p * 0.5, d) if field.config.normalized else field.evaluate(p, p * 0.5, d))


@pytest.fixture
def unrolled(monkeypatch):
    """Networks that were evaluated with constant weights, one entry each."""
    found = []
    monkeypatch.setattr(mlp, "evaluate", lambda layers, x: found.append(len(layers)) or evaluate(layers, x))
    return found


@pytest.mark.parametrize("make", [radiance, gaze_log, lambda: GazeField.random(GazeConfig(grid=GRID), BOX, ns)])
def test01_fields_say_the_same_to_the_bit(make, unrolled):
    field = make()
    before = said_by(field)
    set_constant_weights(field)
    assert not unrolled
    assert np.ptp(before, axis=1).max() > 0 and np.array_equal(said_by(field), before)
    assert len(unrolled) >= len(field.mlps)


def test02_all_networks_of_all_members_and_back():
    ensemble = GazeEnsemble([gaze_log(0), gaze_log(1)])
    for constant in (True, False):
        set_constant_weights(ensemble, constant)
        assert [net.constant for m in ensemble.members for net in (m.emit_net, m.capture_net)] == [constant] * 4


def test03_weights_that_are_replaced_count():
    field = radiance()
    set_constant_weights(field)
    before = said_by(field)
    field.set_parameters({k: v * 2 for k, v in field.parameters().items() if "net" in k})
    assert field.density_net.constant and field.color_net.constant
    other = radiance()
    other.set_parameters({k: v * 2 for k, v in other.parameters().items() if "net" in k})
    after = said_by(field)
    assert not np.array_equal(after, before) and np.array_equal(after, said_by(other))


def slope_of_weights(field):
    weights = field.parameters()["density_net.0"]
    dr.enable_grad(weights)
    field.set_parameters({"density_net.0": weights})
    dr.backward(dr.sum(field.density(points())))
    return weights.grad.numpy()


def slope_of_points(field):
    p = points()
    dr.enable_grad(p)
    dr.backward(dr.sum(field.density(p)))
    return np.array(p.grad)


@pytest.mark.parametrize("slope", [slope_of_weights, slope_of_points])
def test04_derivatives_are_as_without(slope, unrolled):
    plain, field = radiance(), radiance()
    set_constant_weights(field)
    expected = slope(plain)
    assert np.abs(expected).max() > 0 and np.allclose(slope(field), expected, rtol=1e-5, atol=1e-9)
    assert not unrolled


def test05_a_recorded_function_sees_weights_that_change(unrolled):
    field = radiance()
    set_constant_weights(field)

    @dr.freeze
    def recorded(field, p):
        with no_collection():
            return field.density(p)

    p = points()
    first = recorded(field, p).numpy()
    field.set_parameters({"density_net.1": field.parameters()["density_net.1"] * 2})
    second = recorded(field, p).numpy()
    assert not unrolled
    assert np.allclose(first, radiance().density(p).numpy(), rtol=1e-6)
    assert np.allclose(second, field.density(p).numpy(), rtol=1e-6) and not np.allclose(first, second)


def test06_a_background_is_part_of_its_field():
    flat = HashGridConfig(levels=2, log2_rows=8, base=2, finest=8, dimensions=2)
    behind = Background.random(BackgroundConfig(radius=2.0, grid=flat), ns, np.random.default_rng(0))
    field = radiance()
    field.background = behind
    set_constant_weights(field)
    assert behind.net.constant


def test07_normalised_layers_stay_as_they_are():
    net = MLP.random([8, 16, 3], ns, np.random.default_rng(5), normalized=True)
    x = [ns.Float(c) for c in np.random.default_rng(6).normal(size=(8, 20)).astype(np.float32)]
    before = np.array(net(x))
    net.constant = True
    assert np.ptp(before) > 0 and np.array_equal(np.array(net(x)), before)
