"""Surfaces that a bake has written: visible parts, in the colours of their values."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, overlay
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.surfaces.bake import bake
from nerg_mi.surfaces.baked import draw_surface, read_baked
from nerg_mi.tracking.rays import Rays
from tests.surfaces.meshes import wall

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


def test_values_are_drawn_at_their_positions(rgb, tmp_path):
    """From 2 above, a view of 90 degrees is 4 wide: the square fills the middle half, brighter to the right."""
    path = write_surface(tmp_path / "a.ply", [0, 4, 4, 0])
    figure = draw_surface(path, width=80, height=80, vmax=4.0, **ABOVE)
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


def test_geometry_above_the_cut_is_hidden_and_the_default_view_shows_everything(rgb, tmp_path):
    lid = SQUARE + [0, 0, 1]
    path = write_surface(tmp_path / "a.ply", [1] * 4 + [9] * 4, np.concatenate([SQUARE, lid]))
    size = {"width": 60, "height": 60, "vmax": 9.0}
    level = {"up": (0.0, 0.0, 1.0)}
    closed, opened = (
        picture(draw_surface(path, **size, **(ABOVE | changes))) for changes in (level, level | {"clip_above": 0.5})
    )
    assert closed[30, 30].sum() > opened[30, 30].sum() + 0.3
    seen = picture(draw_surface(path, **size))
    filled = np.abs(seen - seen[0, 0]).sum(axis=2) > 0.02
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    assert 0 < rows[0] and rows[-1] < 59 and 0 < columns[0] and columns[-1] < 59
    assert max(np.ptp(rows), np.ptp(columns)) > 50, "it fills the picture"


def test_the_header_records_the_inputs(rgb, tmp_path):
    comments = ("value: seconds per square metre [s/m²]", 'nerg_mi {"inputs": {"day.npz": "ab", "shop.ply": "cd"}}')
    path = write_surface(tmp_path / "a.ply", [1, 2, 3, 4], comments=comments)
    baked = read_baked(path)
    assert baked.label == "seconds per square metre [s/m²]" and baked.gaze_files == ("day.npz", "shop.ply")
    np.testing.assert_array_equal(baked.values, [1, 2, 3, 4])
    figure = draw_surface(path, width=32, height=32)
    assert figure.axes[0].get_title().replace("\n", " ") == "Seconds per square metre"
    assert figure.texts[0].get_text().replace("\n", " ") == "data: day.npz, shop.ply"


def test_surfaces_that_cannot_be_drawn_are_refused(rgb, tmp_path):
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
        (good, {"camera": (0.0, 0)}, "camera must be three numbers"),
        (good, {"up": (0.0, 0, 0)}, "up must not be of length 0"),
    ):
        with pytest.raises(NergError, match=said):
            draw_surface(path, width=32, height=32, **options)


def test_splats_are_drawn_with_their_gaze(rgb, tmp_path):
    write_ply_splats(tmp_path / "splats.ply", wall(0.0, 0.4, 0.05))
    with pytest.raises(NergError, match="holds Gaussian splats"):
        read_baked(tmp_path / "splats.ply")


def test_a_bake_in_memory_is_drawn_as_its_file(rgb, tmp_path):
    vertices, faces = SQUARE + [0, 0, -1], np.array([[0, 1, 2], [0, 2, 3]])
    write_columns(tmp_path / "floor.ply", dict(zip("xyz", vertices.T)), faces)
    ahead = np.array([[0.1, 0.0, -1.0], [-0.3, 0.2, -1.0]])
    rays = Rays.from_arrays(np.zeros((2, 3)), ahead, times=[0.0, 0.1])
    baked = bake(tmp_path / "floor.ply", rays=rays, max_edge=0.2)
    figures = [draw_surface(s, width=60, height=40) for s in (baked, baked.save(tmp_path / "a.ply"))]
    one, two = map(picture, figures)
    np.testing.assert_allclose(one, two, atol=0.02)
    assert np.ptp(one) > 0.3 and bar(figures[0]).get_ylabel() == bar(figures[1]).get_ylabel()
