"""Normalised gaze fields in the integrator: what an observer gives all directions together is one."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.geometry import Box
from nerg_mi.transport.geometry import Place

from . import fields
from .scenes import camera, channels, observed, observer_at

GRID = HashGridConfig(levels=2, log2_rows=10, base=2, finest=4)


def log_gaze(path, **kwargs):
    import drjit.llvm.ad as ns

    rng = np.random.default_rng(4)
    config = LogGazeConfig(grid=GRID, width=16, prior=16, heads=((-1, -1, -1), (1, 1, 1)), **kwargs)
    field = LogGazeField.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 3)
    field.set_parameters(
        {
            "grid.table": ns.Float((2 * rng.normal(size=len(field.grid.table))).astype(np.float32)),
            "escaped": ns.Float(0.4),
        }
    )
    # Random networks are nearly constant: these are not.
    field.set_parameters({k: 8 * v for k, v in field.parameters().items() if k in ("emit_net.2", "capture_net.2")})
    save_gaze(field, path, {})
    return {"type": "gazefield", "filename": str(path)}


def room(mi, open_side=False):
    """A cube to look at from within, one side of which may be missing."""
    walls = {}
    for axis in range(3):
        for side in (-1, 1):
            if open_side and (axis, side) == (1, 1):
                continue
            up = [0, 0, 1] if axis != 2 else [0, 1, 0]
            at = [0.9 * side if a == axis else 0 for a in range(3)]
            walls[f"w{axis}{side + 1}"] = {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().look_at(at, [0, 0, 0], up).scale([0.9, 0.9, 1]),
            }
    return walls


def around(mi, origin, integrator, size=48, **more):
    """Gaze in every direction of an observer, and the solid angles of the pixels."""
    sensor = {
        "type": "panorama",
        "to_world": mi.ScalarTransform4f().translate(list(origin)),
        "film": {
            "type": "hdrfilm",
            "width": 2 * size,
            "height": size,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "stratified", "sample_count": 4},
    }
    out = channels(mi, integrator, sensor, spp=4, **more)
    theta = np.linspace(0, np.pi, size + 1)
    return out["gaze.Y"], (np.cos(theta[:-1]) - np.cos(theta[1:]))[:, None] * (np.pi / size)


@pytest.mark.parametrize("origin", [(0, 0, 0), (0.5, -0.3, 0.2)])
@pytest.mark.parametrize("kind", ["log", "mixed", "softplus", "capture"])
def test01_integrates_to_one(rgb, tmp_path, origin, kind):
    path = tmp_path / "g.safetensors"
    if kind == "softplus":
        fields.gaze(path, normalized=True)
        gaze = {"type": "gazefield", "filename": str(path)}
    else:
        gaze = log_gaze(
            path, mix=0.3 if kind == "mixed" else 0.0, variant="capture" if kind == "capture" else "emit_capture"
        )
    density, angle = around(rgb, origin, {"type": "nerg", "aovs": "gaze", "radiance": False, "gaze": gaze}, **room(rgb))
    assert np.ptp(density) > 2e-3 and (density >= 0).all()
    assert (density * angle).sum() == pytest.approx(1, abs=4e-3)


def test02_what_escapes_counts(rgb, tmp_path):
    """Through the open side goes what the constant says: the share that is missing from what the walls get."""
    gaze = log_gaze(tmp_path / "g.safetensors", variant="emit")
    density, angle = around(
        rgb, (0, 0, 0), {"type": "nerg", "aovs": "gaze", "radiance": False, "gaze": gaze}, **room(rgb, True)
    )
    seen = density > 0
    share = (angle * ~seen).sum() / (4 * np.pi)
    assert share == pytest.approx(1 / 6, abs=0.02)
    scene = rgb.load_dict({"type": "scene", **room(rgb, True)})
    eye = rgb.Point3f(0)
    lost = np.exp(0.4) / 6 / float(observed(rgb, gaze, eye, Place(None, scene)).integrals(eye)[0][0])
    assert (density * angle).sum() == pytest.approx(1 - lost, abs=0.01)


def test03_one_integral_an_observer(rgb, tmp_path):
    """Kept between renders, made anew for another observer, another place or other weights."""
    gaze = log_gaze(tmp_path / "g.safetensors", mix=0.1)
    integrator = {
        "type": "nerg",
        "aovs": "gaze,visibility",
        "gaze": gaze,
        "observer": observer_at(rgb, 0.2, 0.1, 0),
        "falloff": 0.0,
    }
    scene = rgb.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": camera(rgb, (0.1, -0.2, 0.3), (0.5, 0, 0)), **room(rgb)}
    )
    placed = scene.integrator().gaze

    def kept():
        """What is kept of the observer's surroundings, and of the integral."""
        things = ((placed, "surroundings"), (placed, "integral", placed.field))
        return [scene.integrator().cache.peek(thing)[0].value for thing in things]

    first = np.array(rgb.render(scene, spp=1))
    traced, value = kept()
    np.testing.assert_array_equal(np.array(rgb.render(scene, spp=1)), first)
    assert kept()[0] is traced and kept()[1] is value
    params = rgb.traverse(scene)
    params["integrator.gaze.prior"] = params["integrator.gaze.prior"] + 1
    params.update()
    # Weights that scale everything change nothing but the integral (and the blind part, which is not divided).
    rgb.render(scene, spp=1)
    assert kept()[0] is traced
    assert float(kept()[1][0]) == pytest.approx(np.e * float(value[0]), rel=1e-5)
    params["integrator.observer.to_world"] = rgb.Transform4f().translate([0.1, 0.1, 0.1])
    params.update()
    rgb.render(scene, spp=1)
    assert kept()[0] is not traced


