"""Ensembles and support in the integrator: against NumPy and the members one by one."""

from dataclasses import asdict

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.gaze_base import REACH, GazeEnsemble, RaySupport
from nerg_mi.formats.fields import load_gaze, save_gaze
from tests.reference import fields_numpy

from . import fields
from .scenes import camera, channels, named, observer_at, with_field
from .test_nerg_leaves_out import operations
from .test_nerg_normalized import log_gaze, room

ORIGINS = np.random.default_rng(0).normal((-2, 0.3, -2), 0.3, (300, 3))
AOVS = "gaze,gaze_std,position,visibility,gaze_evals"


def volume(path):
    return {"type": "gazefield", "filename": str(path)}


@pytest.fixture(scope="module")
def ensemble(files):
    """A file of three product fields, and the fields."""
    members = [fields.gaze(files / f"member{seed}.safetensors", seed=seed) for seed in (1, 2, 3)]
    for m in members:
        # Random networks are nearly constant: these are not.
        m.set_parameters({k: 20 * v for k, v in m.parameters().items() if k in ("emit_head.0", "capture_head.0")})
    save_gaze(GazeEnsemble(members, RaySupport.of(ORIGINS, 1.0)), files / "ensemble.safetensors", {})
    return files / "ensemble.safetensors", members


@pytest.mark.parametrize("aligned", [True, False])
def test01_mean_and_spread_are_those_of_the_members(rgb, files, ensemble, aligned):
    """In NumPy, at the surface that the camera sees; where it is hidden from the observer, both fade."""
    path, members = ensemble
    eye = np.array([0.5, 0.4, -3] if aligned else [-2, 0.3, -2.0])
    integrator = with_field(
        files,
        gaze=volume(path),
        aovs=AOVS,
        occlusion=False,
        **({} if aligned else {"observer": observer_at(rgb, *eye)}),
    )
    out = channels(rgb, integrator)
    p = np.stack([out[f"position.{c}"] for c in "XYZ"], axis=-1)
    seen = np.abs(p).sum(axis=-1) > 0
    r = (p - eye) / np.linalg.norm(p - eye, axis=-1, keepdims=True)
    each = []
    for m in members:
        weights = {k: np.array(v, np.float64) for k, v in m.parameters().items()}
        grid = {k: v for k, v in asdict(fields.GRID).items() if k != "dimensions"}
        each.append(
            fields_numpy.gaze(
                p[seen],
                np.broadcast_to(eye, p[seen].shape),
                r[seen],
                weights,
                grid,
                (-1, -1, -1),
                (1, 1, 1),
                "emit_capture",
                "softplus",
                degree=2,
            )[0]
        )
    assert seen.sum() > 20 and np.std(each, axis=0, ddof=1).max() > 0.05
    np.testing.assert_allclose(out["gaze.Y"][seen], np.mean(each, axis=0), rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(out["gaze_std.Y"][seen], np.std(each, axis=0, ddof=1), rtol=5e-3, atol=1e-4)
    assert not out["gaze_std.Y"][~seen].any() and out["gaze_evals.Y"].max() == 6


def test02_the_spread_is_hidden_like_the_gaze(rgb, files, ensemble):
    observer = observer_at(rgb, -2, 0.3, -2)
    open_, hidden = (
        channels(
            rgb, with_field(files, gaze=volume(ensemble[0]), aovs=AOVS, observer=observer, occlusion=o, falloff=0.0)
        )
        for o in (False, True)
    )
    gone = (hidden["visibility.Y"] == 0) & (open_["gaze_std.Y"] > 0)
    assert gone.sum() > 1 and not hidden["gaze_std.Y"][gone].any()
    whole = hidden["visibility.Y"] == 1
    np.testing.assert_allclose(hidden["gaze_std.Y"][whole], open_["gaze_std.Y"][whole], rtol=0.2, atol=0.02)


def test03_members_are_normalised_each_by_itself(rgb, tmp_path):
    """The mean of densities that integrate to one, and depths traced once for all of them."""
    singles = [volume(tmp_path / f"{i}.safetensors") for i in range(2)]
    for i in range(len(singles)):
        log_gaze(tmp_path / f"{i}.safetensors", mix=0.2)
    members = [load_gaze(s["filename"], ns)[0] for s in singles]
    members[1].set_parameters({k: v * 1.3 for k, v in members[1].parameters().items() if k != "prior"})
    save_gaze(members[1], singles[1]["filename"], {})
    save_gaze(GazeEnsemble(members), tmp_path / "e.safetensors", {})
    sensor = camera(rgb, (0.1, -0.2, 0.3), (0.5, 0, 0))
    of = lambda gaze, aovs: {"type": "nerg", "aovs": aovs, "radiance": False, "gaze": gaze}
    a, b = (channels(rgb, of(s, "gaze"), sensor, **room(rgb))["gaze.Y"] for s in singles)
    integrator = of(volume(tmp_path / "e.safetensors"), "gaze,gaze_std")
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **room(rgb)})
    out = named(rgb, np.array(rgb.render(scene, spp=1)), integrator)
    assert np.abs(a - b).max() > 1e-3
    np.testing.assert_allclose(out["gaze.Y"], (a + b) / 2, rtol=1e-4)
    np.testing.assert_allclose(out["gaze_std.Y"], np.abs(a - b) / np.sqrt(2), rtol=2e-3, atol=1e-6)
    placed, cache = scene.integrator().gaze, scene.integrator().cache
    assert len(cache.peek((placed, "surroundings"))) == 1
    first, second = (float(cache.peek((placed, "integral", m))[0].value[0]) for m in placed.field.members)
    assert first != second


