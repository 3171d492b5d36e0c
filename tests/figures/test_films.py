"""Films of a scene, at once and in parts."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

from nerg_mi.environment import bands, scene_sequence
from nerg_mi.environment.bands import render_aovs
from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.errors import NergError
from nerg_mi.figures.films import Film, make_picture, render_film
from nerg_mi.figures.frames import FrameRenderer, FrameSettings, StoredLayers
from nerg_mi.figures.overlay import robust_max
from nerg_mi.figures.settings import Style
from nerg_mi.files.images import read_exr_attributes
from nerg_mi.tasks.settings import Parallel
from tests.conftest import ROOT
from tests.pictures import SCENE, mitsuba_bitmap
from tests.plugins import fields
from tests.recorder import Recorder
from tests.tasks import works

# ---- Overlays: requests, scales, sequences, and refused input ----


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


@pytest.mark.parametrize("overlay", [None, "gaze"])
@pytest.mark.parametrize("in_parts", [False, True])
def test_extrapolated_observers_of_any_picture_are_reported_once(rgb, scene_overlays, tmp_path, overlay, in_parts):
    frames, recorder = tmp_path / "walk.csv", Recorder()
    frames.write_text('eye\n"0.2, 0.1, -0.5"\n"99, 0.4, -2"\n"98, 0.4, -2"\n')
    store = tmp_path / "parts" if in_parts else None
    film = {"frames": frames, "defaults": {"size": "4"}, "spp": 1, "overlay": overlay}
    result = render_film(scene_overlays, tmp_path / "a.png", **film, parallel=Parallel(store=store), progress=recorder)
    (sentence,) = [text for text in recorder.warnings if "extrapolated" in text]
    assert "picture 2" in sentence and "(99, 0.4, -2)" in sentence and result.observer_note in sentence


def test_an_overlay_adds_its_quantity_to_the_scene(rgb, scene_overlays, tmp_path):
    recorder = Recorder()
    made = render_film(scene_overlays, tmp_path / "a.png", overlay="gaze", smoothing=0, progress=recorder)
    loaded = load_scene(scene_overlays)
    rendered = render_aovs(scene_overlays, loaded, loaded.sensors()[0], ["gaze", "opacity"])
    assert made.vmax == pytest.approx(robust_max(rendered.aovs["gaze"], rendered.mask)) and made.files == (
        tmp_path / "a.png",
    )
    # The picture, pixel for pixel, and the scale next to it.
    width, height = mitsuba_bitmap(made.path).size()
    assert width > 18 + 60 and height > 12 and f"scale up to {made.vmax:.4g}" in recorder.messages[0]
    fixed = render_film(scene_overlays, tmp_path / "b.png", overlay="gaze", vmax=9.0)
    assert fixed.vmax == 9.0 and (tmp_path / "b.png").read_bytes() != (tmp_path / "a.png").read_bytes()  # noqa: RUF069 (stored)


@pytest.mark.parametrize("name", ["visibility", "depth", "emit"])
def test_other_overlays_are_rendered(rgb, scene_overlays, tmp_path, name):
    made = render_film(scene_overlays, tmp_path / "a.png", overlay=name)
    assert made.path.stat().st_size > 500 and (made.vmax is None) == (name == "visibility")


def test_a_sequence_shares_one_scale(rgb, scene_overlays, tmp_path):
    options = dict(overlay="gaze", frames=scene_overlays.with_name("walk.csv"))
    both = render_film(scene_overlays, tmp_path / "walk.png", **options)
    tops = []
    for k, eye in enumerate(("0.2, 0.1, -2.5", "-1.5, 0.4, -2")):
        one = dict(overlay="gaze", defaults={"eye": eye})
        tops.append(render_film(scene_overlays, tmp_path / f"one{k}.png", **one).vmax)
    assert tops[0] != tops[1] and both.vmax == max(tops)
    assert [p.name for p in both.files] == ["walk_0001.png", "walk_0002.png"]
    # The image that sets the scale equals its single rendering; the other one does not.
    alone = [(tmp_path / f"one{k}.png").read_bytes() == p.read_bytes() for k, p in enumerate(both.files)]
    assert alone == [t == both.vmax for t in tops]


def test_a_sequence_without_an_overlay(rgb, scene_overlays, tmp_path):
    recorder = Recorder()
    options = dict(frames=scene_overlays.with_name("walk.csv"))
    made = render_film(scene_overlays, tmp_path / "walk.exr", **options, progress=recorder)
    for file, eye in zip(made.files, ("0.2, 0.1, -2.5", "-1.5, 0.4, -2")):
        alone = render_film(scene_overlays, tmp_path / "one.exr", defaults={"eye": eye})
        np.testing.assert_array_equal(mitsuba_bitmap(file), mitsuba_bitmap(alone.path))
    shares = [share for share, _ in recorder.steps]
    assert shares == sorted(shares) and shares[-1] == 1 and "2 images" in recorder.messages[0]


def decoded(av, path):
    with av.open(str(path)) as container:
        frames = [f.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray() for f in container.decode(video=0)]
        return container.metadata, float(container.streams.video[0].average_rate), frames


@pytest.mark.parametrize("top", [None, 3.0])
def test_a_video_contains_the_images_of_the_sequence(rgb, scene_overlays, tmp_path, top, monkeypatch):
    av = pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[video]")')
    written = []
    store = StoredLayers.store
    monkeypatch.setattr(StoredLayers, "store", lambda path, layers: written.append(path) or store(path, layers))
    options = dict(overlay="gaze", frames=scene_overlays.with_name("walk.csv"), vmax=top)
    render_film(scene_overlays, tmp_path / "walk.png", **options)
    # With an explicit scale, no picture waits for the others.
    assert len(written) == (0 if top else 2)
    made = render_film(scene_overlays, tmp_path / "walk.mp4", **options, fps=5.0)
    metadata, rate, frames = decoded(av, made.path)
    assert made.files == (tmp_path / "walk.mp4",) and rate == 5 and len(frames) == 2
    for k, frame in enumerate(frames):
        picture = np.array(mitsuba_bitmap(tmp_path / f"walk_000{k + 1}.png").convert(rgb.Bitmap.PixelFormat.RGB))
        assert frame.shape == picture.shape and np.abs(frame.astype(int) - picture).mean() < 3
    comment = json.loads(metadata["comment"])
    assert comment["settings"]["fps"] == 5.0 and set(comment["inputs"]) == {  # noqa: RUF069 (stored)
        "scene.xml",
        "walk.csv",
        "field.safetensors",
        "gaze.safetensors",
    }
    assert str(tmp_path) not in str(metadata) and str(scene_overlays.parent) not in str(metadata)


def test_a_video_without_an_overlay(rgb, scene_overlays, tmp_path):
    av = pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[video]")')
    options = dict(frames=scene_overlays.with_name("walk.csv"), defaults={"size": "16"})
    with pytest.raises(NergError, match="pixels, but widely supported videos need even"):
        render_film(scene_overlays, tmp_path / "odd.mp4", **{**options, "defaults": {"size": "15"}})
    assert not list(tmp_path.iterdir())
    _, rate, frames = decoded(av, render_film(scene_overlays, tmp_path / "walk.mp4", **options).path)
    assert rate == 25 and [f.shape for f in frames] == [(16, 18, 3)] * 2


def test_each_image_of_a_sequence_records_its_parameters(rgb, scene_overlays, tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    made = render_film(scene_overlays, tmp_path / "walk.png", frames=scene_overlays.with_name("walk.csv"))
    positions = []
    for path in made.files:
        with image.open(path) as stored:
            positions.append(json.loads(stored.text["Comment"])["settings"]["defaults"]["eye"])
    assert positions == ["0.2, 0.1, -2.5", "-1.5, 0.4, -2"]


def test_pixels_without_a_surface_are_hatched(rgb, scene_overlays, tmp_path):
    """The picture within the page, against the opacity that the scene itself renders."""
    made = render_film(scene_overlays, tmp_path / "a.png", overlay="gaze", vmax=1.0)
    plain = render_film(scene_overlays, tmp_path / "b.png", overlay="gaze", vmax=1.0, style=Style(hatching=False))
    loaded = load_scene(scene_overlays)
    mask = render_aovs(scene_overlays, loaded, loaded.sensors()[0], ["gaze", "opacity"]).mask
    assert 0 < mask.sum() < mask.size
    a, b = (np.array(mitsuba_bitmap(m.path)).astype(int)[..., :3] for m in (made, plain))
    # Each pixel is a square of 9 x 9; the scale and its legend lie to the right of the picture.
    differ = np.any(a != b, axis=-1)[:, : 10 + 9 * 18]
    rows, columns = np.nonzero(differ)
    shown = differ[rows.min() :, 10:]
    hatched = np.zeros(mask.shape, bool)
    first = int(np.flatnonzero((~mask).any(axis=1))[0])
    for y in range(first, mask.shape[0]):
        for x in range(mask.shape[1]):
            hatched[y, x] = shown[9 * (y - first) : 9 * (y - first) + 9, 9 * x : 9 * x + 9].mean() > 0.5
    np.testing.assert_array_equal(hatched, ~mask)


def test_ctrl_c_leaves_complete_images(rgb, scene_overlays, tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            if share > 0.5:
                raise KeyboardInterrupt

    frames = scene_overlays.with_name("walk.csv")
    for overlay, left in ((None, ["walk_0001.png"]), ("gaze", [])):
        out = tmp_path / str(overlay) / "walk.png"
        with pytest.raises(KeyboardInterrupt):
            render_film(scene_overlays, out, overlay=overlay, frames=frames, progress=Impatient())
        assert [p.name for p in tmp_path.glob(f"{overlay}/*")] == left


@pytest.mark.parametrize(
    "output, options, said",
    [
        ("a.exr", {"overlay": "gaze"}, r"an .exr file holds the AOV itself, if it is in"),
        ("a.svg", {}, "can only hold an overlay; add overlay, or use"),
        ("a.mp4", {}, "frames"),
        ("a.png", {"fps": 10.0}, "is not one; use a name that ends in .mp"),
        ("a.png", {"style": Style(cmap="viridis")}, "cmap"),
        ("a.png", {"style": Style(hatching=False)}, "hatching=False"),
        ("a.png", {"overlay": "gaze", "style": Style(cmap="jet")}, "is not a perceptually uniform colour map;"),
        ("a.png", {"overlay": "gase"}, "choose one of depth, opacity, position.X,"),
        ("a.png", {"vmax": 1.0}, "vmax applies to overlays only; add overlay"),
        ("a.png", {"overlay": "gaze", "vmax": -1.0}, "vmax must lie in"),
        ("a.png", {"overlay": "kde"}, '"kde", which needs'),
        ("a.png", {"spp": 1 << 31}, "spp must lie in 0 .. 16777216"),
        ("a.png", {"overlay": "gaze", "memory": 1e-5}, "GB; increase memory to"),
        (
            "a.png",
            {"overlay": "gaze", "defaults": {"eye": "0, 0, 1e6"}},
            "on all visible surfaces; move the camera or the",
        ),
    ],
)
def test_wrong_options_are_refused(rgb, scene_overlays, tmp_path, output, options, said):
    with pytest.raises(NergError, match=said):
        render_film(scene_overlays, tmp_path / output, **options)
    assert not list(tmp_path.iterdir())


# ---- A scene file rendered by a job: the result, and its messages ----


@pytest.fixture
def scene_pictures(tmp_path, rgb):
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def test_the_result_matches_the_written_file(scene_pictures, tmp_path):
    recorder = Recorder()
    options = dict(defaults={"level": "0.5"}, sensor=0, spp=2)
    result = render_film(scene_pictures, tmp_path / "new" / "a.exr", **options, progress=recorder)
    bitmap = mitsuba_bitmap(result.path)
    assert tuple(bitmap.size()) == result.size == (16, 8) and bitmap.channel_count() == result.channels
    assert result.mode == "llvm_ad_rgb" and result.undivided_reason is None
    assert recorder.steps[-1][0] == 1 and recorder.steps[-1][1] == "writing"
    assert all("samples/s" in text for share, text in recorder.steps if 0 < share < 1)
    (line,) = recorder.messages
    assert line.startswith(f"Wrote {result.path} (16 x 8, {result.channels} channels, llvm_ad_rgb")


def test_a_reporter_can_stop_the_rendering(scene_pictures, tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_film(scene_pictures, tmp_path / "a.exr", progress=Impatient())
    assert [p.name for p in tmp_path.iterdir()] == ["scene.xml"]


def test_an_unknown_sensor_is_refused(scene_pictures, tmp_path):
    with pytest.raises(NergError, match="has 2 sensor"):
        render_film(scene_pictures, tmp_path / "a.exr", sensor=2)


@pytest.mark.parametrize("frames", [None, [{}, {}]])
def test_overlays_of_other_integrators_are_refused(scene_pictures, tmp_path, frames):
    path = '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/><shape type="sphere"/></scene>'
    scene_pictures.write_text(path)
    with pytest.raises(NergError, match='needs the integrator "nerg"'):
        render_film(scene_pictures, tmp_path / "a.png", overlay="gaze", frames=frames)
    assert list(tmp_path.iterdir()) == [scene_pictures]


@pytest.mark.slow
def test_the_header_records_the_basis_of_the_gaze(rgb, tmp_path):
    small = {"width": "12", "height": "8"}
    options = dict(defaults=small, spp=1)
    text = read_exr_attributes(render_film(SCENE_FILE, tmp_path / "a.exr", **options).path)
    assert text["gaze.basis"].startswith("data: ") and text["gaze.basis"].endswith(" participants")
    assert "nerg render" in text["Comment"] and "kde.basis" not in text


@pytest.mark.nightly
@pytest.mark.slow
def test_images_with_constant_weights_are_byte_identical(rgb, tmp_path, monkeypatch):
    (tmp_path / "frames.csv").write_text("width\n" + "24\n" * 13)
    options = dict(frames=tmp_path / "frames.csv", defaults={"height": "16"}, spp=1)
    monkeypatch.setattr(bands, "LONG_RENDER_SAMPLES", 24 * 16)
    prepared, prepare = [], bands.ConstantWeightsTrial.prepare
    record = lambda trial, *args: prepared.append(prepare(trial, *args)) or prepared[-1]
    monkeypatch.setattr(bands.ConstantWeightsTrial, "prepare", record)
    files = render_film(SCENE_FILE, tmp_path / "a.png", **options).files
    assert prepared[:6] == [False] * 3 + [True] * 3 and len(files) == len(prepared) == 13
    assert len({np.array(mitsuba_bitmap(path)).tobytes() for path in files}) == 1


# ---- Films in parts: equal bytes for any worker, without repeated work ----


AOV = 'type="aov"><string name="aovs" value="dd:depth"/>'
BALL = SCENE.replace(AOV, 'type="nerg">').replace('value="8"', 'value="16"')


@pytest.fixture
def scene(tmp_path, rgb):
    (tmp_path / "scene.xml").write_text(BALL)
    (tmp_path / "frames.csv").write_text("level\n0.25\n0.5\n0.75\n")
    return tmp_path / "scene.xml"


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def film_of(scene, folder, name, reporter=None, store=None, scheduler=None, **options) -> Film:
    options = {"frames": scene.parent / "frames.csv", "seed": 3, **options}
    parallel = Parallel(store=store, scheduler=scheduler)
    return render_film(
        scene, scene.parent / folder / name, **options, parallel=parallel, progress=reporter or Recorder()
    )


@pytest.mark.parametrize(
    "name, overlay",
    [
        ("a.png", {}),
        ("a.exr", {}),
        ("a.png", {"overlay": "depth"}),
        ("a.svg", {"overlay": "depth", "vmax": 4.0}),
        ("a.mp4", {}),
        ("a.mp4", {"overlay": "depth"}),
    ],
)
def test_a_film_in_parts_is_byte_identical(scene, name, overlay):
    if name.endswith("mp4"):
        pytest.importorskip("av")
    expected = film_of(scene, "whole", name, **overlay)
    parts = film_of(scene, "parts", name, store=scene.parent / "store", **overlay)
    part_files = files(scene.parent / "parts")
    assert part_files == files(scene.parent / "whole") and part_files
    assert (parts.size, parts.vmax, len(parts.files)) == (expected.size, expected.vmax, len(expected.files))


def test_stored_images_are_not_rendered_again(scene, monkeypatch):
    store, rendered = scene.parent / "store", []
    render = FrameRenderer.render
    monkeypatch.setattr(FrameRenderer, "render", lambda *args: rendered.append(args) or render(*args))
    film_of(scene, "one", "a.png", store=store)
    recorder = Recorder()
    film_of(scene, "two", "a.png", recorder, store=store)
    assert len(rendered) == 3 and files(scene.parent / "one") == files(scene.parent / "two")
    assert recorder.steps[-1] == (1.0, "3 of 3 parts") and "parts are stored in" in recorder.messages[-2]
    # If the values of one picture change, only it is rendered again; the video takes all others from the store.
    (scene.parent / "frames.csv").write_text("level\n0.25\n0.6\n0.75\n")
    film_of(scene, "three", "a.png", store=store)
    assert len(rendered) == 4
    # If the scene changes, all pictures are rendered again.
    scene.write_text(BALL.replace("0.3", "0.31"))
    film_of(scene, "four", "a.png", store=store)
    assert len(rendered) == 7 and files(scene.parent / "four") != files(scene.parent / "three")


@pytest.mark.parametrize("overlay", [None, "gaze"])
def test_parts_read_their_scene_once(rgb, scene_overlays, tmp_path, monkeypatch, overlay):
    """In any order, while only cameras and observers move; and again in the next job, since a file may change."""
    read, scene = [], shutil.copytree(scene_overlays.parent, tmp_path / "scene") / "scene.xml"
    monkeypatch.setattr(scene_sequence, "load_scene", lambda *args, **more: read.append(1) or load_scene(*args, **more))
    eyes = [{"eye": f"{x}, 0.1, -2.5"} for x in (0.2, -1.5, -0.6, 0.9)]
    options = {"spp": 1, "overlay": overlay, "vmax": None if overlay is None else 0.3}

    def render(frames, name):
        parallel = Parallel(store=tmp_path / f"{name}.tasks")
        render_film(scene, tmp_path / name / "a.png", frames=frames, parallel=parallel, **options)
        return [path.read_bytes() for path in sorted((tmp_path / name).glob("*.png"))]

    first = render(eyes, "first")
    assert len(read) == 1
    assert render(eyes[::-1], "second") == first[::-1] and len(set(first)) == 4
    assert len(read) == 2
    scene.write_text(OVERLAYS_SCENE.replace('value="40"', 'value="30"'))
    assert not set(render(eyes, "third")) & set(first)
    assert len(read) == 3
    whole = render_film(scene, tmp_path / "whole" / "a.png", frames=eyes, **options).files
    assert [path.read_bytes() for path in whole] == render(eyes, "third")


def test_ctrl_c_reports_how_to_resume(scene):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            super().progress(share, text)
            if text.startswith("1 of 3 parts"):
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"Interrupted; finished parts are stored in"):
        film_of(scene, "out", "a.png", Impatient(), scheduler="local")
    recorder = Recorder()
    film_of(scene, "out", "a.png", recorder, scheduler="local")
    assert ("1 of 3 parts" in text for _, text in recorder.steps) and recorder.steps[1][1] == "1 of 3 parts"


def test_scene_files_are_identified_by_content(scene, tmp_path):
    """A picture's name does not depend on folders: a moved project finds its parts."""
    (tmp_path / "moved").mkdir()
    os.rename(scene, tmp_path / "moved" / "scene.xml")
    os.rename(tmp_path / "frames.csv", tmp_path / "moved" / "frames.csv")
    moved, store = tmp_path / "moved" / "scene.xml", tmp_path / "store"
    first = film_of(moved, "out", "a.png", store=store)
    os.rename(tmp_path / "moved", tmp_path / "again")
    recorder = Recorder()
    second = film_of(tmp_path / "again" / "scene.xml", "out", "a.png", recorder, store=store)
    assert (0.0, "3 of 3 parts") in recorder.steps or (1.0, "3 of 3 parts") in recorder.steps
    assert first.files[0].name == second.files[0].name


