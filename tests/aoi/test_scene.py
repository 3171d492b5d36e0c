"""Tests of `nerg_mi.aoi.scene`."""

from __future__ import annotations

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.aoi.scene import (
    aoi_from_shape,
    apply_to_areas,
    apply_to_scene,
    find_shape,
    load_gaze_scene,
    make_aois,
    read_changes,
    read_cohorts,
    read_meshes,
    scene_from_shapes,
    shapes_by_id,
)
from nerg_mi.errors import NergError
from nerg_mi.files.tables import write_csv
from nerg_mi.formats.areas import AreaGroup, AreaSet, MeshPart, Region, SceneShape
from nerg_mi.maths.geometry import Similarity
from nerg_mi.rendering.scene import load_scene
from nerg_mi.transport.mitsuba_mesh import make_mesh

from .place import SIGN, STAND, first_box, people, write_place

# ---- Changes ----


@pytest.fixture(scope="module")
def scene_changes(tmp_path_factory):
    return load_scene(write_place(tmp_path_factory.mktemp("place"), gaze=False), merge=False)


def written(tmp_path, **changes):
    (tmp_path / "c.json").write_text(json.dumps(changes))
    return read_changes(tmp_path / "c.json")


def change(scene, tmp_path, **changes):
    """Return the changed scene and its shapes."""
    made = written(tmp_path, **changes)
    return apply_to_scene(scene, made, read_meshes(made.meshes))


def aois(areas, shapes):
    return make_aois(areas, shapes, read_meshes(AreaSet(tuple(areas)).meshes))


def cast(scene, o, d):
    import mitsuba as mi

    ray = mi.Ray3f(mi.Point3f(*map(float, o)), mi.Vector3f(*map(float, d)))
    return float(np.array(scene.ray_intersect_preliminary(ray).t).ravel()[0])


EYE, EAST = (1.0, 1.6, 1.6), (1.0, 0, 0)


def test_shapes_are_moved_and_rotated(scene_changes, tmp_path):
    assert cast(scene_changes, EYE, EAST) == pytest.approx(1.5)
    moved, shapes = change(scene_changes, tmp_path, move=[{"shape": "stand", "by": [0.3, 0, 0]}])
    assert cast(moved, EYE, EAST) == pytest.approx(1.8, abs=1e-5) and set(shapes) == {"room", "sign", "stand"}
    # A quarter turn about its centre: 0.4 x 1 m become 1 x 0.4 m.
    turned, _ = change(scene_changes, tmp_path, move=[{"shape": "stand", "turn": 90}])
    assert cast(turned, EYE, EAST) == pytest.approx(2.7 - 0.5 - 1.0, abs=1e-5)
    assert cast(turned, (1.0, 1.9, 1.6), EAST) == pytest.approx(3.0, abs=1e-5)
    # The original scene and the names of its shapes are unchanged.
    assert cast(scene_changes, EYE, EAST) == pytest.approx(1.5)
    assert {s.id() for s in scene_changes.shapes()} == {"room", "sign", "stand"}


def test_shapes_are_removed_added_and_swapped(scene_changes, tmp_path):
    removed, shapes = change(scene_changes, tmp_path, remove=["stand"])
    assert cast(removed, EYE, EAST) == pytest.approx(3.0) and "stand" not in shapes
    wall = {"name": "wall", "min": [2, 0, 0], "max": [2.1, 4, 3]}
    added, shapes = change(scene_changes, tmp_path, add=[wall])
    assert cast(added, EYE, EAST) == pytest.approx(1.0) and cast(added, (2.05, 1, 1), EAST) == pytest.approx(
        0.05, abs=1e-5
    )
    swapped, _ = change(scene_changes, tmp_path, swap=[wall | {"shape": "stand"}])
    assert cast(swapped, EYE, EAST) == pytest.approx(1.0)
    (tmp_path / "tri.obj").write_text("v 2.2 0 0\nv 2.2 4 0\nv 2.2 2 9\nf 1 2 3\n")
    mesh, _ = change(scene_changes, tmp_path, swap=[{"shape": "stand", "mesh": "tri.obj"}])
    assert cast(mesh, EYE, EAST) == pytest.approx(1.2)


