"""The demo store: layout, twin, pictures, attention law and shoppers."""

import json
import zipfile
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")

from nerg_mi.scenes.store import attention_law, cameras, layout, make, shoppers, twin, views  # noqa: E402

from nerg_mi.tracking.rays import Rays  # noqa: E402
from tests.plugins import scenes  # noqa: E402
from tests.plugins.scenes import still  # noqa: E402
from tests.plugins.test_nerg_gradients import COLOR, DEPTH, LAST, check  # noqa: E402


@pytest.fixture(scope="module")
def store():
    mi.set_variant("llvm_ad_rgb")
    return layout.build_store(0)


@pytest.fixture(scope="module")
def law(store):
    return attention_law.AttentionLaw()


EYES = np.array([[2.75, 2.0, 1.6], [0.93, 0.8, 1.5], [6.3, 2.5, 1.7], [4.0, 4.8, 1.6]])


def equal_area(n):
    """Directions (n, 3) on a Fibonacci spiral, each representing 4 pi / n steradians."""
    i = np.arange(n) + 0.5
    z, phi = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


# ------------------------------------------------------------------- layout


def test_layout_is_deterministic_and_varies_with_the_seed(store):
    again, other = layout.build_store(0), layout.build_store(1)
    assert np.array_equal(store.quads, again.quads) and np.array_equal(store.colors, again.colors)
    assert [r.to_json() for r in store.regions] == [r.to_json() for r in again.regions]
    assert store.quads.shape != other.quads.shape or not np.array_equal(store.quads, other.quads)


def test_layout_fills_the_room_and_names_its_regions(store):
    assert np.allclose(store.quads.min(axis=(0, 1)), 0) and np.allclose(store.quads.max(axis=(0, 1)), layout.ROOM)
    names = [r.name for r in store.regions]
    assert len(set(names)) == len(names) and 15 <= len(names) <= 30
    for r in store.regions:
        assert np.all(np.array(r.lo) < r.hi)
        lo, hi = np.array(r.focus)
        assert np.all(lo >= np.array(r.lo) - 0.05) and np.all(hi <= np.array(r.hi) + 0.05), r.name


def test_quads_face_outwards():
    place = layout.StoreBuilder()
    place.add_box((0, 0, 0), (1, 2, 3), (0.5, 0.5, 0.5))
    for quad in place.quads:
        normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
        assert np.dot(normal, quad.mean(axis=0) - (0.5, 1.0, 1.5)) > 0


def test_clearance_is_the_distance_to_the_nearest_solid(store):
    room = store.compute_clearance([[0.9, 5.0, 2.6], [1.85, 3.0, 1.0]])
    assert room[0] == pytest.approx(0.4) and room[1] == 0.0  # noqa: RUF069 (a bound)


def test_committed_files_are_those_of_seed_zero(store, tmp_path):
    twin.write_twin(store, tmp_path)
    layout.write_regions(store, tmp_path / "regions.json")
    for name in ("twin.xml", "twin.ply", "twin_lights.ply", "regions.json"):
        assert (tmp_path / name).read_bytes() == (twin.FOLDER / name).read_bytes(), f"run make --stage twin: {name}"
    assert sum(f.stat().st_size for f in tmp_path.iterdir()) < 1e6


# --------------------------------------------------------------------- twin


def test_twin_casts_exact_distances(store):
    up, east = (0, 0, 1.0), (1.0, 0, 0)
    assert twin.cast_rays([(0.9, 5.0, 1.0)], [up])[0] == pytest.approx(2.0, abs=1e-5)
    # the trim panel at the north end of the first gondola
    assert twin.cast_rays([(1.0, 4.19, 1.0)], [east])[0] == pytest.approx(0.5, abs=1e-5)
    assert np.isinf(twin.cast_rays([(-1.0, 1.0, 1.0)], [(-1.0, 0, 0)])[0])


def test_twin_is_closed(store):
    rng = np.random.default_rng(0)
    observers = cameras.sample_free_positions(store, rng, 2000)
    d = rng.normal(size=observers.shape)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    t = twin.cast_rays(observers, d)
    assert np.isfinite(t).all()
    end = observers + t[:, None] * d
    assert np.all(end > -1e-4) and np.all(end < np.array(layout.ROOM) + 1e-4)


def test_visible_agrees_with_cast(store):
    rng = np.random.default_rng(1)
    a, b = cameras.sample_free_positions(store, rng, 500), cameras.sample_free_positions(store, rng, 500)
    length = np.linalg.norm(b - a, axis=1)
    assert np.array_equal(twin.is_visible(a, b), twin.cast_rays(a, (b - a) / length[:, None]) > length - 1e-3)


def test_missing_twin_error_names_the_remedy(tmp_path):
    with pytest.raises(FileNotFoundError, match="--stage twin"):
        twin.load_twin(tmp_path / "twin.xml")


# -------------------------------------------------------------------- views


