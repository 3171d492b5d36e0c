"""Pictures of a report: one scale, and no picture if there is nothing to show."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.figures.style import make_provenance
from nerg_mi.reports.pictures import RenderedViews, draw_rays, draw_views, gaze_vmax
from tests.evaluation.test_gaze import crowd


def view(gaze, **aovs):
    gaze = np.broadcast_to(np.asarray(gaze, float), (32, 48))
    mask = np.ones((32, 48), bool)
    mask[:4] = False
    return SimpleNamespace(color=np.full((32, 48, 3), 0.3), aovs={"gaze": gaze, **aovs}, mask=mask)


def three(observer_value=0.5):
    return {"camera": view(0.2), "own": view(observer_value), "sphere": view(0.1)}


def drawn(seen, top=0.5, has_geometry=True, **fields):
    return draw_views(RenderedViews(seen, **fields), top, has_geometry, PROVENANCE)


PROVENANCE = make_provenance("nerg report", seed=7, settings={"width": 48})


def test_all_images_share_one_scale():
    assert gaze_vmax(three()) == pytest.approx(0.5)
    assert gaze_vmax({"camera": view(0.0)}) is None
    # Gaze does not count if there is no surface.
    assert gaze_vmax({"camera": view(np.where(np.arange(32)[:, None] < 4, 9.0, 0.0))}) is None


def test_images_depend_on_the_rendered_views():
    assert set(drawn(three())) == {"color", "gaze", "own", "sphere"}
    assert set(drawn(three(), has_geometry=False)) == {"own", "sphere"}
    assert set(drawn(three(), None)) == {"color"}
    spread = {**three(), "camera": view(0.2, gaze_std=np.full((32, 48), 0.05))}
    assert "spread" in drawn(spread, marker=(3.0, 4.0))


def test_images_are_reproducible_png_files_with_captions():
    one, two = (drawn(three(), marker=(3.0, 4.0)) for _ in range(2))
    for name, picture in one.items():
        assert picture.png.startswith(b"\x89PNG") and picture.png == two[name].png
        assert picture.alt.endswith(".") and picture.caption.endswith(".")


def test_each_image_records_its_provenance():
    every = drawn(three()) | draw_rays(crowd(300), None, PROVENANCE)
    assert set(every) == {"color", "gaze", "own", "sphere", "plan", "layout"}
    for name, picture in every.items():
        assert PROVENANCE.json().encode("latin-1") in picture.png, name


def hatched(pictures, name):
    """Number of grey pixels in the picture; the colours of the scene and of gaze are not grey."""
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
def test_unknown_gaze_is_hatched(name):
    """More pixels are hatched where no participant was recorded near the observer."""
    every = {k: view(0.3) for k in ("camera", "own", "sphere")}
    for seen in every.values():
        seen.color[...] = (0.6, 0.1, 0.1)
    supported, alone = (hatched(drawn(every, supported=s), name) for s in (True, False))
    assert alone > 1.5 * supported > 0


def test_the_basis_of_the_gaze_is_printed():
    plain, with_basis = (drawn(three(), basis=b) for b in ("", "made of 300 rays of 3 participants"))
    for name in ("gaze", "own", "sphere"):
        a, b = (pixels(p[name].png) for p in (plain, with_basis))
        # One more line below the picture.
        assert b.shape[0] > a.shape[0] and b.shape[1] == a.shape[1]
        assert (b[-16:] < 128).any() and b[-16:].shape == (16, *b.shape[1:])


def test_floor_plans_are_drawn():
    plans = draw_rays(crowd(300), {"centres": [[-0.5, 0, 1.6]], "radius": 0.5}, PROVENANCE)
    assert set(plans) == {"plan", "layout"} and "held-out" in plans["layout"].caption
    assert "held-out" not in draw_rays(crowd(300), None, PROVENANCE)["layout"].caption
