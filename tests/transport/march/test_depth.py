"""Depths against closed forms, for opaque and semi-transparent matter, and a user-defined kind of depth."""

import math

import drjit as dr
import numpy as np
import pytest

from nerg_mi.evaluation import study
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.transport.depth import DEPTHS, Expected, MarchContext, penetration_depth
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.evaluation.subjects import make_subject
from tests.plugins.scenes import channels, constant, straight
from tests.reference import march_numpy as reference

# ---- Expected and median depth against closed forms ----


def depth(mi, medium, kind, settings, o=(0.5, 0.5, 0), d=(0, 0, 1)):
    o, d = np.atleast_2d(np.asarray(o, np.float32)), np.atleast_2d(np.asarray(d, np.float32))
    ray = medium.ray_to_local(mi.Point3f(o.T), mi.Vector3f(d.T))
    t0, t1, active = dr.maximum(ray.t_near, 0), ray.t_far, mi.Bool(True)
    result = march(medium, ray, t0, t1, active, settings)
    return DEPTHS.find(kind).inside(MarchContext(result, medium, ray, t0, t1, active, settings)).numpy()


def slab(mi, sigma, near=1.0):
    to_world = mi.ScalarTransform4f().translate([0, 0, near])
    return VolumeMedium(mi.load_dict({"type": "constvolume", "value": float(sigma), "to_world": to_world}))


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 0.1, 0.69, 0.7, 1, 3, 10, 13.8, 13.9, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("kind", ["expected", "median"])
def test01_slab(rgb, kind, sigma):
    # The median of a thin slab is its middle: half of *this ray's own* opacity.
    expected = reference.slab(sigma, 1, 2)[1 if kind == "expected" else 2]
    assert np.isclose(depth(rgb, slab(rgb, sigma), kind, MarchSettings(0.01))[0], expected, rtol=1e-5)


@pytest.mark.parametrize("kind", ["expected", "median"])
def test02_no_matter_gives_zero_depth(rgb, kind):
    assert depth(rgb, slab(rgb, 0), kind, MarchSettings(0.01)).tolist() == [0]
    assert depth(rgb, slab(rgb, 5), kind, MarchSettings(0.01), o=(3, 3, 0)).tolist() == [0]


def two_slabs(mi, front, back):
    """Density in [0.2, 0.4] and [0.7, 0.9] of the unit cube, as steps of a nearest-neighbour grid."""
    data = np.zeros((10, 1, 1), np.float32)
    data[2:4], data[7:9] = front, back
    return VolumeMedium(mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(data), "filter_type": "nearest"}))


@pytest.mark.parametrize("front, back", [(1, 1), (2, 1e4), (0.1, 50), (5, 5), (100, 1)])
def test03_window_in_front_of_a_wall(rgb, front, back):
    medium = two_slabs(rgb, front, back)
    settings = MarchSettings(0.1 / 64)
    a, b = 0.2 * front, 0.2 * back
    w1, w2 = -math.expm1(-a), math.exp(-a) * -math.expm1(-b)
    mean = lambda s, near: reference.slab(s, near, near + 0.2)[1]
    expected = (w1 * mean(front, 1.2) + w2 * mean(back, 1.7)) / (w1 + w2)
    goal = -math.log1p(-(w1 + w2) / 2)
    median = 1.2 + goal / front if goal <= a else 1.7 + (goal - a) / back
    got = [depth(rgb, medium, kind, settings, o=(0.5, 0.5, -1))[0] for kind in ("expected", "median")]
    assert np.allclose(got, [expected, median], rtol=2e-5)


@pytest.mark.parametrize("stop", [0, 1e-6, 1e-2, 0.3, 0.5, 0.6, 0.9, 1.0])
@pytest.mark.parametrize("kind", ["expected", "median"])
def test04_depth_lies_in_the_box_for_any_stop(rgb, kind, stop):
    # A march that ends early sees less, but its depth lies in the box.
    got = depth(rgb, slab(rgb, [20.0][0]), kind, MarchSettings(0.01, stop=stop))[0]
    assert 1 <= got <= 1.06


