"""The table in a room: layout, cameras, photos with exact depth, and the capture."""

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from nerg_mi.scenes.tabletop import cameras, denoising, layout, make, mesh, photos, sparse, stage, table  # noqa: E402
from nerg_mi.scenes.tabletop import textures as t  # noqa: E402

from nerg_mi.photos.cameras import pixel_directions, project  # noqa: E402
from nerg_mi.photos.dataset import open_dataset  # noqa: E402


@pytest.fixture(scope="module")
def place():
    return layout.build_tabletop(0)


@pytest.fixture(scope="module")
def scene(place):
    mi.set_variant("llvm_ad_rgb")
    return stage.load_stage(place)


@pytest.fixture(scope="module")
def capture(place, scene, tmp_path_factory):
    """The folder of a tiny capture, and its photos."""
    folder = tmp_path_factory.mktemp("tabletop")
    taken = photos.take_photos(scene, cameras.make_cameras(0, 6, 32, 24), spp=4, log=lambda text: None)
    photos.write_photos(taken, folder)
    sparse.write_colmap(taken, folder / "sparse" / "0")
    return folder, taken


# ------------------------------------------------------------------- layout


def test_layout_is_deterministic_and_varies_with_the_seed(place):
    again, other = layout.build_tabletop(0), layout.build_tabletop(1)
    assert set(place.meshes) == set(layout.MATERIALS)
    for name, made in place.meshes.items():
        assert all(np.array_equal(a, b) for a, b in zip(made, again.meshes[name])), name
    assert not np.array_equal(place.meshes["books"].points, other.meshes["books"].points)
    # furniture is fixed
    assert np.array_equal(place.meshes["sofa"].points, other.meshes["sofa"].points)


def test_meshes_are_sound(place):
    for name, m in place.meshes.items():
        assert m.normals.shape == m.points.shape and len(m.uv) == len(m.points), name
        assert np.isfinite(m.points).all() and np.isfinite(m.uv).all() and m.faces.max() < len(m.points), name


def test_scene_has_near_and_far_objects(place):
    far = lambda name: np.linalg.norm(place.meshes[name].points[:, :2] - table.OBJECT_CENTER[:2], axis=1)
    assert far("vase").min() < 0.1 and far("facade").min() > 15 and 150 < far("facade").max() < 250


@pytest.mark.parametrize("name", layout.MATERIALS)
def test_paints_are_bitmaps(name):
    paint = np.asarray(layout.MATERIALS[name].paint(layout.make_random_stream(0, name)))
    assert paint.ndim == 3 and paint.shape[2] == 3 and -0.01 < paint.min() and paint.max() < 1.6


def test_noise_fills_its_range_and_has_no_seam():
    n = t.make_noise(np.random.default_rng(0), (64, 96), (4, 6))
    assert n.shape == (64, 96) and n.min() < 0.1 and n.max() > 0.9
    steps = np.abs(np.diff(n, axis=0))
    assert np.abs(n[0] - n[-1]).max() < 1.5 * steps.max()


