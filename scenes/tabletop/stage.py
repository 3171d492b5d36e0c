"""The layout as an `mi.Scene` of the active variant, lit by its lamps, the sky and the sun."""

from __future__ import annotations

import numpy as np
from nerg_mi.scenes.tabletop import textures
from nerg_mi.scenes.tabletop.layout import MATERIALS, Material, TabletopLayout, make_random_stream
from nerg_mi.scenes.tabletop.mesh import Mesh

from nerg_mi.maths.color import decode_srgb
from nerg_mi.transport.mitsuba_mesh import make_mesh

# Reflectances exclude black and white: light stays soft, and every texel has a gradient.
_ALBEDO = (0.02, 0.8)
_SKY = 0.95
# From the south-west, so that it lights the fronts visible through the windows and not the room.
_SUN = dict(direction=[0.55, 0.6, -0.75], irradiance=[1.5, 1.4, 1.2])
MAX_PATH_DEPTH = 5
"""Maximum path length in edges."""


def load_stage(layout: TabletopLayout):
    """Load the scene of a layout with a path tracer."""
    import mitsuba as mi

    sky = decode_srgb(textures.sky(make_random_stream(layout.seed, "sky"))) * _SKY
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": MAX_PATH_DEPTH},
            "sky": {
                "type": "envmap",
                "bitmap": mi.Bitmap(sky.astype(np.float32)),
                # Mitsuba's environment maps have y up.
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
                "sampling_weight": 1.0,
            },
            "sun": {
                "type": "directional",
                "direction": _SUN["direction"],
                "irradiance": {"type": "rgb", "value": _SUN["irradiance"]},
                "sampling_weight": 0.6,
            },
            **{name: _make_shape(name, mesh, MATERIALS[name], layout.seed) for name, mesh in layout.meshes.items()},
        }
    )


def _make_shape(name: str, mesh: Mesh, material: Material, seed: int):
    import mitsuba as mi

    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(
            np.clip(decode_srgb(material.paint(make_random_stream(seed, name))), *_ALBEDO).astype(np.float32)
        ),
        "raw": True,
    }
    bsdf = {"type": "diffuse", "reflectance": texture}
    if material.gloss:
        bsdf = {"type": "roughplastic", "diffuse_reflectance": texture, "alpha": 0.15, "nonlinear": False}
    children: dict[str, dict] = {"bsdf": {"type": "twosided", "bsdf": bsdf}}
    if material.radiance is not None:
        children["emitter"] = {
            "type": "area",
            "radiance": {"type": "rgb", "value": list(material.radiance)},
            "sampling_weight": material.sampling_weight,
        }
    return make_mesh(mesh.points, mesh.faces, name, mesh.normals, mesh.uv, **children)
