"""Colours, pages and sheets."""

from __future__ import annotations

import base64
import hashlib
import io
import itertools
import json
import re
from pathlib import Path
from xml.etree import ElementTree

import drjit
import mitsuba
import numpy as np
import pytest

import nerg_mi
from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, add_scale, color_strip, gaze_figure, overlay
from nerg_mi.figures.style import (
    DIVERGING,
    SEQUENTIAL,
    Provenance,
    Sheet,
    apply_colormap,
    contact_sheet,
    encode,
    existing_files,
    figure_of,
    find_colormap,
    hatch,
    hatch_lines,
    hatch_swatch,
    make_provenance,
    rasterize,
    round_up_to_even,
    save,
    scale_ticks,
    shrink,
    wrap,
)

# ---- Colour maps ----


def lightness(colors):
    """CIE 1976 L* of display sRGB, from its definition."""
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(y > (6 / 29) ** 3, 116 * np.cbrt(y) - 16, y * (29 / 3) ** 3)


@pytest.mark.parametrize("name", SEQUENTIAL)
def test_sequential_lightness_is_uniform(name):
    step = np.diff(lightness(apply_colormap(name, np.linspace(0, 1, 64))))
    assert np.all(step > 0)
    assert np.allclose(apply_colormap(f"{name}_r", [0.2]), apply_colormap(name, [0.8]), atol=0.02)


@pytest.mark.parametrize("name", DIVERGING)
def test_diverging_lightness_is_symmetric(name):
    level = lightness(apply_colormap(name, np.linspace(0, 1, 65), kind="diverging"))
    assert level.argmax() in range(30, 35)
    assert np.all(np.diff(level[:30]) > 0) and np.all(np.diff(level[35:]) < 0)
    assert abs(level[0] - level[-1]) < 25


def test_unknown_colormaps_are_refused():
    for name in ("jet", "hsv", "rainbow", "RdBu_r", "nothing", ""):
        with pytest.raises(NergError, match="not a perceptually uniform colour map; choose one of inferno"):
            find_colormap(name)
    with pytest.raises(NergError, match="not a diverging colour map; choose one of RdBu_r"):
        find_colormap("viridis", kind="diverging")


# ---- Hatching ----

SHOWN = np.random.default_rng(0).random((40, 60, 3))
UNKNOWN = np.zeros((40, 60), bool)
UNKNOWN[5:30, 10:50] = True


def test_only_unknown_pixels_are_hatched():
    drawn = hatch(SHOWN, UNKNOWN)
    np.testing.assert_array_equal(np.any(drawn != SHOWN, axis=-1), UNKNOWN)
    np.testing.assert_array_equal(hatch(SHOWN, ~UNKNOWN & UNKNOWN), SHOWN)
    assert drawn.min() >= 0 and drawn.max() <= 1


def test_hatch_lines_are_diagonal():
    on = hatch_lines(64, 64)
    assert on.mean() == pytest.approx(0.25) and np.array_equal(on[1:, :-1], on[:-1, 1:])
    assert hatch_lines(64, 64, 2)[::2, ::2].mean() == pytest.approx(0.25)


def test_hatching_differs_from_all_colours():
    """No position of any scale, over any image, has the greys of the hatching."""
    pale = hatch(np.zeros((16, 16, 3)), np.full((16, 16), True))
    assert np.ptp(np.unique(pale)) > 0.1 and np.allclose(pale[..., 0], pale[..., 2])
    for name in SEQUENTIAL[:4]:
        colors = apply_colormap(name, np.linspace(0.2, 1, 50))
        assert np.ptp(colors, axis=1).min() > 0.15


def test_the_swatch_is_hatched():
    np.testing.assert_array_equal(hatch_swatch(16, 16), hatch(np.full((16, 16, 3), 0.5), np.full((16, 16), True)))


# ---- Provenance ----
#
# Provenance of pictures: inputs, seed, settings and versions, but nothing about the machine.


def test_provenance_is_complete(tmp_path):
    (tmp_path / "scene.xml").write_text("<scene/>")
    metadata = make_provenance("nerg render", [tmp_path / "scene.xml"], 7, {"spp": 4})
    result = json.loads(metadata.text()["Comment"])
    assert result["inputs"] == {"scene.xml": hashlib.sha256(b"<scene/>").hexdigest()}
    assert (result["what"], result["seed"], result["settings"]) == ("nerg render", 7, {"spp": 4})
    assert result["versions"] == dict(nerg_mi=nerg_mi.__version__, mitsuba=mitsuba.__version__, drjit=drjit.__version__)
    assert metadata.text()["Software"] == ", ".join(
        f"{k} {result['versions'][k]}" for k in ("nerg_mi", "mitsuba", "drjit")
    )