def test_a_box_is_closed_and_turns_about_its_middle():
    made = mesh.MeshBuilder()
    made.add_box("x", (1, 2, 3), (2, 4, 4), yaw=np.pi / 2)
    (box,) = made.join_meshes().values()
    assert np.allclose(box.points.min(axis=0), (0.5, 2.5, 3)) and np.allclose(box.points.max(axis=0), (2.5, 3.5, 4))
    a, b, c = np.moveaxis(box.triangles, 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(2 * (2 + 1 + 2))


# ------------------------------------------------------------------ cameras


def test_cameras_walk_around_the_object_and_see_it():
    walk = cameras.make_cameras(0)
    assert len(walk) == 64 and [c.intrinsics.width for c in walk[:5]] == [320, 320, 320, 320, 240]
    for camera in walk:
        (at,), (shown,) = project(table.OBJECT_CENTER[None], camera)
        i = camera.intrinsics
        assert shown and 0.25 < at[0] / i.width < 0.75 and 0.2 < at[1] / i.height < 0.95
        assert 0.9 < np.linalg.norm(camera.center - table.OBJECT_CENTER) < 2.2
    angles = np.sort([np.arctan2(*(c.center - table.OBJECT_CENTER)[[1, 0]]) for c in walk])
    assert np.diff(angles).max() < np.radians(25)


def test_look_at_is_upright_and_rolls():
    pose = cameras.look_at((2, 0, 1), (0, 0, 1))
    assert np.allclose(pose[:3, :3].T, [(0, 1, 0), (0, 0, 1), (1, 0, 0)])
    assert np.allclose(cameras.look_at((2, 0, 1), (0, 0, 1), np.pi / 2)[:3, 0], (0, 0, 1))


# ------------------------------------------------------------------- photos


def nearest(origin, direction, triangles):
    """Distance to the nearest of ``triangles`` (F, 3, 3) along a ray (Möller and Trumbore 1997), in float64."""
    a, u, v = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        h = np.cross(direction, v)
        inverse = 1 / np.einsum("ij,ij->i", u, h)
        s = origin - a
        q = np.cross(s, u)
        b, c, t = (
            inverse * np.einsum("ij,ij->i", s, h),
            inverse * (q @ direction),
            inverse * np.einsum("ij,ij->i", v, q),
        )
        hit = (b >= 0) & (c >= 0) & (b + c <= 1) & (t > 1e-6)
    return t[hit].min() if hit.any() else 0.0


@pytest.mark.nightly
def test_depth_is_that_of_the_triangles(place, capture):
    triangles = place.triangles
    for photo in capture[1][:3]:
        directions = pixel_directions(photo.camera.intrinsics) @ photo.camera.to_world[:3, :3].T
        h, w = photo.depth.shape
        for y, x in [(h // 2, w // 2), (1, w // 2), (h // 3, 2), (h - 2, w - 3)]:
            exact = nearest(photo.camera.center, directions[y, x], triangles)
            assert photo.depth[y, x] == pytest.approx(exact, rel=2e-5, abs=1e-4)


def test_photos_look_past_the_table(capture):
    depth = np.concatenate([p.depth.ravel() for p in capture[1]])
    assert np.mean((depth == 0) | (depth > 2.5)) > 0.4 and depth.max() > 25
    for photo in capture[1]:
        assert 60 < photo.pixels.mean() < 200 and np.mean(photo.pixels == 255) < 0.2


def test_denoising_keeps_what_is_painted():
    rng = np.random.default_rng(0)
    paint = rng.uniform(0.1, 0.8, (24, 32, 3)).astype(np.float32)
    y, x = np.mgrid[:24, :32] / 10.0
    wall = np.stack([x, 0 * x, y], axis=-1)
    guides = np.concatenate([paint, np.broadcast_to((0, 1, 0), wall.shape), wall], axis=-1)
    truth = 0.5 * paint
    noisy = truth * rng.gamma(10, 1 / 10, (24, 32, 1))
    error = np.abs(denoising.denoise(noisy, guides, paint) - truth).mean()
    assert error < 0.25 * np.abs(noisy - truth).mean()
    # pixels without albedo, such as sky, are unchanged
    assert np.array_equal(denoising.denoise(noisy, 0 * guides, paint), noisy.astype(np.float32))


# ------------------------------------------------------------------ capture


def test_the_capture_is_read_back(capture):
    folder, taken = capture
    for source, depth in ((folder, False), (folder / photos.DEPTH_FILE, True)):
        data = open_dataset(source)
        views = sorted([*data.train, *data.held_out], key=lambda v: v.name)
        assert len(data.held_out) == 1 and len(views) == len(taken) and not data.unused
        for view, photo in zip(views, taken):
            assert np.allclose(view.camera.to_world, photo.camera.to_world, atol=1e-9)
            assert view.camera.intrinsics == photo.camera.intrinsics and np.array_equal(view.pixels, photo.pixels)
            assert np.array_equal(view.depth, photo.depth) if depth else view.depth is None


def test_points_are_triangulated_where_surfaces_are(scene):
    """From photos of the albedo only, which are fast to render."""
    photographer = photos.TabletopPhotographer(scene)
    walk = cameras.make_cameras(0, 96, 160, 120)[34:40]
    taken = [
        photos.Photo(
            f"{k}.png",
            camera,
            (255 * np.sqrt(photographer.render_albedo(camera, k, 16))).astype(np.uint8),
            photographer.render_depth(camera),
        )
        for k, camera in enumerate(walk)
    ]
    result, points = sparse.triangulate_points(taken)
    assert len(points) > 100 and max(len(at) for at in result) <= sparse.MAX_CORNERS
    gaps = []
    for p in points:
        assert len(p.track) >= 2 and len({j for j, _ in p.track}) == len(p.track)
        j, m = p.track[0]
        x, y = result[j][m].astype(int)
        gaps.append(abs(np.linalg.norm(p.position - taken[j].camera.center) / taken[j].depth[y, x] - 1))
    assert np.median(gaps) < 0.02


def test_corners_are_located_exactly():
    picture = np.zeros((40, 40, 3), np.uint8)
    picture[20:, 15:] = 255
    assert np.abs(sparse.detect_corners(picture)[0] - (15, 20)).max() < 1.6  # within the blur


def test_the_command_reports_its_output(capsys):
    with pytest.raises(SystemExit, match="0"):
        make.main(["--help"])
    assert "--count" in capsys.readouterr().out
