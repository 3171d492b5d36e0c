"""Figures of files and scenes, and floor plans; each kind is drawn and written."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import fields

import numpy as np
import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.figures.overlay import (
    Heat,
    Style,
    find_channel_overlay,
    find_overlay,
    overlay,
    robust_max,
    srgb,
    write_png,
)
from nerg_mi.figures.style import apply_colormap
from nerg_mi.files.images import write_exr
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.ranges import RANGE
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import render_aovs
from nerg_mi.transport.geometry import pixel_directions
from nerg_mi.workflows import draw_scenes as scenes
from nerg_mi.workflows.draw import draw, find_kind, read_baked, read_stored, shared_note
from nerg_mi.workflows.draw_scenes import cut_scene, make_film, open_scene, upright_pose
from nerg_mi.workflows.scene_commands import KINDS, ScaleOptions, SceneFigureOptions, SphereOptions
from tests.pictures import SCENE
from tests.surfaces.meshes import wall
from tests.workflows.recorder import Recorder
from tests.workflows.watched import MODE, write_scene

# ---- Quantities in EXR files ----


RNG = np.random.default_rng(0)
COLOR, GAZE = RNG.random((6, 8, 3)).astype(np.float32), RNG.random((6, 8)).astype(np.float32)
OPACITY = np.where(np.arange(8) < 3, 0.2, 0.9).astype(np.float32) * np.ones((6, 1), np.float32)


def write(path, text=None, **channels):
    write_exr(path, {name: COLOR[..., k] for k, name in enumerate("RGB")} | {"gaze.Y": GAZE} | channels, text)
    return path


def test_colour_values_and_mask(tmp_path):
    stored = read_stored(write(tmp_path / "a.exr", **{"opacity.Y": OPACITY}), find_channel_overlay("gaze"))
    np.testing.assert_array_equal(stored.color, COLOR)
    np.testing.assert_array_equal(stored.values, GAZE)
    np.testing.assert_array_equal(stored.mask, np.tile(np.arange(8) >= 3, (6, 1)))
    assert read_stored(write(tmp_path / "b.exr"), find_channel_overlay("gaze.Y")).mask.all()


def test_the_basis_of_the_gaze_is_read(tmp_path):
    text = {"gaze.basis": "made of 5 rays of 2 participants", "kde.basis": "made of 3 rays of 1 participant"}
    path = write(tmp_path / "a.exr", text, **{"kde.Y": GAZE, "depth.T": GAZE})
    bases = [read_stored(path, find_channel_overlay(channel)).support_note for channel in ("gaze", "kde.Y", "depth")]
    assert (
        bases == [*text.values(), ""]
        and read_stored(write(tmp_path / "b.exr"), find_channel_overlay("gaze")).support_note == ""
    )
    assert shared_note("ab", bases[:1] * 2) == bases[0]
    assert shared_note("ab", ["x", ""]) == "a: x; b: unknown"


def test_unusable_exr_files_are_refused(tmp_path):
    with pytest.raises(NergError, match="it has R, G, B, gaze.Y"):
        read_stored(write(tmp_path / "a.exr"), find_channel_overlay("depth"))
    with pytest.raises(NergError, match="has no AOVs"):
        read_stored(tmp_path / "a.png", find_channel_overlay("gaze"))


# ---- Differences of two files ----


def test_the_second_image_is_subtracted_from_the_first(tmp_path):
    other = GAZE[::-1].copy()
    a = write(tmp_path / "a.exr", **{"opacity.Y": OPACITY})
    b = write(tmp_path / "b.exr", **{"opacity.Y": OPACITY, "gaze.Y": other})
    figure = draw("difference", [a, b], vmax=0.5)
    shown = figure.axes[0].images[0].get_array()
    mask = OPACITY > 0.5
    wanted = apply_colormap("RdBu_r", np.clip(0.5 + (GAZE - other), 0, 1), kind="diverging")
    np.testing.assert_allclose(shown[mask], wanted[mask], atol=1e-6)
    assert np.ptp(shown[~mask], axis=-1).max() < 1e-9 and figure.axes[0].get_title() == "a minus b"


def test_differences_that_cannot_be_drawn_are_refused(tmp_path):
    a = write(tmp_path / "a.exr")
    write_exr(tmp_path / "b.exr", {"gaze.Y": np.ones((3, 4), np.float32)})
    for files, options, said in (
        ([a], {}, "a difference needs two images, got"),
        ([a, tmp_path / "b.exr"], {}, "8 x 6 and 4 x 3 pixels cannot be compared"),
        ([a, a], {"cmap": "viridis"}, "not a diverging colour map"),
        ([a, a], {"vmax": -1.0}, "vmax must lie in"),
        ([a, a, a], {}, "takes 1 to 2 files, got 3"),
    ):
        with pytest.raises(NergError, match=said):
            draw("difference", files, **options)


# ---- Contact sheets of files ----


def test_all_images_share_one_scale(tmp_path):
    bright = np.where(OPACITY > 0.5, 3 * GAZE, 100)
    files = [
        write(tmp_path / "first.exr", **{"opacity.Y": OPACITY}),
        write(tmp_path / "second.exr", **{"opacity.Y": OPACITY, "gaze.Y": bright.astype(np.float32)}),
    ]
    figure = draw("sheet", files, overlay="gaze")
    assert [a.get_title() for a in figure.axes[:2]] == ["first", "second"]
    bar = figure.axes[-1 if figure.axes[-1].get_ylabel() else -2]
    bar = next(a for a in figure.axes if a.get_ylabel())
    top = robust_max(bright, OPACITY > 0.5)
    said = [float(t.get_text()) for t in bar.get_yticklabels()]
    np.testing.assert_allclose(bar.get_yticks(), np.array(said) / top, atol=1e-6)
    assert "no data" in [t.get_text() for a in figure.axes for t in a.texts]


def test_images_are_shown_unchanged(rgb, tmp_path):
    write_png(tmp_path / "a.png", COLOR)
    write(tmp_path / "b.exr")
    figure = draw("sheet", [tmp_path / "a.png", tmp_path / "b.exr"], tmp_path / "out.png", columns=2)
    a, b = (axes.images[0].get_array() for axes in figure.axes)
    np.testing.assert_allclose(a, COLOR, atol=0.51 / 255)
    np.testing.assert_allclose(b, srgb(COLOR))
    assert (tmp_path / "out.png").is_file()


def test_a_sheet_without_values_needs_a_scale(tmp_path):
    dark = write(tmp_path / "a.exr", **{"gaze.Y": 0 * GAZE})
    with pytest.raises(NergError, match='"gaze" is 0'):
        draw("sheet", dark, overlay="gaze")
    assert draw("sheet", dark, overlay="gaze", vmax=1.0).axes


def test_the_basis_of_the_gaze_is_printed_below_the_images(tmp_path):
    texts = [{"gaze.basis": f"made of {n} rays of 2 participants"} for n in (5, 6)]
    a, b = (write(tmp_path / f"{name}.exr", text) for name, text in zip("ab", texts))
    said = lambda *files: {t.get_text().replace("\n", " ") for t in draw("sheet", list(files), overlay="gaze").texts}
    assert said(a, a) == {texts[0]["gaze.basis"]}
    assert said(a, b) == {f"a: {texts[0]['gaze.basis']}; b: {texts[1]['gaze.basis']}"}
    figure = draw("difference", [a, a])
    assert figure.texts[0].get_text().replace("\n", " ") == texts[0]["gaze.basis"]


# ---- Baked surfaces: visible parts, in the colours of their values ----


SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
ABOVE = {"camera": (0.0, 0.0, 2.0), "target": (0.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0), "fov": 90.0}


def write_surface(path, values, vertices=SQUARE, comments=("value: share of gaze per square metre [1/m²]",), **columns):
    faces = np.concatenate([4 * k + np.array([[0, 1, 2], [0, 2, 3]]) for k in range(len(vertices) // 4)])
    columns = dict(zip("xyz", np.asarray(vertices, np.float32).T)) | columns
    write_columns(path, columns | {"value": np.asarray(values, np.float32)}, faces, comments=comments)
    return path


def picture(figure):
    return np.asarray(figure.axes[0].images[0].get_array())


def bar(figure):
    return next(axes for axes in figure.axes if axes.get_ylabel())


def test_values_are_drawn_at_their_positions(tmp_path):
    """From 2 above, a view of 90 degrees is 4 wide: the square fills the middle half, brighter to the right."""
    path = write_surface(tmp_path / "a.ply", [0, 4, 4, 0])
    figure = draw("surface", path, mode="llvm_ad_rgb", width=80, height=80, vmax=4.0, **ABOVE)
    shown = picture(figure)
    paper = shown[2, 2]
    assert np.allclose(shown[:19], paper) and np.allclose(shown[:, :19], paper) and np.allclose(shown[61:], paper)
    # Values from 0 at the left to 4 at the right, over grey that is lit from the camera and from above.
    x = (np.arange(20, 60) + 0.5) / 20 - 2
    grey = 0.18 + 0.3 * (0.6 * 2 / np.sqrt(4 + x**2 + 0.025**2) + 0.4 * 0)
    wanted = overlay(np.repeat(grey[None, :, None], 3, axis=2), 2 * (x + 1)[None], Heat(4.0))
    # Within one step of the colour map, since single precision can round to a neighbouring colour.
    np.testing.assert_allclose(shown[40, 20:60], wanted[0], atol=0.02)
    assert bar(figure).get_ylabel().replace("\n", " ") == "share of gaze per square metre [1/m²]"


def test_geometry_above_the_cut_is_hidden_and_the_default_view_shows_everything(tmp_path):
    lid = SQUARE + [0, 0, 1]
    path = write_surface(tmp_path / "a.ply", [1] * 4 + [9] * 4, np.concatenate([SQUARE, lid]))
    size = {"width": 60, "height": 60, "vmax": 9.0, "mode": "llvm_ad_rgb"}
    level = {"up": (0.0, 0.0, 1.0)}
    closed, opened = (
        picture(draw("surface", path, **size, **(ABOVE | changes))) for changes in (level, level | {"clip_above": 0.5})
    )
    assert closed[30, 30].sum() > opened[30, 30].sum() + 0.3
    seen = picture(draw("surface", path, **size))
    filled = np.abs(seen - seen[0, 0]).sum(axis=2) > 0.02
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    assert 0 < rows[0] and rows[-1] < 59 and 0 < columns[0] and columns[-1] < 59
    assert max(np.ptp(rows), np.ptp(columns)) > 50, "it fills the picture"


def test_the_header_records_the_inputs(tmp_path):
    comments = ("value: seconds per square metre [s/m²]", 'nerg_mi {"inputs": {"day.npz": "ab", "shop.ply": "cd"}}')
    path = write_surface(tmp_path / "a.ply", [1, 2, 3, 4], comments=comments)
    baked = read_baked(path)
    assert baked.label == "seconds per square metre [s/m²]" and baked.gaze_files == ("day.npz", "shop.ply")
    np.testing.assert_array_equal(baked.values, [1, 2, 3, 4])
    figure = draw("surface", path, width=32, height=32, mode="llvm_ad_rgb")
    assert figure.axes[0].get_title().replace("\n", " ") == "Seconds per square metre"
    assert figure.texts[0].get_text().replace("\n", " ") == "data: day.npz, shop.ply"


def test_surfaces_that_cannot_be_drawn_are_refused(tmp_path):
    good = write_surface(tmp_path / "a.ply", [1, 2, 3, 4])
    columns = dict(zip("xyz", SQUARE.astype(np.float32).T))
    write_columns(tmp_path / "bare.ply", columns, np.array([[0, 1, 2]]))
    (tmp_path / "a.glb").write_bytes(b"x")
    (tmp_path / "odd.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    damaged = write_surface(tmp_path / "damaged.ply", [1, 2, 3, 4], comments=("nerg_mi {",))
    for path, options, said in (
        (tmp_path / "a.glb", {}, "give the .ply"),
        (tmp_path / "none.ply", {}, "there is no file"),
        (tmp_path / "bare.ply", {}, "give a .ply file that"),
        (tmp_path / "odd.ply", {}, "odd.ply"),
        (damaged, {}, "is damaged"),
        (good, {"clip_above": -1.0}, "clip_above"),
        (good, {"camera": (0.0, 0, 2), "target": (0.0, 0, 5)}, "is in the image"),
        (good, {"camera": (0.0, 0, 2), "target": (0.0, 0, 2)}, "from camera to target must not be"),
        (good, {"up": (0.0, 0, 0)}, "up must not be of length 0"),
    ):
        with pytest.raises(NergError, match=said):
            draw("surface", path, mode="llvm_ad_rgb", width=32, height=32, **options)


def test_splats_are_drawn_with_their_gaze(tmp_path):
    write_ply_splats(tmp_path / "splats.ply", wall(0.0, 0.4, 0.05))
    with pytest.raises(NergError, match="holds Gaussian splats"):
        read_baked(tmp_path / "splats.ply")


# ---- Options that kinds of figures share ----


def test_wrong_scale_options_are_refused():
    assert ScaleOptions(cmap="viridis", log_decades=3, hatching=False).style("a") == Style("viridis", 3, False, "a")
    for options, said in (
        ({"vmax": 0.0}, "vmax must lie in"),
        ({"log_decades": -1}, "log_decades"),
        ({"cmap": "jet"}, '"jet" is no'),
    ):
        with pytest.raises(NergError, match=said):
            ScaleOptions(**options).style()


def test_a_scale_is_needed():
    find_overlay("visibility").check_limits(None)
    find_overlay("gaze").check_limits((0, 1))
    with pytest.raises(NergError, match="on all visible surfaces; move the camera or the"):
        find_overlay("gaze").check_limits(None)


# ---- Scenes opened for figures: level poses, films, and what is refused ----


def camera(mi, origin, target, up):
    return mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().look_at(origin, target, up)})


@pytest.mark.parametrize(
    "target, up, level, heading",
    [
        ((4, 6, 0.5), (0, 0, 1), (0, 0, 1), (0.6, 0.8, 0)),  # looks down a little, z up
        ((1, 2.5, -9), (0, 1, 0), (0, 1, 0), (0, 0, -1)),  # y up
        ((1, 9, 3), (0, 0, -1), (0, 0, -1), (0, 1, 0)),  # upside down
    ],
)
def test_a_level_pose(rgb, target, up, level, heading):
    matrix = np.array(upright_pose(camera(rgb, (1, 2, 3), target, up)).matrix, float)
    np.testing.assert_allclose(matrix[:3, 3], (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 1], level, atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 2], heading, atol=1e-6)


def test_a_camera_looking_straight_down_has_a_heading(rgb):
    matrix = np.array(upright_pose(camera(rgb, (0, 0, 3), (0, 0, 0), (0, 1, 0))).matrix, float)
    assert np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6)


def test_a_film_that_is_too_large_is_refused():
    assert make_film(30, 20)["rfilter"] == {"type": "box"}
    with pytest.raises(NergError, match="4,096.*4,096"):
        make_film(4096, 4096)
    # The widest sphere, which takes a gigabyte to draw, is allowed.
    (width,) = (f.metadata[RANGE].high for f in fields(SphereOptions) if f.name == "width")
    assert make_film(width, width // 2)["width"] == width


def test_another_integrator_is_refused(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    options = SceneFigureOptions(mode="llvm_ad_rgb")
    with (
        pytest.raises(NergError, match='needs the integrator "nerg"'),
        open_scene(tmp_path / "scene.xml", options, Recorder()),
    ):
        pass


# ---- The observer's sphere of a scene file ----


@pytest.fixture(scope="module")
def scene_sphere(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_the_sphere_shows_the_gaze_of_the_observer(rgb, scene_sphere):
    """Compared with rays of the API from the observer's eye, in directions of the panorama that the test rotates."""
    import nerg_mi as nerg

    figure = draw("sphere", scene_sphere, width=64, spp=1, mode=MODE, projection="equirectangular", vmax=0.5)
    assert "integral" in figure.axes[0].get_title().replace("\n", " ")
    assert figure.axes[-1].get_ylabel().replace("\n", " ") == "gaze density [1/sr]"
    shown = figure.axes[0].images[0].get_array()
    assert shown.shape == (32, 64, 3)
    eye = np.array([0.2, 0.1, -2.5])
    # The view is level, towards the middle of the scene, and up is y. The right of a Mitsuba camera is its -x.
    ahead = -eye * (1, 0, 1)
    ahead /= np.linalg.norm(ahead)
    up = np.array([0.0, 1.0, 0.0])
    local = pixel_directions(64, 32)
    world = local[..., :1] * np.cross(up, ahead) + local[..., 1:2] * up + local[..., 2:] * ahead
    seen = nerg.trace(nerg.Scene.load(str(scene_sphere)), eye, world.reshape(-1, 3), ["depth", "opacity", "gaze"])
    hit = (seen.opacity.reshape(32, 64) > 0.9) & (seen.gaze.reshape(32, 64) > 0.3)
    void = seen.opacity.reshape(32, 64) < 0.1
    assert hit.sum() > 20 and void.sum() > 500
    # The paper's pale hatching where no surface is hit, and dark or saturated colours on surfaces.
    grey = np.ptp(shown, axis=-1) < 0.01
    rows = np.rint((np.arange(32) + 0.5) / 32 * 31).astype(int)
    inner = lambda m: m & np.roll(m, 1, 0) & np.roll(m, -1, 0) & np.roll(m, 1, 1) & np.roll(m, -1, 1)
    assert grey[inner(void)[rows]].mean() > 0.95 and grey[inner(hit)[rows]].mean() < 0.2