def test_areas_follow_shapes(tmp_path):
    box = Region.create("shelf", *SIGN)
    areas = AreaSet(
        (box, SceneShape("stand", "stand"), AreaGroup("all", ("shelf", "stand")), AreaGroup("g", ("stand",)))
    )
    result = apply_to_areas(
        areas, written(tmp_path, move=[{"area": "shelf", "by": [1, 0, 0], "turn": 90}], remove=["stand"])
    )
    assert result.names == ("shelf", "all") and result.element_indices()["all"] == (0,)
    assert np.allclose(result.boxes[0].bounds, [[4.6, 1.9, 1.0], [5.6, 2.1, 2.0]])
    options = apply_to_areas(areas, written(tmp_path, add=[{"name": "x", "min": [0, 0, 0], "max": [1, 1, 1]}]))
    assert options.areas[-1] == SceneShape("x", "x")
    for wrong in ("stand", "nobody"):
        with pytest.raises(NergError, match="cannot be moved as an area"):
            apply_to_areas(areas, written(tmp_path, move=[{"area": wrong}]))


def test_observers_are_changed(tmp_path):
    result = written(tmp_path, observers=[[1, 2, 3]], shift=[0, 0, -0.5])
    assert (
        result.observers.tolist() == [[1, 2, 3]] and result.shift.tolist() == [0, 0, -0.5] and not result.changes_shapes
    )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"remove": ["nobody"]}, 'no shape "nobody"'),
        ({"move": [{"shape": "nobody"}]}, 'no shape "nobody"'),
        ({"remove": ["sign"], "move": [{"shape": "sign"}]}, "both moved and removed"),
        ({"add": [{"name": "sign", "min": [0, 0, 0], "max": [1, 1, 1]}]}, "already"),
        ({"remove": ["sign", "stand", "room"]}, "keep at least one"),
    ],
)
def test_invalid_changes_are_refused(scene_changes, tmp_path, changes, said):
    with pytest.raises(NergError, match=said):
        change(scene_changes, tmp_path, **changes)


def test_changes_need_a_scene(tmp_path):
    with pytest.raises(NergError, match="need a scene"):
        change(None, tmp_path, remove=["sign"])


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"mvoe": []},
        {"move": []},
        {"move": 3},
        {"move": [3]},
        {"move": [{"by": [1, 0, 0]}]},
        {"move": [{"shape": "a", "area": "b"}]},
        {"move": [{"shape": "a", "by": [1, 0]}]},
        {"move": [{"shape": "a", "by": [1, 0, 1e300]}]},
        {"move": [{"shape": "a", "turn": "x"}]},
        {"move": [{"shape": "a", "spin": 1}]},
        {"remove": [3]},
        {"remove": [""]},
        {"add": [{"min": [0, 0, 0], "max": [1, 1, 1]}]},
        {"add": [{"name": "a"}]},
        {"add": [{"name": "a", "mesh": "../a.ply"}]},
        {"add": [{"name": "a", "mesh": "/a.ply"}]},
        {"add": [{"name": "a", "mesh": "a.stl"}]},
        {"swap": [{"name": "a", "mesh": "a.ply"}]},
        {"observers": [[1, 2]]},
        {"shift": [1, 2, None]},
    ],
)
def test_malformed_changes_are_refused(tmp_path, changes):
    with pytest.raises(NergError) as texts:
        written(tmp_path, **changes)
    assert str(tmp_path) in str(texts.value) and "\n" not in str(texts.value)


# ---- Cohorts ----


def test_cohorts_are_read(tmp_path):
    (tmp_path / "c.csv").write_text("cohort;person\nold;Ada\nyoung;Bo\nold;Ada\n")
    assert read_cohorts(tmp_path / "c.csv") == {"Ada": "old", "Bo": "young"}


