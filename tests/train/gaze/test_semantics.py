"""Gaze fields that learn on a radiance field's features, and such that begin as its trunk."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_product import GazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.formats.fields import save_gaze, save_radiance
from nerg_mi.maths.geometry import Box
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import TargetNeeds, semantic_features, targets_of_rays
from nerg_mi.train.gaze_product import ProductTrainer, gaze_density, initial_weights, sized_gaze_config, trunk_config
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.geometry import GazePlace, place_of_field
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import default_settings

BOX = Box((-2, -2, 0), (2, 2, 3))
PROBES = ProbeSettings(radius=0.5, count=12, cap=64, min_rays=8, kappa=20.0, directions=64)


def gaze_config(radiance, variant="emit_capture", **more):
    """Of a gaze field that can begin as the radiance field."""
    return replace(trunk_config(sized_gaze_config("small", variant), radiance.config), **more)


def place_of(field):
    return GazePlace(FieldMedium(field), BOX, "field", radiance=field)


@pytest.fixture
def radiance(rgb):
    """A random radiance field, dense enough to have surfaces."""
    ns = namespace("llvm")
    config = RadianceConfig(
        HashGridConfig(levels=2, log2_rows=10, base=4, finest=8), width=16, geometry=5, sh_degree=2, density_scale=6.0
    )
    field = RadianceField.random(config, BOX, ns, 0, march_step=0.1)
    table = np.random.default_rng(0).normal(size=len(field.grid.table)).astype(np.float32)
    field.set_parameters({"grid.table": ns.Float(table)})
    return field


@pytest.fixture
def rays():
    rng = np.random.default_rng(1)
    origin = rng.uniform([-1, -1, 1.5], [1, 1, 1.7], (300, 3))
    direction = np.array([1.5, 0.4, 1.2]) + rng.normal(0, 0.15, (300, 3)) - origin
    return Rays(
        np.arange(300),
        np.arange(300) % 2,
        ("a", "b"),
        origin,
        direction / np.linalg.norm(direction, axis=1, keepdims=True),
        np.ones(300),
    )


def test01_the_trunk_gives_the_fields_features(radiance):
    ns = namespace("llvm")
    gaze = GazeField.random(gaze_config(radiance), BOX, ns, 3)
    gaze.set_parameters(initial_weights(radiance, gaze.config))
    p = ns.Array3f(np.random.default_rng(2).uniform(BOX.lower, BOX.upper, (50, 3)).astype(np.float32).T)
    expected = radiance.density_features(p)[1]
    got = gaze.position_net(gaze.grid(gaze.box.to_unit(p)))
    assert len(got) == 5
    for a, b in zip(got, expected):
        assert np.allclose(np.array(a), np.array(b), atol=1e-6)
    with pytest.raises(ValueError, match="must have its sizes"):
        initial_weights(radiance, replace(gaze.config, geometry=6))


@pytest.mark.parametrize("own", [False, True])
def test02_the_fast_path_is_the_field(radiance, own):
    ns, rng = namespace("llvm"), np.random.default_rng(3)
    config = gaze_config(radiance, semantic="snapshot", semantic_own=own)
    gaze = GazeField.random(config, BOX, ns, 3)
    gaze.set_parameters({"grid.table": ns.Float(rng.normal(size=len(gaze.grid.table)).astype(np.float32))})
    B, D = 3, 32
    p_o, p_od = (ns.Array3f(rng.uniform(BOX.lower, BOX.upper, (n, 3)).astype(np.float32).T) for n in (B, B * D))
    d = rng.normal(size=(B * D, 3))
    r_o = ns.Array3f((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32).T)
    features = [ns.Float(rng.normal(size=B * D).astype(np.float32)) for _ in range(5)]
    fast = gaze_density(config, BOX, gaze.parameters(), p_od, p_o, r_o, ns, features)
    at = dr.arange(ns.UInt32, B * D) // D
    slow = gaze.evaluate(p_od, dr.gather(ns.Array3f, p_o, at), r_o, True, features)[0]
    assert np.allclose(np.array(fast), np.array(slow), rtol=1e-5) and np.ptp(np.array(slow)) > 0


def test03_snapshots_and_accumulations(rgb, radiance):
    """A snapshot is the field at the point; in a single dense slab of equal features both agree."""
    medium = FieldMedium(radiance)
    o = np.tile([0.0, 0.0, 1.5], (20, 1))
    d = np.random.default_rng(4).normal(size=(20, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    t = np.full(20, 0.5)
    got = semantic_features(place_of(radiance), o, d, t, "snapshot")
    p = rgb.Point3f((o + d * 0.5).astype(np.float32).T)
    expected = np.stack([np.array(f) for f in radiance.density_features(p)[1]], -1)
    assert got.dtype == np.float16 and np.allclose(got, expected, atol=2e-3 * np.abs(expected).max())

    # The same everywhere: what is accumulated is the opacity times it.
    uniform = namespace("llvm").Float(np.full(len(radiance.grid.table), 0.3, np.float32))
    radiance.set_parameters({"grid.table": uniform})
    medium = FieldMedium(radiance)
    from nerg_mi.transport.geometry import trace_depth

    _, opacity = trace_depth(medium, o, d)
    here = semantic_features(place_of(radiance), o, d, t, "snapshot").astype(float)
    along = semantic_features(place_of(radiance), o, d, t, "accumulated").astype(float)
    assert opacity.min() > 0.2
    assert np.allclose(along, here * opacity[:, None], atol=3e-3 * np.abs(here).max())


@pytest.mark.parametrize("frozen", [True, False])
def test04_frozen_trunks_stay_and_others_move(rgb, radiance, rays, frozen):
    ns = namespace("llvm")
    config = gaze_config(radiance, semantic="accumulated", semantic_own=True)
    data = targets_of_rays(rays, place_of(radiance), PROBES, TargetNeeds(semantic="accumulated"))
    assert data.semantic.shape == (*data.truth.shape, 5)
    trainer = ProductTrainer(
        data, BOX, config, GazeSettings(steps=30, frozen=frozen), ns, initial=initial_weights(radiance, config)
    )
    before = trainer.measure(data).loss
    while trainer.progress < 1:
        trainer.step()
    field, start = trainer.field().parameters(), initial_weights(radiance, config)
    for name, value in start.items():
        assert np.array_equal(np.array(field[name]), np.array(value)) == frozen, name
    assert trainer.measure(data).loss < 0.9 * before


@pytest.mark.parametrize("cutoff", [None, 0.0, 0.05])
@pytest.mark.parametrize("kind", ["snapshot", "accumulated"])
def test_features_of_training_are_those_of_rendering(rgb, radiance, tmp_path, monkeypatch, kind, cutoff):
    """Whatever the picture's colours are cut off at: a field must be shown what it was trained on."""
    save_radiance(radiance, tmp_path / "field.safetensors", {})
    config = gaze_config(radiance, "emit", semantic=kind)
    save_gaze(GazeField.random(config, BOX, namespace("llvm"), 3), tmp_path / "gaze.safetensors", {})
    integrator = {
        "type": "nerg",
        "aovs": "opacity,position,gaze",
        "field": {"type": "nerf", "filename": str(tmp_path / "field.safetensors")},
        "gaze": {"type": "gazefield", "filename": str(tmp_path / "gaze.safetensors")},
    }
    if cutoff is not None:
        integrator["color_cutoff"] = cutoff
    eye = np.array([0.1, -1.9, 1.6])
    sensor = {
        "type": "perspective",
        "to_world": rgb.ScalarTransform4f().look_at(eye.tolist(), [0, 0, 1.4], [0, 0, 1]),
        "near_clip": 1e-4,
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "component_format": "float32", "rfilter": {"type": "box"}},
    }
    scene, given = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor}), []
    made = scene.integrator()
    if cutoff is None:
        assert made.settings == default_settings(made.medium)
    field = made.gaze.field
    evaluate = field.evaluate
    # Kept as the render hands them over, and evaluated with the picture.
    monkeypatch.setattr(field, "evaluate", lambda *a: (given.append([rgb.Float(f) for f in a[4]]), evaluate(*a))[1])
    picture = np.array(rgb.render(scene, spp=1)).reshape(64, -1)[:, -5:]
    rendered = np.stack([np.array(f) for f in given[0]], axis=-1)
    met = picture[:, 0] >= 0.5
    way = picture[:, 1:4] - eye
    distance = np.linalg.norm(way, axis=1)
    trained = semantic_features(
        place_of_field(tmp_path / "field.safetensors", namespace("llvm")),
        np.broadcast_to(eye, way.shape)[met],
        (way / distance[:, None])[met],
        distance[met],
        kind,
    )
    assert met.sum() > 30 and np.ptp(rendered[met]) > 0.1
    # Half precision, and directions that were read back from positions.
    np.testing.assert_allclose(rendered[met], trained, atol=2e-3 * np.abs(trained).max())
