"""Derivatives along lists of Gaussians: against central differences in float64, against the tree, and in images."""

from __future__ import annotations

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.splats import Splats, quaternions_to_matrices
from nerg_mi.maths.sphere import eval_harmonics
from nerg_mi.registration import get_plugin_class
from nerg_mi.transport import splat_lists
from nerg_mi.transport.geometry import SceneGeometry, SceneRay, default_march_settings
from nerg_mi.transport.medium import ColorShader
from nerg_mi.transport.splat_medium import MAX_ALPHA, SplatArrays, SplatMedium
from tests.plugins.scenes import camera, look_at, put, still

NAMES = ("centers", "scales", "rotations", "opacities", "harmonics")
STOP = 1e-4

pytestmark = pytest.mark.usefixtures("any_number", "sorted_hits")


def cloud(count, degree=1, seed=0, size=2.0, width=0.2, opacities=(0.05, 0.95)):
    """Gaussians in a shell around the origin."""
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(count, 3))
    p *= size * rng.uniform(0.3, 1, (count, 1)) / np.linalg.norm(p, axis=1, keepdims=True)
    scales = width * np.exp(rng.normal(0, 0.4, (count, 3)))
    harmonics = rng.normal(0, 0.5, (count, (degree + 1) ** 2, 3))
    return Splats(p, scales, rng.normal(size=(count, 4)), rng.uniform(*opacities, count), harmonics)


def opaque_front():
    """Gaussians that absorb as much light as any in front of others, which are partly hidden."""
    splats = cloud(40, seed=3, size=3)
    near = np.arange(40)[:, None] < 24
    centers = np.where(near, 1.0, 2.0) * splats.centers / np.linalg.norm(splats.centers, axis=1)[:, None]
    scales = np.where(near, 0.6, 0.3) * (0.7, 1, 1.3)
    opacities = np.where(near.ravel(), 1.0, 0.6)
    return Splats(centers, scales, splats.rotations, opacities, splats.harmonics)


def overlapping_pair():
    harmonics = np.random.default_rng(8).normal(0, 0.4, (2, 4, 3))
    turns = np.eye(4)[:2] + 0.1
    return Splats([[0, 0, 1.5], [0.1, 0.1, 1.6]], [[0.4, 0.2, 0.3]] * 2, turns, [0.6, 0.8], harmonics)


SCENES = {
    "one": lambda: cloud(1, size=1, width=0.3),
    "two": overlapping_pair,
    "hundred": lambda: cloud(100),
    "transparent": lambda: cloud(60, seed=2, opacities=(0.01, 0.06)),
    "opaque front": opaque_front,
}


def directions(splats, count=150):
    """Towards the Gaussians, and around them."""
    rng = np.random.default_rng(1)
    p = splats.centers[rng.integers(0, len(splats), count)]
    d = p / np.linalg.norm(p, axis=1, keepdims=True) + rng.normal(0, 0.1, (count, 3))
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


# ---- In float64 ----


def trace_exactly(values, d, hits=None):
    """Colour, opacity and mean depth (R, 5) of rays from the origin, and the hits that led to them; ``hits``: those."""
    turn = quaternions_to_matrices(values["rotations"] / np.linalg.norm(values["rotations"], axis=1, keepdims=True))
    to_axes = turn.transpose(0, 2, 1) / values["scales"][:, :, None]
    start = -np.einsum("nij,nj->ni", to_axes, values["centers"])
    along = np.einsum("nij,rj->rni", to_axes, d)
    t = -(start * along).sum(-1) / (along * along).sum(-1)
    square = ((start + t[..., None] * along) ** 2).sum(-1)
    alpha = np.minimum(values["opacities"] * np.exp(-square / 2), MAX_ALPHA)
    u = values["centers"] / np.linalg.norm(values["centers"], axis=1, keepdims=True)
    basis = eval_harmonics(u, round(values["harmonics"].shape[1] ** 0.5) - 1)
    color = np.maximum(np.einsum("nk,nkc->nc", basis, values["harmonics"]) + 0.5, 0)
    if hits is None:
        is_hit = (t >= 0) & (alpha >= splat_lists.MIN_ALPHA) & (square < 9)
        order = np.argsort(np.where(is_hit, t, np.inf), axis=1)
        is_hit = np.take_along_axis(is_hit, order, 1)
        behind = np.cumprod(1 - np.where(is_hit, np.take_along_axis(alpha, order, 1), 0), axis=1)
        before = np.concatenate([np.ones((len(d), 1)), behind[:, :-1]], axis=1)
        hits = order, is_hit & (before > STOP)
    order, is_hit = hits
    alpha, t = np.where(is_hit, np.take_along_axis(alpha, order, 1), 0), np.take_along_axis(t, order, 1)
    behind = np.cumprod(1 - alpha, axis=1)
    weight = np.concatenate([np.ones((len(d), 1)), behind[:, :-1]], axis=1) * alpha
    opacity = weight.sum(1)
    depth = (weight * t).sum(1) / np.where(opacity > 0, opacity, 1)
    return np.column_stack([(weight[..., None] * color[order]).sum(1), opacity, depth]), hits