def test05_median_gradient_equals_central_differences(rgb):
    # d/dσ of -log((1 + e^-σ) / 2) / σ
    for sigma in (0.1, 1.0, 5.0, 50.0):
        data = rgb.TensorXf(np.full((2, 2, 2, 1), sigma, np.float32))
        volume = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.full((2, 2, 2), sigma, np.float32))})
        params = rgb.traverse(volume)
        key = next(k for k in params.keys() if k.endswith("data"))
        s = rgb.Float(sigma)
        dr.enable_grad(s)
        params[key] = data * 0 + s
        params.update()
        medium = VolumeMedium(volume)
        for kind, form in (("median", 2), ("expected", 1)):
            ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, -1), rgb.Vector3f(0, 0, 1))
            settings = MarchSettings(1 / 32)
            result = march(medium, ray, ray.t_near, ray.t_far, True, settings)
            d = DEPTHS.find(kind).inside(
                MarchContext(result, medium, ray, ray.t_near, ray.t_far, rgb.Bool(True), settings)
            )
            dr.set_grad(s, 0)
            dr.backward(d, dr.ADFlag.ClearInterior)
            h = 1e-5 * sigma
            difference = (reference.slab(sigma + h, 1, 2)[form] - reference.slab(sigma - h, 1, 2)[form]) / (2 * h)
            assert np.isclose(dr.grad(s).numpy()[0], difference, rtol=2e-3, atol=1e-5), (kind, sigma)


@pytest.mark.parametrize("kind", DEPTHS.names())
def test06_penetration_depth_of_thick_and_thin_matter(rgb, kind):
    # The surface of thick matter lies at the penetration depth; in fog the distance is limited.
    for sigma, near in ((200, 1), (1e3, 1), (1e6, 2), (20, 1), (0.5, 1)):
        medium = slab(rgb, sigma, near)
        ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
        result = march(medium, ray, ray.t_near, ray.t_far, True, MarchSettings(1 / 64))
        d = DEPTHS.find(kind).inside(
            MarchContext(result, medium, ray, ray.t_near, ray.t_far, rgb.Bool(True), MarchSettings(1 / 64))
        )
        out, d = penetration_depth(kind, result, d).numpy()[0], d.numpy()[0]
        if sigma >= 200:
            assert abs(d - out - near) < 1e-5
        else:
            direction = min(DEPTHS.find(kind).mean_free_paths / sigma, d / 64)
            assert math.isclose(out, direction if sigma == 20 else 0, rel_tol=1e-5)


@pytest.mark.parametrize("sigma", [0.4, 60.0])
def test07_evaluations_of_depth_search_are_added(rgb, sigma):
    medium, settings = slab(rgb, sigma), MarchSettings(0.01, stop=1e-3)
    ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
    counts = {}
    for kind in DEPTHS.names():
        result = march(medium, ray, ray.t_near, ray.t_far, True, settings, count=True)
        first = result.density_evals[0]
        DEPTHS.find(kind).inside(MarchContext(result, medium, ray, ray.t_near, ray.t_far, rgb.Bool(True), settings))
        counts[kind] = result.density_evals[0] - first
    # Thin matter is marched again up to half of its own opacity; a refined depth takes at most sixteen steps inside
    # one.
    again = 0 if sigma > 1 else -math.log1p(0.5 * math.expm1(-sigma)) / sigma * 100
    assert counts["expected"] == 0 and abs(counts["median"] - again) <= 1
    assert counts["median"] < counts["refined"] <= counts["median"] + 17


@pytest.mark.parametrize("stop", [1e-6, 1e-2])
def test08_refined_depth_resolves_walls_inside_a_step(rgb, stop):
    """A wall that starts inside a step: the rule spreads it over the whole step, refinement does not. For opaque rays
    and for others."""
    back = 40.0
    data = np.zeros((64, 1, 1), np.float32)
    data[27:37] = 3.0
    data[44:] = back
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data), "filter_type": "nearest"}))
    total = 3 * 10 / 64 + back * 20 / 64
    goal = -math.log1p(0.5 * math.expm1(-total))
    want = 27 / 64 + goal / 3 if goal < 30 / 64 else 44 / 64 + (goal - 30 / 64) / back
    steps = MarchSettings(1 / 9, stop=stop)
    median, refined = (abs(depth(rgb, medium, kind, steps, (0.5, 0.5, 0))[0] - want) for kind in ("median", "refined"))
    assert refined < 0.25 * median and median > 4e-3


