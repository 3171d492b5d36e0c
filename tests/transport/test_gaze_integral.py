"""The integral over an observer's sphere: a number of the place and the observer, not of how many directions it is a sum over."""
from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.field.log_gaze import LogGazeField
from nerg_mi.field.backend import namespace
from nerg_mi.training.gaze_places import place_of_volume
from nerg_mi.formats.volumes import write_volume
from nerg_mi.transport.gaze_integral import GazeIntegral
from nerg_mi.transport.media import GazeMedium
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import default_settings
from ..field.test_log_gaze import BOX, SMALL


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
    integral = lambda count, p: float(GazeIntegral(GazeMedium(field), place, mi.Point3f(*p), settings, "median", 0.5, count).value()[0])
    for p in ((0, 0, 1.5), (0.3, -0.2, 1.6)):
        assert integral(1 << 17, p) == pytest.approx(integral(1 << 19, p), rel=3e-4), p