def differentiate_exactly(splats, d, weights, along):
    """Central differences of the weighted sum of all values in the directions ``along`` of each parameter (K, size), at
    fixed hits."""
    values = {name: getattr(splats, name).astype(np.float64) for name in NAMES}
    _, hits = trace_exactly(values, d)
    result = {}
    for name, steps in along.items():
        ends = []
        for sign in (1, -1):
            moved = [values[name] + sign * 1e-6 * step.reshape(values[name].shape) for step in steps]
            ends.append([(weights * trace_exactly(values | {name: m}, d, hits)[0]).sum() for m in moved])
        result[name] = np.subtract(*ends) / 2e-6
    return result


def choose_steps(splats):
    """Each entry of small parameters, and random directions of others."""
    rng, result = np.random.default_rng(5), {}
    for name in NAMES:
        size = getattr(splats, name).size
        result[name] = np.eye(size) if size <= 24 else rng.normal(size=(12, size))
    return result


def choose_weights(values):
    """A weight for each value; none for depths of very faint rays."""
    weights = np.random.default_rng(6).uniform(0.2, 1, values.shape)
    weights[values[:, 3] < 0.02, 4] = 0
    return weights


# ---- With lists, or the tree ----


class Differentiation:
    """Values (R, 5) of rays from the origin through Gaussians, and the derivatives of their weighted sum."""

    def __init__(self, rgb, splats, d, has_lists=True):
        ns = namespace(rgb.Float)
        self.rgb, self.arrays = rgb, SplatArrays(splats, ns)
        for name in NAMES:
            dr.enable_grad(getattr(self.arrays, name))
        self.arrays.pack()
        self.origin, self.d = rgb.Point3f(0, 0, 0), rgb.Vector3f(d.T)
        dr.enable_grad(self.origin, self.d)
        geometry = SceneGeometry(SplatMedium(self.arrays, may_list=has_lists))
        geometry = geometry.seen_from(self.origin, len(d))
        ray = SceneRay(self.origin + 0 * self.d, self.d, rgb.Float(dr.inf))
        settings = default_march_settings(geometry)
        hit = geometry.trace(ray, dr.full(rgb.Bool, True, len(d)), settings, color=ColorShader(rgb.Color3f))
        self.outputs = [*hit.march.color, hit.opacity, hit.depth("expected", hit.opacity > 0)]
        self.values = np.stack([np.array(dr.detach(v), np.float64) for v in self.outputs], axis=1)

    def backward(self, weights):
        """Derivatives by parameter, flat."""
        terms = [dr.sum(v * self.rgb.Float(w.astype(np.float32))) for v, w in zip(self.outputs, weights.T)]
        dr.backward(sum(terms))
        result = {name: np.array(dr.grad(getattr(self.arrays, name)), np.float64) for name in NAMES}
        return result | {"origin": np.array(dr.grad(self.origin)).ravel(), "d": np.array(dr.grad(self.d)).ravel()}

    def forward(self, name, step):
        """The derivative of the values (R, 5) along ``step`` of a parameter."""
        dr.set_grad(getattr(self.arrays, name), type(self.outputs[0])(step.astype(np.float32)))
        dr.enqueue(dr.ADMode.Forward, getattr(self.arrays, name))
        dr.traverse(dr.ADMode.Forward)
        return np.stack([np.array(dr.grad(v), np.float64) + np.zeros(len(self.values)) for v in self.outputs], axis=1)


