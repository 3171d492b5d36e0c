"""The integral over an observer's sphere: a number of the place and the observer, not of how many directions it is a
sum over."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.field.backend import namespace
from nerg_mi.field.gaze.log_density import LogGazeField
from nerg_mi.formats.volumes import write_volume
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.training.geometry.places import place_of_volume
from nerg_mi.transport.march.settings import MarchSettings
from nerg_mi.transport.observer.gaze_medium import GazeMedium
from nerg_mi.transport.observer.integral import GazeIntegral, nearest_depth
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import default_settings
from tests.field.gaze.test_log_density import BOX, SMALL


@pytest.fixture(scope="module")
def speckled(tmp_path_factory):
    """A room whose walls are known in places only, as hit points know them."""
    mi.set_variant("llvm_ad_rgb")
    rng = np.random.default_rng(3)
    density = 1e4 * (rng.random((24, 32, 32)) < 0.003)
    density[8:16, 12:20, 12:20] = 0
    path = tmp_path_factory.mktemp("place") / "hits.vol"
    write_volume(path, density, BOX.lower, BOX.upper)
    return place_of_volume(path).medium


@pytest.mark.parametrize("escaped", ["constant", "nearest"])
def test_does_not_depend_on_the_number_of_directions(speckled, escaped):
    config, ns = replace(SMALL, escaped=escaped), namespace("llvm_ad_rgb")
    field = LogGazeField.random(config, BOX, ns, 1)
    rng = np.random.default_rng(1)
    # Steep, so that it matters where what escapes is taken to end.
    field.set_parameters({"grid.table": ns.Float(10 * rng.normal(size=len(field.grid.table)).astype(np.float32))})
    place, settings = Place(speckled), default_settings(speckled)
    integral = lambda count, p: float(
        GazeIntegral(GazeMedium(field), place, mi.Point3f(*p), settings, "median", 0.5, count).value()[0]
    )
    for p in ((0, 0, 1.5), (0.3, -0.2, 1.6)):
        assert integral(1 << 17, p) == pytest.approx(integral(1 << 19, p), rel=3e-4), p


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_is_the_sum_over_what_is_seen_all_around(rgb, variant):
    """In a room of shapes, whose walls are where a formula says."""
    ns, rng = namespace("llvm_ad_rgb"), np.random.default_rng(1)
    field = LogGazeField.random(
        replace(SMALL, variant=variant, mix=0.0), BOX, ns, 1, rng.normal(size=(SMALL.prior, 2 * SMALL.prior))
    )
    field.set_parameters({"grid.table": ns.Float(3 * rng.normal(size=len(field.grid.table)).astype(np.float32))})
    room = rgb.load_dict(
        {
            "type": "scene",
            "walls": {
                "type": "cube",
                "to_world": rgb.ScalarTransform4f().translate([0, 0, 1.5]).scale([1.9, 1.9, 1.4]),
            },
        }
    )
    o = np.array([0.4, -0.7, 1.7])
    gaze = GazeMedium(field)
    found = GazeIntegral(
        gaze, Place(None, room), rgb.Point3f(*map(float, o)), MarchSettings(0.1), "median", 0.5, 1 << 16
    ).value()[0]
    d = fibonacci_directions(20_000)
    walls = np.where(d > 0, [1.9, 1.9, 2.9], [-1.9, -1.9, 0.1])
    distance = ((walls - o) / d).min(axis=1)
    array = lambda v: ns.Array3f(np.ascontiguousarray(v.T, np.float32))
    emit, capture = field.unnormalized(array(o + d * distance[:, None]), array(np.broadcast_to(o, d.shape)), array(d))
    assert found == pytest.approx(4 * np.pi * np.mean(np.array(emit * capture, np.float64)), rel=3e-3)


@pytest.mark.parametrize("count", [1, 5, 8, 40])
def test_depths_of_what_escapes_are_those_of_its_neighbours(count):
    """By hand: the weighted mean of the logarithm over the eight nearest, or all where there are fewer."""
    rng = np.random.default_rng(count)
    unit = lambda n: (lambda v: v / np.linalg.norm(v, axis=1, keepdims=True))(rng.normal(size=(n, 3)))
    known, wanted, depth = unit(count), unit(30), rng.uniform(0.2, 9.0, count)
    expected = []
    for w in wanted:
        apart = np.linalg.norm(known - w, axis=1)
        near = np.argsort(apart)[:8]
        weight = 1 / (apart[near] ** 2 + 1e-3)
        expected.append(np.exp(np.sum(weight * np.log(depth[near])) / weight.sum()))
    np.testing.assert_allclose(nearest_depth(known, depth, wanted), expected, rtol=1e-5)
    # A depth of zero has a logarithm too.
    assert nearest_depth(known, np.zeros(count), wanted) == pytest.approx(1e-6)
