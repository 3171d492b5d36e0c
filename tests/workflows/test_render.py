"""Tests of `nerg_mi.workflows.render`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import top_of
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.images import read_exr_text
from nerg_mi.rendering import aovs
from nerg_mi.rendering.aovs import prepare_for, render_asked
from nerg_mi.rendering.scene import load_scene
from nerg_mi.workflows import render
from nerg_mi.workflows.demo import store_scene
from nerg_mi.workflows.render import render_file
from nerg_mi.workflows.scene_commands import PictureOptions
from nerg_mi.workflows.scene_commands import PictureOptions as PicturesPictureOptions
from tests.cli.test_render import SCENE
from tests.pictures import mitsuba_bitmap
from tests.plugins import fields
from tests.workflows.recorder import Recorder

# ---- Pictures with a quantity over them: what is asked for, their scale, sequences, and what is refused ----


MODE = "llvm_ad_rgb"


OVERLAYS_SCENE = """<scene version="3.0.0">
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
def scene_overlays(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant(MODE)
    folder = tmp_path_factory.mktemp("scene")
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    (folder / "scene.xml").write_text(OVERLAYS_SCENE)
    (folder / "walk.csv").write_text('eye\n"0.2, 0.1, -2.5"\n"-1.5, 0.4, -2"\n')
    return folder / "scene.xml"


def test_a_quantity_that_the_scene_does_not_name(rgb, scene_overlays, tmp_path):
    told = Recorder()
    made = render_file(scene_overlays, tmp_path / "a.png", PictureOptions(overlay="gaze", mode=MODE), told)
    loaded = load_scene(scene_overlays)
    found = render_asked(scene_overlays, loaded, loaded.sensors()[0], ["gaze", "opacity"])
    assert made.top == pytest.approx(top_of(found.aovs["gaze"], found.mask)) and made.files == (tmp_path / "a.png",)
    # The picture, pixel for pixel, and the scale beside it.
    width, height = mitsuba_bitmap(made.path).size()
    assert width > 18 + 60 and height > 12 and f"scale to {made.top:.4g}" in told.messages[0]
    fixed = render_file(scene_overlays, tmp_path / "b.png", PictureOptions(overlay="gaze", top=9.0, mode=MODE))
    assert fixed.top == 9.0 and (tmp_path / "b.png").read_bytes() != (tmp_path / "a.png").read_bytes()


@pytest.mark.parametrize("name", ["visibility", "depth", "emit"])
def test_other_quantities(rgb, scene_overlays, tmp_path, name):
    made = render_file(scene_overlays, tmp_path / "a.png", PictureOptions(overlay=name, mode=MODE))
    assert made.path.stat().st_size > 500 and (made.top is None) == (name == "visibility")


def test_a_sequence_has_one_scale(rgb, scene_overlays, tmp_path):
    options = PictureOptions(overlay="gaze", frames=scene_overlays.with_name("walk.csv"), mode=MODE)
    both = render_file(scene_overlays, tmp_path / "walk.png", options)
    tops = []
    for k, eye in enumerate(("0.2, 0.1, -2.5", "-1.5, 0.4, -2")):
        one = PictureOptions(overlay="gaze", defaults={"eye": eye}, mode=MODE)
        tops.append(render_file(scene_overlays, tmp_path / f"one{k}.png", one).top)
    assert tops[0] != tops[1] and both.top == max(tops)
    assert [p.name for p in both.files] == ["walk_0001.png", "walk_0002.png"]
    # The one whose scale it is looks as it does alone; the other does not.
    alone = [(tmp_path / f"one{k}.png").read_bytes() == p.read_bytes() for k, p in enumerate(both.files)]
    assert alone == [t == both.top for t in tops]


def test_a_sequence_without_an_overlay(rgb, scene_overlays, tmp_path):
    told = Recorder()
    options = PictureOptions(frames=scene_overlays.with_name("walk.csv"), mode=MODE)
    made = render_file(scene_overlays, tmp_path / "walk.exr", options, told)
    alone = render_file(scene_overlays, tmp_path / "one.exr", PictureOptions(mode=MODE))
    first, other = (np.array(mitsuba_bitmap(p)) for p in (made.files[0], alone.path))
    np.testing.assert_array_equal(first, other)
    shares = [share for share, _ in told.steps]
    assert shares == sorted(shares) and shares[-1] == 1 and "2 pictures" in told.messages[0]


def decoded(av, path):
    with av.open(str(path)) as found:
        frames = [f.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray() for f in found.decode(video=0)]
        return found.metadata, float(found.streams.video[0].average_rate), frames


@pytest.mark.parametrize("top", [None, 3.0])
def test_a_video_has_the_pictures_of_the_sequence(rgb, scene_overlays, tmp_path, top, monkeypatch):
    av = pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[video]")')
    kept = []
    monkeypatch.setattr(render, "write_bytes", lambda path, *parts: kept.append(path) or write_bytes(path, *parts))
    options = PictureOptions(overlay="gaze", frames=scene_overlays.with_name("walk.csv"), top=top, mode=MODE)
    render_file(scene_overlays, tmp_path / "walk.png", options)
    # With a scale that is given no picture waits for the others.
    assert len(kept) == (0 if top else 2)
    made = render_file(scene_overlays, tmp_path / "walk.mp4", replace(options, fps=5.0))
    metadata, rate, frames = decoded(av, made.path)
    assert made.files == (tmp_path / "walk.mp4",) and rate == 5 and len(frames) == 2
    for k, frame in enumerate(frames):
        picture = np.array(mitsuba_bitmap(tmp_path / f"walk_000{k + 1}.png").convert(rgb.Bitmap.PixelFormat.RGB))
        assert frame.shape == picture.shape and np.abs(frame.astype(int) - picture).mean() < 3
    about = json.loads(metadata["comment"])
    assert about["settings"]["fps"] == 5.0 and set(about["inputs"]) == {
        "scene.xml",
        "walk.csv",
        "field.safetensors",
        "gaze.safetensors",
    }
    assert str(tmp_path) not in str(metadata) and str(scene_overlays.parent) not in str(metadata)


def test_a_video_of_the_colour(rgb, scene_overlays, tmp_path):
    av = pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[video]")')
    options = PictureOptions(frames=scene_overlays.with_name("walk.csv"), mode=MODE, defaults={"size": "16"})
    with pytest.raises(NergError, match="18 x 15 pixels, and a video that plays everywhere needs even sides"):
        render_file(scene_overlays, tmp_path / "odd.mp4", replace(options, defaults={"size": "15"}))
    assert not list(tmp_path.iterdir())
    _, rate, frames = decoded(av, render_file(scene_overlays, tmp_path / "walk.mp4", options).path)
    assert rate == 25 and [f.shape for f in frames] == [(16, 18, 3)] * 2


def test_each_picture_of_a_sequence_says_its_own_values(rgb, scene_overlays, tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    made = render_file(
        scene_overlays, tmp_path / "walk.png", PictureOptions(frames=scene_overlays.with_name("walk.csv"), mode=MODE)
    )
    eyes = []
    for path in made.files:
        with image.open(path) as found:
            eyes.append(json.loads(found.text["Comment"])["settings"]["defaults"]["eye"])
    assert eyes == ["0.2, 0.1, -2.5", "-1.5, 0.4, -2"]


def test_hatched_where_no_surface_is(rgb, scene_overlays, tmp_path):
    """The picture within the page, against the opacity that the scene itself renders."""
    made = render_file(scene_overlays, tmp_path / "a.png", PictureOptions(overlay="gaze", top=1.0, mode=MODE))
    plain = render_file(
        scene_overlays, tmp_path / "b.png", PictureOptions(overlay="gaze", top=1.0, hatching=False, mode=MODE)
    )
    loaded = load_scene(scene_overlays)
    mask = render_asked(scene_overlays, loaded, loaded.sensors()[0], ["gaze", "opacity"]).mask
    assert 0 < mask.sum() < mask.size
    a, b = (np.array(mitsuba_bitmap(m.path)).astype(int)[..., :3] for m in (made, plain))
    # Each pixel is a square of 9 x 9; the scale and its legend lie to the right of the picture.
    differ = np.any(a != b, axis=-1)[:, : 10 + 9 * 18]
    rows, columns = np.nonzero(differ)
    shown = differ[rows.min() :, 10:]
    found = np.zeros(mask.shape, bool)
    first = int(np.flatnonzero((~mask).any(axis=1))[0])
    for y in range(first, mask.shape[0]):
        for x in range(mask.shape[1]):
            found[y, x] = shown[9 * (y - first) : 9 * (y - first) + 9, 9 * x : 9 * x + 9].mean() > 0.5
    np.testing.assert_array_equal(found, ~mask)


def test_ctrl_c_leaves_whole_pictures(rgb, scene_overlays, tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            if share > 0.5:
                raise KeyboardInterrupt

    frames = scene_overlays.with_name("walk.csv")
    for overlay, left in ((None, ["walk_0001.png"]), ("gaze", [])):
        out = tmp_path / str(overlay) / "walk.png"
        with pytest.raises(KeyboardInterrupt):
            render_file(scene_overlays, out, PictureOptions(overlay=overlay, frames=frames, mode=MODE), Impatient())
        assert [p.name for p in tmp_path.glob(f"{overlay}/*")] == left


@pytest.mark.parametrize(
    "output, options, said",
    [
        ("a.exr", {"overlay": "gaze"}, r"let its name end in .png"),
        ("a.svg", {}, '"[^"]*a.svg" holds an overlay; give --overlay'),
        ("a.mp4", {}, "--frames"),
        ("a.png", {"fps": 10.0}, "--fps is of a video"),
        ("a.png", {"cmap": "viridis"}, "--cmap"),
        ("a.png", {"hatching": False}, "--no-hatching"),
        ("a.png", {"overlay": "gaze", "cmap": "jet"}, '"jet" is no perceptually uniform'),
        ("a.png", {"overlay": "gaze", "decades": 99.0}, "--decades must lie in"),
        ("a.png", {"overlay": "gase"}, 'no overlay "gase"'),
        ("a.png", {"top": 1.0}, "--top.*--overlay"),
        ("a.png", {"overlay": "gaze", "top": -1.0}, "--top must lie in"),
        ("a.png", {"overlay": "kde"}, '"kde", which needs'),
        ("a.png", {"overlay": "gaze", "memory": 1e-5}, "drawn in one piece"),
        ("a.png", {"overlay": "gaze", "defaults": {"eye": "0, 0, 1e6"}}, "is 0 wherever a surface is seen"),
    ],
)
def test_what_is_refused(rgb, scene_overlays, tmp_path, output, options, said):
    with pytest.raises(NergError, match=said):
        render_file(scene_overlays, tmp_path / output, PictureOptions(mode=MODE, **options))
    assert not list(tmp_path.iterdir())


# ---- A scene file rendered by a job: the result, and what is told meanwhile ----


@pytest.fixture
def scene_pictures(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def test_the_result_is_what_was_written(scene_pictures, tmp_path):
    told = Recorder()
    options = PicturesPictureOptions(defaults={"level": "0.5"}, sensor=0, spp=2, mode="llvm_ad_rgb")
    result = render_file(scene_pictures, tmp_path / "new" / "a.exr", options, told)
    bitmap = mitsuba_bitmap(result.path)
    assert tuple(bitmap.size()) == result.size == (16, 8) and bitmap.channel_count() == result.channels
    assert result.mode == "llvm_ad_rgb" and result.whole is None
    assert told.steps[-1][0] == 1 and "samples/s" in told.steps[-1][1]
    (line,) = told.messages
    assert line.startswith(f"Wrote {result.path} (16 x 8, {result.channels} channels, llvm_ad_rgb")


def test_a_reporter_may_end_it(scene_pictures, tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_file(scene_pictures, tmp_path / "a.exr", PicturesPictureOptions(mode="llvm_ad_rgb"), Impatient())
    assert [p.name for p in tmp_path.iterdir()] == ["scene.xml"]


def test_a_sensor_that_is_not_there(scene_pictures, tmp_path):
    with pytest.raises(NergError, match="has 2 sensor"):
        render_file(scene_pictures, tmp_path / "a.exr", PicturesPictureOptions(sensor=2, mode="llvm_ad_rgb"))


@pytest.mark.slow
def test_the_header_says_what_the_gaze_rests_on(tmp_path):
    small = {"width": "12", "height": "8"}
    options = PicturesPictureOptions(defaults=small, spp=1, mode="llvm_ad_rgb")
    text = read_exr_text(render_file(store_scene(), tmp_path / "a.exr", options).path)
    assert text["gaze.basis"].startswith("made of ") and text["gaze.basis"].endswith(" people")
    assert "nerg render" in text["Comment"] and "kde.basis" not in text


@pytest.mark.nightly
@pytest.mark.slow
def test_long_renders_are_prepared_and_the_same_to_the_byte(tmp_path, monkeypatch):
    options = PicturesPictureOptions(defaults={"width": "24", "height": "16"}, spp=2, mode="llvm_ad_rgb")
    render_file(store_scene(), tmp_path / "a.png", options)
    prepared = []
    monkeypatch.setattr(aovs, "SAMPLES", 24 * 16 * 2)
    monkeypatch.setattr(
        render, "prepare_for", lambda samples, scene: prepared.append(prepare_for(samples, scene)) or prepared[-1]
    )
    render_file(store_scene(), tmp_path / "b.png", options)
    assert prepared == [True]
    assert mitsuba_bitmap(tmp_path / "a.png") == mitsuba_bitmap(tmp_path / "b.png")