def test_pinhole_projects_its_own_directions():
    camera = cameras.Pinhole(16, 12)
    pose = cameras.pose_from_angles((1.0, 2.0, 1.5), 0.7, -0.2)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) and np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    assert pose[2, 1] > 0.9  # upright
    points = pose[:3, 3] + 2.5 * camera.directions().reshape(-1, 3) @ pose[:3, :3].T
    uv, inside = camera.project(pose, points)
    u, v = np.meshgrid(np.arange(16) + 0.5, np.arange(12) + 0.5)
    assert inside.all() and np.allclose(uv, np.stack([u.ravel(), v.ravel()], axis=1))
    assert 2 * np.degrees(np.arctan(8 / camera.focal)) == pytest.approx(camera.fov_x)


@pytest.mark.nightly
def test_views_agree_with_each_other(store, tmp_path):
    """A pixel reprojected into another view by its depth has the same colour: poses, depth and pictures are
    consistent."""
    camera = cameras.Pinhole(80, 60)
    views.write_views(store, tmp_path, camera=camera, train=8, test=2, spp=16, log=lambda text: None)
    sets = [json.loads((tmp_path / n).read_text()) for n in ("transforms.json", "transforms_test.json")]
    assert [len(s["frames"]) for s in sets] == [8, 2]
    assert sets[0]["aabb"] == [[0, 0, 0], list(layout.ROOM)] and sets[0]["fl_x"] == pytest.approx(camera.focal)
    frames = sets[0]["frames"] + sets[1]["frames"]
    poses = [np.array(f["transform_matrix"]) for f in frames]
    pictures = [np.array(mi.Bitmap(str(tmp_path / f["file_path"]))).astype(float) / 255 for f in frames]
    depths = [np.load(tmp_path / f["depth_file_path"]) for f in frames]
    assert pictures[0].shape == (60, 80, 3) and depths[0].dtype == np.float32 and depths[0].shape == (60, 80)
    for pose in poses:
        assert store.compute_clearance(pose[:3, 3])[0] >= cameras.CLEARANCE - 1e-9

    near, shuffled = [], []
    rng = np.random.default_rng(0)
    for a, (pose, depth) in enumerate(zip(poses, depths)):
        points = pose[:3, 3] + depth.reshape(-1, 1) * camera.directions().reshape(-1, 3) @ pose[:3, :3].T
        for b in range(len(poses)):
            if a == b:
                continue
            uv, inside = camera.project(poses[b], points)
            inside[inside] = twin.is_visible(poses[b][:3, 3], points[inside] + 2e-3 * (pose[:3, 3] - points[inside]))
            x, y = uv[inside].astype(int).T
            # the depth of the other view at that pixel is the distance to the same point
            gap = np.abs(depths[b][y, x] - np.linalg.norm(points[inside] - poses[b][:3, 3], axis=1))
            same = gap < 0.1
            difference = np.abs(pictures[a].reshape(-1, 3)[inside] - pictures[b][y, x]).mean(axis=1)
            near.append(difference[same])
            other = pictures[b].reshape(-1, 3)[rng.integers(0, 4800, same.sum())]
            shuffled.append(np.abs(pictures[a].reshape(-1, 3)[inside][same] - other).mean(axis=1))
    near, shuffled = np.concatenate(near), np.concatenate(shuffled)
    assert len(near) > 500
    assert np.median(near) < 0.08 and np.median(near) < 0.4 * np.median(shuffled)  # 16 samples a pixel are noisy


# ---------------------------------------------------------------------- law


def test_law_integrates_to_one(law):
    density = law.density(EYES, equal_area(20000))
    assert density.shape == (len(EYES), 20000) and np.all(density >= 0)
    assert np.allclose(density.mean(axis=1) * 4 * np.pi, 1.0, atol=1e-5)


def test_law_depends_on_position_and_occlusion(law):
    lobes = law.compute_lobes(EYES)
    k = law.names.index("cooler_1_dairy")
    assert lobes.visible[2, k] == 0 and lobes.weights[2, k] == 0  # three gondolas are in between
    d = law.density(EYES, equal_area(4096))
    assert np.corrcoef(d)[np.triu_indices(4, 1)].max() < 0.8
    z = equal_area(512)  # above the ceiling nothing of the store is visible
    assert np.allclose(law.density([(4.0, 3.0, 5.0)], z)[0], attention_law.background_density(z[:, 2]))


@pytest.mark.nightly
def test_law_sample_follows_density(law):
    """The number of samples in cells around 192 directions agrees with the density integrated over these cells."""
    centres, fine = equal_area(192), equal_area(60000)
    cell = lambda d: np.argmax(d @ centres.T, axis=1)
    n = 40000
    for eye in EYES[:2]:
        expected = np.bincount(cell(fine), law.density(eye[None], fine)[0], 192) * n * 4 * np.pi / len(fine)
        draws = law.sample(np.repeat(eye[None], n, 0), np.random.default_rng(3))
        assert np.allclose(np.linalg.norm(draws, axis=1), 1)
        counted = np.bincount(cell(draws), minlength=192)
        use = expected > 8
        chi2 = ((counted - expected) ** 2 / expected)[use].sum()
        assert chi2 < use.sum() + 5 * np.sqrt(2 * use.sum())


def test_law_names_an_unknown_category():
    with pytest.raises(ValueError, match="fireworks"):
        attention_law.AttentionLaw([{"name": "x", "category": "fireworks"}])


