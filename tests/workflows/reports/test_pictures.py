"""Pictures of a report: one scale, and none where there is nothing to show."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.figures.style import provenance
from nerg_mi.workflows.report import Views, gaze_top, pictures_of_rays, pictures_of_views
from tests.evaluation.gaze.test_evaluation import crowd


def view(gaze, **aovs):
    gaze = np.broadcast_to(np.asarray(gaze, float), (32, 48))
    mask = np.ones((32, 48), bool)
    mask[:4] = False
    return SimpleNamespace(color=np.full((32, 48, 3), 0.3), aovs={"gaze": gaze, **aovs}, mask=mask)


def three(own=0.5):
    return {"camera": view(0.2), "own": view(own), "sphere": view(0.1)}


def drawn(seen, top=0.5, known=True, **about):
    return pictures_of_views(Views(seen, **about), top, known, ABOUT)


ABOUT = provenance("nerg report", seed=7, settings={"width": 48})


def test_one_scale_for_all():
    assert gaze_top(three()) == pytest.approx(0.5)
    assert gaze_top({"camera": view(0.0)}) is None
    # Where there is no surface gaze does not count.
    assert gaze_top({"camera": view(np.where(np.arange(32)[:, None] < 4, 9.0, 0.0))}) is None


def test_which_pictures_there_are():
    assert set(drawn(three())) == {"color", "gaze", "own", "sphere"}
    assert set(drawn(three(), known=False)) == {"own", "sphere"}
    assert set(drawn(three(), None)) == {"color"}
    spread = {**three(), "camera": view(0.2, gaze_std=np.full((32, 48), 0.05))}
    assert "spread" in drawn(spread, marker=(3.0, 4.0))


def test_they_are_png_files_with_words_and_the_same_again():
    one, two = (drawn(three(), marker=(3.0, 4.0)) for _ in range(2))
    for name, picture in one.items():
        assert picture.png.startswith(b"\x89PNG") and picture.png == two[name].png
        assert picture.alt.endswith(".") and picture.caption.endswith(".")


def test_each_says_in_its_header_what_it_was_made_of():
    every = drawn(three()) | pictures_of_rays(crowd(300), None, ABOUT)
    assert set(every) == {"color", "gaze", "own", "sphere", "plan", "layout"}
    for name, picture in every.items():
        assert ABOUT.json().encode("latin-1") in picture.png, name


def hatched(pictures, name):
    """How many of the picture's pixels are grey: the colours of its place are not, nor those of gaze."""
    return sum(1 for row in pixels(pictures[name].png) for p in row if p.max() - p.min() < 3 and 60 < p.max() < 240)


def pixels(png):
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    stream = mi.MemoryStream()
    stream.write(png)
    stream.seek(0)
    return np.array(mi.Bitmap(stream).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)).astype(
        int
    )


@pytest.mark.parametrize("name", ["gaze", "own", "sphere"])
def test_what_is_not_known_is_hatched(name):
    """More of it where nobody was recorded around the observer: then nothing of the gaze is known."""
    every = {k: view(0.3) for k in ("camera", "own", "sphere")}
    for seen in every.values():
        seen.color[...] = (0.6, 0.1, 0.1)
    known, alone = (hatched(drawn(every, supported=s), name) for s in (True, False))
    assert alone > 1.5 * known > 0


def test_the_rays_that_it_rests_on_are_named():
    plain, told = (drawn(three(), basis=b) for b in ("", "made of 300 rays of 3 people"))
    for name in ("gaze", "own", "sphere"):
        a, b = (pixels(p[name].png) for p in (plain, told))
        # A line more, below the picture.
        assert b.shape[0] > a.shape[0] and b.shape[1] == a.shape[1]
        assert (b[-16:] < 128).any() and b[-16:].shape == (16, *b.shape[1:])


def test_plans():
    found = pictures_of_rays(crowd(300), {"centres": [[-0.5, 0, 1.6]], "radius": 0.5}, ABOUT)
    assert set(found) == {"plan", "layout"} and "held out" in found["layout"].caption
    assert "held out" not in pictures_of_rays(crowd(300), None, ABOUT)["layout"].caption