def test_a_single_image_loads_no_engine(scene, tmp_path):
    """Without parts, neither the engine nor dask is loaded."""
    code = (
        f"import sys, nerg_mi\nnerg_mi.render_film({str(scene)!r}, {str(tmp_path / 'a.png')!r})\n"
        "print([m for m in sys.modules if m.startswith(('nerg_mi.tasks.engines', 'distributed', 'dask'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "[]", done.stderr


def test_contradictory_options_are_refused_before_rendering(scene, tmp_path):
    with pytest.raises(NergError, match="use local, local:N for N processes, tcp"):
        film_of(scene, "out", "a.png", scheduler="nowhere")
    with pytest.raises(NergError, match=r"is not supported: choose a file name"):
        film_of(scene, "out", "a.jpg", store=tmp_path / "store")
    assert not (tmp_path / "store").exists() and not (tmp_path / "out").exists()


def test_a_scene_that_reads_an_unplanned_file_is_refused(tmp_path):
    """As on a worker where an absolute path refers to another file."""
    (tmp_path / "more.xml").write_text('<scene version="3.0.0"/>')
    scene = tmp_path / "scene.xml"
    scene.write_text(f'<scene version="3.0.0"><include filename="{tmp_path / "more.xml"}"/></scene>')
    planned = PlannedFiles.plan(scene)
    assert planned.checked_path() == scene and len(planned.files.members) == 2
    copied = works.lay_out(planned, tmp_path / "worker")
    with pytest.raises(NergError, match="is not the file that the job was planned with"):
        make_picture(FrameSettings("llvm_ad_rgb"), copied, tmp_path / "a.png")
    scene.write_text('<scene version="3.0.0"><include filename="more.xml"/></scene>')
    copied = works.lay_out(PlannedFiles.plan(scene), tmp_path / "relative")
    shutil.move(tmp_path / "more.xml", tmp_path / "gone.xml")
    assert copied.checked_path().read_text() == scene.read_text() and copied.checked_path() != scene