@pytest.mark.parametrize("scene", SCENES)
def test_derivatives_equal_central_differences_in_double_precision(rgb, no_tree, scene):
    splats = SCENES[scene]()
    d, steps = directions(splats), choose_steps(splats)
    ours = Differentiation(rgb, splats, d)
    exact, _ = trace_exactly({name: getattr(splats, name).astype(np.float64) for name in NAMES}, d.astype(np.float64))
    np.testing.assert_allclose(ours.values, exact, rtol=2e-4, atol=2e-4)
    if scene == "opaque front":
        assert (exact[:, 3] > 1 - STOP).sum() > 20
    weights = choose_weights(exact)
    gradients = ours.backward(weights)
    for name, expected in differentiate_exactly(splats, d.astype(np.float64), weights, steps).items():
        got = steps[name] @ gradients[name]
        assert np.abs(expected).max() > 1e-2
        assert np.abs(got - expected).max() < 1e-3 * np.abs(expected).max(), name


@pytest.mark.parametrize("scene", SCENES)
def test_derivatives_equal_those_of_the_tree_in_one_order(rgb, monkeypatch, scene):
    """Where both blend the same hits in the same order: colours of one tone, and none left out."""
    monkeypatch.setattr(splat_lists, "MIN_ALPHA", 1e-9)
    splats = SCENES[scene]()
    splats = Splats(splats.centers, splats.scales, splats.rotations, splats.opacities, splats.harmonics[:, :1])
    d = directions(splats)
    both = [Differentiation(rgb, splats, d, has_lists) for has_lists in (True, False)]
    np.testing.assert_allclose(both[0].values, both[1].values, rtol=1e-4, atol=1e-4)
    weights = choose_weights(both[1].values)
    lists, tree = (run.backward(weights) for run in both)
    for name, expected in tree.items():
        assert np.linalg.norm(expected) > 1e-2
        assert np.linalg.norm(lists[name] - expected) < 1e-3 * np.linalg.norm(expected), name


def test_forward_and_reverse_derivatives_agree(rgb, no_tree):
    splats, rng = cloud(60), np.random.default_rng(2)
    d = directions(splats)
    ours = Differentiation(rgb, splats, d)
    weights = choose_weights(ours.values)
    gradients = ours.backward(weights)
    for name in NAMES:
        step = rng.normal(size=gradients[name].size)
        got = (weights * Differentiation(rgb, splats, d).forward(name, step)).sum()
        assert np.isclose(got, step @ gradients[name], rtol=1e-3), name


def test_all_hits_before_the_end_of_a_ray_have_derivatives(rgb, no_tree):
    """The derivative of the sum of all colours with respect to a colour is the light that it absorbs."""
    splats = opaque_front()
    flat = Splats(splats.centers, splats.scales, splats.rotations, splats.opacities, 0 * splats.harmonics[:, :1])
    ours = Differentiation(rgb, flat, directions(flat, 2000))
    gradients = ours.backward(np.tile([1.0, 1, 1, 0, 0], (2000, 1)))["harmonics"]
    assert np.isclose(gradients.sum(), 3 * 0.28209479 * ours.values[:, 3].sum(), rtol=1e-5)


# ---- Images ----

KEY = "i.field."
CAMERAS = {
    "perspective": lambda mi: still(camera(mi, (0.2, 0.1, -3), size=24)),
    "orthographic": lambda mi: still(camera(mi, (0.2, 0.1, -3), kind="orthographic", size=24)),
    # Its rays are random.
    "lens": lambda mi: camera(
        mi, (0.2, 0.1, -3), kind="thinlens", size=24, fov=35, aperture_radius=0.2, focus_distance=2.7
    ),
}


def scene_of(rgb, splats, extent=3.0, kind="perspective"):
    place = get_plugin_class("splats").from_network(splats)
    place.field.extent = extent
    place.field.pack()
    integrator = {"type": "nerg", "id": "i", "field": place, "depth": "expected", "stop": 1e-7}
    sensor = CAMERAS[kind](rgb) | {"id": "s"}
    return rgb.load_dict({"type": "scene", "i": integrator, "s": sensor})


