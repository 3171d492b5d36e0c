"""The gaze field against NumPy: equation 1, variants and activations."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import ACTIVATIONS, VARIANTS, GazeConfig, ProductHead, activate, softplus
from nerg_mi.maths.geometry import Box
from tests.reference import fields_numpy as reference

GRID = dict(levels=4, features=2, log2_rows=12, base=4, finest=32)
BOX = Box((-1, 0, 2), (3, 2, 4))


def make(variant="emit_capture", activation="softplus", gain=3.0):
    config = GazeConfig(HashGridConfig(**GRID), variant, activation, width=16, geometry=7)
    field = ProductHead.random(config, BOX, ns, 3)
    rng = np.random.default_rng(3)
    values = {"grid.table": ns.Float(gain * rng.normal(size=len(field.grid.table)).astype(np.float32))}
    values |= {k: v * gain for k, v in field.parameters().items() if k.endswith("head.0")}
    field.set_parameters(values)
    return field


def arrays(field):
    return {k: v.numpy() for k, v in field.parameters().items()}


def queries(n=50):
    rng = np.random.default_rng(5)
    p_o, p_od = rng.uniform(BOX.lower, BOX.upper, (2, n, 3)).astype(np.float32)
    r_o = (p_od - p_o) / np.linalg.norm(p_od - p_o, axis=-1, keepdims=True)
    return p_od, p_o, r_o


def evaluate(field, p_od, p_o, r_o):
    out = field.evaluate(*(ns.Array3f(np.asarray(v, np.float32).T) for v in (p_od, p_o, r_o)))
    return [np.broadcast_to(v.numpy(), len(p_od)) for v in out]


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test01_equals_numpy(variant, activation):
    field, (p_od, p_o, r_o) = make(variant, activation), queries()
    got = evaluate(field, p_od, p_o, r_o)
    expected = reference.gaze(p_od, p_o, r_o, arrays(field), GRID, BOX.lower, BOX.upper, variant, activation)
    for g, e in zip(got, expected):
        assert np.allclose(g, e, rtol=3e-5, atol=3e-6)
    # The values are not trivial.
    assert np.ptp(expected[0]) > 0.05


def test05_features_are_zero_outside_the_box():
    field = make(activation="linear")
    far = np.array([[100.0, 0, 0], [0, -50, 3]], np.float32)
    # No bias anywhere: zero features leave only the dependence on direction.
    _, emit, _ = evaluate(field, far, far, np.tile([0, 0, 1.0], (2, 1)))
    assert emit[0] == emit[1]


def test06_softplus_and_its_gradient():
    x = ns.Float([-1e4, -100, -50, -1, -1e-4, 0, 1e-4, 1, 50, 100, 1e4])
    dr.enable_grad(x)
    y = softplus(x)
    dr.backward(dr.sum(y))
    v = x.numpy().astype(float)
    assert np.allclose(y.numpy(), np.logaddexp(0, v), rtol=1e-6, atol=1e-7)
    assert np.all(y.numpy() >= 0)
    assert np.allclose(dr.grad(x).numpy(), reference.sigmoid(v), atol=1e-6)


def test07_extreme_activations_are_finite():
    x = ns.Float([-1e30, -90, 0, 29, 90, 1e30])
    for name in ("softplus", "exp"):
        assert np.all(np.isfinite(activate(x, name).numpy())) and np.all(activate(x, name).numpy() >= 0)
    assert np.array_equal(activate(x, "linear").numpy(), x.numpy())


@pytest.mark.parametrize("name", ["grid.table", "position_net.1", "direction_net.0", "emit_head.0", "capture_head.0"])
def test08_gradients_equal_central_differences(name):
    field, (p_od, p_o, r_o) = make(), queries(12)
    w = type(field.parameters()[name])(field.parameters()[name])
    dr.enable_grad(w)
    field.set_parameters({name: w})
    dr.backward(dr.sum(field.evaluate(*(ns.Array3f(v.T) for v in (p_od, p_o, r_o)))[0]))
    gradient = dr.grad(w).numpy().ravel()
    values = {k: v.astype(np.float64) for k, v in arrays(field).items()}
    for i in np.argsort(-np.abs(gradient))[[0, 3, 10]]:
        ends = []
        for h in (1e-6, -1e-6):
            moved = {**values, name: values[name].copy()}
            moved[name].flat[i] += h
            ends.append(
                reference.gaze(p_od, p_o, r_o, moved, GRID, BOX.lower, BOX.upper, "emit_capture", "softplus")[0].sum()
            )
        assert np.isclose(gradient[i], (ends[0] - ends[1]) / 2e-6, rtol=3e-3, atol=1e-5)


def test09_names_and_sizes():
    config = GazeConfig()
    assert config.position_sizes == [32, 64, 15] and config.direction_sizes == [31, 64, 64]
    assert config.grid.finest == 512
    assert GazeConfig.from_dict(make().config.to_dict()) == make().config
    assert list(make().parameters()) == [
        "grid.table",
        "position_net.0",
        "position_net.1",
        "direction_net.0",
        "direction_net.1",
        "emit_head.0",
        "capture_head.0",
    ]
    with pytest.raises(ValueError, match='no parameter "color_net.0"'):
        make().set_parameters({"color_net.0": None})


@pytest.mark.parametrize(
    "wrong, words",
    [
        (dict(variant="both"), 'emit_capture.*"both"'),
        (dict(activation="relu"), '"relu"'),
        (dict(width=0), "at least 1"),
        (dict(semantic="snapshot", normalized=True), "cannot be normalised"),
        (dict(semantic="snapshot", variant="capture"), "inputs of emit"),
    ],
)
def test10_wrong_settings(wrong, words):
    with pytest.raises(ValueError, match=words):
        GazeConfig(**wrong)
    # One of two exclusive options is valid.
    for name, value in wrong.items() if len(wrong) > 1 else ():
        assert getattr(GazeConfig(**{name: value}), name) == value


def test11_single_observer_with_many_directions():
    # As in the integrator: a single position, one direction per pixel; values and gradients.
    field, (p_od, p_o, r_o) = make(), queries(8)
    x = ns.Float(0)
    dr.enable_grad(x)
    eye = ns.Array3f(*p_o[0].tolist()) + ns.Array3f(x, 0.5 * x, -x)
    gaze = field.evaluate(ns.Array3f(p_od.T), eye, ns.Array3f(r_o.T))[0]
    many = np.repeat(p_o[:1], 8, 0)
    assert np.allclose(gaze.numpy(), evaluate(field, p_od, many, r_o)[0], rtol=1e-6)
    dr.backward(dr.sum(gaze))
    ends = [
        reference.gaze(
            p_od,
            many + h * np.array([1, 0.5, -1]),
            r_o,
            arrays(field),
            GRID,
            BOX.lower,
            BOX.upper,
            "emit_capture",
            "softplus",
        )[0].sum()
        for h in (1e-4, -1e-4)
    ]
    assert np.isclose(dr.grad(x).numpy()[0], (ends[0] - ends[1]) / 2e-4, rtol=0.02)