def test04_a_batch_has_an_integral_a_camera(rgb, tmp_path):
    gaze = log_gaze(tmp_path / "g.safetensors")
    integrator = {"type": "nerg", "aovs": "gaze", "radiance": False, "gaze": gaze}
    eyes = [(0.3, 0.1, 0), (-0.5, 0.4, 0.2)]
    alone = [channels(rgb, integrator, camera(rgb, eye, (0, 0.5, 0.9)), **room(rgb))["gaze.Y"] for eye in eyes]
    film = {"type": "hdrfilm", "width": 24, "height": 12, "component_format": "float32", "rfilter": {"type": "box"}}
    batch = {"type": "batch", "film": film, **{f"s{i}": camera(rgb, eye, (0, 0.5, 0.9)) for i, eye in enumerate(eyes)}}
    both = channels(rgb, integrator, batch, **room(rgb))["gaze.Y"]
    # Pixels are sampled elsewhere in a batch: in the mean they agree, and the two cameras do not with each other.
    for i in range(2):
        assert both[:, 12 * i : 12 * i + 12].mean() == pytest.approx(alone[i].mean(), rel=0.05)


def test05_derivatives_pass_the_integral(rgb, tmp_path):
    """Of all weights together: scaling emit by a factor changes nothing, so that the derivative with the blind table is
    0."""
    gaze = log_gaze(tmp_path / "g.safetensors")
    integrator = {"type": "nerg", "aovs": "gaze", "radiance": False, "gaze": gaze}
    scene = rgb.load_dict(
        {"type": "scene", "integrator": integrator, "sensor": camera(rgb, (0.1, -0.2, 0.3), (0.5, 0, 0)), **room(rgb)}
    )
    params = rgb.traverse(scene)
    shift = rgb.Float(0)
    dr.enable_grad(shift)
    prior = rgb.TensorXf(params["integrator.gaze.prior"])
    params["integrator.gaze.prior"] = prior + shift
    params.update()
    loss = dr.mean(rgb.render(scene, params, spp=1)[..., 3], axis=None)
    dr.backward(loss)
    assert abs(float(dr.grad(shift)[0])) < 1e-5 * float(loss.array[0])

    def at(h):
        table = np.array(prior)
        table[:8] += h
        params["integrator.gaze.prior"] = rgb.TensorXf(table)
        params.update()
        return float(dr.mean(rgb.render(scene, spp=1)[..., 3], axis=None).array[0])

    half = rgb.Float(0)
    dr.enable_grad(half)
    upper = rgb.TensorXf(np.repeat((np.arange(16) < 8).astype(np.float32)[:, None], 32, axis=1))
    params["integrator.gaze.prior"] = prior + upper * half
    params.update()
    dr.backward(dr.mean(rgb.render(scene, params, spp=1)[..., 3], axis=None))
    expected = (at(0.02) - at(-0.02)) / 0.04
    assert abs(expected) > 1e-4 and float(dr.grad(half)[0]) == pytest.approx(expected, rel=0.02)