def channels_of(rgb, scene, params):
    """Channels of an image; of a lens, those of random rays, since Mitsuba takes others for derivatives."""
    sensor, integrator = scene.sensors()[0], scene.integrator()
    if not sensor.needs_aperture_sample():
        picture = rgb.render(scene, params, spp=1, seed=0)
        return [rgb.Float(picture[..., i].array) for i in range(5)]
    numbers = np.random.default_rng(4).uniform(size=(2, 2, 24 * 24)).astype(np.float32)
    ray, _ = sensor.sample_ray_differential(0, 0.5, *map(rgb.Point2f, numbers))
    with integrator.rendering_from(sensor, scene):
        color, _, aovs = integrator.sample(scene, sensor.sampler(), ray)
    return [*color, *aovs]


def loss_of(rgb, scene, params=None):
    """A weighted sum of colours, depths times opacities, and opacities: depths of faint pixels jump at cut-offs."""
    *color, depth, opacity = channels_of(rgb, scene, params)
    weights = np.random.default_rng(3).uniform(0.2, 1, (5, 24 * 24)).astype(np.float32)
    return dr.mean(sum(rgb.Float(w) * v for w, v in zip(weights, (*color, depth * opacity, opacity))))


@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize("name", NAMES)
def test_derivatives_of_images(rgb, no_tree, monkeypatch, name, kind):
    monkeypatch.setattr(splat_lists, "MIN_ALPHA", 1e-9)
    scene = scene_of(rgb, cloud(60, size=1, width=0.06), 6.0, kind)
    params, h = rgb.traverse(scene), 2e-3
    before = rgb.Float(params[KEY + name])
    value = rgb.Float(before)
    dr.enable_grad(value)
    put(params, KEY + name, value)
    dr.backward(loss_of(rgb, scene, params))
    gradient = np.array(dr.grad(value), np.float64)
    step = gradient / np.linalg.norm(gradient)
    ends = []
    for sign in (1, -1):
        put(params, KEY + name, before + rgb.Float((sign * h * step).astype(np.float32)))
        ends.append(float(loss_of(rgb, scene).numpy().item()))
    assert np.isclose((ends[0] - ends[1]) / (2 * h), np.linalg.norm(gradient), rtol=2e-2)


@pytest.mark.parametrize("motion", ["translation", "rotation"])
@pytest.mark.parametrize("kind", CAMERAS)
def test_derivatives_of_images_with_respect_to_the_camera(rgb, no_tree, monkeypatch, kind, motion):
    """Colours depend on the direction."""
    monkeypatch.setattr(splat_lists, "MIN_ALPHA", 1e-9)
    scene = scene_of(rgb, cloud(60, degree=2, size=1, width=0.06), 6.0, kind)
    params = rgb.traverse(scene)
    move = {
        "translation": lambda x: rgb.Transform4f().translate(rgb.Vector3f(x, 0, 0)),
        "rotation": lambda x: rgb.Transform4f().rotate(rgb.Vector3f(0, 1, 0), 20 * x),
    }[motion]
    pose = lambda x: move(x) @ rgb.Transform4f(look_at(rgb, (0.2, 0.1, -3)))
    x = rgb.Float(0)
    dr.enable_grad(x)
    put(params, "s.to_world", pose(x))
    dr.backward(loss_of(rgb, scene, params))
    ends = []
    for h in (2e-3, -2e-3):
        put(params, "s.to_world", pose(rgb.Float(h)))
        ends.append(float(loss_of(rgb, scene).numpy().item()))
    assert np.isclose((ends[0] - ends[1]) / 4e-3, dr.grad(x)[0], rtol=2e-2)


def test_a_fit_to_photos_reads_lists(rgb, no_tree):
    splats = cloud(50, size=1)
    photo = rgb.render(scene_of(rgb, splats), spp=4)[..., :3]
    grey = Splats(splats.centers, splats.scales, splats.rotations, splats.opacities, 0.2 * splats.harmonics)
    scene = scene_of(rgb, grey)
    params = rgb.traverse(scene)
    params.keep([KEY + name for name in NAMES])
    opt, losses = rgb.ad.Adam(lr=0.02, params={KEY + "harmonics": params[KEY + "harmonics"]}), []
    for i in range(8):
        params.update(opt)
        picture = rgb.render(scene, params, spp=1, seed=i)
        loss = dr.mean(dr.square(picture[..., :3] - photo), axis=None)
        dr.backward(loss)
        opt.step()
        losses.append(loss.numpy().item())
    assert losses[-1] < 0.7 * losses[0]
    # Lists of earlier steps are not kept.
    assert len(scene.integrator().medium.lists) == 1
