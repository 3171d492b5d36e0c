"""A simple test scene, and helpers for Mitsuba bitmaps and boxes."""

from __future__ import annotations

from nerg_mi.files.images import ensure_two_threads

SCENE = """
<scene version="3.0.0">
    <default name="integrator" value="path"/>
    <default name="level" value="0.25"/>
    <integrator type="aov"><string name="aovs" value="dd:depth"/><integrator type="$integrator"/></integrator>
    <emitter type="constant"><float name="radiance" value="$level"/></emitter>
    <shape type="sphere"><float name="radius" value="0.3"/></shape>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, -4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><rfilter type="box"/>
            <integer name="width" value="16"/><integer name="height" value="8"/></film>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    </sensor>
    <sensor type="panorama">
        <film type="hdrfilm"><rfilter type="box"/>
            <integer name="width" value="12"/><integer name="height" value="6"/></film>
    </sensor>
</scene>
"""
"""A sphere made of stock plugins, with a perspective camera and a panorama."""


def mitsuba_bitmap(path):
    """Load a file as a Mitsuba bitmap, also on one core."""
    import mitsuba as mi

    with ensure_two_threads():
        return mi.Bitmap(str(path))


def box_dict(lower, upper) -> dict:
    """Return a dict of a box between two corners for `mi.load_dict`."""
    import mitsuba as mi

    middle, half = (lower + upper) / 2, (upper - lower) / 2
    return {"type": "cube", "to_world": mi.ScalarTransform4d().translate(middle.tolist()).scale(half.tolist())}
