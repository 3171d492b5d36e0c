"""What can be set of Gaussian splats: they are not marched, but cut off, each at so many standard deviations, and rays
end where little light is left."""

from __future__ import annotations

from collections.abc import Mapping

EXTENTS = (1.5, 2.0, 2.5, 3.0, 4.0, 5.0)
STOPS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
LIMITS = ({"extent": 8.0}, {"extent": 6.0})
"""Where Gaussians are cut off in a reference, and in one that tells how good it is."""
SOURCE = f"render of Gaussians cut off at {LIMITS[0]['extent']:g} standard deviations"


def cut_off(params: Mapping) -> dict:
    """``params`` of an integrator without ``extent``, where Gaussians of its field are cut off: if it is there, the
    field is another one that is cut off there."""
    import mitsuba as mi

    found = dict(params)
    extent = found.pop("extent", None)
    if extent is not None:
        field = found["field"]
        medium = field.medium()
        to_world = mi.ScalarTransform4f(medium.to_world.matrix.tolist())
        splats = {"type": "splats", "filename": field.filename, "color_space": medium.color_space}
        found["field"] = mi.load_dict(splats | {"to_world": to_world, "extent": extent})
    return found
