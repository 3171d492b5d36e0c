"""Tests of `nerg_mi.workflows.draw`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, find_stored, overlay, srgb, top_of, write_png
from nerg_mi.figures.style import color_values
from nerg_mi.files.images import write_exr
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.workflows.draw import draw, read_baked, read_stored, shared_note
from tests.surfaces.walls import wall

# ---- Quantities in EXR files ----


RNG = np.random.default_rng(0)


COLOR, GAZE = RNG.random((6, 8, 3)).astype(np.float32), RNG.random((6, 8)).astype(np.float32)


OPACITY = np.where(np.arange(8) < 3, 0.2, 0.9).astype(np.float32) * np.ones((6, 1), np.float32)


def write(path, text=None, **more):
    write_exr(path, {name: COLOR[..., k] for k, name in enumerate("RGB")} | {"gaze.Y": GAZE} | more, text)
    return path


def test_colour_values_and_mask(tmp_path):
    found = read_stored(write(tmp_path / "a.exr", **{"opacity.Y": OPACITY}), find_stored("gaze"))
    np.testing.assert_array_equal(found.color, COLOR)
    np.testing.assert_array_equal(found.values, GAZE)
    np.testing.assert_array_equal(found.mask, np.tile(np.arange(8) >= 3, (6, 1)))
    assert read_stored(write(tmp_path / "b.exr"), find_stored("gaze.Y")).mask.all()


def test_what_gaze_rests_on(tmp_path):
    text = {"gaze.basis": "made of 5 rays of 2 people", "kde.basis": "made of 3 rays of 1 person"}
    path = write(tmp_path / "a.exr", text, **{"kde.Y": GAZE, "depth.T": GAZE})
    bases = [read_stored(path, find_stored(channel)).basis for channel in ("gaze", "kde.Y", "depth")]
    assert bases == [*text.values(), ""] and read_stored(write(tmp_path / "b.exr"), find_stored("gaze")).basis == ""
    assert shared_note("ab", bases[:1] * 2) == bases[0]
    assert shared_note("ab", ["x", ""]) == "a: x; b: not known"


def test_what_is_refused(tmp_path):
    with pytest.raises(NergError, match='has no "depth"; it has R, G, B, gaze.Y'):
        read_stored(write(tmp_path / "a.exr"), find_stored("depth"))
    with pytest.raises(NergError, match="holds no quantities"):
        read_stored(tmp_path / "a.png", find_stored("gaze"))


# ---- Differences of two files ----


def test_the_first_less_the_second(tmp_path):
    other = GAZE[::-1].copy()
    a = write(tmp_path / "a.exr", **{"opacity.Y": OPACITY})
    b = write(tmp_path / "b.exr", **{"opacity.Y": OPACITY, "gaze.Y": other})
    figure = draw("difference", [a, b], top=0.5)
    shown = figure.axes[0].images[0].get_array()
    mask = OPACITY > 0.5
    wanted = color_values("RdBu_r", np.clip(0.5 + (GAZE - other), 0, 1), kind="diverging")
    np.testing.assert_allclose(shown[mask], wanted[mask], atol=1e-6)
    assert np.ptp(shown[~mask], axis=-1).max() < 1e-9 and figure.axes[0].get_title() == "a less b"


def test_difference_what_is_refused(tmp_path):
    a = write(tmp_path / "a.exr")
    write_exr(tmp_path / "b.exr", {"gaze.Y": np.ones((3, 4), np.float32)})
    for files, given, said in (
        ([a], {}, "two pictures, and 1 were given"),
        ([a, tmp_path / "b.exr"], {}, "8 x 6 and 4 x 3 pixels cannot be compared"),
        ([a, a], {"cmap": "viridis"}, "no diverging colour map"),
        ([a, a], {"top": -1.0}, "--top must lie in"),
        ([a, a, a], {}, "1 to 2 files, and 3 were given"),
    ):
        with pytest.raises(NergError, match=said):
            draw("difference", files, **given)


# ---- Contact sheets of files ----


def test_one_scale_for_all(tmp_path):
    bright = np.where(OPACITY > 0.5, 3 * GAZE, 100)
    files = [
        write(tmp_path / "first.exr", **{"opacity.Y": OPACITY}),
        write(tmp_path / "second.exr", **{"opacity.Y": OPACITY, "gaze.Y": bright.astype(np.float32)}),
    ]
    figure = draw("sheet", files, overlay="gaze")
    assert [a.get_title() for a in figure.axes[:2]] == ["first", "second"]
    bar = figure.axes[-1 if figure.axes[-1].get_ylabel() else -2]
    bar = next(a for a in figure.axes if a.get_ylabel())
    top = top_of(bright, OPACITY > 0.5)
    said = [float(t.get_text()) for t in bar.get_yticklabels()]
    np.testing.assert_allclose(bar.get_yticks(), np.array(said) / top, atol=1e-6)
    assert "no data" in [t.get_text() for a in figure.axes for t in a.texts]


def test_pictures_as_they_are(rgb, tmp_path):
    write_png(tmp_path / "a.png", COLOR)
    write(tmp_path / "b.exr")
    figure = draw("sheet", [tmp_path / "a.png", tmp_path / "b.exr"], tmp_path / "out.png", columns=2)
    a, b = (axes.images[0].get_array() for axes in figure.axes)
    np.testing.assert_allclose(a, COLOR, atol=0.51 / 255)
    np.testing.assert_allclose(b, srgb(COLOR))
    assert (tmp_path / "out.png").is_file()


def test_nothing_to_take_a_scale_from(tmp_path):
    dark = write(tmp_path / "a.exr", **{"gaze.Y": 0 * GAZE})
    with pytest.raises(NergError, match='"gaze" is 0'):
        draw("sheet", dark, overlay="gaze")
    assert draw("sheet", dark, overlay="gaze", top=1.0).axes


def test_what_the_pictures_rest_on_is_said_below(tmp_path):
    texts = [{"gaze.basis": f"made of {n} rays of 2 people"} for n in (5, 6)]
    a, b = (write(tmp_path / f"{name}.exr", text) for name, text in zip("ab", texts))
    said = lambda *files: {t.get_text().replace("\n", " ") for t in draw("sheet", list(files), overlay="gaze").texts}
    assert said(a, a) == {texts[0]["gaze.basis"]}
    assert said(a, b) == {f"a: {texts[0]['gaze.basis']}; b: {texts[1]['gaze.basis']}"}
    figure = draw("difference", [a, a])
    assert figure.texts[0].get_text().replace("\n", " ") == texts[0]["gaze.basis"]


# ---- Baked surfaces: what is seen of them where, in the colours of their values ----


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


def test_values_lie_where_they_are(tmp_path):
    """From 2 above, a view of 90 degrees is 4 wide: the square fills the middle half, brighter to the right."""
    path = write_surface(tmp_path / "a.ply", [0, 4, 4, 0])
    figure = draw("surface", path, mode="llvm_ad_rgb", width=80, height=80, top=4.0, **ABOVE)
    shown = picture(figure)
    paper = shown[2, 2]
    assert np.allclose(shown[:19], paper) and np.allclose(shown[:, :19], paper) and np.allclose(shown[61:], paper)
    # From 0 at the left to 4 at the right, over grey that is lit from the camera and from above.
    x = (np.arange(20, 60) + 0.5) / 20 - 2
    grey = 0.18 + 0.3 * (0.6 * 2 / np.sqrt(4 + x**2 + 0.025**2) + 0.4 * 0)
    wanted = overlay(np.repeat(grey[None, :, None], 3, axis=2), 2 * (x + 1)[None], Heat(4.0))
    # To a step of the colour map, between whose colours single precision may decide otherwise.
    np.testing.assert_allclose(shown[40, 20:60], wanted[0], atol=0.02)
    assert bar(figure).get_ylabel().replace("\n", " ") == "share of gaze per square metre [1/m²]"


def test_what_is_above_is_left_out_and_all_is_seen_at_first(tmp_path):
    lid = SQUARE + [0, 0, 1]
    path = write_surface(tmp_path / "a.ply", [1] * 4 + [9] * 4, np.concatenate([SQUARE, lid]))
    size = {"width": 60, "height": 60, "top": 9.0, "mode": "llvm_ad_rgb"}
    level = {"up": (0.0, 0.0, 1.0)}
    closed, opened = (
        picture(draw("surface", path, **size, **(ABOVE | more))) for more in (level, level | {"below": 0.5})
    )
    assert closed[30, 30].sum() > opened[30, 30].sum() + 0.3
    seen = picture(draw("surface", path, **size))
    filled = np.abs(seen - seen[0, 0]).sum(axis=2) > 0.02
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    assert 0 < rows[0] and rows[-1] < 59 and 0 < columns[0] and columns[-1] < 59
    assert max(np.ptp(rows), np.ptp(columns)) > 50, "it fills the picture"


def test_the_header_says_what_it_is_made_of(tmp_path):
    comments = ("value: seconds per square metre [s/m²]", 'nerg_mi {"inputs": {"day.npz": "ab", "shop.ply": "cd"}}')
    path = write_surface(tmp_path / "a.ply", [1, 2, 3, 4], comments=comments)
    baked = read_baked(path)
    assert baked.label == "seconds per square metre [s/m²]" and baked.made_of == ("day.npz", "shop.ply")
    np.testing.assert_array_equal(baked.values, [1, 2, 3, 4])
    figure = draw("surface", path, width=32, height=32, mode="llvm_ad_rgb")
    assert figure.axes[0].get_title().replace("\n", " ") == "Seconds per square metre"
    assert figure.texts[0].get_text().replace("\n", " ") == "made of day.npz, shop.ply"


def test_surface_what_is_refused(tmp_path):
    good = write_surface(tmp_path / "a.ply", [1, 2, 3, 4])
    columns = dict(zip("xyz", SQUARE.astype(np.float32).T))
    write_columns(tmp_path / "bare.ply", columns, np.array([[0, 1, 2]]))
    (tmp_path / "a.glb").write_bytes(b"x")
    (tmp_path / "odd.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    damaged = write_surface(tmp_path / "damaged.ply", [1, 2, 3, 4], comments=("nerg_mi {",))
    for path, given, said in (
        (tmp_path / "a.glb", {}, "give the .ply"),
        (tmp_path / "none.ply", {}, "there is no file"),
        (tmp_path / "bare.ply", {}, "no property value"),
        (tmp_path / "odd.ply", {}, "odd.ply"),
        (damaged, {}, "is damaged"),
        (good, {"below": -1.0}, "larger --below"),
        (good, {"camera": (0.0, 0, 2), "target": (0.0, 0, 5)}, "in the picture"),
        (good, {"camera": (0.0, 0, 2), "target": (0.0, 0, 2)}, "elsewhere than --camera"),
        (good, {"up": (0.0, 0, 0)}, "--up must not be of length 0"),
    ):
        with pytest.raises(NergError, match=said):
            draw("surface", path, mode="llvm_ad_rgb", width=32, height=32, **given)


def test_splats_show_their_gaze_themselves(tmp_path):
    write_ply_splats(tmp_path / "splats.ply", wall(0.0, 0.4, 0.05))
    with pytest.raises(NergError, match="holds Gaussian splats"):
        read_baked(tmp_path / "splats.ply")
