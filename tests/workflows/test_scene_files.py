"""Cameras, observers and geometries of written scene files."""

from __future__ import annotations

import json

import numpy as np
import pytest

from nerg_mi.environment.environment import identify_file
from nerg_mi.environment.kinds import detect_kind
from nerg_mi.errors import NergError
from nerg_mi.figures.overview import PinholeFrame, SeenSurfaces
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.color import encode_srgb
from nerg_mi.maths.geometry import Similarity, intersect_box_numpy
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import GazeFiles, Lens, LookAt, SceneContent, SceneText, element, format_document
from nerg_mi.workflows.scene_cameras import (
    SceneProbe,
    check_point,
    find_best_camera,
    find_best_photo,
    find_eye,
    interpolate_walk,
    make_upright,
    probe_values,
    support_of_rays,
    to_scene_frame,
    turn_to_attention,
)
from nerg_mi.workflows.scene_environments import (
    InputFiles,
    PhotoCamera,
    colors_path,
    load_photo_camera,
    load_photo_cameras,
    recognise,
    write_scene_geometry,
)
from tests.formats.splats.writers import random_splats, write_inria
from tests.refusals import mentions
from tests.workflows.recorder import Recorder

# ---- Panoramas from which a camera is chosen: directions, depths and bounds of a known room ----


EYE = LookAt(np.array([0.3, -0.2, 0.1]), np.array([1.0, 0.6, 0.4]))


@pytest.fixture
def probe(rgb, tmp_path):
    """A cube of ±1, with +y up."""
    up = np.array([0.0, 1, 0])
    place = SceneContent(scene_children=(element("shape", type="cube"),))
    (tmp_path / "a.xml").write_text(SceneText(place, GazeFiles(), EYE, EYE, up).to_xml())
    return SceneProbe(load_scene(tmp_path / "a.xml", probe_values()), None, up)


def test_the_probe_measures_its_surroundings(probe):
    seen = probe.around(EYE)
    _, far = intersect_box_numpy(
        np.broadcast_to(EYE.origin, seen.directions.shape), seen.directions, -np.ones(3), np.ones(3)
    )
    assert seen.is_hit.all() and np.sum(seen.solid_angle) == pytest.approx(4 * np.pi)
    # Pixels are sampled at random positions, so directions vary by a few degrees.
    assert np.quantile(np.abs(seen.depth - far) / far, 0.95) < 0.08
    depth, opacity = probe.trace(EYE.origin[None], np.array([[1.0, 0, 0]]))
    assert depth[0] == pytest.approx(0.7) and opacity[0] == 1
    np.testing.assert_allclose(np.array(probe.bounds()), [[-1] * 3, [1] * 3], atol=1e-6)
    turned = turn_to_attention(EYE, seen)
    np.testing.assert_allclose(turned.origin, EYE.origin)
    assert np.abs(turned.target).max() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("depths, length", [((0, 0), 1), ((0, 4), 4), ((3, 5), 3)], ids=["within", "next to", "before"])
def test_observers_inside_matter_face_a_positive_distance(depths, length):
    """Their rays hit at once; the target is still in front of them, at a distance of hits in other directions."""
    directions = np.array([[0.6, 0.8, 0], *[[0, 0, 1.0]] * 3])
    depth = np.array([depths[0], *[depths[1]] * 3], float)
    seen = SeenSurfaces(EYE.origin, directions, depth, np.ones(4, bool), np.array([9.0, 0, 0, 0]), np.ones(4))
    np.testing.assert_allclose(turn_to_attention(EYE, seen).target, EYE.origin + length * directions[0])


def test_points_and_up_axes():
    assert check_point(None, "target") is None and check_point((1, 2, 3), "target").tolist() == [1, 2, 3]
    with pytest.raises(NergError, match="--to must be three numbers x,y,z, got"):
        check_point((1.0, 2.0), "--to")
    up = np.array([0.0, 0, 1])
    assert make_upright(EYE, up) is EYE
    down = make_upright(LookAt(np.zeros(3), np.array([0, 0, -2.0])), up)
    assert abs(down.up @ up) < 1e-9
    far = make_upright(LookAt(np.array([-1e7, 0, 1e7]), np.array([-1e7, 1.0, 1e7])), up)
    assert np.allclose(np.float32(far.target) - np.float32(far.origin), [0, 1000, 0])
    with pytest.raises(NergError, check=mentions("target")):
        make_upright(LookAt(np.ones(3), np.ones(3)), up)


