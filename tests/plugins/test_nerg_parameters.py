"""Parameters as ``mi.traverse`` shows them."""

import numpy as np
import pytest

from .scenes import camera, observer_at, with_gaze


def scene_of(mi, files, size=6, origins=((0.5, 0.4, -3),), **more):
    """A field and a gaze field seen by as many cameras, one ray through the centre of each pixel."""
    integrator = with_gaze(files, **{"aovs": "gaze", "falloff": 2.0, "observer": observer_at(mi, -2, 0.3, -2), **more})
    centers = {"sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}
    sensors = {f"camera{i}": {**camera(mi, origin, size=size), **centers} for i, origin in enumerate(origins)}
    return mi.load_dict(
        {"type": "scene", "integrator": {k: v for k, v in integrator.items() if v is not None}, **sensors}
    )


def test01_flags(rgb, files):
    params = rgb.traverse(scene_of(rgb, files))
    D, edges = rgb.ParamFlags.Differentiable, rgb.ParamFlags.Discontinuous
    shown = {k: params.flags(k) for k in params.keys() if k.startswith("integrator.")}
    assert shown.pop("integrator.observer.to_world") == D | edges
    assert "integrator.falloff" in shown and len(shown) == 14 and all(v == D for v in shown.values())
    # What of a sensor has no part in where it stands is no parameter of ours.
    assert [k for k in params.keys() if "observer" in k] == ["integrator.observer.to_world"]


@pytest.mark.parametrize("kind", ["perspective", "panorama"])
def test02_an_observer_is_moved(rgb, files, kind):
    make = lambda at: {**observer_at(rgb, *at), "type": kind}
    scene = scene_of(rgb, files, observer=make((-2, 0.3, -2)))
    params = rgb.traverse(scene)
    params["integrator.observer.to_world"] = rgb.ScalarTransform4f().translate([-1, -1, -2])
    params.update()
    got = np.array(rgb.render(scene, spp=1))
    assert np.array_equal(got, np.array(rgb.render(scene_of(rgb, files, observer=make((-1, -1, -2))), spp=1)))
    params["integrator.observer.to_world"] = rgb.ScalarTransform4f().translate([np.nan, 0, 0])
    with pytest.raises(Exception, match="not finite"):
        params.update()


def test03_updates_are_seen_and_wrong_ones_refused(rgb, files):
    scene = scene_of(rgb, files)
    before = np.array(rgb.render(scene, spp=1))
    params = rgb.traverse(scene)
    params["integrator.gaze.emit_head.0"] = params["integrator.gaze.emit_head.0"] * 2
    params["integrator.falloff"] = rgb.Float(5.0)
    params.update()
    assert not np.array_equal(before, np.array(rgb.render(scene, spp=1)))
    params["integrator.falloff"] = rgb.Float(-1.0)
    with pytest.raises(Exception, match="falloff"):
        params.update()
