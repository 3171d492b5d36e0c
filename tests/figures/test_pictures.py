"""Pictures of one and several observers, compared with Mitsuba and the command."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.figures.pictures import split_channels
from tests.pictures import mitsuba_bitmap

BALL = {"type": "sphere", "center": [1.4, -1.0, 0.3], "radius": 0.4}
EYES = [(0.3, -3, 0.4), (2.5, -1, 0.5), (-1.5, -2.0, 1.0)]

XML = """<scene version="3.0.0">
  <integrator type="nerg">
    <volume name="field" type="nerf"><string name="filename" value="field.safetensors"/></volume>
    <volume name="gaze" type="gazefield"><string name="filename" value="gaze.safetensors"/></volume>
    <sensor name="observer" type="perspective">
      <transform name="to_world"><lookat origin="2.5, -1, 0.5" target="0, 0, 0" up="0, 0, 1"/></transform>
    </sensor>
    <string name="aovs" value="depth,opacity,gaze,visibility,position"/>
  </integrator>
  <shape type="sphere"><point name="center" x="1.4" y="-1.0" z="0.3"/><float name="radius" value="0.4"/></shape>
  <sensor type="perspective">
    <float name="fov" value="50"/>
    <transform name="to_world"><lookat origin="0.3, -3, 0.4" target="0, 0, 0" up="0, 0, 1"/></transform>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="12"/><integer name="height" value="8"/><rfilter type="box"/>
      <string name="component_format" value="float32"/><string name="pixel_format" value="rgb"/>
    </film>
  </sensor>