@pytest.mark.parametrize("kind", ["median", "refined"])
def test09_inactive_lanes_have_no_depth(rgb, kind):
    """For rays that have all been marched."""
    medium, settings = slab(rgb, 60), MarchSettings(0.1)
    ray = medium.ray_to_local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
    result = march(medium, ray, ray.t_near, ray.t_far, True, settings)
    requested = rgb.Bool([True, False])
    results = (
        DEPTHS.find(kind).inside(MarchContext(result, medium, ray, ray.t_near, ray.t_far, requested, settings)).numpy()
    )
    assert results[0] > 1 and results[1] == 0


# ---- A user-defined kind of depth is one object: it is traced, rendered with and without shapes, and studied ----


class Entered:
    """The start of the march, and the shape itself if there is one."""

    name = "entered"
    summary = "where the march begins"
    mean_free_paths = 0.0
    is_at_half_opacity = False
    surface_kind = "entered"

    def find_exact(self, profile):
        return profile.quantile(0)

    def inside(self, context):
        return dr.select(context.result.tau > 0, context.t0, 0)

    def combine_with_shape(self, result, front, inside, hit, distance):
        return distance


@pytest.fixture
def entered():
    kind = DEPTHS.register(Entered())
    yield kind
    DEPTHS.unregister("entered")


def test01_registered_depth_is_traced(rgb, entered):
    fog = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 3.0}))
    depth, opacity = trace_depth(fog, [[0.5, 0.5, -1.5], [3, 0.5, -1]], [[0, 0, 1], [0, 0, 1]], kind="entered")
    assert depth.tolist() == [1.5, 0] and opacity[0] > 0.9


def test02_registered_depth_renders_with_and_without_shapes(rgb, entered):
    plate = {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([0, 0, 0.5]).scale(2)}
    requested = constant(3.0, depth="entered", aovs="depth,position")
    sensor = straight(rgb, "perspective")
    # The camera is at z = -2, and its rays start a hundredth in front of it.
    for overrides, want in (({}, 1.99), ({"plate": plate}, 2.49)):
        result = channels(rgb, requested, sensor, **overrides)
        assert np.allclose(result["depth.T"], want, rtol=1e-5) and np.allclose(
            result["position.Z"], want - 1.99, atol=1e-4
        )


def test03_registered_depth_is_listed(rgb, entered):
    assert DEPTHS.names()[-1] == "entered"
    assert DEPTHS.format_manual().endswith("``entered``: where the march begins.")
    DEPTHS.unregister("entered")
    with pytest.raises(RuntimeError, match='"depth"'):
        rgb.load_dict(constant(depth="entered"))
    DEPTHS.register(entered)


def test04_penetration_depth_matches_mean_free_paths(rgb):
    """The mean free paths of each kind are those of a thick slab of constant density."""
    sigma = 500.0
    slab = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": sigma}))
    for kind in DEPTHS:
        depth, _ = trace_depth(slab, [[0.5, 0.5, 0.0]], [[0, 0, 1]], kind=kind.name)
        assert np.isclose(depth[0] * sigma, kind.mean_free_paths, rtol=1e-3), kind.name
    assert Expected().mean_free_paths == 1


@pytest.mark.parametrize("hits", [False, True], ids=["marched", "splats"])
def test05_study_includes_registered_depth(entered, hits):
    """Each kind is among the study's settings, for splats only kinds with a surface of their own."""
    subject = make_subject(1.0, has_splats=hits)
    kinds = {s.params["depth"] for s in study.list_rows(subject) if s.group == "depth"}
    assert kinds >= {"expected", "median", "entered"} and ("refined" in kinds) is not hits


def test06_study_compares_registered_depth_with_its_exact_value(rgb, entered):
    subject = open_subject("slab", "auto", 8, 8)
    entry, median, refined = (subject.get_truth(1, kind, "depth") for kind in ("entered", "median", "refined"))
    rendered = subject.render_channels(subject.make_integrator({"depth": "entered"}), 1, 1)["depth"]
    assert np.allclose(entry.depth, rendered, rtol=1e-4) and (entry.depth < median.depth).any() and refined is median
