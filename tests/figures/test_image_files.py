"""Contact sheets and differences of image files."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.figures.image_files import draw_difference, draw_sheet, read_aov, shared_note
from nerg_mi.figures.overlay import find_channel_overlay, robust_max, srgb, write_png
from nerg_mi.figures.settings import Style
from nerg_mi.figures.style import apply_colormap
from nerg_mi.files.images import write_exr
from nerg_mi.tracking.rays import Rays
from tests.recorder import Recorder

RNG = np.random.default_rng(0)
COLOR, GAZE = RNG.random((6, 8, 3)).astype(np.float32), RNG.random((6, 8)).astype(np.float32)
OPACITY = np.where(np.arange(8) < 3, 0.2, 0.9).astype(np.float32) * np.ones((6, 1), np.float32)


def write(path, text=None, **channels):
    write_exr(path, {name: COLOR[..., k] for k, name in enumerate("RGB")} | {"gaze.Y": GAZE} | channels, text)
    return path


def test_colour_values_and_mask(tmp_path):
    stored = read_aov(write(tmp_path / "a.exr", **{"opacity.Y": OPACITY}), find_channel_overlay("gaze"))
    np.testing.assert_array_equal(stored.color, COLOR)
    np.testing.assert_array_equal(stored.values, GAZE)
    np.testing.assert_array_equal(stored.mask, np.tile(np.arange(8) >= 3, (6, 1)))
    assert read_aov(write(tmp_path / "b.exr"), find_channel_overlay("gaze.Y")).mask.all()


def test_the_basis_of_the_gaze_is_read(tmp_path):
    text = {"gaze.basis": "made of 5 rays of 2 participants", "kde.basis": "made of 3 rays of 1 participant"}
    path = write(tmp_path / "a.exr", text, **{"kde.Y": GAZE, "depth.T": GAZE})
    bases = [read_aov(path, find_channel_overlay(channel)).support_note for channel in ("gaze", "kde.Y", "depth")]
    assert (
        bases == [*text.values(), ""]
        and read_aov(write(tmp_path / "b.exr"), find_channel_overlay("gaze")).support_note == ""
    )
    assert shared_note("ab", bases[:1] * 2) == bases[0]
    assert shared_note("ab", ["x", ""]) == "a: x; b: unknown"


def test_unusable_exr_files_are_refused(tmp_path):
    with pytest.raises(NergError, match="it has R, G, B, gaze.Y"):
        read_aov(write(tmp_path / "a.exr"), find_channel_overlay("depth"))
    with pytest.raises(NergError, match="has no AOVs"):
        read_aov(tmp_path / "a.png", find_channel_overlay("gaze"))


# ---- Differences of two files ----


def test_the_second_image_is_subtracted_from_the_first(tmp_path):
    other = GAZE[::-1].copy()
    a = write(tmp_path / "a.exr", **{"opacity.Y": OPACITY})
    b = write(tmp_path / "b.exr", **{"opacity.Y": OPACITY, "gaze.Y": other})
    figure = draw_difference(a, b, vmax=0.5)
    shown = figure.axes[0].images[0].get_array()
    mask = OPACITY > 0.5
    wanted = apply_colormap("RdBu_r", np.clip(0.5 + (GAZE - other), 0, 1), kind="diverging")
    np.testing.assert_allclose(shown[mask], wanted[mask], atol=1e-6)
    assert np.ptp(shown[~mask], axis=-1).max() < 1e-9 and figure.axes[0].get_title() == "a minus b"


def test_differences_that_cannot_be_drawn_are_refused(tmp_path):
    a = write(tmp_path / "a.exr")
    write_exr(tmp_path / "b.exr", {"gaze.Y": np.ones((3, 4), np.float32)})
    for second, options, message in (
        (tmp_path / "b.exr", {}, "8 x 6 and 4 x 3 pixels cannot be compared"),
        (a, {"vmax": -1.0}, "vmax must lie in"),
        (tmp_path / "gone.exr", {}, "there is no file"),
    ):
        with pytest.raises(NergError, match=message):
            draw_difference(a, second, **options)


# ---- Contact sheets of files ----


def test_all_images_share_one_scale(tmp_path):
    bright = np.where(OPACITY > 0.5, 3 * GAZE, 100)
    files = [
        write(tmp_path / "first.exr", **{"opacity.Y": OPACITY}),
        write(tmp_path / "second.exr", **{"opacity.Y": OPACITY, "gaze.Y": bright.astype(np.float32)}),
    ]
    figure = draw_sheet(files, overlay="gaze")
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
    figure = draw_sheet([tmp_path / "a.png", tmp_path / "b.exr"], tmp_path / "out.png", columns=2)
    a, b = (axes.images[0].get_array() for axes in figure.axes)
    np.testing.assert_allclose(a, COLOR, atol=0.51 / 255)
    np.testing.assert_allclose(b, srgb(COLOR))
    assert (tmp_path / "out.png").is_file()


def test_a_sheet_without_values_needs_a_scale(tmp_path):
    dark = write(tmp_path / "a.exr", **{"gaze.Y": 0 * GAZE})
    with pytest.raises(NergError, match='"gaze" is 0'):
        draw_sheet(dark, overlay="gaze")
    assert draw_sheet(dark, overlay="gaze", vmax=1.0).axes


def test_the_basis_of_the_gaze_is_printed_below_the_images(tmp_path):
    texts = [{"gaze.basis": f"made of {n} rays of 2 participants"} for n in (5, 6)]
    a, b = (write(tmp_path / f"{name}.exr", text) for name, text in zip("ab", texts))
    said = lambda *files: {t.get_text().replace("\n", " ") for t in draw_sheet(files, overlay="gaze").texts}
    assert said(a, a) == {texts[0]["gaze.basis"]}
    assert said(a, b) == {f"a: {texts[0]['gaze.basis']}; b: {texts[1]['gaze.basis']}"}
    figure = draw_difference(a, a)
    assert figure.texts[0].get_text().replace("\n", " ") == texts[0]["gaze.basis"]


def test_a_figure_file_records_its_provenance(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    recorder = Recorder()
    a, path = write(tmp_path / "a.exr"), tmp_path / "new" / "b.png"
    style = Style(log_decades=2.0)
    figure = draw_sheet(str(a), str(path), overlay="gaze", style=style, progress=recorder)
    width, height = (round(v) for v in figure.bbox.size)
    assert recorder.messages == [f"Wrote {path} ({width} x {height})."]
    with image.open(path) as stored:
        assert stored.size == (width, height)
        metadata = json.loads(stored.text["Comment"])
    assert metadata["what"] == "nerg draw sheet" and metadata["settings"] == {"overlay": "gaze", "log_decades": 2.0}
    assert metadata["inputs"] == {"a.exr": hashlib.sha256(a.read_bytes()).hexdigest()} and metadata["seed"] is None


def test_wrong_files_and_settings_are_refused(tmp_path):
    a = write(tmp_path / "a.exr")
    with pytest.raises(NergError, match="is not supported: choose a file name that ends"):
        draw_sheet(a, tmp_path / "b.bmp")
    with pytest.raises(MissingFile, match="gone.exr"):
        draw_sheet(tmp_path / "gone.exr")
    with pytest.raises(NergError, match="1.*400.*0"):
        draw_sheet([])
    with pytest.raises(NergError, match="got Rays"):
        draw_sheet(a, Rays.from_arrays([[0, 0, 0]], [[1, 0, 0]], times=[0]))
    for make, message in (
        (lambda: {"vmax": 0.0}, "vmax must lie in"),
        (lambda: {"style": Style(log_decades=-1)}, "log_decades"),
        (lambda: {"style": Style(cmap="jet")}, '"jet" is no'),
    ):
        with pytest.raises(NergError, match=message):
            draw_sheet(a, overlay="gaze", **make())
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