def test_the_best_photo_is_selected(probe):
    # Of three cameras in the cube, one sees all of it, one a wall, and one looks out of it.
    poses = [((0.9, 0, 0), (1, 0, 0)), ((-0.9, 0.1, 0.1), (0, 0.1, 0.1)), ((3, 0, 0), (4, 0, 0))]
    views = [LookAt(np.array(o, float), np.array(t, float)) for o, t in poses]
    cameras = [PhotoCamera(str(k), eye, Lens(), False) for k, eye in enumerate(views)]
    assert find_best_photo(probe, None, cameras).name == "1"


@pytest.mark.parametrize("room", [False, True], ids=["a thing", "a room"])
def test_objects_are_viewed_from_outside_and_rooms_from_inside(rgb, tmp_path, room):
    """A cube with outward faces is an object, one with inward faces a room."""
    place = SceneContent(
        scene_children=(element("shape", element("boolean", name="flip_normals", value=str(room)), type="cube"),)
    )
    up = np.array([0.0, 0, 1])
    (tmp_path / "a.xml").write_text(SceneText(place, GazeFiles(), EYE, EYE, up).to_xml())
    probe = SceneProbe(load_scene(tmp_path / "a.xml", probe_values()), None, up)
    assert probe.within(np.array([[0, 0, 0], [0.9, -0.5, 0.3], [3, 0, 0], [0, 0, -1.1]])).tolist() == [
        not room,
        not room,
        False,
        False,
    ]
    shot = find_best_camera(probe, None, PinholeFrame(70, 1.5, up), None)
    assert (np.abs(shot.origin).max() < 1) == room and shot.surface_fraction > 0.2


# ---- Observers: participants at a time, walks, and the position with most rays ----


# Half as large, turned by 90 degrees about z, moved.
ALIGN = Similarity(np.array([[0, -0.5, 0, 1.0], [0.5, 0, 0, 2], [0, 0, 0.5, 3], [0, 0, 0, 1]]))


@pytest.fixture
def rays():
    t = np.array([0, 1, 2, 10, 11, 0.5])
    origin = np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1], [5, 0, 1], [6, 0, 1], [9, 9, 9]], float)
    direction = np.array([[1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1]], float)
    return Rays(t, [0, 0, 0, 0, 0, 1], ("Ada", "Bob", "Cy"), origin, direction, np.ones(6))


def test_the_nearest_ray_of_a_person(rays):
    eye, when = find_eye(rays, "Ada", 1.2, 0.5, ALIGN)
    assert when == 1
    np.testing.assert_allclose(eye.origin, [1, 2.5, 3.5])  # (1, 0, 1) turned is (0, 1, 1), half of it, moved
    np.testing.assert_allclose(eye.target - eye.origin, [-0.5, 0, 0])  # +y turned is -x, a metre is half a unit
    np.testing.assert_allclose(to_scene_frame([[1, 0, 1]], ALIGN)[0], eye.origin)


@pytest.mark.parametrize(
    "person, time, said",
    [
        ("Eve", 0, "Eve"),
        ("Cy", 0, "has no rays; choose another person"),
        ("Ada", 5.0, "s; increase max_gap to bridge longer pauses"),
    ],
)
def test_a_time_without_participants_is_refused(rays, person, time, said):
    with pytest.raises(NergError, match=said):
        find_eye(rays, person, time, 0.5, Similarity())


def test_a_walk_is_interpolated(rays):
    walk = interpolate_walk(rays, "Ada", 0, 2, 4, 1.0, Similarity())
    np.testing.assert_allclose(walk.times, np.arange(9) / 4)
    np.testing.assert_allclose([e.origin[0] for e in walk.eyes], np.arange(9) / 4)
    ahead = np.array([e.target - e.origin for e in walk.eyes])
    np.testing.assert_allclose(np.linalg.norm(ahead, axis=1), 1)
    np.testing.assert_allclose(ahead[2], np.array([1, 1, 0]) / np.sqrt(2))
    assert walk.missing == 0


