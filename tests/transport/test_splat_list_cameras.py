"""Lists of Gaussians for orthographic and thin-lens cameras, against sums in float64 and against the tree."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.splats import Splats, quaternions_to_matrices
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import eval_harmonics
from nerg_mi.registration import get_plugin_class
from nerg_mi.transport import splat_lists
from nerg_mi.transport.geometry import SceneGeometry, SceneRay, default_march_settings
from nerg_mi.transport.medium import ColorShader
from nerg_mi.transport.observer import camera_cells, sensor_center
from nerg_mi.transport.splat_medium import MAX_ALPHA, SplatArrays, SplatMedium
from tests.plugins.scenes import camera, look_at, make_observer, scene_with

STOP = 1e-4
ORIGIN = (0.5, 0.4, -3)

pytestmark = pytest.mark.usefixtures("any_number", "sorted_hits")


def orthographic(mi, *sizes):
    scale = mi.ScalarTransform4f().scale([*sizes, 1])
    return camera(mi, kind="orthographic", size=40) | {"to_world": look_at(mi, ORIGIN) @ scale}


def sheared(mi):
    matrix = np.eye(4)
    matrix[0, 1], matrix[0, 2] = 0.4, 0.3
    shear = mi.ScalarTransform4f(matrix.tolist())
    return camera(mi, kind="orthographic", size=40) | {"to_world": look_at(mi, ORIGIN) @ shear}


def lens(mi, radius, focus=3.0, **options):
    return camera(mi, kind="thinlens", size=40, fov=50, aperture_radius=radius, focus_distance=focus, **options)


CAMERAS = {
    "orthographic": lambda mi: orthographic(mi, 1.5, 1.5),
    "wide orthographic": lambda mi: orthographic(mi, 30, 20),
    "mirrored orthographic": lambda mi: orthographic(mi, -1.5, 1),
    "sheared orthographic": sheared,
    "lens": lambda mi: lens(mi, 0.05),
    "large aperture": lambda mi: lens(mi, 0.8),
    "focus near the lens": lambda mi: lens(mi, 0.3, 0.4),
    "focus at the far plane": lambda mi: lens(mi, 0.2, 1e4),
    "wide lens": lambda mi: lens(mi, 0.3, 2.0) | {"fov": 130},
}


def cloud(count, degree=1, seed=0, size=1.5, width=0.12, opacities=(0.05, 0.95), around=(0, 0, 0)):
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(count, 3))
    p *= size * rng.uniform(0.1, 1, (count, 1)) / np.linalg.norm(p, axis=1, keepdims=True)
    scales = width * np.exp(rng.normal(0, 0.6, (count, 3)))
    harmonics = rng.normal(0, 0.5, (count, (degree + 1) ** 2, 3))
    return Splats(p + around, scales, rng.normal(size=(count, 4)), rng.uniform(*opacities, count), harmonics)


def around_the_focus():
    """A Gaussian in front of the plane in focus, one behind it, and one across the plane of the lens."""
    forward = -np.array(ORIGIN) / np.linalg.norm(ORIGIN)
    centers = np.array(ORIGIN) + np.array([[1.0], [8.0], [0.05]]) * forward + [[0.05, 0, 0], [0.3, 0.2, 0], [0.2, 0, 0]]
    scales = [[0.05, 0.1, 0.02], [0.5, 0.3, 0.4], [0.1, 0.15, 0.05]]
    harmonics = np.random.default_rng(4).normal(0, 0.4, (3, 4, 3))
    return Splats(centers, scales, np.eye(4)[:3] + 0.2, [0.6, 0.9, 0.7], harmonics)


def thin():
    splats = cloud(150, seed=6)
    scales = np.tile([1e-4, 1e-3, 0.4], (150, 1))
    return Splats(splats.centers, scales, splats.rotations, splats.opacities, splats.harmonics)


SCENES = {
    "one": lambda: cloud(1, size=0.3, width=0.3),
    "two": lambda: cloud(2, size=0.4, width=0.3, seed=1),
    "hundred": lambda: cloud(100),
    "near plane": lambda: cloud(40, around=ORIGIN, size=0.8, width=0.15),
    "thin": thin,
    "transparent": lambda: cloud(60, seed=2, opacities=(0.005, 0.05)),
    "around the focus": around_the_focus,
}


# ---- Rays and sums ----


def camera_rays(rgb, sensor, count=1500):
    """Random rays of a camera: positions on the film and on the lens."""
    rng = np.random.default_rng(1)
    film, aperture = (rgb.Point2f(rng.uniform(size=(2, count)).astype(np.float32)) for _ in range(2))
    return sensor.sample_ray(0, 0.5, film, aperture)[0]


def trace(rgb, splats, sensor, ray, has_lists=True, **options):
    """Colour, opacity, mean and median depth (N, 6)."""
    geometry = SceneGeometry(SplatMedium(SplatArrays(splats, namespace(rgb.Float)), **options))
    count = dr.width(ray)
    if has_lists:
        geometry = geometry.seen_from(sensor_center(sensor), count, camera_cells(sensor))
        assert isinstance(geometry.medium.hits, splat_lists.SplatLists)
    hit = geometry.trace(
        SceneRay(ray.o, ray.d, rgb.Float(dr.inf)),
        dr.full(rgb.Bool, True, count),
        default_march_settings(geometry),
        color=ColorShader(rgb.Color3f),
    )
    depths = [hit.depth(kind, hit.opacity > 0) for kind in ("expected", "median")]
    values = [*hit.march.color, hit.opacity, *depths]
    return np.stack([np.array(v, np.float64) + np.zeros(count) for v in values], axis=1)


def sum_exactly(splats, sensor, ray, has_center):
    """The same in float64, with Gaussians sorted by their peaks."""
    o, d = (np.array(v, np.float64).T + np.zeros((dr.width(ray), 3)) for v in (ray.o, ray.d))
    turn = quaternions_to_matrices(splats.rotations.astype(np.float64))
    to_axes = turn.transpose(0, 2, 1) / splats.scales[:, :, None].astype(np.float64)
    start = np.einsum("nij,rnj->rni", to_axes, o[:, None] - splats.centers)
    along = np.einsum("nij,rj->rni", to_axes, d)
    t = -(start * along).sum(-1) / (along * along).sum(-1)
    square = ((start + t[..., None] * along) ** 2).sum(-1)
    alpha = np.minimum(splats.opacities * np.exp(-square / 2), MAX_ALPHA)
    alpha[(t < 0) | (alpha < splat_lists.MIN_ALPHA) | (square > 9)] = 0
    order = np.argsort(t, axis=1)
    alpha, t = (np.take_along_axis(v, order, 1) for v in (alpha, t))
    light = np.cumprod(1 - alpha, axis=1)
    before = np.concatenate([np.ones((len(d), 1)), light[:, :-1]], axis=1)
    alpha[before <= STOP] = 0
    weight = before * alpha
    w = splats.centers - np.array(sensor_center(sensor)).ravel() if has_center else d[:1]
    basis = eval_harmonics(w / np.linalg.norm(w, axis=1, keepdims=True), round(splats.harmonics.shape[1] ** 0.5) - 1)
    color = np.maximum((basis[..., None] * splats.harmonics).sum(1) + 0.5, 0)
    opacity = weight.sum(1)
    depth = (weight * t).sum(1) / np.where(opacity > 0, opacity, 1)
    goal = np.where(1 - opacity <= STOP, 0.5, 0.5 * opacity)
    half = np.argmax(np.cumsum(weight, axis=1) >= goal[:, None], axis=1)
    median = np.where(opacity > 0, t[np.arange(len(d)), half], 0)
    return np.column_stack([(weight[..., None] * color[order]).sum(1), opacity, depth, median])


def check_equal(ours, expected, tolerance=1e-3):
    """Except where a Gaussian at a cut-off, or a median between two of them, is on the other side by rounding."""
    scale = np.maximum(1, np.abs(expected))
    for k in range(6):
        differs = np.abs(ours - expected)[:, k] > tolerance * scale[:, k]
        assert differs.mean() < 0.005, (k, differs.mean())
    assert np.abs(ours - expected)[:, :4].max() < 0.02


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("kind", CAMERAS)
def test_sums_equal_those_in_double_precision(rgb, no_tree, kind, scene):
    splats, sensor = SCENES[scene](), rgb.load_dict(CAMERAS[kind](rgb))
    ray = camera_rays(rgb, sensor)
    ours, exact = trace(rgb, splats, sensor, ray), sum_exactly(splats, sensor, ray, "orthographic" not in kind)
    if kind != "wide orthographic" and scene not in ("near plane", "thin", "one"):
        assert (exact[:, 3] > 0).sum() > 20
    check_equal(ours, exact)


@pytest.mark.parametrize("kind", CAMERAS)
def test_lists_show_what_the_tree_shows(rgb, monkeypatch, kind):
    """Where both blend the same hits in the same order: colours of one tone, and none left out."""
    monkeypatch.setattr(splat_lists, "MIN_ALPHA", 1e-9)
    turned = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 1.7 * turned * np.sign(np.linalg.det(turned)), (0.3, -0.2, 0.5)
    splats, sensor = cloud(150, degree=0), rgb.load_dict(CAMERAS[kind](rgb))
    ray, place = camera_rays(rgb, sensor), {"to_world": Similarity(matrix)}
    check_equal(trace(rgb, splats, sensor, ray, **place), trace(rgb, splats, sensor, ray, False, **place), 2e-4)


def test_cameras_far_from_the_origin(rgb, no_tree):
    for make in (lambda mi: orthographic(mi, 1.5, 1.5), lambda mi: lens(mi, 0.3)):
        far = rgb.ScalarTransform4f().translate([1e3, -2e3, 500])
        description = make(rgb)
        sensor = rgb.load_dict(description | {"to_world": far @ description["to_world"]})
        splats = cloud(80, degree=0, around=(1e3, -2e3, 500))
        ray = camera_rays(rgb, sensor)
        check_equal(trace(rgb, splats, sensor, ray), sum_exactly(splats, sensor, ray, True), 5e-3)


def test_lists_that_would_be_too_long_are_not_made(rgb, monkeypatch):
    monkeypatch.setattr(splat_lists, "_MAX_ENTRIES", 100)
    sensor = rgb.load_dict(lens(rgb, 0.3))
    geometry = SceneGeometry(SplatMedium(SplatArrays(cloud(100), namespace(rgb.Float))))
    for _ in range(2):
        seen = geometry.seen_from(sensor_center(sensor), 1000, camera_cells(sensor))
        assert not isinstance(seen.medium.hits, splat_lists.SplatLists)
    near = geometry.seen_from(sensor_center(sensor), 1000)
    assert isinstance(near.medium.hits, splat_lists.SplatLists)
    # That there are none is not recorded for ever more cameras.
    monkeypatch.setattr(splat_lists, "_MAX_VIEWPOINTS", 3)
    for k in range(5):
        geometry.seen_from(rgb.Point3f(k, 0, -3), 1000, camera_cells(sensor))
    assert len(geometry.medium.lists) == 3


# ---- Images ----

FILMS = {
    "whole": {},
    "crop": dict(crop_offset_x=11, crop_offset_y=5, crop_width=17, crop_height=24),
    "sample border": dict(sample_border=True, rfilter={"type": "gaussian"}),
}


@pytest.mark.parametrize("film", FILMS)
@pytest.mark.parametrize("kind", ["orthographic", "lens", "large aperture"])
@pytest.mark.parametrize("depth", ["median", "expected"])
def test_images_equal_those_by_the_tree(rgb, monkeypatch, kind, film, depth):
    """With several samples per pixel, a ceiling, and the visibility for an observer."""
    monkeypatch.setattr(splat_lists, "MIN_ALPHA", 1e-9)
    pictures, splats = [], cloud(200, degree=0)
    sensor = CAMERAS[kind](rgb)
    sensor["film"] = sensor["film"] | FILMS[film]
    for may_list in (True, False):
        place = get_plugin_class("splats").from_network(splats)
        place.may_list = may_list
        integrator = {
            "type": "nerg",
            "field": place,
            "aovs": "depth,opacity,visibility,observer_depth,position,density_evals",
            "depth": depth,
            "observer": make_observer(rgb, -2, 0.3, -2),
            "ceiling": 2.5,
            "up": [0.0, 0.0, -1.0],
        }
        pictures.append(np.array(rgb.render(scene_with(rgb, integrator, sensor), spp=3, seed=2)))
    lists, tree = pictures
    assert np.abs(lists - tree)[..., -1].max() > 0  # the number of evaluated Gaussians
    assert (tree[..., 4] > 0).mean() > 0.2
    assert np.abs(lists - tree)[..., :5].mean() < 1e-3
    differs = np.abs(lists - tree)[..., :-1] > 2e-3
    assert differs.mean() < 0.01
