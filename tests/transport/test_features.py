"""Features that a gaze field may ask for: of the point itself, or gathered on the way there."""

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceField, mean_features
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.transport.field_medium import FeaturePainter, FieldMedium, color_painter, observed_features
from nerg_mi.transport.geometry import Place
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import ColorPainter

O, D = np.array([0.1, -0.2, -3.0]), np.array([0.0, 0.1, 1.0]) / np.hypot(0.1, 1)


@pytest.fixture
def place(rgb):
    """A field of the cube [-1, 1]³, at twice the size."""
    config = RadianceConfig(HashGridConfig(levels=2, log2_rows=10, base=4, finest=8), width=16, geometry=3, sh_degree=2)
    field, rng = RadianceField.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 0), np.random.default_rng(0)
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    return Place(FieldMedium(field, Similarity(np.diag([2.0, 2, 2, 1])))), field


def asked(rgb, place, kind, p, active=True):
    vector = lambda of, v: of(*map(float, v))
    settings = MarchSettings(1 / 128, stop=0.0, color_cutoff=1e-2)
    found = observed_features(
        kind, place, vector(rgb.Point3f, p), vector(rgb.Point3f, O), vector(rgb.Vector3f, D), rgb.Bool(active), settings
    )
    return None if found is None else np.array([f[0] for f in found])


def features(field, p):
    """Density and features of points (N, 3) of the scene, whose unit is half of the field's."""
    sigma, f = field.density_features(ns.Array3f(np.ascontiguousarray((p / 2).T, np.float32)))
    return sigma.numpy() / 2, np.stack([x.numpy() for x in f], axis=1)


def test_a_snapshot_is_of_the_point(rgb, place):
    place, field = place
    p = np.array([0.3, 0.5, 0.2])
    assert np.allclose(asked(rgb, place, "snapshot", p), features(field, p[None])[1][0], atol=1e-5)
    assert not asked(rgb, place, "snapshot", p, active=False).any() and asked(rgb, place, "", p) is None


def test_accumulated_ones_are_weighted_by_what_reaches_the_eye(rgb, place):
    place, field = place
    t = np.linspace(0, 6, 6001)
    p = O + D * (0.5 * (t[:-1] + t[1:]))[:, None]
    sigma, f = features(field, p)
    tau = sigma * np.diff(t) * (np.abs(p).max(axis=1) < 2)
    weight = np.exp(-(np.cumsum(tau) - tau)) * -np.expm1(-tau)
    found = asked(rgb, place, "accumulated", (0.3, 0.5, 0.2))
    assert found.shape == (3,) and np.allclose(found, weight @ f, atol=5e-3 * np.abs(f).max())
    assert not asked(rgb, place, "accumulated", (0.3, 0.5, 0.2), active=False).any()
    assert np.abs(found - asked(rgb, place, "snapshot", (0.3, 0.5, 0.2))).max() > 0.01


def test_colours_of_a_deferred_medium_come_of_what_is_accumulated(rgb, place):
    """Beside features or alone; those of another medium from its samples."""
    kinds = []
    for deferred in (False, True):
        field = place[1]
        config = replace(field.config, deferred=deferred)
        medium = FieldMedium(RadianceField(config, field.box, field.grid, field.density_net, field.color_net))
        ray = medium.local(rgb.Point3f(0.1, -0.2, -3), rgb.Vector3f(*map(float, D)))
        one, both = color_painter(medium, rgb.Color3f), color_painter(medium, rgb.Color3f, features=True)
        kinds.append(type(one))
        found = []
        for painter in (one, both):
            r = march(medium, ray, ray.t_near, ray.t_far, True, MarchSettings(1 / 64, color_cutoff=0.0), color=painter)
            found.append(np.array(painter.color(medium, r.color, r.opacity, ray, rgb.Bool(True))).ravel())
            hidden = painter.color(medium, r.color, r.opacity, ray, rgb.Bool(False))
            assert not deferred or not np.array(hidden).any()
        sums = both.features(r.color)
        assert len(sums) == 3 and np.allclose(found[0], found[1], atol=1e-6) and found[0].max() > 0.01
        if deferred:
            means = mean_features(sums, r.opacity)
            want = np.array(r.opacity * medium.field.color(means, ray.w)).ravel()
            assert np.allclose(found[0], want, atol=1e-6)
    assert kinds == [ColorPainter, FeaturePainter]
    assert FeaturePainter(medium).color(medium, r.color, r.opacity, ray, True) is None
