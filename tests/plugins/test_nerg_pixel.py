"""What is found along one camera ray, and when."""

from functools import cached_property

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.geometry import Place

from .scenes import camera, named, observer_at, with_gaze


@pytest.fixture
def traced(monkeypatch):
    """One entry for each ray that is traced: the origin of its first lane."""
    found, trace = [], Place.trace
    monkeypatch.setattr(Place, "trace", lambda *a, **k: (found.append(np.array(a[1].o)[:, 0]), trace(*a, **k))[1])
    return found


def pixel(mi, integrator, eye=(0.5, 0.4, -3), **more):
    """Of rays from a camera at ``eye`` to and past the field."""
    scene = mi.load_dict({"type": "scene", "integrator": {**integrator, **more}, "sensor": camera(mi, eye)})
    o = mi.Point3f(*map(float, eye))
    target = mi.Point3f([0, 0.1, 9], [0, 0.1, 9], 0)
    ray = mi.Ray3f(o + dr.zeros(mi.Point3f, 3), dr.normalize(target - o))
    context = scene.integrator().context()
    return context.trace(scene, scene.sensors(), None, ray, mi.Bool(True)).for_observer()


def test01_nothing_is_traced_before_it_is_asked_for(rgb, files, traced):
    found = pixel(rgb, with_gaze(files, "gaze,visibility", observer=observer_at(rgb, -2, 0.3, -2)))
    assert len(traced) == 1
    found.camera.depth, found.camera.surface, found.camera.p_d, found.r_o  # noqa: B018
    assert len(traced) == 1
    found.sight, found.attention, found.sight  # noqa: B018
    assert len(traced) == 2 and np.allclose(traced[1], (-2, 0.3, -2))


@pytest.mark.parametrize("observer", [None, (0.5, 0.4, -3)])
def test02_who_stands_at_the_camera_sees_what_it_sees(rgb, files, traced, observer):
    more = {} if observer is None else {"observer": observer_at(rgb, *observer)}
    found = pixel(rgb, with_gaze(files, "gaze,visibility", **more))
    assert found.aligned and np.allclose(np.array(found.observer.p_o).T, (0.5, 0.4, -3))
    assert (found.sight.visibility.numpy() == 1).all() and len(traced) == 1
    assert np.allclose(found.sight.depth.numpy()[:2], found.camera.depth.numpy()[:2], rtol=1e-5)


def test03_gaze_is_zero_without_a_surface(rgb, files):
    found = pixel(rgb, with_gaze(files, "gaze,emit"))
    surface = found.camera.surface.numpy()
    assert surface.tolist() == [True, True, False]
    for value in (found.attention.gaze, found.attention.emit, found.attention.capture):
        assert ((value.numpy() > 0) == surface).all()
    assert found.attention.evaluations.numpy().tolist() == [2, 2, 0] and found.attention.spread is None


def test03b_networks_are_evaluated_where_gaze_is_seen(rgb, files):
    """And give what they give everywhere, as derivatives have it; with factors, wherever there is a surface."""

    def attention(aovs, attached):
        integrator = with_gaze(files, aovs, observer=observer_at(rgb, -0.2, 3, 0.1), falloff=0.0)
        scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb, (0.5, 0.4, -3))})
        if attached:
            params = rgb.traverse(scene)
            dr.enable_grad(params["integrator.gaze.emit_head.0"])
            params.update()
        found = named(rgb, np.array(rgb.render(scene, spp=1)), integrator)
        return {name.split(".")[0]: values for name, values in found.items()}

    aovs = "gaze,gaze_evals,visibility,opacity"
    seen, everywhere = (attention(aovs, attached) for attached in (False, True))
    np.testing.assert_array_equal(seen["gaze"], everywhere["gaze"])
    surface, visible = seen["opacity"] >= 0.5, seen["visibility"] > 0
    assert (surface & visible).any() and (surface & ~visible).any() and (seen["gaze"][surface & visible] > 0).all()
    np.testing.assert_array_equal(seen["gaze_evals"], np.where(surface & visible, 2, 0))
    whole = attention(aovs + ",emit", False)
    np.testing.assert_array_equal(whole["gaze_evals"], np.where(surface, 2, 0))
    np.testing.assert_allclose(whole["gaze"], seen["gaze"], rtol=1e-5)


def test04_evaluations_are_those_of_all_that_was_traced(rgb, files):
    integrator = with_gaze(files, "visibility,density_evals", observer=observer_at(rgb, -2, 0.3, -2))
    found = pixel(rgb, integrator)
    alone = found.density_evaluations().numpy()
    found.sight  # noqa: B018
    assert (found.density_evaluations().numpy()[:2] > alone[:2]).all() and (alone[:2] > 5).all()


@pytest.mark.parametrize(
    "aovs, looked_up", [("gaze", True), ("gaze,gaze_evals,depth", True), ("gaze,emit", False), ("visibility", False)]
)
def test05_a_map_stands_in_for_gaze_alone(rgb, files, aovs, looked_up):
    """It keeps neither factors nor what nobody asks for."""
    observer = observer_at(rgb, -2, 0.3, -2)
    found = pixel(rgb, with_gaze(files, aovs, observer=observer, visibility="map", map_height=32))
    assert (found.sight.gaze is not None) == looked_up
    assert bool(found.context.cache.peek("gaze of map")) == looked_up
    assert len(found.context.cache.peek("map")) == 1


def test06_colour_is_found_where_it_is_wanted(rgb, files):
    integrator = with_gaze(files, "features")
    lit, dark = (pixel(rgb, {**integrator, "radiance": r}).camera for r in (True, False))
    assert lit.lit and not dark.lit and dark.color is None
    assert np.array(lit.color).shape[0] == 3
    for a, b in zip(lit.accumulated_features, dark.accumulated_features):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-5, atol=1e-6)


def test07_another_observer_is_another_object(rgb, files):
    """All that a pixel computes follows its observer; the camera's part is one object that knows of none."""
    first = pixel(rgb, with_gaze(files, "gaze,visibility,density_evals", observer=observer_at(rgb, -2, 0.3, -2)))
    for name, value in vars(type(first)).items():
        assert not isinstance(value, cached_property) or getattr(first, name) is not None
    other = first.camera.for_observer(first.context.observer_at((2, 0.3, -2)))
    assert other.camera is first.camera and not set(vars(other)) & {"observer", "sight", "gaze", "attention"}
    assert not np.allclose(np.array(other.r_o), np.array(first.r_o))
    assert not np.allclose(other.attention.gaze.numpy(), first.attention.gaze.numpy())
