"""Tests of `nerg_mi.aoi.attention`."""

import warnings

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.aoi.attention import compute_box_shares
from nerg_mi.aoi.placed import MARGIN, BoxAoi
from nerg_mi.aoi.shares import COARSE, gaze_shares
from nerg_mi.aoi.statistics import statistics
from nerg_mi.environment.environment import Environment
from nerg_mi.formats.boxes import Region
from nerg_mi.progress import WarningReporter
from nerg_mi.reports.data import make_report_sampler
from nerg_mi.transport.mitsuba_mesh import make_mesh
from tests.aoi.place import SIGN, STAND, write_place
from tests.pictures import box_dict

# ---- Attention on boxes, meshes and shapes: sums and occlusion ----


BOX = [(-0.2, 1.8, -0.1), (0.2, 2.2, 0.1)]
EYE = (1.2, 2.2, 1.5)
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
    """An empty surrounding and a gaze field."""
    return nerg.make_scene(gaze=files / "gaze.safetensors", shapes=FAR)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A room with a sign, an occluder for some observers, and one open side, as a file; and its scene."""
    path = write_place(tmp_path_factory.mktemp("room"))
    return path, nerg.Scene.load(path)


def test01_the_share_is_the_integral_over_directions(empty):
    eye = np.array((0.4, 0.1, 0.2))
    seen = nerg.attention(empty, box_dict(*np.array(BOX)), eye, divisions=16)
    d = on_sphere(400_000)
    d = d[hits_box(eye, d, *BOX) & (d @ (np.mean(BOX, axis=0) - eye) > 0)]
    # The gaze of the box is at the entry points of the rays.
    low, high = ((np.array(corner) - eye) / d for corner in BOX)
    entry = eye + d * np.minimum(low, high).max(axis=1)[:, None]
    gaze = nerg.observe(empty, entry, eye, "gaze").gaze[0]
    # A field that is not normalised is divided by its integral.
    full = compute_box_shares(empty, [], eye[None].astype(np.float32)).integral[0]
    assert np.isclose(seen.share[0], gaze.sum() * 4 * np.pi / 400_000 / full, rtol=1e-2) and abs(full - 1) > 0.1


def test02_density_times_area_is_the_share(empty):
    observers = [(0.4, 0.1, 0.2), (-1, 0.5, 0.3), (0, 5, 0)]
    seen = nerg.attention(empty, box_dict(*np.array(BOX)), observers, divisions=3)
    assert seen.density.shape == (3, 12 * 9) and seen.points.shape == seen.normals.shape == (108, 3)
    assert np.allclose(seen.density @ seen.area, seen.share, rtol=1e-5)
    assert np.isclose(seen.area.sum(), 2 * (0.4 * 0.4 + 0.4 * 0.2 + 0.4 * 0.2), rtol=1e-5)
    assert np.allclose(np.linalg.norm(seen.normals, axis=1), 1, atol=1e-5)
    # A face that is turned away has no attention.
    away = (np.array(observers)[:, None] - seen.points) @ np.eye(3) * seen.normals
    assert np.array_equal(seen.density[away.sum(axis=-1) < -1e-5], np.zeros((away.sum(axis=-1) < -1e-5).sum()))
    assert seen.mean == pytest.approx(float(seen.share.mean()))
    assert repr(seen).startswith("<Attention: mean share ") and "3 observers" in repr(seen)
    assert (seen.error < 0.01 * seen.share + 1e-5).all() and (seen.escaped > 0.5).all()


def test03_occluders_hide_surfaces(files, empty):
    wall = box_dict(np.array((-3.0, 1.0, -3.0)), np.array((3.0, 1.1, 3.0)))
    hidden = nerg.make_scene(gaze=files / "gaze.safetensors", shapes=wall)
    observers = [(0, 0, 0), (0, 4, 0)]
    seen, before = (nerg.attention(scene, box_dict(*np.array(BOX)), observers) for scene in (hidden, empty))
    assert before.share.min() > 0 and seen.share[0] == 0
    assert np.isclose(seen.share[1], before.share[1], rtol=0, atol=before.error[1])


def test04_a_shape_of_the_scene_by_its_id(files, rgb, tmp_path):
    box = box_dict(*np.array(BOX))
    scene = nerg.make_scene(gaze=files / "gaze.safetensors", shapes={"product": box, "far": FAR})
    path = tmp_path / "box.ply"
    rgb.load_dict(box).write_ply(str(path))
    eye = (0.4, 0.1, 0.2)
    by_id = nerg.attention(scene, "product", eye)
    # A surface does not occlude itself.
    assert by_id.share[0] > 0
    alone = nerg.make_scene(gaze=files / "gaze.safetensors", shapes=FAR)
    for surface in (box, path, str(path), rgb.load_dict(box)):
        assert np.isclose(nerg.attention(alone, surface, eye).share[0], by_id.share[0], rtol=1e-4)


def test05_both_sides_of_an_open_surface(empty, rgb):
    mesh = make_mesh(np.array([(0, 2, 0), (0.3, 2, 0), (0, 2, 0.3)]), np.array([(0, 1, 2)]), "sheet")
    observers = [(0, 0, 0), (0, 4, 0)]
    one, both = (nerg.attention(empty, mesh, observers, two_sided=t).share for t in (False, True))
    assert (one > 0).sum() == 1 and (both > 0).all() and np.allclose(one[one > 0], both[one > 0])


def test15_a_mesh_that_is_not_in_the_scene_occludes_itself(empty):
    """A sheet in front of a larger one, both facing the observer: one mesh, and each alone."""
    eye = np.zeros(3)
    corners = [np.array([(-a, y, -a), (a, y, -a), (0, y, a)]) for a, y in ((0.3, 1.5), (0.6, 2.0))]
    front, back, both = (
        nerg.attention(empty, make_mesh(np.concatenate(v), np.arange(3 * len(v)).reshape(-1, 3), "sheets"), eye)
        for v in (corners[:1], corners[1:], corners)
    )
    assert both.share[0] < 0.95 * (front.share[0] + back.share[0])
    assert both.share[0] > front.share[0] > 0
    # The patches behind the front sheet receive nothing.
    is_behind = (both.points[:, 1] > 1.9) & (np.abs(both.points[:, [0, 2]]).max(axis=1) < 0.15)
    assert is_behind.any() and not both.density[0, is_behind].any()


@pytest.mark.parametrize(
    "surface, said",
    [
        ("nothing", '"nothing"'),
        ("nothing.ply", 'there is no mesh "nothing.ply"'),
        ([(0, 0, 0), (1, 1, -1)], "a box must be a lower and an upper corner"),
        ([(0, 0, 0)], "a box must be a lower and an upper corner"),
        ({"type": "sphere"}, "is not a mesh"),
        (object(), "corners of a box"),
    ],
)
def test06_invalid_surfaces_are_refused(empty, surface, said):
    with pytest.raises(nerg.NergError, match=said):
        nerg.attention(empty, surface, (0, 0, 0))


def test07_errors_are_sentences(files, empty):
    with pytest.raises(nerg.NergError, match="make_scene"):
        nerg.attention(nerg.make_scene(files / "field.safetensors"), BOX, (0, 0, 0))
    for wrong in (0, 2.5, True):
        with pytest.raises(nerg.NergError, match="divisions must be an integer from 1"):
            nerg.attention(empty, box_dict(*np.array(BOX)), (0, 0, 0), divisions=wrong)
    for wrong in ({"margin": -1}, {"margin": "a"}, {"tolerance": 0}, {"tolerance": float("nan")}):
        with pytest.raises(nerg.NergError, match=f"{next(iter(wrong))} must"):
            nerg.attention(empty, BOX, (0, 0, 0), **wrong)
    with pytest.raises(nerg.NergError, match="two_sided"):
        nerg.attention(empty, BOX, (0, 0, 0), divisions=2)
    with pytest.raises(nerg.NergError, match="has no observer"):
        nerg.attention(empty, BOX)


def test09_patches_are_small_relative_to_distance(empty):
    cube = box_dict(*np.array(BOX))
    near, far = nerg.attention(empty, cube, (0, 1.5, 0)), nerg.attention(empty, cube, [(0, 0, 0), (0, -30, 0)])
    assert len(near.area) > len(far.area)
    finer = nerg.attention(empty, cube, (0, 1.5, 0), divisions=32)
    assert np.isclose(near.share[0], finer.share[0], rtol=5e-3)
    assert len(nerg.attention(empty, cube, np.mean(BOX, axis=0), two_sided=True).area) == 12 * 32**2


def test08_progress_is_reported(empty):
    messages = []

    class Reporter:
        def message(self, text): ...
        def warn(self, text): ...
        def progress(self, share, text=""):
            messages.append(share)

    nerg.attention(empty, box_dict(*np.array(BOX)), [(0, 0, 0), (0.1, 0, 0)], progress=Reporter())
    assert messages == [0.5, 1.0]


def rays_of_gaze(scene, eye, count=40_000, seed=0):
    """End points of rays drawn from an observer's gaze by rejection sampling: (count, 3)."""
    d = np.random.default_rng(seed).normal(size=(20 * count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = nerg.trace(scene, eye, d, ["gaze", "depth"], observers=[eye])
    gaze, depth = seen.gaze[0], np.ravel(seen.depth)
    selected = np.flatnonzero(np.random.default_rng(seed + 1).random(len(d)) * gaze.max() < gaze)[:count]
    assert len(selected) == count and (depth[selected] > 0).all()
    return eye + depth[selected, None] * d[selected]


def test10_attention_grows_with_the_box_and_matches_rays(room):
    _, scene = room
    grown = (0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 9.0)
    regions = [Region.create("sign", SIGN[0] - g, SIGN[1] + g) for g in grown]
    result = compute_box_shares(scene, regions, np.float32([EYE]))
    share, error = result.share[0], result.error[0]
    assert (np.diff(share) >= -error[1:]).all() and share[-1] == pytest.approx(1, abs=2e-6)
    assert (error < 0.01 * share + 1e-4).all()
    ends = rays_of_gaze(scene, EYE)
    for region, value, err in zip(regions, share, error):
        rays = region.contains(ends, 1e-4).mean()
        assert abs(value - rays) < 3 * np.sqrt(rays * (1 - rays) / len(ends)) + err
    alone = nerg.attention(scene, "sign", EYE)
    assert share[0] == pytest.approx(alone.share[0], abs=error[0] + 5e-3 * share[0])
    one = nerg.attention(scene, SIGN, EYE)
    assert one.share[0] == pytest.approx(share[0], abs=error[0]) and one.error[0] < 0.01 * one.share[0]


@pytest.mark.parametrize("eye", [EYE, (5.5, 3.5, 0.4)])
def test11_boxes_that_fill_space_sum_to_one(files, eye):
    """Includes rays that escape; planes between the boxes also pass through the observer."""
    shapes = {"floor": box_dict(np.array((0.0, 0, -1)), np.array((6.0, 4, 0)))}
    shapes["stand"] = box_dict(*STAND)
    scene = nerg.make_scene(gaze=files / "gaze.safetensors", shapes=shapes)
    cuts = [(-1e6, eye[0], 2.5, 1e6), (-1e6, 1.0, eye[1], 1e6), (-1e6, 0.001, 1.1, 1e6)]
    cuts = [sorted(set(c)) for c in cuts]
    spans = [list(zip(c[:-1], c[1:])) for c in cuts]
    corners = [np.transpose((a, b, c)) for a in spans[0] for b in spans[1] for c in spans[2]]
    regions = [Region.create(f"{k}", *corner) for k, corner in enumerate(corners)]
    result = compute_box_shares(scene, regions, np.float32([eye]), margin=0.0)
    assert 0.2 < result.escaped[0] < 0.8
    assert result.share.sum() + result.escaped[0] == pytest.approx(1, abs=3 * np.linalg.norm(result.error))
    assert np.linalg.norm(result.error) < 2e-3
    # Two adjacent boxes have the sum.
    full = nerg.attention(scene, [(2.0, 0.5, -0.5), (4.0, 3.0, 2.3)], eye, margin=0)
    parts = [nerg.attention(scene, [(2 + k, 0.5, -0.5), (3 + k, 3.0, 2.3)], eye, margin=0) for k in range(2)]
    assert sum(p.share[0] for p in parts) == pytest.approx(full.share[0], abs=3 * float(full.error[0]))
    everything = nerg.attention(scene, [(-1e7,) * 3, (1e7,) * 3], eye)
    assert everything.share[0] + everything.escaped[0] == pytest.approx(1, abs=1e-5)


def test12_small_objects_are_sampled(files):
    """A cube of 2 cm at three metres, which no direction of a coarse quadrature hits; and no attention on occluded
    objects.
    """
    aoi = np.array([(-0.01, 2.99, 0.2), (0.01, 3.01, 0.22)])
    scene = nerg.make_scene(gaze=files / "gaze.safetensors", shapes={"thing": box_dict(*aoi), "far": FAR})
    by_id = nerg.attention(scene, "thing", (0, 0, 0.1))
    by_box = nerg.attention(scene, aoi, (0, 0, 0.1), tolerance=1e-3)
    assert 0 < by_id.share[0] < 1e-4 and by_box.share[0] == pytest.approx(by_id.share[0], rel=0.05)
    assert nerg.attention(scene, aoi + (0, 0, 0.5), (0, 0, 0.1)).share[0] == 0
    assert nerg.attention(scene, aoi + (0, 1, 0), (0, 0, 0.1)).share[0] == 0


@pytest.mark.parametrize(
    ("box", "eye", "said"),
    [
        ([(-1e30,) * 3, (1e30,) * 3], EYE, "the corners of a box must have coordinates from"),
        ([(0, 0, 0), (10**400, 1, 1)], EYE, "the corners of a box must have coordinates from"),
        (BOX, (10**400, 0, 0), "observers must have coordinates from"),
        (BOX, (float("nan"), 0, 0), "observers must have coordinates from"),
    ],
)
def test13_extreme_sizes_are_reported(empty, box, eye, said):
    with pytest.raises(nerg.NergError, match=said):
        nerg.attention(empty, box, eye)


def test14_statistics_viewer_and_report_agree(room):
    from nerg_mi.viewer.shares import iter_attention_shares

    path, scene = room
    regions = [Region.create("the sign", *SIGN), Region.create("corner", (4.5, 2.5, 0), (6.1, 4.1, 3.1), 20)]
    eye = np.array(EYE)
    position = nerg.attention(scene, SIGN, eye)
    table = statistics(path, path.parent / "areas.json", observers=[EYE], resamples=199).aois
    messages = {row["aoi"]: row["share"] for row in table}
    assert messages["the sign"] == pytest.approx(position.share[0], rel=0.03)
    assert messages["the stand"] == pytest.approx(nerg.attention(scene, "stand", eye).share[0], rel=0.03)
    *_, viewer = iter_attention_shares(scene, eye, regions, [])
    assert viewer["the sign"].share == pytest.approx(position.share[0], rel=0.03)
    field = scene.integrator.gaze.field
    onlooker = make_report_sampler(field, Environment(scene.geometry, field.box, "scene"))
    things = [BoxAoi(region) for region in regions]
    report = gaze_shares(onlooker.query_from, eye[None], things, [(0,), (1,)], MARGIN, COARSE)
    assert report.share[0, 0] == pytest.approx(position.share[0], rel=0.03)
    assert report.share[0, 1] == pytest.approx(viewer["corner"].share, rel=0.03)
    assert viewer["corner"].share > 1e-3


# ---- Observers whose values are extrapolated ----


CALLS = {
    "observe": lambda scene, eye, **k: nerg.observe(scene, (2, 2, 1), eye),
    "attention on a box": lambda scene, eye, **k: nerg.attention(scene, SIGN, eye),
    "attention on a mesh": lambda scene, eye, **k: nerg.attention(scene, "sign", eye),
    "trace": lambda scene, eye, **k: nerg.trace(scene, EYE, (1, 0, 0), "gaze", observers=eye),
    "trace from origins": lambda scene, eye, **k: nerg.trace(scene, eye, (1, 0, 0), "gaze"),
    "render": lambda scene, eye, **k: nerg.render(
        scene, eye, "gaze", camera=nerg.Camera((1, 1, 1), (3, 2, 1), width=4, height=3), spp=1
    ),
    "statistics": lambda scene, eye, path: statistics(
        path, path.parent / "areas.json", observers=[eye], resamples=199, progress=WarningReporter()
    ),
}


@pytest.mark.parametrize("call", list(CALLS))
def test16_extrapolated_observers_are_reported(room, call):
    path, scene = room
    for eye, reason in (((99, 99, 1.6), "outside"), ((2.7, 1.5, 1.0), "solid")):
        with pytest.warns(UserWarning, match=f"{eye[0]:g}, {eye[1]:g}.*{reason}.*extrapolated"):
            result = CALLS[call](scene, eye, path=path)
        if call == "statistics":
            assert all(reason in row["note"] for row in result.aois)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = CALLS[call](scene, EYE, path=path)
    if call == "statistics":
        assert not any("extrapolated" in row["note"] for row in result.aois)