def test_provenance_excludes_users_and_paths(tmp_path):
    options = {"store": tmp_path, "scheduler": "local:2", "spp": 5, "seed": 4}
    assert dict(make_provenance("x", [], 4, options).settings) == {"spp": 5}


def test_no_path_of_the_machine(tmp_path):
    (tmp_path / "a.csv").write_text("x")
    defaults = {"field": f"{tmp_path}/deep/f.safetensors", "w": r"C:\Users\me\b.ply"}
    options = {"frames": tmp_path / "a.csv", "defaults": defaults, "spp": 2}
    text = json.dumps(make_provenance("x", [tmp_path / "a.csv"], 0, options).text())
    assert str(tmp_path) not in text and "Users" not in text and str(Path.home()) not in text
    settings = make_provenance("x", [], 0, options).settings
    assert settings == {"frames": "a.csv", "defaults": {"field": "f.safetensors", "w": "b.ply"}, "spp": 2}


def test_files_with_equal_names(tmp_path):
    for k in "ab":
        (tmp_path / k).mkdir()
        (tmp_path / k / "day.csv").write_text(k)
    paths = [tmp_path / "a/day.csv", tmp_path / "b/day.csv", tmp_path / "a/day.csv"]
    expected = {paths[1]: "seen before"}
    result = make_provenance("x", paths, checksums=expected).inputs
    assert result == {"day.csv": hashlib.sha256(b"a").hexdigest(), "day.csv (2)": "seen before"}
    assert expected[paths[0]] == result["day.csv"]


def test_missing_input_is_refused(tmp_path):
    with pytest.raises(NergError, match="gone.xml"):
        make_provenance("x", [tmp_path / "gone.xml"])


def test_existing_files_are_selected(tmp_path):
    (tmp_path / "a.csv").write_text("x")
    assert existing_files(tmp_path / "a.csv", str(tmp_path / "a.csv"), None, 3, tmp_path / "gone") == [
        tmp_path / "a.csv",
        tmp_path / "a.csv",
    ]
    # Values without a JSON form are recorded by their type.
    assert make_provenance("x", settings={"rays": object()}).settings == {"rays": "object"}


# ---- Files ----

RNG = np.random.default_rng(3)
COLOR, GAZE = RNG.random((160, 200, 3)), RNG.random((160, 200))
MASK = np.ones((160, 200), bool)
METADATA = Provenance("nerg render", {"scène.xml": "ab" * 32}, 5, {"spp": 2}, {"nerg_mi": "1"})
SVG = "{http://www.w3.org/2000/svg}"
LINK = "{http://www.w3.org/1999/xlink}href"


def figure():
    return figure_of(gaze_figure(COLOR, GAZE, MASK, Heat(0.5)))


