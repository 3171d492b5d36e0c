"""What is kept of observers: for the same position, as long as what it was made of is the same."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.geometry import Place
from nerg_mi.transport.jit import Fingerprint
from nerg_mi.transport.observer import Known, ObserverCache, fingerprint_of
from nerg_mi.transport.volume_medium import VolumeMedium


@pytest.fixture
def made():
    """A list, and a maker that appends to it the position that it was called for."""
    calls = []

    def make(center):
        calls.append(np.array(center).ravel().tolist())
        return len(calls)

    return calls, make


def values(known):
    return [k.value for k in known]


def test_the_same_position_is_served_again(rgb, made):
    cache, (calls, make) = ObserverCache(), made
    eyes = [rgb.Point3f(1, 2, 3), rgb.Point3f(4, 5, 6)]
    first = cache.of_each("thing", eyes, 0, make)
    assert values(first) == [1, 2] and calls == [[1, 2, 3], [4, 5, 6]]
    assert np.allclose(np.array(first[1].center).ravel(), [4, 5, 6])
    # In another order, and one of them alone: the other one is not kept then.
    assert values(cache.of_each("thing", eyes[::-1], 0, make)) == [2, 1]
    assert values(cache.of_each("thing", eyes[:1], 0, make)) == [1]
    assert values(cache.of_each("thing", eyes, 0, make)) == [1, 3]
    # To the bit.
    next_to = rgb.Point3f(1, 2, float(np.nextafter(np.float32(3), np.float32(4))))
    assert values(cache.of_each("thing", [next_to], 0, make)) == [4]


def test_numbers_of_others_are_kept(rgb, made):
    (calls, make), whole = made, ObserverCache()
    own = lambda known: make(known.center)
    at = lambda x: [Known(rgb.Point3f(x, 0, 0), None)]
    assert [values(whole.of_numbers("n", at(x), 0, own)) for x in (1, 2, 1)] == [[1], [2], [1]]
    # Of a cache that lives shortly they are those of the whole; what is more than a number is its own.
    part = ObserverCache(numbers=whole)
    assert values(part.of_numbers("n", at(2), 0, own)) == [2]
    assert values(part.of_known("n", at(2), 0, own)) == [3] and values(whole.of_known("m", at(2), 0, own)) == [4]
    # Others of what has changed are dropped, and of very many those who were asked for first.
    assert values(whole.of_numbers("n", at(1), 1, own)) == [5] and len(whole.peek("n")) == 1
    for x in range(2, 300):
        whole.of_numbers("n", at(x), 1, own)
    assert len(whole.peek("n")) == 257
    count = len(calls)
    whole.of_numbers("n", at(298), 1, own)
    assert len(calls) == count
    whole.of_numbers("n", at(1), 1, own)
    assert len(calls) == count + 1


def test_two_who_stand_at_one_place_share(rgb, made):
    cache, (_, make) = ObserverCache(), made
    assert values(cache.of_each("thing", [rgb.Point3f(1, 2, 3)] * 2, 0, make)) == [1, 1]


def test_each_thing_has_its_own(rgb, made):
    cache, (_, make) = ObserverCache(), made
    eye = [rgb.Point3f(1, 2, 3)]
    assert [values(cache.of_each(t, eye, 0, make)) for t in ("a", "b", "a")] == [[1], [2], [1]]
    assert values(cache.peek("a")) == [1] and cache.peek("c") == []
    cache.forget()
    assert values(cache.of_each("a", eye, 0, make)) == [3] and cache.peek("b") == []


def test_other_arrays_make_it_anew(rgb, made):
    cache, (_, make) = ObserverCache(), made
    eye, weights = [rgb.Point3f(1, 2, 3)], rgb.Float([1, 2, 3])
    ask = lambda: values(cache.of_each("thing", eye, Fingerprint([weights]), make))
    assert ask() == ask() == [1]
    weights += 0
    # Equal in value, and another array: it may be another one in every lane.
    weights = rgb.Float(weights.numpy())
    assert ask() == [2]
    dr.scatter(weights, rgb.Float(7), rgb.UInt32(1))
    assert ask() == [3]


def test_positions_carry_no_derivatives(rgb, made):
    cache, (_, make) = ObserverCache(), made
    p = rgb.Point3f(1, 2, 3)
    dr.enable_grad(p)
    (known,) = cache.of_each("thing", [p], 0, make)
    assert not dr.grad_enabled(known.center)


def test_nothing_is_kept_of_a_recording(rgb):
    """What is made in a frozen function is the recording's, and is looked up in none."""
    cache = ObserverCache()

    @dr.freeze
    def double(p):
        (known,) = cache.of_each("thing", [p], 0, lambda center: center.x * 2)
        return known.value + 0

    for x in (1.0, 2.0, 3.0):
        assert double(rgb.Point3f(rgb.Float([x]), 0, 0)).numpy()[0] == 2 * x
    assert cache.peek("thing") == []


def test_a_place_is_told_by_its_shapes_and_its_medium(rgb):
    scene = rgb.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 2.0}})
    of = fingerprint_of
    first = of(Place(None, scene))
    assert first == of(Place(None, scene)) != of(Place(None))
    params = rgb.traverse(scene)
    params[next(k for k in params.keys() if k.endswith("to_world"))] = rgb.Transform4f().translate([0, 0, 0.5])
    params.update()
    assert of(Place(None, scene)) != first
    volume = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.ones((2, 2, 2), np.float32))})
    medium = VolumeMedium(volume)
    before = of(Place(medium))
    assert before == of(Place(medium))
    params = rgb.traverse(volume)
    params["data"] = params["data"] * 2
    params.update()
    assert of(Place(medium)) != before
