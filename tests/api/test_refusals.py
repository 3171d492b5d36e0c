"""Cameras without a centre, and scenes of another Mitsuba variant."""

import mitsuba
import pytest

import nerg_mi as nerg
from nerg_mi.errors import translate_mitsuba_errors
from nerg_mi.workflows.render import render_file
from nerg_mi.workflows.scene_commands import PictureOptions

SIZE = '<integer name="width" value="1"/><integer name="height" value="1"/>'
FILM = f'<film type="hdrfilm">{SIZE}<rfilter type="box"/></film>'
LOOK = '<transform name="to_world"><lookat origin="0,-3,0" target="0,0,0" up="0,0,1"/></transform>'
ORTHOGRAPHIC = f'<sensor type="orthographic">{FILM}{LOOK}</sensor>'
PERSPECTIVE = ORTHOGRAPHIC.replace("orthographic", "perspective")
SENSORS = {
    "orthographic": ORTHOGRAPHIC,
    "distant": f'<sensor type="distant">{FILM}</sensor>',
    "irradiance meter": f'<shape type="rectangle"><sensor type="irradiancemeter">{FILM}</sensor></shape>',
    "batch": f'<sensor type="batch">{PERSPECTIVE}{ORTHOGRAPHIC}{FILM.replace("1", "2", 1)}</sensor>',
}
CALLS = {
    "command": lambda path: render_file(path, path.with_suffix(".exr"), PictureOptions(spp=1, mode="llvm_ad_rgb")),
    "function": lambda path: nerg.render(nerg.Scene.load(path), spp=1),
}


@pytest.fixture
def write(files):
    def write(sensor, inside=""):
        path = files / "scene.xml"
        gaze = '<volume name="gaze" type="gazefield"><string name="filename" value="gaze.safetensors"/></volume>'
        aovs = f'<string name="aovs" value="depth,gaze"/>{inside}'
        integrator = f'<integrator type="nerg">{gaze}{aovs}</integrator>'
        path.write_text(f'<scene version="3.0.0">{integrator}{sensor}<shape type="sphere"/></scene>')
        return path

    return write


@pytest.mark.parametrize("call", list(CALLS))
@pytest.mark.parametrize("sensor", list(SENSORS))
def test01_a_camera_without_centre_needs_an_observer(write, sensor, call, rgb):
    with pytest.raises(nerg.NergError, match='centre.*"observer"'):
        CALLS[call](write(SENSORS[sensor]))


def test02_an_observer_makes_it_possible(write, rgb):
    observer = PERSPECTIVE.replace("<sensor", '<sensor name="observer"')
    CALLS["command"](write(ORTHOGRAPHIC, observer))


def test03_mitsuba_wraps_the_error_before_rays_are_traced(write, rgb, monkeypatch):
    scene = rgb.load_file(str(write(ORTHOGRAPHIC)))
    monkeypatch.setattr(type(scene.integrator()), "sample", lambda *_: pytest.fail("rays are traced"))
    with pytest.raises(nerg.NergError, match="centre"), translate_mitsuba_errors():
        rgb.render(scene, spp=1)


QUERIES = {
    "render": lambda scene: nerg.render(scene, spp=1),
    "trace": lambda scene: nerg.trace(scene, (0, -3, 0), (0, 1, 0)),
    "observe": lambda scene: nerg.observe(scene, (0, 0, 1), (0, -3, 0)),
    "attention": lambda scene: nerg.attention(scene, [(0, 0, 0), (1, 1, 1)], (0, -3, 0)),
}


@pytest.mark.parametrize("wrap", [lambda s: s, lambda s: s.mitsuba], ids=["nerg", "Mitsuba"])
@pytest.mark.parametrize("query", list(QUERIES))
def test04_a_scene_of_another_variant_is_refused(write, query, wrap, rgb):
    scene = wrap(nerg.Scene.load(write(PERSPECTIVE)))
    mitsuba.set_variant("llvm_ad_mono")
    with pytest.raises(nerg.NergError) as error:
        QUERIES[query](scene)
    assert "llvm_ad_rgb" in str(error.value) and "llvm_ad_mono" in str(error.value)


def test05_areas_that_are_an_environment_are_refused():
    trimesh = pytest.importorskip("trimesh")
    rays = nerg.Rays.from_arrays([[1, 1, 1.6]], [[1, 0, 0]], times=[0])
    with pytest.raises(nerg.NergError, match=r'"(aois|areas)" must be a dict of areas'):
        nerg.statistics(rays, trimesh.Scene(trimesh.creation.box((1, 1, 1))))


@pytest.mark.parametrize(
    "content, name",
    [
        ({"shelf": [[0, 0, 0], [1, 1, 1]]}, "shelf"),
        ({"shelf": None}, "shelf"),
        ({"type": 3}, "3"),
        ({"type": "scene", "lamp": None}, "lamp"),
        ({"type": "rectangle", "to_world": None}, "to_world"),
        ({"type": "sphere"}, "Shape"),
    ],
    ids=str,
)
def test06_dicts_without_a_plugin_or_values_are_refused(write, content, name, rgb):
    scene = nerg.Scene.load(write(PERSPECTIVE))
    for call in (nerg.Scene.coerce, lambda surface: nerg.attention(scene, surface, (0, -3, 0))):
        with pytest.raises(nerg.NergError, match=f"{name}|mesh"):
            call(content)