def test_png_is_read_by_another_library(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    save(figure(), tmp_path / "a.png", METADATA)
    with image.open(tmp_path / "a.png") as result:
        assert (
            json.loads(result.text["Comment"]) == json.loads(METADATA.json()) and result.text["Software"] == "nerg_mi 1"
        )
        np.testing.assert_array_equal(np.asarray(result.convert("RGB")), rasterize(figure()))


def test_svg_is_self_contained(tmp_path):
    save(figure(), tmp_path / "a.svg", METADATA)
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    links = [v for e in root.iter() for k, v in e.attrib.items() if k in ("href", LINK, "src")]
    assert links and all(v.startswith(("data:image/png;base64,", "#")) for v in links)
    assert "url(http" not in (tmp_path / "a.svg").read_text()
    # Text stays text.
    texts = ["".join(e.itertext()) for e in root.iter(f"{SVG}text")]
    assert "Gaze" in texts and "gaze density [1/sr]" in texts and "0.5" in texts
    (said,) = [e.text for e in root.iter("{http://purl.org/dc/elements/1.1/}description")]
    assert json.loads(said) == json.loads(METADATA.json())
    assert not list(root.iter("{http://purl.org/dc/elements/1.1/}date"))


def test_svg_image_has_exact_pixels(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    text = encode(figure(), ".svg").decode()
    parts = [base64.b64decode(p) for p in re.findall(r'base64,\s*([^"]+)"', text)]
    pictures = [np.asarray(image.open(io.BytesIO(p)).convert("RGB")) for p in parts]
    (result,) = [p for p in pictures if p.shape[:2] == (160, 200)]
    wanted = overlay(COLOR, GAZE, Heat(0.5), MASK)
    # Perhaps upside down, as matplotlib's transforms have it.
    assert min(np.abs(v / 255 - wanted).max() for v in (result, result[::-1])) < 0.01


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_files_are_reproducible(suffix):
    assert encode(figure(), suffix, METADATA.text()) == encode(figure(), suffix, METADATA.text())


def test_other_formats_are_refused(tmp_path):
    with pytest.raises(NergError, match=r"ends in .png or .svg"):
        save(figure(), tmp_path / "a.jpg")
    assert not list(tmp_path.iterdir())


def test_notebooks_display_figures():
    assert figure()._repr_png_().startswith(b"\x89PNG")


# ---- Ticks ----

SUPER = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")


def value(name, factor=""):
    """Parse the number of a tick label."""
    name, factor = name.translate(SUPER), factor.translate(SUPER)
    power = lambda text: 1.0 if text in ("", "1") else 10.0 ** int(text[2:] or 1)
    return (
        power(name)
        if name.startswith("10") and name[2:].startswith(("-", *"23456789"))
        else float(name) * power(factor)
    )


@pytest.mark.parametrize("top", [1.0, 0.8, 1.37, 23.0, 9999.0, 12345.0, 3.3e-4, 7e-12, 4e15, 1e-3])
@pytest.mark.parametrize("max_count", [3, 5, 9])
def test_linear_ticks(top, max_count):
    places, names, factor = scale_ticks(0.0, top, max_count)
    assert 2 <= len(places) <= max_count + 1 and len(set(names)) == len(names)
    for place, name in zip(places, names):
        assert -1e-9 <= place <= 1 + 1e-9
        assert value(name, factor) == pytest.approx(place * top, abs=1e-6 * top)
        assert len(name) <= 6


def test_ticks_around_zero():
    for low, high in ((2.0, 7.3), (-0.5, 0.5), (-3e-6, 3e-6), (100.0, 100.4)):
        places, names, factor = scale_ticks(low, high, 6)
        for place, name in zip(places, names):
            assert value(name, factor) == pytest.approx(low + place * (high - low), abs=1e-6 * max(abs(low), high))
    assert "0.0" in scale_ticks(-0.5, 0.5, 6)[1] and not any(n.startswith("−0.0") and float(n[1:]) == 0 for n in names)  # noqa: RUF069 (text)


@pytest.mark.parametrize("low, high", [(1e-4, 1.0), (3e-12, 0.3), (1e-20, 1e10), (0.05, 700.0)])
def test_logarithmic_ticks(low, high):
    places, names, factor = scale_ticks(low, high, 5, log=True)
    assert factor == "" and 2 <= len(places) <= 6
    for place, name in zip(places, names):
        text = name.translate(SUPER)
        result = {"1": 1.0, "10": 10.0}.get(text) or 10.0 ** int(text[2:])
        assert np.log10(result) == pytest.approx(np.log10(low) + place * np.log10(high / low), abs=1e-9)


def test_logarithmic_ticks_within_a_decade():
    places, names, _ = scale_ticks(0.2, 0.8, 5, log=True)
    assert places == [0.0, 0.5, 1.0] and names == ["0.2", "0.4", "0.8"]


# ---- Page layout ----

SIZES = [(320, 480), (60, 1200), (500, 60), (16, 24), (1, 1), (900, 1600), (3, 400)]


def boxes(page):
    """Boxes (x0, y0, x1, y1) of all texts that are shown, and of the axes with pictures."""
    page.canvas.draw()
    renderer = page.canvas.get_renderer()
    texts = [
        t.get_window_extent(renderer)
        for axes in page.axes
        for t in (*axes.texts, axes.title, axes.xaxis.label, axes.yaxis.label, *axes.get_yticklabels())
        if t.get_text() and t.get_visible()
    ]
    return [b.extents for b in texts], [a.get_window_extent(renderer).extents for a in page.axes]


def overlap(a, b, slack=0.5):
    return min(a[2], b[2]) - max(a[0], b[0]) > slack and min(a[3], b[3]) - max(a[1], b[1]) > slack


@pytest.mark.parametrize(
    "size, label", list(zip(SIZES, itertools.cycle(("gaze density [1/sr]", "training rays around the observer"))))
)
def test_labels_do_not_overlap_or_leave_the_page(size, label):
    values = np.linspace(0, 2e-5, size[0] * size[1]).reshape(size)
    color, mask = np.zeros((*size, 3)), np.ones(size, bool)
    page = figure_of(gaze_figure(color, values, mask, Heat(1.6e-5), "Where people looked", label, None, values < 1e-6))
    texts, axes = boxes(page)
    width, height = page.bbox.size
    for a, b in itertools.combinations(texts, 2):
        assert not overlap(a, b)
    for a in texts:
        assert a[0] >= 0 and a[1] >= 0 and a[2] <= width + 0.01 and a[3] <= height + 0.01
        assert not any(overlap(a, b) for b in axes)
    for a, b in itertools.combinations(axes, 2):
        assert not overlap(a, b)
    assert [n % 2 for n in rasterize(page).shape[:2]] == [0, 0]


def test_large_pictures_have_large_text():
    small, large = (Sheet([np.zeros((h, 2 * h, 3))], ["a"], scale=True) for h in (200, 2000))
    assert small.unit == 1 and 3 < large.unit < 6
    assert large.panels[0].title.get_fontsize() == pytest.approx(large.unit * small.panels[0].title.get_fontsize())


def test_sheet_rows_and_columns():
    sheet = Sheet([np.full((100, 160, 3), k / 5) for k in range(5)], list("abcde"), columns=2)
    at = [tuple(np.round(p.get_window_extent().extents)) for p in sheet.panels]
    assert len({a[0] for a in at}) == 2 and len({a[1] for a in at}) == 3
    assert [p.get_title() for p in sheet.panels] == list("abcde")
    assert all(
        (round(p.get_window_extent().width), round(p.get_window_extent().height)) == (160, 100) for p in sheet.panels
    )


@pytest.mark.parametrize("decades", [0.0, 6.0])
def test_ticks_match_colours(decades):
    """The position of a tick has the colour of a pixel with its value."""
    heat = Heat(2.0, decades=decades)
    page = figure_of(gaze_figure(np.full((200, 200, 3), 0.2), np.zeros((200, 200)), np.ones((200, 200), bool), heat))
    bar = page.axes[-1]
    strip = bar.images[0].get_array()[:, 0]
    np.testing.assert_allclose(strip, color_strip(heat))
    names = [t.get_text() for t in bar.get_yticklabels()]
    power = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    for place, name in zip(bar.get_yticks(), names):
        text = name.translate(power)
        value = 10.0 ** int(text[2:]) if decades and text not in ("1", "10") else float(text)
        expected = np.log10(value / heat.vmin) / decades if decades else value / heat.vmax
        assert place == pytest.approx(expected, abs=1e-6)
        assert heat.normalize(value) == pytest.approx(place, abs=1e-6)


def test_helpers():
    assert [round_up_to_even(v) for v in (3, 4, 4.2, 4.6)] == [4, 4, 4, 6]
    assert wrap("one two three", 60, 10).count("\n") >= 1 and wrap("", 60, 10) == ""


# ---- Contact sheets ----

RANDOM = np.random.default_rng(0)


def test_contact_sheet_of_different_sizes():
    pictures = [RANDOM.random((90, 160, 3)), RANDOM.random((200, 100, 3)), RANDOM.random((50, 50, 3))]
    page = figure_of(contact_sheet(pictures, ["first", "second", "third"]))
    assert [a.get_title() for a in page.axes] == ["first", "second", "third"]
    for axes, picture in zip(page.axes, pictures):
        shown = axes.images[0].get_array()
        assert shown.shape == (200, 160, 3)
        h, w = picture.shape[:2]
        np.testing.assert_array_equal(shown[(200 - h) // 2 :][:h, (160 - w) // 2 :][:, :w], picture)
        assert np.count_nonzero(shown.min(axis=-1) < 1) == h * w


def test_contact_sheet_with_one_scale():
    scale = lambda sheet: add_scale(sheet, Heat(2.0), "gaze [1/sr]", [(np.array([3.0]), np.ones(1, bool))])
    page = figure_of(contact_sheet([RANDOM.random((90, 160, 3))] * 2, "ab", None, scale))
    assert len(page.axes) == 3 and page.axes[-1].get_ylabel() == "gaze [1/sr]" and len(page.axes[-1].patches) == 1


def test_shrinking_averages_blocks():
    picture = RANDOM.random((95, 160, 3))
    assert shrink(picture, 160) is not None and np.array_equal(shrink(picture, 160), picture)
    small = shrink(picture, 50)
    assert small.shape == (23, 40, 3)
    np.testing.assert_allclose(small[3, 5], picture[12:16, 20:24].reshape(-1, 3).mean(axis=0))
    assert shrink(np.ones((1, 900, 3)), 100).shape == (1, 100, 3)


def test_empty_contact_sheet_is_refused():
    with pytest.raises(ValueError, match="at least one picture"):
        figure_of(contact_sheet([], []))
