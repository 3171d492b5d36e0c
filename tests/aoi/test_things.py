"""Areas as things: meshes, some of their faces, shapes of a scene."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.aoi.scene import scene_of, shape_named, shapes_of, thing_of_shape, things_of
from nerg_mi.errors import NergError
from nerg_mi.formats.areas import MeshPart, Region, SceneShape
from nerg_mi.rendering.scene import load_scene
from nerg_mi.surfaces.mesh import mitsuba_mesh

from .place import SIGN, STAND, write_place

TWO = "v 1 0 0\nv 1 1 0\nv 1 0 1\nv 3 0 0\nv 3 1 0\nv 3 0 1\nf 1 2 3\nf 4 5 6\n"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(write_place(tmp_path_factory.mktemp("place"), gaze=False), merge=False)


def test01_one_of_each(scene, tmp_path):
    (tmp_path / "two.obj").write_text(TWO)
    areas = [
        Region.of("box", *SIGN),
        MeshPart("both", tmp_path / "two.obj"),
        MeshPart("far", tmp_path / "two.obj", ((1, 1),)),
        SceneShape("stand", "stand"),
    ]
    things = things_of(areas, shapes_of(scene))
    assert [t.name for t in things] == ["box", "both", "far", "stand"] and [t.open for t in things] == [
        False,
        True,
        True,
        True,
    ]
    o, d = np.array([[0.0, 0.2, 0.2], [0, 1.5, 1.5]]), np.tile([1.0, 0, 0], (2, 1))
    near = np.array([t.interval(o, d)[0] for t in things])
    assert np.allclose(near[1:], [[1.0, np.inf], [3.0, np.inf], [np.inf, 2.5]])
    # The scene's shapes have their names still.
    assert set(shapes_of(scene)) == {"room", "sign", "stand"}


def test02_samples_lie_on_the_surface(scene, tmp_path):
    (tmp_path / "two.obj").write_text(TWO)
    both, stand = things_of([MeshPart("m", tmp_path / "two.obj"), SceneShape("stand", "stand")], shapes_of(scene))
    points, normals = both.samples(64)
    assert points.shape == (64, 3) and not normals.any()
    assert (np.isclose(points[:, 0], 1) | np.isclose(points[:, 0], 3)).all() and 20 < np.isclose(
        points[:, 0], 1
    ).sum() < 44
    points, _ = stand.samples(64)
    on = np.isclose(points, STAND[0], atol=1e-5) | np.isclose(points, STAND[1], atol=1e-5)
    assert on.any(axis=1).all() and (points > STAND[0] - 1e-5).all() and (points < STAND[1] + 1e-5).all()


def test03_a_sphere():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    ball = thing_of_shape("ball", mi.load_dict({"type": "sphere", "radius": 0.5, "center": [2, 0, 0]}))
    near, far = ball.interval(np.zeros((1, 3)), np.array([[1.0, 0, 0]]))
    assert near == pytest.approx(1.5) and far == near
    points, _ = ball.samples(50)
    assert np.allclose(np.linalg.norm(points - (2, 0, 0), axis=1), 0.5, atol=1e-5)


def test04_what_there_is_not(scene, tmp_path):
    with pytest.raises(NergError, match='"x"'):
        shape_named(shapes_of(scene), "x")
    with pytest.raises(NergError, match="give a scene"):
        shape_named(shapes_of(None), "x")
    with pytest.raises(NergError, match="there is no mesh"):
        things_of([MeshPart("m", tmp_path / "none.ply")], {})
    (tmp_path / "two.obj").write_text(TWO)
    with pytest.raises(NergError, match="face 2"):
        things_of([MeshPart("m", tmp_path / "two.obj", ((0, 2),))], {})


def test05_meshes_keep_their_names_in_a_scene():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mesh = mitsuba_mesh(np.eye(3), np.array([[0, 1, 2]]), "tri")
    before = mesh.id()
    assert len(scene_of({"tri": mesh}).shapes()) == 1 and mesh.id() == before
