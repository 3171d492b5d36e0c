"""What else is known of observers: made once for each, and shown to every lane that belongs to them."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.maths.geometry import Similarity
from nerg_mi.transport.observer import ObserverCache, SupportView, view_along


class Counting:
    """A view that counts for whom it was made: the x of the observer, plus that of the direction."""

    occluded = True

    def __init__(self):
        self.made = 0

    def at(self, p_o):
        self.made += 1
        return Of(p_o.x)


class Of:
    def __init__(self, x):
        self.x = x

    def value(self, r_o):
        return self.x + r_o.x


def test_a_view_is_made_once_an_observer(rgb):
    view, cache = Counting(), ObserverCache()
    eyes = [rgb.Point3f(1, 0, 0), rgb.Point3f(5, 0, 0)]
    p_o, r_o = rgb.Point3f([1, 5, 5], 0, 0), rgb.Vector3f([0.1, 0.2, 0.3], 0, 0)
    for _ in range(2):
        assert np.allclose(view_along(view, eyes, p_o, r_o, cache).numpy(), [1.1, 5.2, 5.3])
        assert view.made == 2


def test_a_frozen_function_is_refused(rgb):
    cache = ObserverCache()

    @dr.freeze
    def frozen(p):
        return view_along(Counting(), [p], p, rgb.Vector3f(0, 0, 1), cache)

    with pytest.raises(RuntimeError) as refused:
        frozen(rgb.Point3f(rgb.Float([1]), 0, 0))
    assert isinstance(refused.value.__cause__, NergError) and 'out of "aovs"' in str(refused.value.__cause__)


def test_support_is_that_of_the_place_in_the_scene(rgb):
    origins = np.random.default_rng(0).normal(size=(100, 3))
    support = RaySupport.of(origins, 2.0)
    m = np.array([[0, -2.0, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])
    p = np.array([0.2, -0.3, 0.4])
    alone = support.at(rgb.Point3f(*map(float, p)))[0]
    there = rgb.Point3f(*map(float, (m @ [*p, 1])[:3]))
    found = SupportView(support, Similarity(m)).at(there).value(rgb.Vector3f(0, 0, 1))
    assert found[0] == pytest.approx(alone, rel=1e-5) and alone > 1
