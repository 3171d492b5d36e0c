"""Small scenes, and how to render them, for the tests of the integrator."""

import numpy as np

from nerg_mi.transport.geometry import Place
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverSettings

SIZE = 12


def look_at(mi, origin, target=(0, 0, 0), up=(0, 1, 0)):
    return mi.ScalarTransform4f().look_at(list(origin), list(target), list(up))


def camera(
    mi, origin=(0.5, 0.4, -3), target=(0, 0, 0), kind="perspective", rfilter="box", size=SIZE, film=(), **kwargs
):
    if kind == "perspective":
        kwargs = {"fov": 35, **kwargs}
    return {
        "type": kind,
        "to_world": look_at(mi, origin, target),
        **kwargs,
        "sampler": {"type": "independent", "sample_count": 1},
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "component_format": "float32",
            "rfilter": {"type": rfilter},
            "pixel_format": "luminance" if "mono" in mi.variant() else "rgb",
            **dict(film),
        },
    }


# Expected depths have closed forms also where matter is thin, unlike the medians of the default.
def with_field(files, **kwargs):
    return {
        "type": "nerg",
        "depth": "expected",
        "field": {"type": "nerf", "filename": str(files / "field.safetensors")},
        **kwargs,
    }


def with_gaze(files, aovs="depth,opacity,gaze,visibility", **kwargs):
    gaze = {"type": "gazefield", "filename": str(files / "gaze.safetensors")}
    return with_field(files, gaze=gaze, aovs=aovs, **kwargs)


def constant(sigma=3.0, **kwargs):
    return {"type": "nerg", "depth": "expected", "density": {"type": "constvolume", "value": sigma}, **kwargs}


def render(mi, integrator, sensor=None, spp=1, seed=0, **more):
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor or camera(mi), **more})
    return np.array(mi.render(scene, spp=spp, seed=seed))


def named(mi, image, integrator):
    """The channels of ``image`` behind the colour, by name."""
    names = mi.load_dict(integrator).aov_names()
    return dict(zip(names, np.moveaxis(image[..., image.shape[-1] - len(names) :], -1, 0)))


def channels(mi, integrator, sensor=None, **kwargs):
    return named(mi, render(mi, integrator, sensor, **kwargs), integrator)


def straight(mi, kind):
    """A ray along +z through the middle of the unit cube, from z = -2."""
    if kind == "orthographic":
        to_world = mi.ScalarTransform4f().translate([0.5, 0.5, -2]).scale([1e-3, 1e-3, 1])
        return {**camera(mi, kind="orthographic", size=1), "to_world": to_world, "near_clip": 0.01}
    return camera(mi, (0.5, 0.5, -2), (0.5, 0.5, 0), fov=1e-3, size=1, near_clip=0.01)


def observer_at(mi, *origin, **kwargs):
    return {"type": "perspective", "to_world": look_at(mi, origin, (0.1, 0.2, 0.3)), **kwargs}


def wall(mi, gap=0.3):
    """An opaque wall in the plane z = 0 that leaves x > ``gap`` open, and a back wall at z = 0.8 .. 1."""
    n = 40
    data = np.zeros((n, 2, n), np.float32)
    x = (np.arange(n) + 0.5) / n * 2 - 1
    data[19:21, :, x < gap] = 1e4
    data[36:] = 1e4
    return {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(data),
        "filter_type": "nearest",
        "to_world": mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2),
    }


def hidden_scene(mi, **kwargs):
    # The camera is behind the wall and sees the back wall; the observer is in front of it.
    sensor = camera(mi, (0.5, 0, 0.2), (0.5, 0, 1), fov=65, near_clip=1e-3)
    integrator = {
        "type": "nerg",
        "density": wall(mi),
        "aovs": "visibility,position,observer_depth",
        "step": 0.01,
        "observer": observer_at(mi, 0, 0, -0.9),
        **kwargs,
    }
    return channels(mi, integrator, sensor)


GAZE = "depth,opacity,position,gaze,emit,capture,visibility,observer_depth"


def observed(mi, gaze, p_o, place=None):
    """The gaze field that the dict ``gaze`` describes, for the observer at ``p_o``."""
    return (
        mi.load_dict(gaze).placed_gaze().at([p_o], place or Place(None), ObserverSettings(march=MarchSettings(step=1)))
    )
