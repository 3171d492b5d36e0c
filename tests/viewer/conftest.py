"""The demo store, and a scene of a few shapes whose answers are known, for tests of the viewer."""

from __future__ import annotations

import pytest

import nerg_mi as nerg
from nerg_mi.jobs import demo

ROOM = """<scene version="3.0.0">
    <integrator type="nerg" id="integrator">
        <integrator type="direct"/>
        <sensor name="observer" type="perspective">
            <transform name="to_world"><lookat origin="0, 0, 0.5" target="1, 0, 0.5" up="0, 0, 1"/></transform>
        </sensor>
        <string name="aovs" value="depth"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="-2, 0, 1" target="2, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="48"/><integer name="height" value="32"/><rfilter type="box"/>
        </film>
    </sensor>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="3"/></transform>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.5"/><translate x="1.5" z="0.5"/></transform>
    </shape>
    <emitter type="constant"/>
</scene>
"""


@pytest.fixture
def room(rgb, tmp_path):
    """The file of a floor at z = 0 with a box from 1 to 2 along x, in plain light."""
    path = tmp_path / "room.xml"
    path.write_text(ROOM)
    return path


@pytest.fixture
def room_scene(room):
    return nerg.Scene.load(room)


@pytest.fixture
def store(rgb):
    """The file of the demo store's scene, with its trained fields."""
    path = demo.store_scene()
    if not all((path.parent / name).is_file() for name in demo.CHECKPOINTS.values()):
        pytest.skip("the store's fields are not here: python -m nerg_mi.scenes.store.make")
    return path