def test_pauses_have_no_frames(rays):
    walk = interpolate_walk(rays, "Ada", 1, 12, 1, 1.0, Similarity())
    assert walk.times.tolist() == [1, 2, 10, 11, 12] and walk.missing == 7
    # Opposite directions have no mean.
    turned = interpolate_walk(rays, "Ada", 10, 11, 2, 1.0, Similarity())
    assert np.abs(turned.eyes[1].target - turned.eyes[1].origin).max() == 1
    with pytest.raises(NergError, match="within 1 s from 4 to 6 s"):
        interpolate_walk(rays, "Ada", 4, 6, 1, 1.0, Similarity())
    with pytest.raises(NergError, match="the earlier first"):
        interpolate_walk(rays, "Ada", 2, 1, 1, 1.0, Similarity())
    with pytest.raises(NergError, match="at most 100,000 frames"):
        interpolate_walk(rays, "Ada", 0, 11, 1e5, 1.0, Similarity())


def test_the_densest_viewpoint_is_selected():
    rng = np.random.default_rng(0)
    origin = np.concatenate([rng.normal((1, 2, 1.6), 0.1, (300, 3)), rng.normal((5, 5, 1.6), 0.1, (900, 3))])
    n = len(origin)
    rays = Rays(np.arange(n), np.zeros(n, int), ("a",), origin, np.tile([1.0, 0, 0], (n, 1)), np.ones(n))
    assert np.linalg.norm(support_of_rays(rays).find_densest_position() - (5, 5, 1.6)) < 0.15


# ---- Types of files by their content, and valid combinations ----


ONE = {"a": np.zeros(1, np.float32)}


def some_rays(hit):
    end = None if not hit else [[2.0, 0, 0]]
    return Rays([0.0], [0], ("a",), [[0.0, 0, 0]], [[1.0, 0, 0]], [1.0], end)


@pytest.fixture
def folder(tmp_path):
    write_checkpoint(tmp_path / "field.safetensors", "radiance", ONE, {"provenance": {"up": [0, 0, 1]}})
    place = {"field_file": identify_file(tmp_path / "field.safetensors")}
    align = np.diag([2.0, 2, 2, 1]).tolist()
    write_checkpoint(tmp_path / "gaze.safetensors", "gaze", ONE, {"provenance": {**place, "align": align}})
    write_checkpoint(tmp_path / "nowhere.safetensors", "gaze", ONE, {"provenance": {"geometry": "none"}})
    write_checkpoint(tmp_path / "odd.safetensors", "sound", ONE, {})
    some_rays(True).save(tmp_path / "hits.npz")
    some_rays(False).save(tmp_path / "rays.npz")
    for name in ("a.ply", "a.obj", "a.xml", "a.vol", "a.pth", "a.jpg"):
        (tmp_path / name).write_text("x")
    return tmp_path


def test_files_are_recognised_by_kind(folder):
    kinds = {
        "field.safetensors": "field",
        "gaze.safetensors": "gaze",
        "rays.npz": "rays",
        "a.ply": "mesh",
        "a.obj": "mesh",
        "a.xml": "scene",
        "a.vol": "hits",
    }
    assert {name: detect_kind(folder / name) for name in kinds} == kinds
    for name, said in (
        ("odd.safetensors", "contains a sound field; a scene can show"),
        ("a.pth", '"nerg import"'),
        ("a.jpg", "cannot be shown in a scene"),
        ("a.png", "there is no file"),
    ):
        with pytest.raises(NergError, match=said):
            detect_kind(folder / name)


