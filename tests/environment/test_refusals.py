"""Cameras without a centre, scenes of another Mitsuba variant, and matrices that are no transforms."""

import mitsuba
import numpy as np
import pytest
import trimesh

import nerg_mi as nerg
from nerg_mi.errors import NergError, translate_mitsuba_errors

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
    "command": lambda path: nerg.render_film(path, path.with_suffix(".exr"), spp=1),
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
    with pytest.raises(NergError, match='centre.*"observer"'):
        CALLS[call](write(SENSORS[sensor]))


def test02_an_observer_makes_it_possible(write, rgb):
    observer = PERSPECTIVE.replace("<sensor", '<sensor name="observer"')
    CALLS["command"](write(ORTHOGRAPHIC, observer))


def test03_mitsuba_wraps_the_error_before_rays_are_traced(write, rgb, monkeypatch):
    scene = rgb.load_file(str(write(ORTHOGRAPHIC)))
    monkeypatch.setattr(type(scene.integrator()), "sample", lambda *_: pytest.fail("rays are traced"))
    with pytest.raises(NergError, match="centre"), translate_mitsuba_errors():
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
    with pytest.raises(NergError) as error:
        QUERIES[query](scene)
    assert "llvm_ad_rgb" in str(error.value) and "llvm_ad_mono" in str(error.value)


def test05_areas_that_are_an_environment_are_refused():
    trimesh = pytest.importorskip("trimesh")
    rays = nerg.Rays.from_arrays([[1, 1, 1.6]], [[1, 0, 0]], times=[0])
    with pytest.raises(NergError, match="aois must be a dict of areas"):
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
        with pytest.raises(NergError, match=f"{name}|mesh"):
            call(content)


def _load_node(matrix):
    room = trimesh.Scene()
    room.add_geometry(trimesh.creation.box((1, 1, 1)), transform=matrix)
    return nerg.make_scene(shapes=room)


ENTRIES = {
    "node of trimesh": _load_node,
    "shape": lambda matrix: nerg.make_scene(shapes={"type": "cube", "to_world": to_mitsuba(matrix)}),
    "camera": lambda matrix: nerg.make_scene(shapes=CUBE, camera=make_sensor(matrix)),
    "scene": lambda matrix: nerg.Scene.coerce(NERG | {"camera": make_sensor(matrix)}),
    "scene of Mitsuba": lambda matrix: nerg.Scene(mitsuba.load_dict(NERG | {"camera": make_sensor(matrix)})),
    "sensor": lambda m: nerg.render(nerg.Scene.coerce(NERG), camera=mitsuba.load_dict(make_sensor(m)), spp=1),
}
CUBE = {"type": "cube"}
NERG = {"type": "scene", "integrator": {"type": "nerg"}, "cube": CUBE}


def to_mitsuba(matrix):
    return mitsuba.ScalarTransform4f(matrix.tolist())


def make_sensor(matrix):
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    return {"type": "perspective", "to_world": to_mitsuba(matrix), "film": film}


@pytest.mark.parametrize("entry", ENTRIES)
def test_matrices_in_memory_have_the_last_row_of_a_transform(rgb, entry):
    """Mitsuba and trimesh use others as they are."""
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, -3
    ENTRIES[entry](matrix)
    with pytest.raises(NergError, match="transpose"):
        ENTRIES[entry](matrix.T)
    matrix[3, 3] = 2
    with pytest.raises(NergError, match="last row"):
        ENTRIES[entry](matrix)


@pytest.mark.parametrize("name", ["room.stl", "room.fbx", "room", "rays.npz", "gaze.safetensors"])
def test07_what_is_no_environment_is_named(files, name, rgb):
    """By its own name and kind, and not as a field that Mitsuba cannot load."""
    path = files / name
    if not path.exists():
        path.write_bytes(b"solid room")
    with pytest.raises(NergError, match=f'"{path}" (cannot be shown|contains)') as error:
        nerg.make_scene(path)
    assert "plugin" not in str(error.value)
    if name != "gaze.safetensors":
        with pytest.raises(NergError, match=f'"{path}"') as error:
            nerg.make_scene(shapes={"type": "cube"}, gaze=path)
        assert "plugin" not in str(error.value)


REFUSED = [
    (lambda: nerg.train_gaze("no.npz", "no.xml"), "no.xml"),
    (lambda: nerg.train_gaze("no.npz", "none"), "no.npz"),
    (lambda: nerg.train_gaze(np.zeros(3), "none"), "rays must be .* got ndarray; .* import_rays"),
    (lambda: nerg.train_gaze("no.npz"), "environment="),
    (lambda: nerg.train_gaze("no.npz", 3), "got int"),
    (lambda: nerg.train_radiance(None), "got NoneType"),
    (lambda: nerg.train_radiance("no"), '"no"'),
    (lambda: nerg.evaluate_gaze("no.safetensors", "no.npz"), "no.safetensors"),
    (lambda: nerg.evaluate_radiance(3, "."), "got int"),
    (lambda: nerg.align("no.npz", "no.xml"), "no.npz"),
    (lambda: nerg.study(3), "a scene must be a file or a Mitsuba scene, got int"),
    (lambda: nerg.make_scene("no.safetensors", falof=0.1), 'no setting "falof"; did you mean "falloff"?'),
    (lambda: nerg.make_scene("no.safetensors"), '^the file "no.safetensors" of "environment" does not exist'),
    (lambda: nerg.render("no.xml"), 'there is no scene file "no.xml"'),
    (lambda: nerg.render(None), "a scene must be a Scene.* got NoneType"),
    (lambda: nerg.trace(3, [0, 0, 0], [1, 0, 0]), "a scene must be a Scene.* got int"),
    (lambda: nerg.bake("no.ply", gaze="no.safetensors"), "no.ply"),
    (lambda: nerg.statistics("no.npz", "no.json"), "no.npz"),
]


@pytest.mark.parametrize("call, said", REFUSED)
def test_names_are_checked_before_files_and_files_before_work(rgb, tmp_path, monkeypatch, call, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NergError, match=said) as messages:
        call()
    assert len(str(messages.value)) < 300 and not any(tmp_path.iterdir())


def test_natural_arguments_are_accepted(rgb, tmp_path):
    import mitsuba as mi

    path = tmp_path / "room.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="nerg"/><shape type="cube"/><sensor type="perspective"><film '
        'type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film></sensor></scene>'
    )
    scene = nerg.Scene.load(path)
    pictures = [
        nerg.render(options, quantities="opacity").opacity for options in (path, str(path), scene, scene.mitsuba)
    ]
    assert all((picture == pictures[0]).all() for picture in pictures)
    # Values of `<default>`s change the scene of the file.
    assert nerg.Scene.load(path).path == path and nerg.Scene(mi.load_file(str(path))).path is None