def test04_support_is_that_of_the_observer(rgb, files, ensemble):
    eyes = [(-2, 0.3, -2), (-1.6, 0.3, -2.2), (5.0, 5, 5)]
    for eye in eyes:
        expected = np.maximum(1 - ((ORIGINS - eye) ** 2).sum(axis=1) / REACH**2, 0).sum()
        out = channels(
            rgb,
            with_field(files, gaze=volume(ensemble[0]), aovs="support,position", observer=observer_at(rgb, *eye)),
            camera(rgb, fov=80),
        )
        there = out["position.Z"] != 0
        np.testing.assert_allclose(out["support.Y"][there], expected, rtol=0.03)
        assert 0 < there.sum() < there.size and not out["support.Y"][~there].any()
    assert expected == 0


def test05_support_follows_the_observer_and_the_placement(rgb, files, ensemble):
    """Twice as large and moved: p_o = 2 p + (1, 0, 0) is where p was."""
    to_world = rgb.ScalarTransform4f().translate([1, 0, 0]).scale(2)
    placed = {
        "field": {"type": "nerf", "filename": str(files / "field.safetensors"), "to_world": to_world},
        "gaze": {**volume(ensemble[0]), "to_world": to_world},
        "type": "nerg",
        "aovs": "support",
        "radiance": False,
    }
    integrator = {**placed, "observer": observer_at(rgb, -3, 0.6, -4)}
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb, (2, 0.8, -6), (1, 0, 0))})
    of = lambda eye: np.maximum(1 - ((ORIGINS - eye) ** 2).sum(axis=1) / REACH**2, 0).sum()
    assert np.array(rgb.render(scene, spp=1))[..., 3].max() == pytest.approx(of((-2, 0.3, -2)), rel=0.03)
    params = rgb.traverse(scene)
    params["integrator.observer.to_world"] = rgb.Transform4f().translate([-2.2, 0.6, -4.4])
    params.update()
    assert np.array(rgb.render(scene, spp=1))[..., 3].max() == pytest.approx(of((-1.6, 0.3, -2.2)), rel=0.03)


def test06_what_is_not_asked_for_is_not_traced(rgb, files, ensemble, monkeypatch):
    observer = observer_at(rgb, -2, 0.3, -2)
    asking = lambda aovs, path=ensemble[0]: with_field(files, gaze=volume(path), aovs=aovs, observer=observer)
    depth, support, gaze, both = (operations(rgb, asking(a)) for a in ("depth", "support", "gaze", "gaze,gaze_std"))
    # Neither the observer's march nor a network for support; of the spread only squares and a root.
    assert support < depth + 100 < gaze and both < gaze + 120
    assert operations(rgb, asking("depth", files / "member1.safetensors")) == depth


def test07_what_is_needed_is_said(rgb, files, ensemble):
    for aov, gaze, said in (
        ("gaze_std", "gaze.safetensors", "several members; train it with --ensemble"),
        ("support", "gaze.safetensors", "does not hold; train it again"),
    ):
        with pytest.raises(RuntimeError, match=said):
            rgb.load_dict(with_field(files, gaze=volume(files / gaze), aovs=aov))
    for aov in ("gaze_std", "support"):
        with pytest.raises(RuntimeError, match=f'"{aov}", which needs a "gaze" volume'):
            rgb.load_dict(with_field(files, aovs=aov))


def test08_derivatives_reach_every_member(rgb, files, ensemble):
    import drjit as dr

    integrator = with_field(files, gaze=volume(ensemble[0]), aovs="gaze_std")
    scene = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": camera(rgb)})
    params = rgb.traverse(scene)
    keys = [k for k in params.keys() if "gaze" in k and k.endswith("emit_head.0")]
    assert len(keys) == 3
    for k in keys:
        dr.enable_grad(params[k])
    params.update()
    dr.backward(dr.mean(rgb.render(scene, params, spp=1)[..., 3], axis=None))
    for k in keys:
        g = np.array(dr.grad(params[k]))
        assert np.isfinite(g).all() and np.abs(g).max() > 1e-6, k
