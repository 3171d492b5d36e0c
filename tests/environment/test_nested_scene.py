"""Tests of `nerg_mi.environment.nested_scene`."""

from __future__ import annotations

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

import nerg_mi as nerg
from nerg_mi.environment.bands import render_channels
from nerg_mi.environment.nested_scene import SceneDocument, nest_scene
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.environment.scene_writer import GazeFiles, LookAt, SceneText
from nerg_mi.errors import NergError
from nerg_mi.formats.surfaces import write_volume

# ---- Nested scenes ----

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
    camera = LookAt(np.array([0.3, 0, 4.0]), np.array([0, 0, 0.0]))
    place = nest_scene(path)
    scene = SceneText(place, GazeFiles(), camera, None, np.array([0.0, 1, 0]), width=12)
    out.write_text(scene.to_xml(out.parent))
    return load_scene(out)


@pytest.mark.parametrize("where", ["theirs/ours.xml", "elsewhere/ours.xml"])
def test_nested_light_sensors_and_files(rgb, theirs, tmp_path, where):
    path, out = theirs(), tmp_path / where
    out.parent.mkdir(exist_ok=True)
    scene = shown(path, out)
    assert len(scene.sensors()) == 4 and tuple(scene.sensors()[3].film().crop_size()) == (7, 5)
    image = render_channels(scene, scene.sensors()[0], spp=256)
    # A diffuse plane under constant light reflects its albedo: 0.8 x 0.5.
    assert image.color[4].mean() == pytest.approx(0.4, rel=0.02)
    assert image.mask[4].all()
    np.testing.assert_allclose(image.aovs["depth"][4, 6], 4, atol=0.1)
    text = out.read_text()
    assert ("<path" in text) == (where[0] == "e") and "theirs" in text and str(tmp_path) not in text


def test_nested_integrator_is_kept(rgb, theirs, tmp_path):
    scene = shown(theirs("direct", THEIRS.replace('<integer name="max_depth" value="2"/>', "")), tmp_path / "a.xml")
    assert scene.integrator().shading.nested.class_name() == "DirectIntegrator"


NERG_THEIRS = """<scene version="3.0.0"><default name="kind" value="nerg"/>
    <integrator type="$kind" id="integrator"><string name="aovs" value="depth"/><float name="falloff" value="0.3"/>
        <volume name="density" type="gridvolume"><string name="filename" value="d.vol"/>
            <boolean name="use_grid_bbox" value="true"/></volume>
        <volume name="gaze" type="gazefield"><string name="filename" value="nowhere.safetensors"/></volume>
        <sensor name="observer" type="perspective"/>{light}
        <rgb name="background" value="0.25"/></integrator>
    <shape type="obj"><string name="filename" value="tri.obj"/></shape></scene>"""


@pytest.mark.parametrize("where", ["theirs/ours.xml", "elsewhere/ours.xml"])
def test_volumes_of_nerg_are_copied(rgb, theirs, tmp_path, where):
    path, out = theirs(text=NERG_THEIRS.replace("{light}", "")), tmp_path / where
    out.parent.mkdir(exist_ok=True)
    # Solid from x = 1 to 3; the camera is at x = 0.3.
    write_volume(path.parent / "d.vol", np.full((4, 4, 4), 1e3), (1, -2, 2), (3, 2, 6))
    scene = shown(path, out)
    assert nest_scene(path).left_out == ("aovs", "falloff", "gaze", "observer")
    assert scene.integrator().id() == "integrator" and scene.integrator().gaze is None
    views = nerg.Scene(scene)
    rays = nerg.trace(views, [(0.3, 0, 4)] * 3, [(1, 0, 0), (0, 0, -1), (0, 0, 1)], ["depth", "color"])
    np.testing.assert_allclose(rays.depth[:2], [0.7, 4], atol=0.01)
    np.testing.assert_allclose(rays.color[2], 0.25, atol=1e-6)


def test_light_in_nerg_takes_more_samples(theirs, tmp_path):
    count = {}
    for light in ("", '<integrator type="path"/>'):
        count[light] = nest_scene(theirs(text=NERG_THEIRS.replace("{light}", light))).spp
    assert count[""] < count['<integrator type="path"/>'] == nest_scene(theirs()).spp


@pytest.mark.parametrize(
    "text, said",
    [
        ('<scene version="3.0.0"><integrator type="moment"><integrator type="nerg"/></integrator></scene>', "within"),
        ('<scene version="3.0.0"><integrator type="path"/><integrator type="path"/></scene>', "has 2 integrators"),
        ('<scene version="3.0.0"><include filename="nowhere.xml"/></scene>', 'includes "nowhere.xml"'),
        ("<bsdf/>", "root element is <bsdf>"),
        ("<scene", "not well-formed XML"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><scene version="3.0.0"/>', "declares an entity"),
    ],
)
def test_invalid_scenes_are_refused(theirs, tmp_path, text, said):
    with pytest.raises(NergError, match=said):
        nest_scene(theirs(text=text))


# ---- Replaced gaze fields ----

PLAIN = """<scene version="3.0.0"><default name="n" value="a"/>{}<shape type="sphere"/></scene>"""
NERG = """<integrator type="nerg"><volume name="gaze" type="gazefield"><string name="filename" value="$n.bin"/></volume>
</integrator>"""


def test01_gaze_is_replaced_or_added(tmp_path):
    path, names = tmp_path / "a.xml", []
    for integrator in (NERG, '<integrator type="nerg"/>'):
        path.write_text(PLAIN.format(integrator))
        document = SceneDocument.read(path)
        again = SceneDocument.parse(document.with_gaze(tmp_path / "b.bin").to_xml(), "again").find_integrator()
        names.append([node.get("value") for node in again.iter("string")])
        assert len(document.find_integrator()) == (integrator is NERG), "a copy is changed"
    assert names == [[str((tmp_path / "b.bin").resolve())]] * 2


@pytest.mark.parametrize("count", [0, 2])
def test02_exactly_one_integrator_is_required(tmp_path, count):
    path = tmp_path / "a.xml"
    path.write_text(PLAIN.format('<integrator type="nerg"/>' * count))
    with pytest.raises(NergError, match=f"has {count} integrators"):
        SceneDocument.read(path).with_gaze(tmp_path / "b.bin")


@pytest.mark.slow
def test03_replaced_gaze_renders_the_same(rgb, tmp_path):
    """A copy of the store's gaze field under another name."""
    store = SCENE_FILE
    other = tmp_path / "other.safetensors"
    other.write_bytes((store.parent / "shoppers.safetensors").read_bytes())
    (tmp_path / "copy.xml").write_text(SceneDocument.read(store).with_gaze(other).to_xml())
    at, ahead = [(4.4, 2.8, 1.6)] * 16, np.random.default_rng(1).normal(size=(16, 3))
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    image = [nerg.trace(nerg.Scene.load(path), at, ahead, ["gaze", "depth"]) for path in (store, tmp_path / "copy.xml")]
    assert np.array_equal(image[0]["gaze"], image[1]["gaze"]) and np.array_equal(image[0].depth, image[1].depth)