def test_cohorts_of_participants_and_remedies_of_their_table(tmp_path):
    (tmp_path / "c.csv").write_text("Participant,Cohort\nAda,old\n")
    assert read_cohorts(tmp_path / "c.csv") == {"Ada": "old"}
    (tmp_path / "c.csv").write_text("person,kind\nAda,old\n")
    with pytest.raises(NergError, match="no column cohort; .*person, kind") as error:
        read_cohorts(tmp_path / "c.csv")
    assert "columns" not in error.value.parameters
    (tmp_path / "c.csv").write_text("person,cohort\nAda,old,x\n")
    with pytest.raises(NergError, match="line 2: 3 cells") as error:
        read_cohorts(tmp_path / "c.csv")
    assert "skip_bad_lines" not in error.value.parameters


def test_cohort_names_survive_a_round_trip(tmp_path):
    cohorts = {"=Ada": "-old", "@Bo": "+young", "'Cy": "old", "'=Di": "-1"}
    write_csv(tmp_path / "c.csv", [{"person": k, "cohort": v} for k, v in cohorts.items()])
    assert read_cohorts(tmp_path / "c.csv") == cohorts


def test_rows_without_a_cohort_are_in_none(tmp_path):
    (tmp_path / "c.csv").write_text("sep=;\nperson;cohort\nAda;old\nBo;\n;young\n;\n")
    assert read_cohorts(tmp_path / "c.csv") == {"Ada": "old"}
    (tmp_path / "c.csv").write_text("person,cohort\nBo,\n")
    with pytest.raises(NergError, match="no participants"):
        read_cohorts(tmp_path / "c.csv")


def test_cohorts_of_ids_and_names_in_another_form(tmp_path):
    (tmp_path / "c.csv").write_text("person,cohort\n1.0,o\u0308ld\nJo\u0308rg,young\n", "utf-8")
    assert read_cohorts(tmp_path / "c.csv") == {"1": "\u00f6ld", "J\u00f6rg": "young"}


@pytest.mark.parametrize(
    "text", ["person,cohort\n", "person,group\nAda,old\n", "person,cohort\nAda,old\nAda,young\n", ""]
)
def test_invalid_cohorts_are_refused(tmp_path, text):
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(NergError, match=r"c\.csv"):
        read_cohorts(tmp_path / "c.csv")


# ---- Surfaces, gaze fields and frames ----


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("place")
    write_place(made)
    (made / "bare").mkdir()
    write_place(made / "bare", gaze=False)
    return made


def test_depths_match_the_shapes(folder):
    around = load_gaze_scene(folder / "bare" / "scene.xml", None, None, None, ns)
    rays = people()
    expected = [first_box(o, d)[1] for o, d in zip(rays.origin, rays.direction)]
    assert np.allclose(around.trace_depth(rays.origin, rays.direction), expected, rtol=1e-4) and around.gaze is None
    assert np.allclose(around.bounds(), [[0, 0, 0], [6, 4, 3]], atol=1e-5)


def test_gaze_field_of_the_scene_or_of_a_file(folder):
    d = np.array([[1.0, 0, 0], [0, 1, 0]])
    subset = load_gaze_scene(folder / "scene.xml", None, None, None, ns)
    beside = load_gaze_scene(folder / "bare" / "scene.xml", None, folder / "gaze.safetensors", None, ns)
    eye = np.array([1.0, 1.0, 1.5])
    result, other = subset.query_from(eye)(d), beside.query_from(eye)(d)
    assert result[0].shape == (1, 2) and np.allclose(result[0], other[0], rtol=1e-4)
    assert np.allclose(result[1], subset.trace_depth(np.broadcast_to(eye, d.shape), d)) and np.allclose(
        result[1], other[1]
    )
    assert np.isnan(subset.support_at(eye))


def test_frames(folder):
    matrix = np.diag([2.0, 2, 2, 1])
    matrix[:3, 3] = 1, 0, 0
    around = load_gaze_scene(folder / "scene.xml", None, None, Similarity(matrix), ns)
    assert around.scale == pytest.approx(2) and np.allclose(around.transform_points(np.ones(3)), [3, 2, 2])
    assert np.allclose(around.transform_directions(np.array([0, 0, 1.0])), [0, 0, 1])


def test_scene_without_geometry(folder):
    around = load_gaze_scene(None, None, None, None, ns)
    assert np.isinf(around.trace_depth(np.zeros((3, 3)), np.eye(3))).all()
    with pytest.raises(NergError, match="bounds of the scene"):
        around.bounds()


