"""Six scenes for statistical tests, and their stored references.

    python -m tests.renders.scenes [NAME ...]     renders the references again (about a minute on two cores)

`mi.testing.RenderingRegressionTest` compares the first three channels of a `moment` integrator, and expects the second
moments in the three after them. In Mitsuba 3.9 these are channels of the nested integrator: `Shown` returns the
squares.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from tests.plugins import fields
from tests.plugins.scenes import camera, constant, make_observer

REFERENCES = Path(__file__).parent / "references"
SIZE = 24
TEST_SPP, REFERENCE_SPP = 256, 4096


def shown(mi, integrator, names):
    """`integrator` with three of its channels (names of AOVs, or R, G, B) as the image, and their squares as AOVs."""

    class Shown(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.inner = mi.load_dict(integrator)
            self.order = ["R", "G", "B", *self.inner.aov_names()]

        def aov_names(self):
            return ["square.X", "square.Y", "square.Z"]

        def sample(self, scene, sampler, ray, medium=None, active=True):
            L, valid, aovs = self.inner.sample(scene, sampler, ray, medium, active)
            every = [L.x, L.y, L.z, *aovs]
            picture = mi.Color3f(*[every[self.order.index(n)] for n in names])
            return picture, valid, list(picture * picture)

        def to_string(self):
            return f"Shown[{names}]"

    return Shown(mi.Properties())


def rgb_of(*value):
    return {"type": "rgb", "value": list(value)}


def things(mi):
    """A sphere and a rotated box on a floor."""
    T = mi.ScalarTransform4f
    return {
        "ball": {
            "type": "sphere",
            "center": [-0.4, 0, 0],
            "radius": 0.5,
            "b": {"type": "diffuse", "reflectance": rgb_of(0.7, 0.3, 0.2)},
        },
        "box": {"type": "cube", "to_world": T().translate([0.7, -0.2, 0.3]).rotate([0, 1, 0], 30).scale(0.3)},
        "floor": {"type": "rectangle", "to_world": T().translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(2)},
    }


def slab(mi, folder, change=1.0):
    integrator = constant(
        0.8 * change,
        aovs="depth,opacity",
        background=0.2,
        color={"type": "constvolume", "value": rgb_of(0.9, 0.5, 0.1)},
    )
    return integrator, {}, ("depth.T", "opacity.Y", "R"), camera(mi, (1.8, 1.2, -1.5), (0.5, 0.5, 0.5), size=SIZE)


def neural(folder, change=1.0, **kwargs):
    fields.radiance(folder / "field.safetensors", density_scale=2.0 * change)
    fields.gaze(folder / "gaze.safetensors")
    return {
        "type": "nerg",
        "field": {"type": "nerf", "filename": str(folder / "field.safetensors")},
        "gaze": {"type": "gazefield", "filename": str(folder / "gaze.safetensors")},
        **kwargs,
    }


def gaze(mi, folder, change=1.0):
    """Gaze of the camera itself, on a trained field's median surface."""
    return neural(folder, change, aovs="depth,gaze", jitter=True), {}, ("depth.T", "gaze.Y", "G"), camera(mi, size=SIZE)


def shapes(mi, folder, change=1.0):
    lit = {"type": "path", "max_depth": 4}
    overrides = things(mi) | {"sky": {"type": "constant", "radiance": rgb_of(0.9 * change, change, 1.2 * change)}}
    return {"type": "nerg", "lit": lit, "aovs": ""}, overrides, ("R", "G", "B"), camera(mi, (1, 1, -3), size=SIZE)


def both(mi, folder, change=1.0):
    box = mi.ScalarTransform4f().translate([-1, -0.4, -1]).scale([2, 0.8, 1])
    integrator = constant(
        1.0,
        density={"type": "constvolume", "value": 1.0 * change, "to_world": box},
        aovs="depth,visibility",
        visibility="transmittance",
        observer=make_observer(mi, -2, 0.8, -2),
        background=0.1,
        color={"type": "constvolume", "value": rgb_of(0.2, 0.4, 0.8)},
        headlight=0,
    )
    return integrator, things(mi), ("depth.T", "visibility.Y", "B"), camera(mi, (1, 1, -3), size=SIZE)


def observer(mi, folder, change=1.0):
    """Visibility of an observer elsewhere, with a long fall-off."""
    integrator = neural(
        folder,
        aovs="gaze,visibility,observer_depth",
        observer=make_observer(mi, -3, 0.5, 0.5),
        falloff=1.0 * change,
        radiance=False,
    )
    return integrator, {}, ("gaze.Y", "visibility.Y", "observer_depth.T"), camera(mi, size=SIZE)


def panorama(mi, folder, change=1.0):
    """Inside a cloud of voxels with a sphere in it."""
    data = np.random.default_rng(0).uniform(0, 2, (5, 5, 5)).astype(np.float32)
    box = mi.ScalarTransform4f().translate([-1.5, -1.5, -1.5]).scale(3)
    density = {"type": "gridvolume", "grid": mi.VolumeGrid(data * np.float32(change)), "to_world": box}
    integrator = {
        "type": "nerg",
        "density": density,
        "quadrature": "cells",
        "depth": "expected",
        "radiance": False,
        "aovs": "depth,opacity,visibility",
        "visibility": "transmittance",
        "surface_opacity": 0.0,
        "observer": make_observer(mi, 0.9, 0.2, -0.9),
    }
    sensor = {
        "type": "panorama",
        "to_world": mi.ScalarTransform4f().translate([0.3, 0, 0.4]),
        "film": camera(mi)["film"] | {"width": 32, "height": 16},
    }
    return integrator, {"ball": things(mi)["ball"]}, ("depth.T", "opacity.Y", "visibility.Y"), sensor


# name: (scene, the relative change of its density, light or fall-off that its test must detect)
SCENES = {
    "slab": (slab, 0.02),
    "gaze": (gaze, 0.02),
    "shapes": (shapes, 0.02),
    "both": (both, 0.02),
    "observer": (observer, 0.02),
    "panorama": (panorama, 0.02),
}


def scene(mi, name, folder, change=1.0):
    integrator, overrides, names, sensor = SCENES[name][0](mi, folder, change)
    moments = {"type": "moment", "in": shown(mi, integrator, names)}
    return mi.load_dict({"type": "scene", "integrator": moments, "sensor": sensor, **overrides})


def test_of(mi, name, folder, references=REFERENCES, change=1.0):
    from mitsuba.python.testing import RenderingRegressionTest

    return RenderingRegressionTest(
        name,
        scene(mi, name, Path(folder), change),
        test_spp=TEST_SPP,
        ref_spp=REFERENCE_SPP,
        references_folder=str(references),
    )


test_of.__test__ = False


def main(names):
    import mitsuba as mi

    import nerg_mi  # noqa: F401  selects the libLLVM, so it comes before mitsuba

    mi.set_variant("llvm_ad_rgb")
    with tempfile.TemporaryDirectory() as folder:
        for name in names or SCENES:
            test_of(mi, name, folder).render_reference()


if __name__ == "__main__":
    main(sys.argv[1:])