# ----------------------------------------------------------------- shoppers


def test_shoppers_keep_clear_of_furniture_and_return_to_the_skeleton_file(store, law, tmp_path):
    from nerg_mi.tracking.readers.skeleton import LEFT_EAR, NOSE, RIGHT_EAR, head_poses, iterate_skeleton

    ids, times, origins, directions = shoppers.simulate_shoppers(store, shoppers=3, stops=(2, 4), seed=5, law=law)
    again = shoppers.simulate_shoppers(store, shoppers=3, stops=(2, 4), seed=5, law=law)
    assert np.array_equal(directions, again[3]) and len(set(ids)) == 3
    assert shoppers.compute_floor_clearance(store, origins[:, :2]).min() > 0.1
    for name in set(ids):
        mine = ids == name
        assert np.all(np.diff(times[mine]) == 200)
        assert np.linalg.norm(np.diff(origins[mine], axis=0), axis=1).max() < 0.5  # metres in 0.2 s

    path = shoppers.write_shoppers(
        store, tmp_path / "s.csv", shoppers=3, stops=(2, 4), seed=5, law=law, log=lambda text: None
    )
    (rows,) = iterate_skeleton(path)
    o, d = head_poses(*(rows.keypoints[:, k] for k in (LEFT_EAR, RIGHT_EAR, NOSE)))
    assert np.array_equal(rows.ids, ids) and np.array_equal(rows.times, times)
    assert np.allclose(o, origins, atol=1e-4) and np.allclose(d, directions, atol=2e-3)


def read_members(path):
    """Uncompressed bytes of the files of an archive: the compressed ones differ between versions of zlib."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_committed_sample_is_written_as_today(tmp_path):
    Rays.load(make.FOLDER / "shoppers.npz").save(tmp_path / "again.npz")
    assert read_members(tmp_path / "again.npz") == read_members(make.FOLDER / "shoppers.npz"), "run make --stage rays"


@pytest.mark.nightly
def test_committed_sample_is_that_of_seed_zero(tmp_path):
    job = make.Job(0, tmp_path, tmp_path / "build")
    job.build.mkdir()
    make.make_twin(job)
    make.make_shoppers(job)
    _, sample = make.make_rays(job)
    assert read_members(sample) == read_members(make.FOLDER / "shoppers.npz"), "run make --stage rays"


# ------------------------------------------------------------------- derivatives of images of the trained store


@pytest.fixture(scope="module")
def aisle():
    """A picture of 10 x 10 pixels along an aisle, with the gaze of a shopper, and continuous except at edges."""
    mi.set_variant("llvm_ad_rgb")
    sensor = still(scenes.camera(mi, size=10, fov=40))
    sensor["to_world"] = scenes.look_at(mi, (4.4, 2.8, 1.6), (6.5, 3.4, 1.2), (0, 0, 1))
    folder = Path(make.__file__).parent
    integrator = scenes.plugin("nerg", depth="expected", stop=1e-12, color_cutoff=0.0, aovs="depth,opacity,gaze")
    integrator |= {
        "field": scenes.stored("nerf", folder / "store.safetensors"),
        "gaze": scenes.stored("gazefield", folder / "shoppers.safetensors"),
        "observer": scenes.make_observer(mi, 4.4, 2.8, 1.6),
    }
    return scenes.scene_with(mi, integrator, sensor)


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name, channels",
    [
        ("field.color_net.0", COLOR),
        ("field.color_net.1", COLOR),
        ("gaze.emit_net.0", LAST),
        ("gaze.capture_net.1", LAST),
        ("gaze.grid.table", LAST),
    ],
)
def test_derivatives_of_weights_equal_differences(aisle, name, channels):
    check(mi, aisle, f"integrator.{name}", channels, 1e-2)


@pytest.mark.nightly
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_derivatives_of_the_camera_equal_differences_away_from_edges(aisle, axis):
    params = mi.traverse(aisle)
    base = mi.Transform4f(params["sensor.to_world"])

    def image(x):
        scenes.put(params, "sensor.to_world", mi.Transform4f().translate(x * mi.Vector3f(*axis)) @ base)
        return mi.render(aisle, params=params, spp=1, seed=0)

    x = mi.Float(0)
    dr.enable_grad(x)
    shown = image(x)
    dr.forward(x)
    slope = dr.grad(shown).numpy()
    differences = [
        (np.array(image(mi.Float(h))) - np.array(image(mi.Float(-h)))).astype(float) / (2 * h) for h in (2e-3, 1e-3)
    ]
    scenes.put(params, "sensor.to_world", base)
    for channels in (COLOR, DEPTH, LAST):
        got, wide, narrow = (v[..., channels] for v in (slope, *differences))
        scale = np.maximum(np.abs(narrow), np.median(np.abs(narrow)))
        # Differences over two distances agree where neither crosses an edge.
        is_smooth = np.abs(wide - narrow) < 0.05 * scale
        assert np.isfinite(got).all() and is_smooth.mean() > 0.2
        error = np.abs(got - narrow)[is_smooth] / scale[is_smooth]
        assert np.median(error) < 0.04
