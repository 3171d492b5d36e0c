"""Gaze on Gaussian splats: closed forms, and the sum that looks at all Gaussians in double precision."""

import drjit as dr
import numpy as np

from nerg_mi.fields.splats import Splats, matrices_of
from nerg_mi.surfaces.sources import lookers_of_law
from nerg_mi.surfaces.splats import splat_densities
from nerg_mi.transport.geometry import Place, default_settings
from nerg_mi.transport.observer import ObserverSettings
from tests.reference import splats as reference
from tests.surfaces.meshes import vmf
from tests.transport.media.splats.scenes import medium_of, stack

EYE = np.array([[0.0, 0, -2]])
ALONG = np.array([0.0, 0, 1])


def found(splats, law, eyes=EYE, weights=(1.0,), **more):
    place = Place(medium_of(splats))
    settings = ObserverSettings(march=default_settings(place))
    make, eyes, weights = lookers_of_law(law), np.asarray(eyes), np.asarray(weights)
    return splat_densities(splats, place, make, eyes, weights, settings, **more).sum(axis=0)


def uniform(rgb):
    return lambda d: dr.full(rgb.Float, 1 / (4 * np.pi), dr.width(d))


def test01_a_ball_that_is_looked_at_and_one_behind_it(rgb):
    """Kappa / 2 pi in the middle of a narrow law, by the square of the distance; nothing in the shadow."""
    balls = stack([0.0, 1.0], [0.95, 0.95])
    kappa = 300.0
    there = found(balls, vmf(rgb, ALONG, kappa))
    assert np.allclose(there, [kappa / (2 * np.pi) / 4, 0], rtol=1e-5)
    # From the other side it is the other one, and three of four look from there.
    both = found(balls, uniform(rgb), [EYE[0], (0, 0, 4.0)], [0.25, 0.75])
    assert np.allclose(both, [0.25 / (4 * np.pi * 4), 0.75 / (4 * np.pi * 9)], rtol=1e-5)
    # What a ball lets through reaches the next: half of a ray's opacity lies there.
    assert found(stack([0.0, 1.0], [0.2, 0.95]), uniform(rgb))[1] > 0


def test02_a_disk_by_its_cosine_and_any_by_the_area_under_which_it_is_seen(rgb):
    angles = np.radians([0, 30, 60, 80])
    turned = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=1)
    far = np.stack([40.0 * np.arange(4), 0 * angles, 0 * angles], axis=1)
    make = lambda scales: Splats(far, [scales] * 4, turned, [0.9] * 4, np.zeros((4, 1, 3)))
    eyes = lambda k: far[k] - [0, 0, 2]
    seen = [found(make((0.1, 0.1, 1e-4)), uniform(rgb), [eyes(k)])[k] for k in range(4)]
    assert np.allclose(np.array(seen) * 16 * np.pi, np.cos(angles), rtol=1e-4)
    # The outline of an ellipsoid has the area pi det(S) |S^-1 w| (of semi-axes S), and the largest one pi s0 s1.
    scales = np.array([0.1, 0.05, 0.02])
    for k in range(4):
        w = matrices_of(turned[k : k + 1])[0].T @ [0, 0, 1]
        area = np.prod(scales) * np.linalg.norm(w / scales) / (scales[0] * scales[1])
        assert np.isclose(found(make(scales), uniform(rgb), [eyes(k)])[k] * 16 * np.pi, area, rtol=1e-4)


def test03_all_gaussians_in_double_precision(rgb):
    """Visibility by the median depth of the ray to a point before the centre, by the thickness and the tolerance."""
    rng = np.random.default_rng(3)
    n = 60
    centers, scales = rng.uniform(-1, 1, (n, 3)), rng.uniform(0.02, 0.3, (n, 3))
    splats = Splats(centers, scales, rng.normal(size=(n, 4)), rng.uniform(0.3, 1, n), rng.normal(size=(n, 4, 3)))
    law, eye = vmf(rgb, ALONG, 4.0), EYE[0]
    c = splats.centers.astype(np.float64)
    covariance = np.einsum("nij,nj,nkj->nik", splats.axes(), splats.scales.astype(float) ** 2, splats.axes())
    inverse = np.linalg.inv(covariance)
    to, distance = c - eye, np.linalg.norm(c - eye, axis=1)
    w = to / distance[:, None]
    normal = np.einsum("nij,nj->ni", inverse, w)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    depth = np.sqrt(np.einsum("ni,nij,nj->n", normal, covariance, normal))
    tolerance = 2 * np.median(splats.scales.min(axis=1))
    before = c - (depth + tolerance)[:, None] * normal - eye
    reach = np.linalg.norm(before, axis=1)
    d = before / reach[:, None]
    opacity, _, _, median = reference.trace(splats, np.tile(eye, (n, 1)), d)
    hidden = (opacity >= 0.5) & (median < reach - tolerance)
    density = 4 / (2 * np.pi * (1 - np.exp(-8))) * np.exp(4 * (w @ ALONG - 1))
    area = np.sqrt(np.einsum("ni,nij,nj->n", w, inverse, w)) * splats.scales.min(axis=1)
    expected = np.where(hidden, 0, density * area / distance**2)
    there = found(splats, law)
    assert 10 < hidden.sum() < 50
    assert np.allclose(there, expected, rtol=1e-4)


def test04_a_cone_widens_a_law_and_within_a_gaussian_nothing_is_infinite(rgb):
    ball, cone, kappa = stack([0.0], [0.9]), 0.03, 400.0
    wide = 1 / (1 / kappa + cone**2)
    assert np.isclose(found(ball, vmf(rgb, ALONG, kappa), cone=cone)[0] * 8 * np.pi, wide, rtol=0.02)
    inside = found(ball, uniform(rgb), [(0, 0, -0.01), (0, 0, -0.1)], [1.0, 0.0])
    assert np.isclose(inside[0], 1 / (4 * np.pi * 0.1**2), rtol=1e-5)
