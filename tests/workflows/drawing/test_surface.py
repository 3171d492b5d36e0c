"""Baked surfaces: what is seen of them where, in the colours of their values."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, overlay
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.workflows.draw import draw
from nerg_mi.workflows.draw_files import read_baked
from tests.surfaces.walls import wall

SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
ABOVE = {"camera": (0.0, 0.0, 2.0), "target": (0.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0), "fov": 90.0}


def write(path, values, vertices=SQUARE, comments=("value: share of gaze per square metre [1/m²]",), **columns):
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
    path = write(tmp_path / "a.ply", [0, 4, 4, 0])
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
    path = write(tmp_path / "a.ply", [1] * 4 + [9] * 4, np.concatenate([SQUARE, lid]))
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
    path = write(tmp_path / "a.ply", [1, 2, 3, 4], comments=comments)
    baked = read_baked(path)
    assert baked.label == "seconds per square metre [s/m²]" and baked.made_of == ("day.npz", "shop.ply")
    np.testing.assert_array_equal(baked.values, [1, 2, 3, 4])
    figure = draw("surface", path, width=32, height=32, mode="llvm_ad_rgb")
    assert figure.axes[0].get_title().replace("\n", " ") == "Seconds per square metre"
    assert figure.texts[0].get_text().replace("\n", " ") == "made of day.npz, shop.ply"


def test_what_is_refused(tmp_path):
    good = write(tmp_path / "a.ply", [1, 2, 3, 4])
    columns = dict(zip("xyz", SQUARE.astype(np.float32).T))
    write_columns(tmp_path / "bare.ply", columns, np.array([[0, 1, 2]]))
    (tmp_path / "a.glb").write_bytes(b"x")
    (tmp_path / "odd.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    damaged = write(tmp_path / "damaged.ply", [1, 2, 3, 4], comments=("nerg_mi {",))
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
