"""The density of tracked rays in the integrator: against the float64 sum over the rays."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.maths.vmf import log_normaliser
from nerg_mi.tracking.rays import Rays
from tests.reference import kde as reference

from .scenes import (
    attach,
    camera,
    channels,
    make_observer,
    named,
    picture,
    plugin,
    points,
    put,
    room,
    scene_with,
    stored,
    wall,
)

KAPPA = 20.0
# Error of the table: 1e-4 of the maximum density of one ray.
TABLE = 1e-4 * float(np.exp(log_normaliser(KAPPA)))


def tracked(n=600, seed=0):
    """Participants near the middle of the room who look at two regions of its walls."""
    rng = np.random.default_rng(seed)
    origin = rng.normal(0, 0.3, (n, 3)).clip(-0.7, 0.7)
    target = np.where(np.arange(n)[:, None] % 3, (0.9, 0.3, 0.1), (0.2, 0.9, -0.3)) + rng.normal(0, 0.2, (n, 3))
    d = target - origin
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return Rays(np.arange(n), np.arange(n) % 4, tuple("abcd"), origin, d, np.ones(n))


@pytest.fixture(scope="module")
def rays(tmp_path_factory):
    path = tmp_path_factory.mktemp("rays") / "rays.npz"
    tracked().save(path)
    return str(path)


def shown(rays, aovs="kde,position", count=4096, radiance=False, **overrides):
    kde = stored("gazekde", rays, count=count, kappa=KAPPA)
    return plugin("nerg", aovs=aovs, radiance=radiance, kde=kde, **overrides)


def expected(eye, out, count=4096):
    """Float64 density of the ``count`` rays nearest to ``eye`` in the directions of the pixels."""
    data = tracked()
    near = np.argsort(np.linalg.norm(data.origin - eye, axis=1))[:count]
    p = points(out).astype(np.float64)
    d = p - eye
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    selected = data.direction[near]
    return reference.kde(d.reshape(-1, 3), selected, np.array([0, len(selected)]), np.array([KAPPA])).reshape(
        d.shape[:-1]
    )


@pytest.mark.parametrize("count", [4096, 50])
@pytest.mark.parametrize("size, error", [(12, 1e-5), (70, TABLE)], ids=["exact", "table"])
def test01_density_matches_the_rays(rgb, rays, count, size, error):
    """Small images sum all rays for each pixel, large ones interpolate a table."""
    eye = (0.1, -0.2, 0.3)
    out = channels(rgb, shown(rays, count=count), camera(rgb, eye, (0.5, 0.4, 0), size=size, fov=90), **room(rgb))
    truth = expected(eye, out, count)
    assert truth.max() > 0.3 and truth.min() < 0.05
    assert np.abs(out["kde.Y"] - truth).max() < error * (1 if error == TABLE else truth.max()) + 2e-6


def test02_other_observers_and_occlusion(rgb, rays):
    """No gaze field is needed; hidden surfaces are 0, others have the observer's density."""
    eye = (0, 0, -0.9)
    sensor = camera(rgb, (0.5, 0, 0.2), (0.5, 0, 1), fov=65, near_clip=1e-3)
    how = {"density": wall(rgb), "step": 0.01, "falloff": 0.0, "observer": make_observer(rgb, *eye)}
    out = channels(rgb, shown(rays, "kde,position,visibility", **how), sensor)
    hidden, seen = out["visibility.Y"] == 0, out["visibility.Y"] == 1
    assert hidden.sum() > 20 and seen.sum() > 5 and not out["kde.Y"][hidden].any()
    np.testing.assert_allclose(out["kde.Y"][seen], expected(eye, out)[seen], rtol=1e-3, atol=1e-5)
    open_ = channels(rgb, shown(rays, occlusion=False, **how), sensor)["kde.Y"]
    assert (open_[hidden] > 0).all()


def test03_rays_are_collected_once_per_observer(rgb, rays):
    integrator = shown(rays, observer=make_observer(rgb, 0.2, 0.1, 0), falloff=0.0)
    scene = scene_with(rgb, integrator, camera(rgb, (0.1, -0.2, 0.3), (0.5, 0, 0), size=70), **room(rgb))
    view = scene.integrator().views["kde"]
    selected = lambda: scene.integrator().cache.peek(view)[0].value
    first = picture(rgb, scene)
    made, table = selected(), selected().table
    np.testing.assert_array_equal(picture(rgb, scene), first)
    assert selected() is made and made.table is table is not None
    put(rgb.traverse(scene), "integrator.observer.to_world", rgb.Transform4f().translate([-0.3, 0.1, 0.1]))
    moved = named(rgb, picture(rgb, scene), integrator)
    assert selected() is not made
    seen = moved["kde.Y"] > 0
    assert np.abs(moved["kde.Y"] - expected((-0.3, 0.1, 0.1), moved))[seen].max() < TABLE + 1e-5


