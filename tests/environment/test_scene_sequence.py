"""Scenes of one file, loaded one after the other, equal those that are loaded alone."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.environment import bands
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.environment.scene_sequence import SceneSequence
from nerg_mi.errors import NergError
from tests.plugins import fields

SCENE = """<scene version="3.0.0">
    <default name="eye" value="0.2, 0.1, -2.5"/>
    <default name="camera" value="1, 0.5, -4"/>
    <default name="fov" value="40"/>
    <default name="focus" value="3"/>
    <default name="radius" value="0.1"/>
    <default name="width" value="9"/>
    <default name="falloff" value="0.5"/>
    <default name="spp" value="1"/>
    <default name="scale" value="1"/>
    <integrator type="nerg">
        <volume name="field" type="nerf"><string name="filename" value="field.safetensors"/></volume>
        <volume name="gaze" type="gazefield"><string name="filename" value="gaze.safetensors"/></volume>
        <sensor name="observer" type="perspective">
            <transform name="to_world"><lookat origin="$eye" target="0, 0, 0" up="0, 1, 0"/></transform>
        </sensor>
        <float name="falloff" value="$falloff"/>
        <string name="aovs" value="depth,gaze,visibility"/>
    </integrator>
    <shape type="sphere"><transform name="to_world"><scale value="0.1"/><scale value="$scale"/></transform></shape>
    <sensor type="perspective" id="camera">
        <float name="fov" value="$fov"/><string name="fov_axis" value="smaller"/>
        <transform name="to_world"><lookat origin="$camera" target="0, 0, 0" up="0, 1, 0"/></transform>
        {film}
    </sensor>
    <sensor type="thinlens">
        <float name="aperture_radius" value="$radius"/><float name="focus_distance" value="$focus"/>
        <transform name="to_world"><lookat origin="$camera" target="0, 0, 0" up="0, 1, 0"/></transform>
        {film}
    </sensor>
    <sensor type="panorama"><transform name="to_world"><translate value="$eye"/></transform>{film}</sensor>
    <sensor type="orthographic">
        <transform name="to_world"><lookat origin="$camera" target="0, 0, 0" up="0, 1, 0"/></transform>
        {film}
    </sensor>
</scene>"""
FILM = """<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm"><rfilter type="box"/><string name="component_format" value="float32"/>
            <integer name="width" value="$width"/><integer name="height" value="6"/></film>"""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sequence")
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    (folder / "scene.xml").write_text(SCENE.format(film=FILM))
    return folder / "scene.xml"


def render(scene, index):
    (band,) = bands.render_bands(scene, scene.sensors()[index], seed=3)
    return np.array(band.film.develop())


MOVES = {
    "eye": lambda rng: ",".join(map(str, rng.uniform(-1, 1, 3) - (0, 0, 2.5))),
    "camera": lambda rng: ",".join(map(str, rng.uniform(-1, 1, 3) - (0, 0, 3))),
    "fov": lambda rng: str(rng.uniform(20, 60)),
    "focus": lambda rng: str(rng.uniform(2, 4)),
    "radius": lambda rng: str(rng.uniform(0.1, 0.3)),
}
OTHERS = {
    "width": lambda rng: str(rng.integers(6, 12)),
    "falloff": lambda rng: str(rng.uniform(0.1, 2)),
    "spp": lambda rng: str(rng.integers(1, 3)),
    "scale": lambda rng: str(rng.uniform(0.5, 2)),
}


def test01_any_values_give_the_image_of_a_new_scene(rgb, path):
    rng, sequence, values = np.random.default_rng(1), SceneSequence(path), {"spp": "1", "width": "9"}
    loaded = sequence.load(values)
    moved = 0
    for _ in range(24):
        changes = MOVES if rng.uniform() < 0.7 else OTHERS
        before, previous = loaded, values
        for name in rng.choice(list(changes), 2):
            values = {**values, str(name): changes[name](rng)}
        loaded = sequence.load(values)
        assert (loaded is before) == (changes is MOVES or values == previous)
        moved += loaded is before
        new = load_scene(path, values)
        for index in range(4):
            assert np.array_equal(render(loaded, index), render(new, index)), (values, index)
    assert 10 < moved < 24


def test02_sensors_inside_others_are_loaded_again(rgb, path):
    text = SCENE.format(film=FILM)
    begin = text.index('<sensor type="perspective" id="camera">')
    single = text[begin : text.index("</sensor>", begin) + len("</sensor>")]
    (path.parent / "batch.xml").write_text(
        text.replace(single, f'<sensor type="batch">{single}{single.replace("camera", "second", 1)}{FILM}</sensor>')
    )
    sequence = SceneSequence(path.parent / "batch.xml")
    first = sequence.load({"width": "8"})
    assert sequence.load({"width": "8", "eye": "0.3, 0.1, -2.5"}) is first
    assert sequence.load({"width": "8", "eye": "0.3, 0.1, -2.5", "fov": "33"}) is not first


@pytest.mark.parametrize("values", [{"nowhere": "1"}, {"fov": "-3"}, {"eye": "1e30, 0, 0"}, {"camera": "nan, 0, 0"}])
def test03_errors_are_those_of_a_new_scene(rgb, path, values):
    sequence = SceneSequence(path)
    sequence.load({})
    with pytest.raises(NergError) as expected:
        load_scene(path, values)
    with pytest.raises(NergError) as raised:
        sequence.load(values)
    assert str(raised.value) == str(expected.value)
    # Nothing of the refused values is left.
    assert np.array_equal(render(sequence.load({}), 0), render(load_scene(path), 0))
