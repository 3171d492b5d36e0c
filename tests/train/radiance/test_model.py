"""The forward pass that trains: what was looked up already changes no value and no derivative, and heads are the
field's."""

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np

from nerg_mi.fields.radiance import RadianceField
from nerg_mi.train.radiance_losses import density, density_of, density_summand, ray_color, stack, unstack

from .ball import BOX, TINY


def field():
    out, rng = RadianceField.random(TINY, BOX, ns, 0), np.random.default_rng(1)
    out.set_parameters({"grid.table": ns.Float(rng.normal(size=len(out.grid.table)).astype(np.float32))})
    return out


def points():
    rng = np.random.default_rng(2)
    p = ns.Array3f(rng.uniform(-0.9, 0.9, (3, 40)).astype(np.float32))
    return p, dr.normalize(ns.Array3f(rng.normal(size=(3, 40)).astype(np.float32)))


def test_known_features_change_no_value_and_no_derivative():
    f, (p, d), found = field(), points(), []
    known = [dr.detach(x) for x in f.grid(BOX.to_unit(p))]
    for features in (None, known):
        parameters = {k: type(v)(v) for k, v in f.parameters().items()}
        dr.enable_grad(parameters)
        sigma, rgb = density_summand(TINY, BOX, parameters, p, d, ns, features)
        dr.backward(dr.sum(sigma + rgb[0] - 2 * rgb[1] * rgb[2]))
        found.append([dr.detach(sigma).numpy()] + [dr.grad(v).numpy() for v in parameters.values()])
    for a, b in zip(*found):
        assert np.abs(b).max() > 0 and np.allclose(a, b, rtol=1e-4, atol=1e-5)


def test_density_alone_is_that_of_the_field():
    f, (p, _) = field(), points()
    want = f.density(p).numpy()
    assert np.allclose(density(TINY, BOX, f.parameters(), p, ns).numpy(), want, rtol=1e-4)
    features = [ns.Float(x) for x in f.grid(BOX.to_unit(p))]
    assert np.allclose(density_of(TINY, BOX, f.parameters(), p, features).numpy(), want, rtol=1e-4)


def test_rows_are_stacked_and_taken_apart():
    rows = [ns.Float([1, 2, 3]), ns.Float([4, 5, 6])]
    x = stack(rows, ns)
    assert x.shape == (3, 2) and np.array_equal(x.numpy(), [[1, 4], [2, 5], [3, 6]])
    assert np.array_equal([r.numpy() for r in unstack(x, ns)], [[1, 2, 3], [4, 5, 6]])
    dr.enable_grad(x)
    a, b = unstack(x, ns)
    dr.backward(dr.sum(a * ns.Float([1, 10, 100]) + 2 * b))
    assert np.array_equal(dr.grad(x).numpy(), [[1, 2], [10, 2], [100, 2]])


def test_tensor_products_equal_the_fields_own_evaluation():
    rng = np.random.default_rng(2)
    field = RadianceField.random(TINY, BOX, ns, 0)
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    p = ns.Array3f(rng.uniform(-0.99, 0.99, (3, 200)).astype(np.float32))
    d = dr.normalize(ns.Array3f(rng.normal(size=(3, 200)).astype(np.float32)))
    sigma, rgb = density_summand(TINY, BOX, field.parameters(), p, d, ns)
    expected, features = field.density_features(p)
    assert np.allclose(sigma.numpy(), expected.numpy(), rtol=1e-4)
    assert np.allclose(np.array([c.numpy() for c in rgb]), field.color(features, d).numpy(), atol=1e-5)


def test_a_deferred_field_composites_features_and_colours_rays():
    config, (p, d) = replace(TINY, deferred=True), points()
    made = RadianceField.random(config, BOX, ns, 0)
    sigma, parts = density_summand(config, BOX, made.parameters(), p, d, ns)
    expected, features = made.density_features(p)
    assert np.allclose(sigma.numpy(), expected.numpy(), rtol=1e-4) and len(parts) == TINY.geometry
    assert np.allclose([x.numpy() for x in parts], [x.numpy() for x in features], atol=1e-6)
    opacity = ns.Float(np.linspace(0, 1, 40).astype(np.float32))
    rgb = ray_color(config, made.parameters(), [opacity * f for f in features], opacity, d, ns)
    assert np.allclose([c.numpy() for c in rgb], opacity.numpy() * made.color(features, d).numpy(), atol=1e-5)
    assert ray_color(TINY, {}, parts, opacity, d, ns) is parts