def test04_each_camera_of_a_batch_has_its_own_density(rgb, rays):
    integrator, positions = shown(rays, count=100), [(0.3, 0.1, 0), (-0.5, 0.4, 0.2)]
    film = {"type": "hdrfilm", "width": 24, "height": 12, "component_format": "float32", "rfilter": {"type": "box"}}
    batch = {
        "type": "batch",
        "film": film,
        **{f"s{i}": camera(rgb, eye, (0, 0.5, 0.9)) for i, eye in enumerate(positions)},
    }
    both = channels(rgb, integrator, batch, **room(rgb))
    for i, eye in enumerate(positions):
        half = {k: v[:, 12 * i : 12 * i + 12] for k, v in both.items()}
        np.testing.assert_allclose(half["kde.Y"], expected(eye, half, 100), rtol=1e-3, atol=1e-5)


def test05_rays_in_another_frame(rgb, rays):
    """The rays' frame is rotated, scaled by two and moved, like the whole scene; densities do not change."""
    matrix = rgb.ScalarTransform4f().translate([1, 2, 3]).rotate([0, 0, 1], 90).scale(2)
    shapes = {k: {**v, "to_world": matrix @ v["to_world"]} for k, v in room(rgb).items()}
    integrator, sensor = shown(rays), camera(rgb, (0.1, -0.2, 0.3), (0.5, 0.4, 0), fov=60)
    plain = channels(rgb, integrator, sensor, **room(rgb))["kde.Y"]
    integrator["kde"]["to_world"] = matrix
    # A camera has no scale.
    sensor["to_world"] = matrix @ sensor["to_world"] @ rgb.ScalarTransform4f().scale(0.5)
    np.testing.assert_allclose(channels(rgb, integrator, sensor, **shapes)["kde.Y"], plain, rtol=2e-3, atol=1e-4)


def test07_missing_dependencies_are_reported(rgb, rays, tmp_path):
    for integrator, said in (
        ({"type": "nerg", "aovs": "kde"}, '"kde" volume of type "gazekde"'),
        ({"type": "nerg", "kde": {"type": "constvolume"}}, 'must be a volume of type "gazekde"'),
        (shown(str(tmp_path / "no.npz")), "no.npz"),
        (shown(rays, count=0), '"count"'),
    ):
        with pytest.raises(RuntimeError, match=said):
            rgb.load_dict(integrator)
    assert "count = 600" in str(rgb.load_dict(shown(rays)["kde"]))


def test09_density_is_zero_without_a_surface(rgb, rays):
    """Neither next to a shape nor where matter is thinner than a surface."""
    eye, sensor = (0.1, -0.2, 0.3), camera(rgb, (0.5, 0.4, -3), (0, 0, 0), fov=60)
    ball = {"type": "sphere", "center": [0.3, 0.2, -0.4], "radius": 0.5}
    thin = {"density": {"type": "constvolume", "value": 0.4}, "surface_opacity": 0.5, "occlusion": False}
    out = channels(
        rgb, shown(rays, "kde,position,opacity", observer=make_observer(rgb, *eye), **thin), sensor, ball=ball
    )
    solid = out["opacity.Y"] == 1
    assert solid.sum() > 5 and (out["opacity.Y"][~solid] > 0).any() and (out["opacity.Y"] == 0).any()
    assert not out["kde.Y"][~solid].any()
    np.testing.assert_allclose(out["kde.Y"][solid], expected(eye, out)[solid], rtol=1e-3, atol=1e-5)


def test_rays_beside_a_differentiated_albedo_are_one_kernel(rgb, rays):
    """Mitsuba evaluates the loops of a derivative: each ray would be a kernel."""
    counts = []
    for count in (20, 200):
        integrator = shown(rays, "kde", count, radiance=True)
        scene = scene_with(rgb, integrator, camera(rgb, (0.1, -0.2, 0.3), (0.5, 0.4, 0), size=8), **room(rgb))
        params = rgb.traverse(scene)
        attach(params, next(k for k in params.keys() if k.endswith("reflectance.value")))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.backward(dr.mean(rgb.render(scene, params, spp=4)[..., :3]))
            counts.append(len(dr.kernel_history([dr.KernelType.JIT])))
    assert counts[0] == counts[1] < 30
