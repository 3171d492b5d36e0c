"""Attention on boxes, meshes and shapes: what it adds up to, and what hides it."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.shapes import box_dict

BOX = [(-0.2, 1.8, -0.1), (0.2, 2.2, 0.1)]
FAR = {"type": "sphere", "radius": 0.01, "center": [0, 0, -50]}


def on_sphere(count: int) -> np.ndarray:
    """Unit directions of equal area (count, 3)."""
    i = np.arange(count)
    z, phi = 1 - (2 * i + 1) / count, i * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=1)


def hits_box(o, d, low, high) -> np.ndarray:
    with np.errstate(divide="ignore"):
        a, b = (np.array(low) - o) / d, (np.array(high) - o) / d
    return np.minimum(a, b).max(axis=1) < np.maximum(a, b).min(axis=1)


@pytest.fixture
def empty(files):
    """Nothing near, and a gaze field."""
    return nerg.make_scene(gaze=files / "gaze.safetensors", shapes=FAR)


def test01_the_share_is_the_integral_over_directions(empty):
    eye = np.array((0.4, 0.1, 0.2))
    seen = nerg.attention(empty, BOX, eye, divisions=16)
    d = on_sphere(400_000)
    d = d[hits_box(eye, d, *BOX) & (d @ (np.mean(BOX, axis=0) - eye) > 0)]
    # Where the rays enter the box is where its gaze is.
    low, high = ((np.array(corner) - eye) / d for corner in BOX)
    entry = eye + d * np.minimum(low, high).max(axis=1)[:, None]
    gaze = nerg.observe(empty, entry, eye, "gaze").gaze[0]
    assert np.isclose(seen.share[0], gaze.sum() * 4 * np.pi / 400_000, rtol=1e-2)


def test02_density_times_area_is_the_share(empty):
    eyes = [(0.4, 0.1, 0.2), (-1, 0.5, 0.3), (0, 5, 0)]
    seen = nerg.attention(empty, BOX, eyes, divisions=3)
    assert seen.density.shape == (3, 12 * 9) and seen.points.shape == seen.normals.shape == (108, 3)
    assert np.allclose(seen.density @ seen.area, seen.share, rtol=1e-5)
    assert np.isclose(seen.area.sum(), 2 * (0.4 * 0.4 + 0.4 * 0.2 + 0.4 * 0.2), rtol=1e-5)
    assert np.allclose(np.linalg.norm(seen.normals, axis=1), 1, atol=1e-5)
    # A side that is turned away receives nothing.
    away = (np.array(eyes)[:, None] - seen.points) @ np.eye(3) * seen.normals
    assert np.array_equal(seen.density[away.sum(axis=-1) < -1e-5], np.zeros((away.sum(axis=-1) < -1e-5).sum()))
    assert seen.mean == pytest.approx(float(seen.share.mean()))
    assert repr(seen).startswith("<Attention: mean share ") and "3 observers" in repr(seen)


def test03_what_stands_before_it_hides_it(files, empty):
    wall = box_dict(np.array((-3.0, 1.0, -3.0)), np.array((3.0, 1.1, 3.0)))
    hidden = nerg.make_scene(gaze=files / "gaze.safetensors", shapes=wall)
    eyes = [(0, 0, 0), (0, 4, 0)]
    seen, before = nerg.attention(hidden, BOX, eyes), nerg.attention(empty, BOX, eyes)
    assert before.share.min() > 0 and seen.share[0] == 0
    assert np.isclose(seen.share[1], before.share[1], rtol=1e-3)


def test04_a_shape_of_the_scene_by_its_id(files, rgb, tmp_path):
    box = box_dict(*np.array(BOX))
    scene = nerg.make_scene(gaze=files / "gaze.safetensors", shapes={"product": box, "far": FAR})
    path = tmp_path / "box.ply"
    rgb.load_dict(box).write_ply(str(path))
    eye = (0.4, 0.1, 0.2)
    by_id = nerg.attention(scene, "product", eye)
    # It does not hide itself.
    assert by_id.share[0] > 0
    alone = nerg.make_scene(gaze=files / "gaze.safetensors", shapes=FAR)
    for surface in (BOX, np.array(BOX), box, path, str(path), rgb.load_dict(box)):
        assert np.isclose(nerg.attention(alone, surface, eye).share[0], by_id.share[0], rtol=1e-4)


def test05_both_sides_of_an_open_surface(empty, rgb):
    mesh = rgb.Mesh("sheet", 3, 1)
    params = rgb.traverse(mesh)
    params["vertex_positions"] = np.float32([0, 2, 0, 0.3, 2, 0, 0, 2, 0.3])
    params["faces"] = np.uint32([0, 1, 2])
    params.update()
    eyes = [(0, 0, 0), (0, 4, 0)]
    one, both = (nerg.attention(empty, mesh, eyes, two_sided=t).share for t in (False, True))
    assert (one > 0).sum() == 1 and (both > 0).all() and np.allclose(one[one > 0], both[one > 0])


@pytest.mark.parametrize(
    "surface, said",
    [
        ("nothing", 'the scene has no shape "nothing"; it has shape'),
        ("nothing.ply", 'there is no mesh "nothing.ply"'),
        ([(0, 0, 0), (1, 1, -1)], "a box is a lower corner and an upper one"),
        ([(0, 0, 0)], "a box is a lower corner and an upper one"),
        ({"type": "sphere"}, "is not a mesh; attention is received by meshes"),
        (object(), "the corners of a box must be numbers"),
    ],
)
def test06_what_is_no_surface(empty, surface, said):
    with pytest.raises(nerg.NergError, match=said):
        nerg.attention(empty, surface, (0, 0, 0))


def test07_errors_are_sentences(files, empty):
    with pytest.raises(nerg.NergError, match="needs a gaze field; give make_scene gaze="):
        nerg.attention(nerg.make_scene(files / "field.safetensors"), BOX, (0, 0, 0))
    for wrong in (0, 2.5, True):
        with pytest.raises(nerg.NergError, match="divisions must be a whole number from 1"):
            nerg.attention(empty, BOX, (0, 0, 0), divisions=wrong)
    with pytest.raises(nerg.NergError, match="no observer of its own"):
        nerg.attention(empty, BOX)


def test09_pieces_are_small_against_their_distance(empty):
    near, far = nerg.attention(empty, BOX, (0, 1.5, 0)), nerg.attention(empty, BOX, [(0, 0, 0), (0, -30, 0)])
    assert len(near.area) > len(far.area)
    finer = nerg.attention(empty, BOX, (0, 1.5, 0), divisions=32)
    assert np.isclose(near.share[0], finer.share[0], rtol=5e-3)
    assert len(nerg.attention(empty, BOX, np.mean(BOX, axis=0)).area) == 12 * 32**2


def test08_progress_is_told(empty):
    told = []

    class Reporter:
        def message(self, text): ...
        def warn(self, text): ...
        def progress(self, share, text=""):
            told.append(share)

    nerg.attention(empty, BOX, [(0, 0, 0), (0.1, 0, 0)], reporter=Reporter())
    assert told == [0.5, 1.0]