</scene>"""


def test01_pixels_of_the_command_to_the_bit(files, scene, tmp_path):
    from typer.testing import CliRunner

    from nerg_mi.cli import build_app

    (files / "scene.xml").write_text(XML)
    out = tmp_path / "picture.exr"
    arguments = ["render", str(files / "scene.xml"), "-o", str(out), "-m", "llvm_ad_rgb", "--spp", "4"]
    done = CliRunner().invoke(build_app(), arguments)
    assert done.exit_code == 0, done.output
    bitmap = mitsuba_bitmap(out)
    names = [field.name for field in bitmap.struct_()]
    written = dict(zip(names, np.moveaxis(np.array(bitmap), -1, 0)))
    quantities = ["gaze", "visibility", "position", "color", "opacity", "depth"]
    result = nerg.render(scene, EYES, quantities, spp=4)
    assert result.names == tuple(quantities)
    source = {"gaze": ["gaze.Y"], "visibility": ["visibility.Y"], "opacity": ["opacity.Y"], "depth": ["depth.T"]}
    source |= {"color": ["R", "G", "B"], "position": ["position.X", "position.Y", "position.Z"]}
    for name, channels in source.items():
        expected = np.stack([written[c] for c in channels], axis=-1)
        mine = result[name][1] if name in ("color", "position") else result[name][1][..., None]
        assert np.array_equal(mine, expected), name
    assert result.gaze.max() > 0 and result.visibility.min() == 0 < result.visibility.max()


def test02_observers_are_independent(scene):
    quantities = ("color", "depth", "gaze", "visibility", "observer_depth", "gaze_evals", "density_evals")
    together = nerg.render(scene, EYES, quantities, spp=2)
    assert together.gaze.shape == (3, 8, 12) and together.color.shape == (3, 8, 12, 3)
    assert np.array_equal(together.observers, np.float32(EYES))
    for i, eye in enumerate(EYES):
        alone = nerg.render(scene, eye, quantities, spp=2)
        for name in quantities:
            assert np.array_equal(alone[name][0], together[name][i]), (name, i)
    assert not np.array_equal(together.gaze[0], together.gaze[1])


def test03_an_observer_at_the_camera_is_the_camera(scene):
    individual, is_valid = nerg.render(scene, spp=2), nerg.render(scene, EYES[0], spp=2)
    assert np.allclose(individual.observers, EYES[:1])
    for name in individual:
        assert np.array_equal(individual[name], is_valid[name]), name


def test04_the_scenes_own_observer(files, camera):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", camera=camera, observer=EYES[1])
    individual, options = nerg.render(scene, spp=1), nerg.render(scene, EYES[1], spp=1)
    assert np.array_equal(individual.observers, options.observers)
    assert all(np.array_equal(individual[name], options[name]) for name in individual)


def test05_the_scene_is_not_changed(files, camera):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", camera=camera, observer=EYES[1])
    before = repr(scene), repr(scene.integrator)
    nerg.render(scene, EYES, ["gaze", "emit"], spp=1)
    assert (repr(scene), repr(scene.integrator)) == before


def test06_changed_parameters_take_effect(files, camera, rgb):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", shapes=BALL, camera=camera)
    before = nerg.render(scene, EYES, ["visibility", "opacity"], spp=1)
    params = rgb.traverse(scene.mitsuba)
    params["integrator.falloff"] = 5.0
    params["integrator.field.grid.table"] = 0.5 * params["integrator.field.grid.table"]
    params.update()
    after = nerg.render(scene, EYES, ["visibility", "opacity"], spp=1)
    assert not np.array_equal(before.visibility, after.visibility)
    assert not np.array_equal(before.opacity, after.opacity)


def test07_seeds_and_samples(scene):
    a, b, c = (nerg.render(scene, quantities="depth", spp=2, seed=s).depth for s in (0, 0, 1))
    assert np.array_equal(a, b) and not np.array_equal(a, c)
    assert np.array_equal(
        nerg.render(scene, quantities="depth").depth, nerg.render(scene, quantities="depth", spp=16).depth
    )


def test08_another_camera(scene):
    other = nerg.Camera((0, -4, 0), (0, 0, 0), fov=40, width=6, height=5)
    assert nerg.render(scene, quantities="opacity", camera=other, spp=1).opacity.shape == (1, 5, 6)


def test09_progress_is_reported(scene):
    messages = []

    class Reporter:
        def message(self, text): ...
        def warn(self, text): ...
        def progress(self, share, text=""):
            messages.append(share)

    nerg.render(scene, EYES, spp=1, progress=Reporter())
    assert messages == sorted(messages) and messages[-1] == 1


@pytest.mark.parametrize(
    "arguments, said",
    [
        ({"quantities": "gazes"}, '"aovs".*"gazes"'),
        ({"quantities": "kde"}, 'needs a "kde" volume'),
        ({"observers": (0, 1)}, "observers must have the shape"),
        ({"spp": -1}, "spp must lie in 0 .. 16777216, got -1"),
        ({"spp": 1.5}, "spp must be a whole number"),
        ({"seed": "one"}, "seed must be a whole number"),
        ({"spp": 1 << 30}, "spp must lie in"),
        ({"camera": 3}, "no camera 3"),
    ],
)
def test10_errors_are_sentences(scene, arguments, said):
    with pytest.raises(nerg.NergError, match=said) as error:
        nerg.render(scene, **{"spp": 1, **arguments})
    assert "\n" not in str(error.value)


def test11_without_gaze(files, camera):
    scene = nerg.make_scene(files / "field.safetensors", camera=camera)
    assert nerg.render(scene, spp=1).names == ("color", "depth", "opacity")
    assert nerg.render(scene, EYES, "visibility", spp=1).visibility.shape == (3, 8, 12)
    with pytest.raises(nerg.NergError, match='needs a "gaze" volume'):
        nerg.render(scene, quantities="gaze", spp=1)


def test12_channels_by_name():
    pixels = np.arange(2 * 3 * 8, dtype=np.float32).reshape(2, 3, 8)
    result = split_channels(
        pixels, ["depth.T", "position.X", "position.Y", "position.Z"], ["position", "color", "depth"], True
    )
    assert np.array_equal(result["color"], pixels[..., :3]) and np.array_equal(result["depth"], pixels[..., 4])
    assert np.array_equal(result["position"], pixels[..., 5:8]) and list(result) == ["position", "color", "depth"]


@pytest.mark.parametrize("name", ["color", "gaze", "depth"])
def test20_pyplot_saves_the_new_figure(scene, tmp_path, name):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pyplot.switch_backend("agg")
    view = nerg.render(scene, quantities=("color", "gaze", "depth"), spp=1)
    try:
        figure, panel = pyplot.subplots()
        before = pyplot.get_fignums()
        assert view.plot(name, axes=panel) is figure and pyplot.get_fignums() == before
        drawn = view.plot(name)
        assert pyplot.gcf() is drawn and len(pyplot.get_fignums()) == len(before) + 1
        pyplot.savefig(tmp_path / "figure.png")
        assert np.ptp(pyplot.imread(tmp_path / "figure.png")) > 0.1
        before = pyplot.get_fignums()
        with pytest.raises(nerg.NergError):
            view.plot("position")
        assert pyplot.get_fignums() == before
    finally:
        pyplot.close("all")