def test_splats_are_a_field_and_a_mesh_is_not(folder):
    write_inria(folder / "place.ply", random_splats(3))
    recognised = recognise([folder / "place.ply", folder / "nowhere.safetensors"], None, Recorder())
    assert recognised.kind == "field" and recognised.field_metadata == {}
    place = write_scene_geometry(recognised, folder / "scene.xml")
    (volume,) = place.make(folder, {}).integrator_children
    assert place.words == "The Gaussian splats place.ply" and 'type="splats"' in format_document([volume], "h")
    assert detect_kind(folder / "a.ply") == "mesh"


def test_the_geometry_of_a_gaze_field_is_next_to_it(folder):
    recognised = recognise([folder / "gaze.safetensors"], None, Recorder())
    assert (recognised.kind, recognised.environment) == ("field", folder / "field.safetensors")
    assert recognised.align.scale == pytest.approx(2) and recognised.field_metadata["provenance"] == {"up": [0, 0, 1]}
    assert recognise([folder / "nowhere.safetensors"], None, Recorder()).kind == "none"
    (folder / "field.safetensors").rename(folder / "moved.safetensors")
    with pytest.raises(NergError, match="which the field was trained in, does not exist;"):
        recognise([folder / "gaze.safetensors"], None, Recorder())
    recorder = Recorder()
    recognised = recognise([folder / "gaze.safetensors", folder / "moved.safetensors"], None, recorder)
    assert recognised.environment == folder / "moved.safetensors" and not recorder.warnings


@pytest.mark.parametrize("geometry", ["hits", "none"])
@pytest.mark.parametrize("gaze", ["gaze", "nowhere"])
def test_a_gaze_field_is_not_shown_in_another_geometry(folder, gaze, geometry):
    with pytest.raises(NergError, match=f'^geometry .*"{folder}/{gaze}.safetensors" is shown .* leave it out$'):
        recognise([folder / f"{gaze}.safetensors", folder / "hits.npz"], geometry, Recorder())


def test_another_geometry_causes_a_warning(folder):
    for gaze, said in (("gaze", "was not trained in"), ("nowhere", "without geometry")):
        recorder = Recorder()
        recognise([folder / "a.ply", folder / f"{gaze}.safetensors"], None, recorder)
        assert said in recorder.warnings[0]


def test_rays_alone_have_hit_points_or_no_geometry(folder):
    kind = lambda name, geometry=None: recognise([folder / name], geometry, Recorder()).kind
    assert (kind("hits.npz"), kind("rays.npz"), kind("hits.npz", "none")) == ("hits", "none", "none")


def test_wrong_provenance_is_refused(folder):
    cases = (
        ({"field_file": {"file": "a.ply", "sha256": "0"}}, "is not the file that"),
        ({}, "does not store the geometry"),
    )
    for provenance, said in cases:
        write_checkpoint(folder / "b.safetensors", "gaze", ONE, {"provenance": json.loads(json.dumps(provenance))})
        with pytest.raises(NergError, match=said):
            recognise([folder / "b.safetensors"], None, Recorder())


# ---- The camera of a photo, against the pose in its file, in the coordinates in which a field was trained ----


POSE = np.array([[1, 0, 0, 0.5], [0, 0, -1, -3], [0, 1, 0, 1.2], [0, 0, 0, 1]], float)  # looks along +y, up is +z


@pytest.fixture
def photos(rgb, tmp_path):
    frames = []
    for k in range(3):
        rgb.Bitmap(np.full((20, 30, 3), 99, np.uint8)).write(str(tmp_path / f"p{k}.png"))
        pose = POSE.copy()
        pose[0, 3] += k
        frames.append({"file_path": f"p{k}.png", "transform_matrix": pose.tolist()})
    lens = {"w": 30, "h": 20, "fl_x": 25.0, "fl_y": 25.0, "cx": 12.0, "cy": 11.0}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return tmp_path