def test_two_geometries_are_refused(folder):
    with pytest.raises(NergError, match="both define the geometry"):
        load_gaze_scene(folder / "scene.xml", folder / "field.safetensors", None, None, ns)
    (folder / "empty.xml").write_text('<scene version="3.0.0"><integrator type="path"/></scene>')
    with pytest.raises(NergError, match="neither shapes nor a radiance field"):
        load_gaze_scene(folder / "empty.xml", None, None, None, ns)


# ---- AOI geometry ----

TWO = "v 1 0 0\nv 1 1 0\nv 1 0 1\nv 3 0 0\nv 3 1 0\nv 3 0 1\nf 1 2 3\nf 4 5 6\n"


@pytest.fixture(scope="module")
def scene_things(tmp_path_factory):
    return load_scene(write_place(tmp_path_factory.mktemp("place"), gaze=False), merge=False)


def test_aois_of_each_kind(scene_things, tmp_path):
    (tmp_path / "two.obj").write_text(TWO)
    areas = [
        Region.create("box", *SIGN),
        MeshPart("both", tmp_path / "two.obj"),
        MeshPart("far", tmp_path / "two.obj", ((1, 1),)),
        SceneShape("stand", "stand"),
    ]
    made = aois(areas, shapes_by_id(scene_things))
    assert [t.name for t in made] == ["box", "both", "far", "stand"] and [t.is_surface for t in made] == [
        False,
        True,
        True,
        True,
    ]
    o, d = np.array([[0.0, 0.2, 0.2], [0, 1.5, 1.5]]), np.tile([1.0, 0, 0], (2, 1))
    near = np.array([t.intersect(o, d)[0] for t in made])
    assert np.allclose(near[1:], [[1.0, np.inf], [3.0, np.inf], [np.inf, 2.5]])
    # The shapes of the scene keep their names.
    assert set(shapes_by_id(scene_things)) == {"room", "sign", "stand"}


def test_sample_points_lie_on_the_surface(scene_things, tmp_path):
    (tmp_path / "two.obj").write_text(TWO)
    both, stand = aois([MeshPart("m", tmp_path / "two.obj"), SceneShape("stand", "stand")], shapes_by_id(scene_things))
    points, normals = both.sample_points(64)
    assert points.shape == (64, 3) and not normals.any()
    assert (np.isclose(points[:, 0], 1) | np.isclose(points[:, 0], 3)).all() and 20 < np.isclose(
        points[:, 0], 1
    ).sum() < 44
    points, _ = stand.sample_points(64)
    on = np.isclose(points, STAND[0], atol=1e-5) | np.isclose(points, STAND[1], atol=1e-5)
    assert on.any(axis=1).all() and (points > STAND[0] - 1e-5).all() and (points < STAND[1] + 1e-5).all()


def test_sphere_aoi():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    ball = aoi_from_shape("ball", mi.load_dict({"type": "sphere", "radius": 0.5, "center": [2, 0, 0]}))
    near, far = ball.intersect(np.zeros((1, 3)), np.array([[1.0, 0, 0]]))
    assert near == pytest.approx(1.5) and far == near
    points, _ = ball.sample_points(50)
    assert np.allclose(np.linalg.norm(points - (2, 0, 0), axis=1), 0.5, atol=1e-5)


def test_missing_shapes_and_faces_are_refused(scene_things, tmp_path):
    with pytest.raises(NergError, match='"x"'):
        find_shape(shapes_by_id(scene_things), "x")
    with pytest.raises(NergError, match="use a scene"):
        find_shape(shapes_by_id(None), "x")
    with pytest.raises(NergError, match="there is no mesh"):
        aois([MeshPart("m", tmp_path / "none.ply")], {})
    (tmp_path / "two.obj").write_text(TWO)
    with pytest.raises(NergError, match="face 2"):
        aois([MeshPart("m", tmp_path / "two.obj", ((0, 2),))], {})


def test_meshes_keep_their_names_in_a_scene():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    mesh = make_mesh(np.eye(3), np.array([[0, 1, 2]]), "tri")
    before = mesh.id()
    assert len(scene_from_shapes({"tri": mesh}).shapes()) == 1 and mesh.id() == before