def test_wrong_options_of_a_scene_figure_are_refused(scene_sphere):
    for options, said in (
        ({"projection": "globe"}, "choose one of mollweide, equirectangular"),
        ({"sensor": 7}, "has 1 sensor"),
        ({"cmap": "jet"}, '"jet" is no'),
        ({"color": 1}, 'has no option "color"'),
    ):
        with pytest.raises(NergError, match=said):
            draw("sphere", scene_sphere, mode=MODE, width=64, **options)


# ---- Occlusion of any scene with an observer ----


@pytest.fixture(scope="module")
def scene_triptych(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_a_triptych_has_one_scale(rgb, scene_triptych, monkeypatch):
    seen = []
    see = scenes.OpenScene.render
    monkeypatch.setattr(scenes.OpenScene, "render", lambda self, *args: seen.append(see(self, *args)) or seen[-1])
    recorder = Recorder()
    behind = {"eye": "0.2, 0.1, 2.5"}
    figure = draw("triptych", scene_triptych, reporter=recorder, mode=MODE, spp=2, defaults=behind)
    # Three pictures, the scale, and the swatch for unknown values.
    assert len(figure.axes) == 5 and [s for s, _ in recorder.steps] == sorted(s for s, _ in recorder.steps)
    observer_view, without, with_ = seen
    # Occlusion only decreases gaze; visible surfaces keep their gaze.
    assert (without.values >= with_.values - 1e-6).all() and (without.values > with_.values + 1e-3).any()
    assert (without.color == with_.color).all() and observer_view.values.shape == with_.values.shape
    # The first picture is that of a camera at the observer, with its own gaze.
    with scenes.open_scene(scene_triptych, SceneFigureOptions(mode=MODE, spp=2, defaults=behind), recorder) as opened:
        plain = opened.render(opened.camera(0), find_overlay("gaze"))
        again = render_aovs(scene_triptych, opened.scene, opened.camera(0), ["gaze", "opacity"], spp=2)
    assert (plain.values == with_.values).all() and (again.aovs["gaze"] == with_.values).all()
    assert observer_view.values.max() > 0


@pytest.mark.parametrize("kind", ["sphere", "triptych"])
def test_figures_of_extrapolated_observers_say_so_once(rgb, scene_triptych, kind):
    for eye, count in (("0.2, 0.1, 0.9", 0), ("0.2, 0.1, 2.5", 1)):
        recorder = Recorder()
        draw(kind, scene_triptych, reporter=recorder, mode=MODE, spp=1, defaults={"eye": eye}, vmax=0.5)
        assert sum("extrapolated" in text for text in recorder.warnings) == count


def test_a_scene_whose_camera_is_the_observer_is_refused(rgb, scene_triptych, tmp_path):
    text = scene_triptych.read_text()
    a, b = text.index("        <sensor name"), text.index('        <string name="aovs"')
    alone = scene_triptych.with_name("alone.xml")
    alone.write_text(text[:a] + text[b:])
    with pytest.raises(NergError, match="has no observer other than its camera, so"):
        draw("triptych", alone, mode=MODE, defaults={})


# ---- Scanpaths: fixations at known points of a scene ----


def test_fixations_are_numbered_where_they_are(rgb, tmp_path):
    view = """<sensor type="perspective"><float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="0, -4, 1" target="0, 0, 1" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="60"/><integer name="height" value="40"/></film></sensor>"""
    (tmp_path / "scene.xml").write_text(WALLS_SCENE.replace("</scene>", f"{view}</scene>"))
    # At the front of the tall box, behind it, and at the floor in front of the camera; from another position.
    eye, targets = np.array([0.5, -2.0, 1.6]), np.array([[1.2, 0.1, 1.0], [1.0, 3.0, 0.0], [-0.8, -1.0, 0.0]])
    eyes = np.stack([eye, [1.0, 2.0, 1.6], eye])
    n = 20
    origin, direction = np.repeat(eyes, n, axis=0), np.repeat(targets - eyes, n, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    t = np.arange(3 * n) / 60 + np.repeat([0, 0.5, 1.0], n)
    Rays(t, np.zeros(3 * n), ("Ada", "Bob"), origin, direction, np.ones(3 * n)).save(tmp_path / "rays.npz")
    options = dict(scene=tmp_path / "scene.xml", mode="llvm_ad_rgb", spp=2)
    recorder = Recorder()
    axes = draw("scanpath", [tmp_path / "rays.npz"], None, recorder, **options).axes[0]
    assert sum("heads" in line for line in recorder.warnings) == 1
    assert [t.get_text() for t in axes.texts][:2] == ["1", "3"]
    offset = targets[[0, 2]] - (0, -4, 1)
    scale = 30 / np.tan(np.radians(30)) / offset[:, 1]
    expected = np.stack([29.5 + offset[:, 0] * scale, 19.5 - offset[:, 2] * scale], axis=1)
    magnification = np.ptp(axes.get_xlim()) / 60
    assert magnification == 1 and np.allclose([t.xy for t in axes.texts[:2]], expected, atol=0.05)
    assert "1 outside of the image or hidden" in " ".join(axes.figure.texts[0].get_text().split())
    for refused, said in ((dict(participants="Eve"), "Eve"), (dict(start=9.0), "start"), (dict(scene=None), "scene")):
        with pytest.raises(NergError, match=said):
            draw("scanpath", tmp_path / "rays.npz", **(options | refused))


# ---- A scene cut at a height: boxes with known walls and heights ----


LOW, HIGH = np.array([-2.0, -1.0]), np.array([2.0, 1.0])
WALLS_SCENE = """<scene version="3.0.0"><integrator type="nerg"/>
<shape type="rectangle"><transform name="to_world"><scale value="5"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.3" y="0.4" z="0.25"/>
  <translate x="-1" y="0" z="0.25"/></transform></shape>
<shape type="cube"><transform name="to_world"><scale x="0.5" y="0.2" z="1"/>
  <translate x="1" y="0.3" z="1"/></transform></shape></scene>"""


def test_boxes_are_cut_at_a_height(rgb, tmp_path):
    (tmp_path / "scene.xml").write_text(WALLS_SCENE)
    scene = rgb.load_file(str(tmp_path / "scene.xml"))
    plan = cut_scene(scene.integrator(), scene, LOW, HIGH, 1.2, 0.0)
    ny, nx = plan.height.shape
    side = (plan.high - plan.low) / (nx, ny)
    assert plan.cut_height == 1.2 and np.allclose(side, side[0])  # noqa: RUF069 (stored)
    x, y = plan.low[0] + (np.arange(nx) + 0.5) * side[0], plan.low[1] + (np.arange(ny) + 0.5) * side[0]
    x, y = np.meshgrid(x, y)
    low_box = (np.abs(x + 1) < 0.3) & (np.abs(y) < 0.4)
    tall_box = (np.abs(x - 1) < 0.5) & (np.abs(y - 0.3) < 0.2)
    np.testing.assert_allclose(plan.height[low_box], 0.5, atol=1e-4)
    np.testing.assert_allclose(plan.height[~low_box & ~tall_box], 0.0, atol=1e-4)
    # The cut follows only the walls of the tall box, one cell wide on each side.
    edge = np.maximum(np.abs(x - 1) - 0.5, np.abs(y - 0.3) - 0.2)
    assert plan.is_cut[np.abs(edge) < 0.4 * side[0]].all() and not plan.is_cut[np.abs(edge) > 1.01 * side[0]].any()


# ---- Floor plans of rays: paths by participant and recording, lines of sight, fields of view ----


def walk(hits=True):
    """Ada walks along x, stops being recorded, and comes back; Bob stands."""
    t = np.r_[np.arange(20) * 0.1, 30 + np.arange(20) * 0.1, np.arange(5) * 0.1]
    x = np.r_[np.arange(20) * 0.05, 1 - np.arange(20) * 0.05, np.full(5, -0.5)]
    y = np.r_[np.zeros(20), np.full(20, 0.4), np.full(5, -0.5)]
    person = np.r_[np.zeros(40, np.int32), np.ones(5, np.int32)]
    direction = np.tile([0.0, 1.0, 0.0], (45, 1))
    origin = np.stack([x, y, np.full(45, 1.6)], axis=1)
    return Rays(t, person, ("Ada", "Bob"), origin, direction, np.ones(45), origin + direction * 0.7 if hits else None)


@pytest.fixture
def rays(tmp_path):
    walk().save(tmp_path / "rays.npz")
    return tmp_path / "rays.npz"


def paths(figure):
    return [line for line in figure.axes[0].lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 1]


def test_paths_break_at_recording_gaps(rays):
    figure = draw("floor", rays)
    assert figure.texts[0].get_text() == "45 rays of 2 participants"
    assert [t.get_text() for t in figure.axes[0].get_legend().get_texts()] == ["Ada", "Bob"]
    ada = paths(figure)[0]
    xy = np.stack([ada.get_xdata(), ada.get_ydata()], axis=1)
    gaps = np.flatnonzero(np.isnan(xy[:, 0]))
    assert len(gaps) == 2 and gaps[0] == 0
    first, second = xy[1 : gaps[1]], xy[gaps[1] + 1 :]
    assert np.all(first[:, 1] == 0) and np.allclose(second[:, 1], 0.4) and len(first) == len(second) == 20


def test_one_participant_and_their_hit_points_are_drawn(rays):
    figure = draw("floor", rays, participants="Bob", num_rays=3, num_views=2)
    lines, wedges = (c for c in figure.axes[0].collections if type(c).__name__ in ("LineCollection", "PatchCollection"))
    if type(lines).__name__ == "PatchCollection":
        lines, wedges = wedges, lines
    segments = np.stack(lines.get_segments())
    np.testing.assert_allclose(segments, np.tile([[-0.5, -0.5], [-0.5, 0.2]], (len(segments), 1, 1)))
    assert len(wedges.get_paths()) == 2


def test_a_floor_plan_is_drawn_over_geometry(rgb, rays, tmp_path):
    (tmp_path / "scene.xml").write_text(WALLS_SCENE)
    figure = draw("floor", rays, tmp_path / "a.svg", scene=str(tmp_path / "scene.xml"), mode="llvm_ad_rgb")
    assert len(figure.axes[0].images) == 1
    text = (tmp_path / "a.svg").read_text()
    assert "scene.xml" in text and "rays.npz" in text and str(tmp_path) not in text


@pytest.mark.parametrize(
    "options, said", [({"participants": "Eve"}, "Eve"), ({"cut_height": 0.0}, "cut_height must be above")]
)
def test_wrong_options_of_a_floor_plan_are_refused(rays, options, said):
    with pytest.raises(NergError, match=said):
        draw("floor", rays, **options)


# ---- Figures are drawn and written with their provenance ----


def test_a_figure_file_records_its_provenance(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    recorder = Recorder()
    a = write(tmp_path / "a.exr")
    figure = draw("sheet", str(a), str(tmp_path / "new" / "b.png"), recorder, overlay="gaze", log_decades=2.0)
    width, height = (round(v) for v in figure.bbox.size)
    assert recorder.messages == [f"Wrote {tmp_path / 'new' / 'b.png'} ({width} x {height})."]
    with image.open(tmp_path / "new" / "b.png") as stored:
        assert stored.size == (width, height)
        metadata = json.loads(stored.text["Comment"])
    assert metadata["what"] == "nerg draw sheet" and metadata["settings"] == {"overlay": "gaze", "log_decades": 2.0}
    assert metadata["inputs"] == {"a.exr": hashlib.sha256(a.read_bytes()).hexdigest()} and metadata["seed"] is None


def test_wrong_files_and_options_of_figures_are_refused(tmp_path):
    a = write(tmp_path / "a.exr")
    with pytest.raises(NergError, match="is not supported: choose a file name that ends"):
        draw("sheet", a, tmp_path / "b.bmp")
    with pytest.raises(MissingFile, match="gone.exr"):
        draw("sheet", tmp_path / "gone.exr")
    with pytest.raises(NergError, match="1.*400.*0"):
        draw("sheet", [])
    with pytest.raises(NergError, match='no figure "pie"'):
        draw("pie", a)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


# ---- The table of kinds ----


@pytest.mark.parametrize("name", KINDS)
def test_each_kind_of_figure_has_a_description(name):
    kind = find_kind(name)
    assert kind.name == name and kind.summary.endswith(".") and kind.max_files >= 1
    assert kind.options() is not None and all(f.metadata["help"] for f in dataclasses.fields(kind.options))


def test_an_unknown_kind_of_figure_is_refused():
    with pytest.raises(NergError, match="choose one of sphere, triptych, scanpath, floor, sheet,"):
        find_kind("pie")
