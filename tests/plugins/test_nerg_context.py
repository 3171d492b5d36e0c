"""The integrator's context for other AOVs, along any rays, and for several observers of the same rays."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import Place

from . import fields

EYES = [(0.3, -3, 0.4), (2.5, -1, 0.5), (-1.5, -2.0, 1.0)]


@pytest.fixture
def scene(rgb, files):
    field = {"type": "nerf", "filename": str(files / "field.safetensors")}
    gaze = {"type": "gazefield", "filename": str(files / "gaze.safetensors")}
    return rgb.load_dict({"type": "scene", "integrator": {"type": "nerg", "field": field, "gaze": gaze}})


@pytest.fixture
def ray(rgb):
    o, d = np.float32([(0, -3, 0), (0.2, -3, 0.3)]), np.float32([(0, 1, 0), (0, 1, -0.1)])
    return rgb.RayDifferential3f(rgb.Point3f(o.T.copy()), dr.normalize(rgb.Vector3f(d.T.copy())))


def sampler(mi):
    made = mi.load_dict({"type": "independent"})
    made.seed(0, 2)
    return made


def test01_what_depends_on_the_observer(scene):
    context = scene.integrator().for_aovs(["depth", "gaze", "position", "visibility"], True)
    assert context.shared == ["depth", "position"] and context.own == ["gaze", "visibility"]
    assert context.channels(context.shared) == ["depth.T", "position.X", "position.Y", "position.Z"]
    # All else is the integrator's, which is left as it was.
    assert context.settings is scene.integrator().settings
    assert scene.integrator().aov_names() == ["depth.T", "opacity.Y"]


@pytest.mark.parametrize(
    "aovs, said",
    [(["gazes"], 'does not know "gazes"'), (["kde"], 'needs a "kde" volume'), (["gaze_std"], "several members")],
)
def test02_what_cannot_be_computed(scene, aovs, said):
    with pytest.raises(NergError, match=said):
        scene.integrator().for_aovs(aovs, False)


def test03_the_values_of_a_render(rgb, scene, ray):
    integrator = scene.integrator()
    context = integrator.for_aovs(["depth", "gaze", "visibility", "gaze_evals"], False)
    camera = context.trace(scene, [], sampler(rgb), ray, rgb.Bool(True))
    camera.settle()
    for eye in EYES:
        found = camera.for_observer(context.observer_at(eye)).channels(["gaze", "visibility", "gaze_evals"])
        field, gaze = integrator.children["field"], integrator.children["gaze"]
        observer = {"type": "perspective", "to_world": rgb.ScalarTransform4f().translate(list(eye))}
        alone = rgb.load_dict(
            {"type": "nerg", "field": field, "gaze": gaze, "observer": observer, "aovs": "gaze,visibility,gaze_evals"}
        )
        expected = alone.sample(scene, sampler(rgb), ray)[2]
        for mine, theirs in zip(found, expected):
            assert np.array_equal(np.array(mine), np.array(theirs))


def test04_the_cameras_ray_is_traced_once(rgb, scene, ray, monkeypatch):
    traced, trace = [], Place.trace
    monkeypatch.setattr(Place, "trace", lambda *a, **k: traced.append(1) or trace(*a, **k))
    context = scene.integrator().for_aovs(["depth", "gaze", "visibility"], False)
    camera = context.trace(scene, [], sampler(rgb), ray, rgb.Bool(True))
    for eye in EYES:
        camera.for_observer(context.observer_at(eye)).channels(["gaze", "visibility"])
    assert len(traced) == 1 + len(EYES)


def test05_kernels_are_those_of_one_observer(rgb, scene, ray):
    context = scene.integrator().for_aovs(["depth", "gaze", "visibility"], False)
    camera = context.trace(scene, [], sampler(rgb), ray, rgb.Bool(True))
    camera.settle()
    kernels = []
    for eye in EYES:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(camera.for_observer(context.observer_at(eye)).channels(["gaze", "visibility"]))
            kernels.append({k["hash"] for k in dr.kernel_history() if "hash" in k})
    assert kernels[0] and kernels[0] == kernels[1] == kernels[2]


def test06_an_observer_where_the_camera_stands(rgb, scene):
    sensor = rgb.load_dict(
        {"type": "perspective", "to_world": rgb.ScalarTransform4f().look_at([0, -3, 0], [0, 0, 0], [0, 0, 1])}
    )
    ray, _ = sensor.sample_ray_differential(0, 0, rgb.Point2f([0.4, 0.5], [0.5, 0.6]), rgb.Point2f(0.5))
    context = scene.integrator().for_aovs(["gaze", "visibility", "density_evals"], False)
    camera = context.trace(scene, [sensor], sampler(rgb), ray, rgb.Bool(True))
    there, elsewhere = (camera.for_observer(context.observer_at(eye)) for eye in ((0, -3, 0), EYES[1]))
    assert there.aligned and not elsewhere.aligned
    # For the others a second march decides what they see.
    evaluations = lambda pixel: np.array(pixel.channels(["visibility", "density_evals"])[1])
    assert np.all(evaluations(there) < evaluations(elsewhere))
    own = camera.for_origins()
    assert own.aligned and np.allclose(
        np.array(own.channels(["gaze"])[0]), np.array(there.channels(["gaze"])[0]), rtol=1e-3
    )


def test07_nothing_to_see(rgb, ray):
    scene = rgb.load_dict({"type": "scene", "integrator": {"type": "nerg"}})
    with pytest.raises(NergError, match="nothing to render"):
        scene.integrator().for_aovs(["depth"], False).trace(scene, [], sampler(rgb), ray, rgb.Bool(True))


def test08_integrals_of_several_observers_are_kept(rgb, files, tmp_path, ray, monkeypatch):
    """Two observers in turns: each has an integral of their own, which is found once."""
    from nerg_mi.transport import observer_gaze

    fields.gaze(tmp_path / "gaze.safetensors", normalized=True)
    volumes = {"field": {"type": "nerf", "filename": str(files / "field.safetensors")}}
    volumes["gaze"] = {"type": "gazefield", "filename": str(tmp_path / "gaze.safetensors")}
    scene = rgb.load_dict({"type": "scene", "integrator": {"type": "nerg", **volumes}})
    found, integrate = [], observer_gaze.integrate
    monkeypatch.setattr(observer_gaze, "integrate", lambda *a: found.append(1) or integrate(*a))
    values = []
    for _ in range(2):
        context = scene.integrator().for_aovs(["gaze"], False)
        camera = context.trace(scene, [], sampler(rgb), ray, rgb.Bool(True))
        values.append(
            [np.array(camera.for_observer(context.observer_at(eye)).channels(["gaze"])[0]) for eye in EYES[:2]]
        )
    assert len(found) == 2
    np.testing.assert_array_equal(values[0], values[1])
