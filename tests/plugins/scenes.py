"""Small scenes for the tests of the integrator, and helpers to render them."""

import drjit as dr
import numpy as np

from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverSettings

SIZE = 12


def plugin(kind, **overrides):
    """The description of a plugin for ``mi.load_dict``."""
    return {"type": kind, **overrides}


def stored(kind, path, **overrides):
    """A volume that reads a file."""
    return {"type": kind, "filename": str(path), **overrides}


def still(sensor):
    """``sensor`` with one ray through the centre of each pixel."""
    return {**sensor, "sampler": {"type": "stratified", "jitter": False, "sample_count": 1}}


def center_rays(mi, sensor):
    """Rays through the pixel centres of the description ``sensor``, row by row."""
    sensor = mi.load_dict(sensor)
    w, h = sensor.film().crop_size()
    y, x = (np.mgrid[:h, :w].reshape(2, -1) + 0.5).astype(np.float32)
    return sensor.sample_ray(0, 0.5, mi.Point2f(x / w, y / h), mi.Point2f(0.5))[0]


def look_at(mi, origin, target=(0, 0, 0), up=(0, 1, 0)):
    return mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))


def camera(
    mi, origin=(0.5, 0.4, -3), target=(0, 0, 0), kind="perspective", rfilter="box", size=SIZE, film=(), **kwargs
):
    if kind == "perspective":
        kwargs = {"fov": 35, **kwargs}
    return plugin(
        kind,
        to_world=look_at(mi, origin, target),
        **kwargs,
        sampler={"type": "independent", "sample_count": 1},
        film=plugin(
            "hdrfilm",
            width=size,
            height=size,
            component_format="float32",
            rfilter={"type": rfilter},
            pixel_format="luminance" if "mono" in mi.variant() else "rgb",
        )
        | dict(film),
    )


# Expected depths have closed forms for thin matter, too, unlike the default median.
def with_field(files, **kwargs):
    return {"type": "nerg", "depth": "expected", "field": stored("nerf", files / "field.safetensors"), **kwargs}


def with_gaze(files, aovs="depth,opacity,gaze,visibility", **kwargs):
    return with_field(files, **({"gaze": stored("gazefield", files / "gaze.safetensors"), "aovs": aovs} | kwargs))


def constant(sigma=3.0, **kwargs):
    return {"type": "nerg", "depth": "expected", "density": {"type": "constvolume", "value": sigma}, **kwargs}


def scene_with(mi, integrator, sensor=None, **overrides):
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor or camera(mi), **overrides})


def picture(mi, scene):
    return np.array(mi.render(scene, spp=1))


def render(mi, integrator, sensor=None, spp=1, seed=0, **overrides):
    return np.array(mi.render(scene_with(mi, integrator, sensor, **overrides), spp=spp, seed=seed))


def put(params, key, value):
    """Set one parameter of ``mi.traverse``."""
    params[key] = value
    params.update()


def attach(params, *keys):
    """Enable gradients of parameters."""
    for key in keys:
        dr.enable_grad(params[key])
    params.update()


def named(mi, image, integrator):
    """The channels of ``image`` behind the colour, by name."""
    names = mi.load_dict(integrator).aov_names()
    return dict(zip(names, np.moveaxis(image[..., image.shape[-1] - len(names) :], -1, 0)))


def points(out):
    """The positions of the channels ``out``, in a last axis."""
    return np.stack([out[f"position.{c}"] for c in "XYZ"], axis=-1)


def channels(mi, integrator, sensor=None, **kwargs):
    return named(mi, render(mi, integrator, sensor, **kwargs), integrator)


def straight(mi, kind):
    """A ray along +z through the middle of the unit cube, from z = -2."""
    if kind == "orthographic":
        to_world = mi.ScalarTransform4f().translate([0.5, 0.5, -2]).scale([1e-3, 1e-3, 1])
        return {**camera(mi, kind="orthographic", size=1), "to_world": to_world, "near_clip": 0.01}
    return camera(mi, (0.5, 0.5, -2), (0.5, 0.5, 0), fov=1e-3, size=1, near_clip=0.01)


def sphere(mi, *center, radius=0.5, color=(0.2, 0.5, 0.8)):
    reflectance = {"type": "rgb", "value": list(color)}
    return plugin("sphere", center=list(center), radius=radius, bsdf=plugin("diffuse", reflectance=reflectance))


def square(mi, z, size=1.0, x=0.0):
    to_world = mi.ScalarTransform4f().translate([x, 0, z]).scale([size, size, 1])
    return plugin("rectangle", to_world=to_world, bsdf={"type": "twosided", "b": {"type": "diffuse"}})


def room(mi, open_side=False):
    """A cube seen from inside; one side can be missing."""
    walls = {}
    for axis in range(3):
        for side in (-1, 1):
            at = [0.9 * side if a == axis else 0 for a in range(3)]
            to_world = look_at(mi, at, up=(0, 0, 1) if axis != 2 else (0, 1, 0)).scale([0.9, 0.9, 1])
            if not (open_side and (axis, side) == (1, 1)):
                walls[f"w{axis}{side + 1}"] = {"type": "rectangle", "to_world": to_world}
    return walls


def make_observer(mi, *origin, **kwargs):
    return {"type": "perspective", "to_world": look_at(mi, origin, (0.1, 0.2, 0.3)), **kwargs}


def wall(mi, gap=0.3):
    """An opaque wall in the plane z = 0 that leaves x > ``gap`` open, and a back wall at z = 0.8 .. 1."""
    n = 40
    data = np.zeros((n, 2, n), np.float32)
    x = (np.arange(n) + 0.5) / n * 2 - 1
    data[19:21, :, x < gap] = 1e4
    data[36:] = 1e4
    return plugin(
        "gridvolume",
        grid=mi.VolumeGrid(data),
        filter_type="nearest",
        to_world=mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
    )


def hidden_scene(mi, **kwargs):
    # The camera is behind the wall and sees the back wall; the observer is in front of it.
    sensor = camera(mi, (0.5, 0, 0.2), (0.5, 0, 1), fov=65, near_clip=1e-3)
    how = {
        "aovs": "visibility,position,observer_depth",
        "step": 0.01,
        "observer": make_observer(mi, 0, 0, -0.9),
    } | kwargs
    return channels(mi, plugin("nerg", density=wall(mi), **how), sensor)


GAZE = "depth,opacity,position,gaze,emit,capture,visibility,observer_depth"


def observed(mi, gaze, p_o, place=None):
    """The gaze field of the dict ``gaze``, for the observer at ``p_o``."""
    settings = ObserverSettings(march=MarchSettings(step=1))
    return mi.load_dict(gaze).placed_gaze().for_observers([p_o], place or SceneGeometry(None), settings)
