"""Somebody's scene as a place: its light goes into ours, its sensors come after ours, its files are found."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering.bands import render_channels
from nerg_mi.rendering.nested_scene import nested_place
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import Attention, Eye, SceneText

THEIRS = """<scene version="3.0.0">
    <!-- theirs -->
    <default name="eye" value="0.5"/>
    <default name="kind" value="{kind}"/>
    <integrator type="$kind" id="integrator"><integer name="max_depth" value="2"/></integrator>
    <include filename="parts/ball.xml"/>
    <emitter type="constant"><rgb name="radiance" value="$eye"/></emitter>
    <sensor type="perspective" id="camera">
        <film type="hdrfilm"><integer name="width" value="7"/><integer name="height" value="5"/></film>
    </sensor>
</scene>"""
BALL = """<scene version="3.0.0">
    <shape type="obj" id="ball"><string name="filename" value="tri.obj"/>
        <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.8"/></bsdf></bsdf></shape>
</scene>"""


@pytest.fixture
def theirs(tmp_path):
    def make(kind="path", text=THEIRS):
        folder = tmp_path / "theirs"
        (folder / "parts").mkdir(parents=True, exist_ok=True)
        (folder / "parts" / "ball.xml").write_text(BALL)
        (folder / "tri.obj").write_text("v -9 -9 0\nv 9 -9 0\nv 0 9 0\nf 1 2 3\n")
        (folder / "scene.xml").write_text(text.replace("{kind}", kind))
        return folder / "scene.xml"

    return make


def shown(path, out):
    camera = Eye(np.array([0.3, 0, 4.0]), np.array([0, 0, 0.0]))
    place = nested_place(path, out.parent)
    scene = SceneText(place, Attention(), camera, None, np.array([0.0, 1, 0]), width=12)
    out.write_text(scene.xml())
    return load_scene(out)


@pytest.mark.parametrize("where", ["theirs/ours.xml", "elsewhere/ours.xml"])
def test_light_sensors_and_files_are_theirs(rgb, theirs, tmp_path, where):
    path, out = theirs(), tmp_path / where
    out.parent.mkdir(exist_ok=True)
    scene = shown(path, out)
    assert len(scene.sensors()) == 4 and tuple(scene.sensors()[3].film().crop_size()) == (7, 5)
    found = render_channels(scene, scene.sensors()[0], spp=256)
    # A diffuse plane in an even light sends back its albedo of it: 0.8 x 0.5.
    assert found.color[4].mean() == pytest.approx(0.4, rel=0.02)
    assert found.mask[4].all()
    np.testing.assert_allclose(found.aovs["depth"][4, 6], 4, atol=0.1)
    text = out.read_text()
    assert ("<path" in text) == (where[0] == "e") and "theirs" in text and str(tmp_path) not in text


def test_their_integrator_stays_what_it_is(rgb, theirs, tmp_path):
    scene = shown(theirs("direct", THEIRS.replace('<integer name="max_depth" value="2"/>', "")), tmp_path / "a.xml")
    assert scene.integrator().shading.nested.class_name() == "DirectIntegrator"


@pytest.mark.parametrize(
    "text, said",
    [
        (THEIRS.replace("{kind}", "nerg").replace('<integer name="max_depth" value="2"/>', ""), '"nerg" already'),
        ('<scene version="3.0.0"><integrator type="path"/><integrator type="path"/></scene>', "has 2 integrators"),
        ('<scene version="3.0.0"><include filename="nowhere.xml"/></scene>', 'includes "nowhere.xml"'),
        ("<bsdf/>", "begins with <bsdf>"),
        ("<scene", "no well-formed XML"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><scene version="3.0.0"/>', "declares an entity"),
    ],
)
def test_what_cannot_be_nested(theirs, tmp_path, text, said):
    with pytest.raises(NergError, match=said):
        nested_place(theirs(text=text), tmp_path)
