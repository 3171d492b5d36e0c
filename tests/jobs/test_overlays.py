"""Pictures with a quantity over them: what is asked for, their scale, sequences, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import top_of
from nerg_mi.jobs.options.pictures import PictureOptions
from nerg_mi.jobs.pictures import render_file
from nerg_mi.rendering.asked import render_asked
from nerg_mi.rendering.pictures import load_scene
from tests.jobs.recorder import Recorder
from tests.pictures import mitsuba_bitmap
from tests.plugins import fields

MODE = "llvm_ad_rgb"
SCENE = """<scene version="3.0.0">
    <default name="eye" value="0.2, 0.1, -2.5"/>
    <default name="size" value="12"/>
    <integrator type="nerg">
        <volume name="field" type="nerf"><string name="filename" value="field.safetensors"/></volume>
        <volume name="gaze" type="gazefield"><string name="filename" value="gaze.safetensors"/></volume>
        <sensor name="observer" type="perspective">
            <transform name="to_world"><lookat origin="$eye" target="0, 0, 0" up="0, 1, 0"/></transform>
        </sensor>
        <string name="aovs" value="opacity"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="1, 0.5, -4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
        <film type="hdrfilm"><rfilter type="box"/><string name="component_format" value="float32"/>
            <integer name="width" value="18"/><integer name="height" value="$size"/></film>
    </sensor>
</scene>"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant(MODE)
    folder = tmp_path_factory.mktemp("scene")
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "walk.csv").write_text('eye\n"0.2, 0.1, -2.5"\n"-1.5, 0.4, -2"\n')
    return folder / "scene.xml"


def test_a_quantity_that_the_scene_does_not_name(rgb, scene, tmp_path):
    told = Recorder()
    made = render_file(scene, tmp_path / "a.png", PictureOptions(overlay="gaze", mode=MODE), told)
    loaded = load_scene(scene)
    found = render_asked(scene, loaded, loaded.sensors()[0], ["gaze", "opacity"])
    assert made.top == pytest.approx(top_of(found.aovs["gaze"], found.mask)) and made.files == (tmp_path / "a.png",)
    # The picture, pixel for pixel, and the scale beside it.
    width, height = mitsuba_bitmap(made.path).size()
    assert width > 18 + 60 and height > 12 and f"scale to {made.top:.4g}" in told.messages[0]
    fixed = render_file(scene, tmp_path / "b.png", PictureOptions(overlay="gaze", top=9.0, mode=MODE))
    assert fixed.top == 9.0 and (tmp_path / "b.png").read_bytes() != (tmp_path / "a.png").read_bytes()


@pytest.mark.parametrize("name", ["visibility", "depth", "emit"])
def test_other_quantities(rgb, scene, tmp_path, name):
    made = render_file(scene, tmp_path / "a.png", PictureOptions(overlay=name, mode=MODE))
    assert made.path.stat().st_size > 500 and (made.top is None) == (name == "visibility")


def test_a_sequence_has_one_scale(rgb, scene, tmp_path):
    options = PictureOptions(overlay="gaze", frames=scene.with_name("walk.csv"), mode=MODE)
    both = render_file(scene, tmp_path / "walk.png", options)
    tops = []
    for k, eye in enumerate(("0.2, 0.1, -2.5", "-1.5, 0.4, -2")):
        one = PictureOptions(overlay="gaze", defaults={"eye": eye}, mode=MODE)
        tops.append(render_file(scene, tmp_path / f"one{k}.png", one).top)
    assert tops[0] != tops[1] and both.top == max(tops)
    assert [p.name for p in both.files] == ["walk_0001.png", "walk_0002.png"]
    # The one whose scale it is looks as it does alone; the other does not.
    alone = [(tmp_path / f"one{k}.png").read_bytes() == p.read_bytes() for k, p in enumerate(both.files)]
    assert alone == [t == both.top for t in tops]


def test_a_sequence_without_an_overlay(rgb, scene, tmp_path):
    told = Recorder()
    options = PictureOptions(frames=scene.with_name("walk.csv"), mode=MODE)
    made = render_file(scene, tmp_path / "walk.exr", options, told)
    alone = render_file(scene, tmp_path / "one.exr", PictureOptions(mode=MODE))
    first, other = (np.array(mitsuba_bitmap(p)) for p in (made.files[0], alone.path))
    np.testing.assert_array_equal(first, other)
    shares = [share for share, _ in told.steps]
    assert shares == sorted(shares) and shares[-1] == 1 and "2 pictures" in told.messages[0]


def test_ctrl_c_leaves_whole_pictures(rgb, scene, tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            if share > 0.5:
                raise KeyboardInterrupt

    frames = scene.with_name("walk.csv")
    for overlay, left in ((None, ["walk_0001.png"]), ("gaze", [])):
        out = tmp_path / str(overlay) / "walk.png"
        with pytest.raises(KeyboardInterrupt):
            render_file(scene, out, PictureOptions(overlay=overlay, frames=frames, mode=MODE), Impatient())
        assert [p.name for p in tmp_path.glob(f"{overlay}/*")] == left


@pytest.mark.parametrize(
    "output, options, said",
    [
        ("a.exr", {"overlay": "gaze"}, r"let its name end in .png"),
        ("a.png", {"overlay": "gase"}, 'no overlay "gase"'),
        ("a.png", {"top": 1.0}, "give --overlay, too"),
        ("a.png", {"overlay": "gaze", "top": -1.0}, "--top must be positive"),
        ("a.png", {"overlay": "kde"}, '"kde", which needs'),
        ("a.png", {"overlay": "gaze", "memory": 1e-5}, "is drawn in one piece, for which it takes"),
        ("a.png", {"overlay": "gaze", "defaults": {"eye": "0, 0, 1e6"}}, "is 0 wherever a surface is seen"),
    ],
)
def test_what_is_refused(rgb, scene, tmp_path, output, options, said):
    with pytest.raises(NergError, match=said):
        render_file(scene, tmp_path / output, PictureOptions(mode=MODE, **options))
    assert not list(tmp_path.iterdir())
