"""A scene of stock plugins, a box as Mitsuba takes it, and pictures as Mitsuba reads them, also on one core."""

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
"""A sphere of stock plugins, as a perspective camera and a panorama see it."""


def mitsuba_bitmap(path):
    """A Mitsuba bitmap of the file ``path``."""
    import mitsuba as mi

    with ensure_two_threads():
        return mi.Bitmap(str(path))


def box_dict(lower, upper) -> dict:
    """The box between two corners, as Mitsuba takes it."""
    import mitsuba as mi

    middle, half = (lower + upper) / 2, (upper - lower) / 2
    return {"type": "cube", "to_world": mi.ScalarTransform4d().translate(middle.tolist()).scale(half.tolist())}