@pytest.mark.parametrize("photo", ["1", "p1", "p1.png"])
def test_pose_and_lens_of_a_photo_are_read(photos, photo):
    camera = load_photo_camera(photos, photo, {})
    assert camera.name == "p1.png" and not camera.has_distortion
    np.testing.assert_allclose(camera.eye.origin, [1.5, -3, 1.2])
    np.testing.assert_allclose(camera.eye.target - camera.eye.origin, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(camera.eye.up, [0, 0, 1], atol=1e-12)
    assert camera.lens.fov == pytest.approx(np.degrees(2 * np.arctan(15 / 25)))
    assert camera.lens.aspect == pytest.approx(1.5)
    assert camera.lens.offset == pytest.approx((0.1, -0.05))


def test_photo_cameras_are_in_training_coordinates(photos):
    # The field is twice as large as the file, and moved.
    to_file = np.diag([0.5, 0.5, 0.5, 1.0])
    to_file[:3, 3] = -1
    metadata = {"sha256": file_sha256(photos / "transforms.json"), "to_file": to_file.tolist()}
    camera = load_photo_camera(photos, "0", metadata)
    np.testing.assert_allclose(to_file[:3, :3] @ camera.eye.origin + to_file[:3, 3], POSE[:3, 3])
    np.testing.assert_allclose(camera.eye.target - camera.eye.origin, [0, 1, 0], atol=1e-12)


def test_photos_without_a_pose_are_refused(photos):
    with pytest.raises(NergError, match="give the photos of its training with photos"):
        load_photo_camera(photos, "0", {"sha256": "0" * 64})
    for photo in ("3", "p9", "-1"):
        with pytest.raises(NergError, match='photo.*0.*2.*"p0.png"'):
            load_photo_camera(photos, photo, {})


def test_all_photo_cameras_are_loaded(photos):
    assert [c.name for c in load_photo_cameras(photos, {})] == ["p0.png", "p1.png", "p2.png"]
    assert [c.name for c in load_photo_cameras(photos, {}, max_count=2)] == ["p0.png", "p2.png"]
    for k, camera in enumerate(load_photo_cameras(photos, {})):
        np.testing.assert_array_equal(camera.eye.origin, load_photo_camera(photos, str(k), {}).eye.origin)


# ---- Geometries as parts of a scene: colours of meshes, and files of other types ----


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
{colors}
element face 1
property list uchar int vertex_indices
end_header
0 0 0 {a}
1 0 0 {a}
0 1 0 {a}
3 0 1 2
"""


def write_input(path, kind):
    return InputFiles(path, kind, None, None, {}, {})


def text_of(folder, path, kind, center="eye"):
    place = write_scene_geometry(write_input(path, kind), folder / "out.xml").make(folder, center)
    return place, format_document([*place.integrator_children, *place.scene_children], "h")


@pytest.mark.parametrize(
    "names, values, said",
    [
        ("", "", 'name="reflectance" value="0.5"'),
        ("rgb", "0.2 0.4 0.6", 'value="vertex_color"'),
        (("color_0", "color_1", "color_2"), "0.2 0.4 0.6", 'value="vertex_color"'),
    ],
    ids=["grey", "rgb", "of Mitsuba"],
)
def test_vertex_colours_of_a_mesh_are_used(rgb, tmp_path, names, values, said):
    colors = "\n".join(f"property float {name}" for name in names) or "comment grey"
    (tmp_path / "a.ply").write_text(PLY.format(colors=colors, a=values))
    place, text = text_of(tmp_path, tmp_path / "a.ply", "mesh")
    assert said in text
    assert place.files == {"place": "out.mesh.ply"} and 'name="headlight"' in text and "<emitter" not in text


@pytest.mark.parametrize(
    "name, text",
    [
        (
            "a.ply",
            PLY.format(
                colors="property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha",
                a="51 102 153 9",
            ),
        ),
        (
            "a.ply",
            PLY.format(colors="property float r\nproperty float g\nproperty float b", a="51 102 153").replace(
                "3 0 1 2", "4 0 1 2 0"
            ),
        ),
        ("a.ply", PLY.format(colors="property uchar red\nproperty uchar green\nproperty uchar blue", a="51 102 153")),
        ("a.obj", "".join(f"v {p} 0.2 0.4 0.6\n" for p in ("0 0 0", "1 0 0", "0 1 0")) + "f -3 -2 -1"),
        ("a.obj", "".join(f"v {p} 51 102 153\n" for p in ("0 0 0", "1 0 0", "0 1 0")) + "f 1 2 \\\n3"),
    ],
    ids=["RGBA", "quads", "RGB", "negative", "continued"],
)
def test_a_mesh_that_mitsuba_cannot_show_is_converted(rgb, tmp_path, name, text):
    (tmp_path / name).write_text(text)
    written = write_scene_geometry(write_input(tmp_path / name, "mesh"), tmp_path / "out.xml")
    place, xml = text_of(tmp_path, tmp_path / name, "mesh")
    assert written.files == (tmp_path / "out.mesh.ply",) and place.files == {"place": "out.mesh.ply"}
    assert '"vertex_color"' in xml and 'type="ply"' in xml
    params = rgb.traverse(rgb.load_dict({"type": "ply", "filename": str(tmp_path / "out.mesh.ply")}))
    shown = np.array(params["vertex_color"]).reshape(-1, 3)
    assert np.allclose(encode_srgb(shown), (0.2, 0.4, 0.6), atol=1e-6)
    assert np.array(params["faces"])[:3].tolist() == [0, 1, 2]


def test_the_input_mesh_is_not_overwritten(tmp_path):
    text = PLY.format(colors="comment grey", a="").replace("3 0 1 2", "4 0 1 2 0")
    (tmp_path / "out.mesh.ply").write_text(text)
    with pytest.raises(NergError, match="another name"):
        write_scene_geometry(write_input(tmp_path / "out.mesh.ply", "mesh"), tmp_path / "out.xml")
    assert (tmp_path / "out.mesh.ply").read_text() == text


@pytest.mark.parametrize("shape", [(1, 6, 8), (6, 1, 8), (6, 8, 1), (2, 2, 2), (1, 1, 1)])
def test_hit_points_of_one_cell_are_shaded(tmp_path, shape):
    write_volume(tmp_path / "a.vol", np.full(shape, 100.0), (0, 0, 0), (1, 1, 1))
    write_scene_geometry(write_input(tmp_path / "a.vol", "hits"), tmp_path / "out.xml")
    colors = np.fromfile(colors_path(tmp_path / "out.xml"), "<f4", offset=48)
    assert np.isfinite(colors).all() and (colors > 0.1).all()
    if shape.count(1) == 1:
        # The normal of a sheet is along the axis in which it has no extent.
        assert np.allclose(colors, [0.55, 0.16, 0.34][shape.index(1)], atol=0.02)


def test_an_error_about_splats_names_their_file(tmp_path):
    splats = random_splats(degree=0)
    splats.centers[0] = np.nan
    write_inria(tmp_path / "a.ply", splats)
    with pytest.raises(NergError, match=r'"[^"]*a\.ply" cannot be read: some of the centers'):
        write_scene_geometry(write_input(tmp_path / "a.ply", "field"), tmp_path / "out.xml")


def test_coloured_hit_points_are_written_next_to_the_scene(rgb, tmp_path):
    density = np.zeros((6, 8, 10), np.float32)
    density[2:4] = 100
    write_volume(tmp_path / "a.vol", density, (0, 0, 0), (1, 0.8, 0.6))
    place, text = text_of(tmp_path, tmp_path / "a.vol", "hits")
    assert place.files == {"density": "a.vol", "color": "out.color.vol"} and '"nearest"' not in text
    colors = rgb.load_dict({"type": "gridvolume", "filename": str(colors_path(tmp_path / "out.xml")), "raw": True})
    assert tuple(np.array(rgb.traverse(colors)["data"]).shape) == (3, 4, 5, 3)
    write_volume(tmp_path / "rgb.vol", np.zeros((2, 2, 2, 3)), (0, 0, 0), (1, 1, 1))
    with pytest.raises(NergError, match="is not a volume of hit points; give one that"):
        write_scene_geometry(write_input(tmp_path / "rgb.vol", "hits"), tmp_path / "out.xml")


def test_without_geometry_the_scene_is_a_sphere(tmp_path):
    place, text = text_of(tmp_path, None, "none")
    assert 'name="center" value="$eye"' in text and 'name="radius" value="2"' in text and not place.files
