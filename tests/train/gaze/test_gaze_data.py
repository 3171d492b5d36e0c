"""Tests of `nerg_mi.train.gaze_data`."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.environment.environment import DEFAULT_DEPTH as NOWHERE_FAR
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import interpolate_table, table_directions
from nerg_mi.fields.gaze_product import ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import save_gaze, save_radiance
from nerg_mi.maths import vmf
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.photos.salience import pixel_solid_angles
from nerg_mi.tracking.probes import place_probes
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_data import (
    GazeTargets,
    Supervision,
    TargetArrays,
    TargetRequirements,
    compute_box_exit,
    compute_semantic_features,
    compute_surface_distances,
    concatenate_targets,
    make_observer_targets,
    make_probes,
    make_rotated_directions,
    make_targets_from_probes,
    make_targets_from_rays,
    make_targets_from_views,
)
from nerg_mi.train.gaze_folds import hold_out, select_far_views, split_validation, split_views
from nerg_mi.train.gaze_log_density import LikelihoodTrainer
from nerg_mi.train.gaze_product import (
    ProductTrainer,
    evaluate_gaze_density,
    extract_initial_weights,
    make_gaze_config,
    match_trunk_config,
)
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.prior import make_prior_from_rays, make_prior_from_views, select_prior_kappa
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import default_march_settings
from tests.fields.gaze.test_log_density import SMALL as VIEW_TARGETS_SMALL
from tests.plugins.scenes import camera, look_at, with_gaze
from tests.refusals import mentions

from .looks import BOX, LENS, NOWHERE, PROBES, RAYS, around, lobe, looking_at, train, view
from .looks import SMALL as PLAIN

# ---- Batches: gathered probes, integrals, and densities within a view ----


@pytest.fixture
def drawn():
    """Three probes of four directions, the first over the whole sphere, the others over parts; as targets and on the
    device.
    """
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(3, 4, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    positions, truth, distance = rng.uniform(-1, 1, (3, 3)), rng.random((3, 4)), rng.uniform(1, 2, (3, 4))
    extent = np.array([4 * np.pi, 1.5, 0.5], np.float32)
    escaped, semantic = rng.random((3, 4)) < 0.5, rng.normal(size=(3, 4, 2)).astype(np.float16)
    data = GazeTargets(positions, directions, truth, distance, escaped, semantic, solid_angle=extent)
    return data, TargetArrays(data, ns)


def test_a_batch_gathers_probes_and_directions(drawn):
    data, arrays = drawn
    probe, which = np.array([2, 0, 2]), np.array([[3, 1], [0, 0], [1, 2]])
    batch = arrays.gather_batch(probe, which)
    towards, distance = data.directions[probe[:, None], which], data.distance[probe[:, None], which]
    np.testing.assert_allclose(batch.p_o.numpy().T, data.positions[probe], rtol=1e-6)
    np.testing.assert_allclose(batch.r_o.numpy().T, towards.reshape(-1, 3), rtol=1e-6)
    ends = data.positions[probe][:, None] + towards * distance[..., None]
    np.testing.assert_allclose(batch.p_od.numpy().T, ends.reshape(-1, 3), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(batch.truth.numpy(), data.truth[probe[:, None], which].ravel(), rtol=1e-6)
    np.testing.assert_array_equal(batch.misses.numpy(), data.misses[probe[:, None], which].ravel())
    np.testing.assert_allclose(batch.solid_angle.numpy(), data.solid_angle[probe], rtol=1e-6)
    features = np.stack([f.numpy() for f in batch.semantic], axis=-1)
    np.testing.assert_array_equal(features, data.semantic[probe[:, None], which].reshape(-1, 2))


@pytest.mark.parametrize("has_prior", [False, True])
def test_only_views_are_conditioned(drawn, has_prior):
    """A part of the sphere has the integral of the truth, or one; the whole sphere and zeros are unchanged."""
    data, arrays = drawn
    batch = arrays.gather_batch(np.arange(3), np.tile(np.arange(4), (3, 1)))
    density = np.array([[1.0, 2, 3, 4], [0, 1, 0, 2], [0, 0, 0, 0]])
    flat = lambda v: ns.Float(v.ravel().astype(np.float32))
    got = batch.condition_on_view(flat(density), flat(data.truth) if has_prior else None).numpy().reshape(3, 4)
    goal = data.truth[1].mean() * 1.5 if has_prior else 1.0
    np.testing.assert_allclose(got, [density[0], density[1] * goal / (0.75 * 1.5), density[2]], rtol=1e-5)


def test_targets_without_observers_are_refused():
    none = np.zeros((0, 4), np.float32)
    with pytest.raises(NergError, match="no probes to train on"):
        TargetArrays(GazeTargets(np.zeros((0, 3)), np.zeros((0, 4, 3)), none, none, none.astype(bool)), ns)


# ---- The position-independent prior: from rays, by participant or by ray, and from views ----


def test_prior_weights_participants_or_rays():
    """Nine rays of one participant, one of another, elsewhere: the ratio of the kernel peaks."""
    direction = np.array(9 * [[1.0, 0, 0]] + [[0, 1.0, 0]])
    rays = Rays(np.arange(10.0), np.array(9 * [0] + [1]), ("a", "b"), np.zeros((10, 3)), direction, np.ones(10))
    for weights, ratio in (("equal", 9), ("person", 1)):
        table = np.exp(make_prior_from_rays(rays, 64, weights=weights).astype(np.float64).ravel())
        x, y = (table[np.argmax(table_directions(64) @ d)] for d in ((1, 0, 0), (0, 1, 0)))
        tail = np.exp(-10.0)  # of the other kernel, at a right angle
        expected = (ratio + tail) / (1 + ratio * tail)
        assert x / y == pytest.approx(expected, rel=0.02), weights


def test_kernels_too_narrow_for_the_table_are_refused():
    """A kernel much narrower than a texel would leave only the uniform part."""
    rays = Rays(np.arange(3.0), np.zeros(3), ("a",), np.zeros((3, 3)), np.tile([0.6, 0.0, 0.8], (3, 1)), np.ones(3))
    assert np.exp(make_prior_from_rays(rays, 64, kappa=400.0)).max() > 40  # 1/sr; its peak is 400 / 2π
    with pytest.raises(NergError, match="64.*1660"):
        make_prior_from_rays(rays, 64, kappa=1700.0)


def test_kernels_of_the_prior_are_those_that_predict_other_participants():
    """All look around one direction with a concentration of 100, or each around an own direction; the result lies
    between the best candidate and the default."""
    rng = np.random.default_rng(0)
    n = 1200
    person = np.arange(n) % 6
    common = np.tile([1.0, 0.0, 0.0], (n, 1))
    individual = fibonacci_directions(6)[person]
    make = lambda mu, count=6: Rays(
        np.arange(n), person % count, tuple("abcdef"[:count]), np.zeros((n, 3)), vmf.sample(mu, 100.0, rng), np.ones(n)
    )
    assert select_prior_kappa(make(common)) == pytest.approx(np.sqrt(100 * 30))
    assert select_prior_kappa(make(individual)) == pytest.approx(np.sqrt(2 * 30))
    # The halves in time of a single participant.
    assert select_prior_kappa(make(common, 1), "person") == pytest.approx(np.sqrt(100 * 30))


@pytest.mark.parametrize("weights, best", [("equal", 2), ("person", 100)])
def test_participants_count_equally_for_the_kernels_of_the_prior(weights, best):
    """One with 2,000 rays to all sides, and five with four rays each, around one direction with a concentration of 100:
    as rays, those are too few to predict each other."""
    around = vmf.sample(np.tile([0.0, 1.0, 0.0], (20, 1)), 100.0, np.random.default_rng(0))
    person = np.concatenate([np.zeros(2000, int), 1 + np.arange(20) % 5])
    direction = np.concatenate([fibonacci_directions(2000), around])
    rays = Rays(np.arange(2020.0), person, tuple("abcdef"), np.zeros((2020, 3)), direction, np.ones(2020))
    assert select_prior_kappa(rays, weights) == pytest.approx(np.sqrt(best * 30))


def test_prior_is_in_the_frame_of_the_geometry():
    """All look along x, which is y in a geometry rotated by a quarter turn."""
    direction = np.tile([1.0, 0, 0], (10, 1))
    rays = Rays(np.arange(10.0), np.zeros(10), ("a",), np.zeros((10, 3)), direction, np.ones(10))
    turned = Environment(None, BOX, "none", align=Similarity([[0, -3, 0, 1], [3, 0, 0, 2], [0, 0, 3, 0], [0, 0, 0, 1]]))
    for place, towards in ((None, (1, 0, 0)), (turned, (0, 1, 0))):
        peak = table_directions(32)[np.argmax(make_prior_from_rays(rays, 32, place).ravel())]
        assert peak @ towards > 0.99


def test_prior_is_estimated_from_partial_views():
    """No view covers more than a sixth of the sphere; the density does not depend on the position."""
    law = lambda p, d: np.exp(1.5 * d[:, 0] - 4 * (d[:, 2] + 0.1) ** 2)
    table = make_prior_from_views(around(60, density=law), 24)
    ns, d = namespace("llvm"), fibonacci_directions(4000)
    result = np.exp(
        np.array(interpolate_table(ns.Float(table.ravel()), 24, ns.Array3f(np.ascontiguousarray(d.T, np.float32))))
    )
    assert 4 * np.pi * result.mean() == pytest.approx(1, abs=1e-3)
    seen = np.abs(d[:, 2]) < 0.7
    result, expected = (v[seen] / v[seen].mean() for v in (result, law(None, d)))
    assert np.corrcoef(result, expected)[0, 1] > 0.97 and np.mean(expected * np.log(expected / result)) < 0.05


def test_one_view_weighs_as_much_as_the_uniform_view():
    """Closed form for one view of A sr with density p: inside, b is proportional to p + 1/4π."""
    right = lambda p, d: (d[:, 1] < 0).astype(float)
    one = view(right, (0, 0, 1.6), (1.0, 0, 0))
    table = make_prior_from_views([one], 24)
    ns = namespace("llvm")
    # Farther from the middle than the smoothing.
    angle = np.radians(32)
    d = np.array([[np.cos(angle), s * np.sin(angle), z] for s in (1, -1) for z in (-0.1, 0, 0.1)])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    log = interpolate_table(ns.Float(table.ravel()), 24, ns.Array3f(np.ascontiguousarray(d.T, np.float32)))
    result = np.exp(np.array(log)).reshape(2, 3).mean(axis=1)
    extent = pixel_solid_angles(LENS).sum()
    assert result[0] / result[1] == pytest.approx(1 / (1 + 8 * np.pi / extent), rel=0.2)


# ---- From rays to probes to targets: rotations, frames, fresh directions ----


def test_direction_sets_have_independent_rotations():
    sets = make_rotated_directions(64, 3, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(sets, axis=-1), 1)
    np.testing.assert_allclose(
        sets @ sets.transpose(0, 2, 1), np.broadcast_to((sets @ sets.transpose(0, 2, 1))[0], (3, 64, 64)), atol=1e-12
    )
    assert np.abs(sets[0] - sets[1]).max() > 0.1


def test_rays_are_aligned_with_the_field(rays, wall):
    """Half the size, rotated and shifted: the same supervision in the frame of the field."""
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn, (0.3, -0.4, 0.5)
    inverse = np.linalg.inv(matrix)
    moved = replace(
        rays, origin=rays.origin @ inverse[:3, :3].T + inverse[:3, 3], direction=rays.direction @ turn, hit=None
    )
    probes = lambda r, radius: place_probes(r, radius, count=8, min_rays=8, kappa_rule="fixed", seed=1)
    a = make_targets_from_probes(probes(rays, 0.5), wall, 32)
    b = make_targets_from_probes(probes(moved, 0.25), replace(wall, align=Similarity(matrix)), 32)
    np.testing.assert_allclose(b.positions, a.positions, atol=1e-5)
    back = b.directions @ turn
    np.testing.assert_allclose(back, a.directions, atol=1e-6)
    # The distances are in the frame of the field: trace them again along the same rays.
    np.testing.assert_allclose(np.linalg.norm(b.directions, axis=-1), 1, atol=1e-6)
    inside = ~b.misses
    p = b.positions[:, None] + b.directions * b.distance[..., None]
    assert inside.any() and np.abs(p[inside][:, 0] - 1.5).max() < 0.02


def test_kernels_too_narrow_for_the_directions_are_refused(rays, wall):
    probes = place_probes(rays, 0.5, count=2, min_rays=8, kappa_rule="fixed", kappa=1e8, seed=1)
    with pytest.raises(NergError, match="16.*kappa"):
        make_targets_from_probes(probes, wall, 16)


def test_probes_are_placed_according_to_the_settings(rays):
    probes = make_probes(rays, PROBES, seed=3)
    assert 1 <= len(probes) <= PROBES.probes and (probes.kappa == PROBES.kappa).all()
    assert probes.radius == PROBES.radius
    assert PROBES.min_rays <= probes.counts.min() <= probes.counts.max() <= PROBES.max_rays
    at = np.array([[-0.6, 0, 1.6]])
    np.testing.assert_array_equal(make_probes(rays, PROBES, at).queries, at)
    lattice = make_probes(rays, replace(PROBES, placement="grid", spacing=0.3))
    assert np.diff(np.unique(lattice.queries[:, 1].round(9))) == pytest.approx(0.3)


def test_prior_is_only_made_if_required(rays, wall):
    assert make_targets_from_rays(rays, wall, PROBES).prior_table is None
    wide, narrow = (
        make_targets_from_rays(
            rays, wall, replace(PROBES, prior_kappa=kappa), TargetRequirements(prior_rows=12)
        ).prior_table
        for kappa in (10.0, 40.0)
    )
    assert wide.shape == narrow.shape == (12, 24)
    # The log of a density: narrower kernels have higher peaks.
    assert narrow.max() > wide.max() + 0.5


# ---- Gaze fields with features of a radiance field, or initialised from it ----


def gaze_config(radiance, variant="emit_capture", **options):
    """Configuration of a gaze field that can be initialised from the radiance field."""
    return replace(match_trunk_config(make_gaze_config("small", variant), radiance.config), **options)


def place_of(field):
    return Environment(FieldMedium(field), BOX, "field", radiance=field)


@pytest.fixture
def radiance(rgb):
    """A random radiance field, dense enough to have surfaces."""
    ns = namespace("llvm")
    config = RadianceConfig(
        HashGridConfig(levels=2, log2_rows=10, base=4, finest=8), width=16, geometry=5, sh_degree=2, density_scale=6.0
    )
    field = RadianceNetwork.random(config, BOX, ns, 0, march_step=0.1)
    table = np.random.default_rng(0).normal(size=len(field.grid.table)).astype(np.float32)
    field.set_parameters({"grid.table": ns.Float(table)})
    return field


def test01_the_trunk_gives_the_fields_features(radiance):
    ns = namespace("llvm")
    gaze = ProductHead.random(gaze_config(radiance), BOX, ns, 3)
    gaze.set_parameters(extract_initial_weights(radiance))
    p = ns.Array3f(np.random.default_rng(2).uniform(BOX.lower, BOX.upper, (50, 3)).astype(np.float32).T)
    expected = radiance.density_features(p)[1]
    got = gaze.position_net(gaze.grid(gaze.box.to_unit(p)))
    assert len(got) == 5
    for a, b in zip(got, expected):
        assert np.allclose(np.array(a), np.array(b), atol=1e-6)


@pytest.mark.parametrize("with_own_features", [False, True])
def test02_the_fast_path_is_the_field(radiance, with_own_features):
    ns, rng = namespace("llvm"), np.random.default_rng(3)
    config = gaze_config(radiance, semantic="snapshot", semantic_own=with_own_features)
    gaze = ProductHead.random(config, BOX, ns, 3)
    gaze.set_parameters({"grid.table": ns.Float(rng.normal(size=len(gaze.grid.table)).astype(np.float32))})
    B, D = 3, 32
    p_o, p_od = (ns.Array3f(rng.uniform(BOX.lower, BOX.upper, (n, 3)).astype(np.float32).T) for n in (B, B * D))
    d = rng.normal(size=(B * D, 3))
    r_o = ns.Array3f((d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32).T)
    features = [ns.Float(rng.normal(size=B * D).astype(np.float32)) for _ in range(5)]
    fast = evaluate_gaze_density(config, BOX, gaze.parameters(), p_od, p_o, r_o, ns, features)
    at = dr.arange(ns.UInt32, B * D) // D
    slow = gaze.evaluate(p_od, dr.gather(ns.Array3f, p_o, at), r_o, True, features)[0]
    assert np.allclose(np.array(fast), np.array(slow), rtol=1e-5) and np.ptp(np.array(slow)) > 0


@pytest.mark.parametrize("freeze", [True, False])
def test04_frozen_trunks_stay_and_others_move(rgb, radiance, rays, freeze):
    ns = namespace("llvm")
    config = gaze_config(radiance, semantic="accumulated", semantic_own=True)
    data = make_targets_from_rays(rays, place_of(radiance), PROBES, TargetRequirements(semantic="accumulated"))
    assert data.semantic.shape == (*data.truth.shape, 5)
    trainer = ProductTrainer(
        data, BOX, config, GazeSettings(steps=30, freeze=freeze), ns, initial=extract_initial_weights(radiance)
    )
    before = trainer.evaluate(data).loss
    while trainer.progress < 1:
        trainer.step()
    field, start = trainer.make_field().parameters(), extract_initial_weights(radiance)
    for name, value in start.items():
        assert np.array_equal(np.array(field[name]), np.array(value)) == freeze, name
    assert trainer.evaluate(data).loss < 0.9 * before


@pytest.mark.parametrize("cutoff", [None, 0.0, 0.05])
@pytest.mark.parametrize("kind", ["snapshot", "accumulated"])
def test_features_of_training_are_those_of_rendering(rgb, radiance, tmp_path, monkeypatch, kind, cutoff):
    """Independent of the colour cut-off of the picture: rendering must provide the features of the training."""
    save_radiance(radiance, tmp_path / "field.safetensors", {})
    config = gaze_config(radiance, "emit", semantic=kind)
    save_gaze(ProductHead.random(config, BOX, namespace("llvm"), 3), tmp_path / "gaze.safetensors", {})
    integrator = with_gaze(tmp_path, "opacity,position,gaze", depth="median")
    if cutoff is not None:
        integrator["color_cutoff"] = cutoff
    eye = np.array([0.1, -1.9, 1.6])
    to_world = look_at(rgb, eye.tolist(), [0, 0, 1.4], [0, 0, 1])
    sensor = {**camera(rgb, size=8, near_clip=1e-4), "to_world": to_world}
    scene, options = rgb.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor}), []
    made = scene.integrator()
    if cutoff is None:
        assert made.settings == default_march_settings(made.medium)
    field = made.gaze.field
    evaluate = field.evaluate
    # Recorded from the render, and evaluated with the picture.
    monkeypatch.setattr(field, "evaluate", lambda *a: (options.append([rgb.Float(f) for f in a[4]]), evaluate(*a))[1])
    picture = np.array(rgb.render(scene, spp=1)).reshape(64, -1)[:, -5:]
    rendered = np.stack([np.array(f) for f in options[0]], axis=-1)
    hits = picture[:, 0] >= 0.5
    direction = picture[:, 1:4] - eye
    distance = np.linalg.norm(direction, axis=1)
    trained = compute_semantic_features(
        Environment.open(tmp_path / "field.safetensors"),
        np.broadcast_to(eye, direction.shape)[hits],
        (direction / distance[:, None])[hits],
        distance[hits],
        kind,
    )
    assert hits.sum() > 30 and np.ptp(rendered[hits]) > 0.1
    # Half precision, and directions recovered from positions.
    np.testing.assert_allclose(rendered[hits], trained, atol=2e-3 * np.abs(trained).max())


# ---- Held-out data: test positions and participants, validation zones, and views near them ----


def test_held_out_positions_are_purged():
    rays = looking_at((1.5, 0, 1.2), 3000, spread=6.0)
    selected, account = hold_out(rays, 0.25, zones=2, positions=10, min_rays=8)
    centres = np.array(account["centres"])
    distances = np.linalg.norm(selected.origin[:, None] - centres[None], axis=2)
    assert distances.min() > 0.5 and len(selected) == account["rays_to_train"] < len(rays)
    assert json.loads(json.dumps(account)) == account


def test_people_and_positions_are_held_out():
    rays = looking_at((1.5, 0, 1.2), 4000, spread=6.0)
    selected, account = hold_out(rays, 0.25, zones=2, positions=10, min_rays=8, participant_fraction=0.5)
    assert len(account["people"]) == 1 and set(np.unique(selected.person)) == {
        1 - rays.persons.index(account["people"][0])
    }
    assert np.linalg.norm(selected.origin[:, None] - np.array(account["centres"])[None], axis=2).min() > 0.5


def test_validation_views_are_far_from_training_views():
    views = around(80)
    learn, watched = split_views(views, 3, 0.3, seed=4)
    assert 8 <= len(watched) <= 12 and len(learn) < 80 - len(watched)
    centres = np.array([v.camera.center for v in watched])
    assert all(np.linalg.norm(centres - v.camera.center, axis=1).min() > 0.3 for v in learn)
    with pytest.raises(ValueError, match="validation_zones"):
        split_views(views, 3, 5.0)
    moved = Similarity([[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
    at = (views[0].camera.center - [1, 0, 0]) / 2
    near = select_far_views(views, at[None] @ moved.matrix[:3, :3].T + moved.matrix[:3, 3], 0.1 * moved.scale)
    assert views[0] not in near and select_far_views(near, views[0].camera.center[None], 0.2) == near


def in_a_row(count):
    """Cameras on a line, one metre apart."""
    return [view(lobe, (float(k), 0, 1.6), (0, 1, 0), name=f"v{k}") for k in range(count)]


def test_a_quarter_of_the_views_must_remain():
    views = in_a_row(12)
    for distance in np.arange(0.5, 12.0):
        try:
            learn, _ = split_views(views, 1, distance, 3)
        except ValueError:
            break
        assert len(learn) >= 3
    left = len(select_far_views(views, np.array([v.camera.center for v in split_views(views, 1, 0.5, 3)[1]]), distance))
    assert left < 3


def test_validation_zones_use_all_rays_around_them():
    double = Environment(None, BOX, "none", align=Similarity(np.diag([2.0, 2, 2, 1])))
    settings = GazeSettings(steps=1, validation_zones=2, validation_probes=6)
    for place in (NOWHERE, double):
        observers = place.points_to_field(RAYS.origin[::60])
        views = [view(lobe, eye, (1, 0, 0), name=f"v{k}") for k, eye in enumerate(observers)]
        split = split_validation(Supervision(RAYS, views), place, settings, PROBES)
        distances = np.linalg.norm(split.training.rays.origin[:, None] - split.centres, axis=2)
        assert distances.min() > 2 * PROBES.radius and split.rays_held_out == len(RAYS) - len(split.training.rays) > 0
        assert split.validation.rays is RAYS and not split.validation.views
        near = place.points_to_field(split.centres)
        left = {v.name for v in split.training.views}
        for v in views:
            far = np.linalg.norm(near - v.camera.center, axis=1).min() > 2 * PROBES.radius * place.align.scale
            assert (v.name in left) == far
        assert split.views_held_out == len(views) - len(left) >= 2


def test_views_alone_are_split_for_validation():
    split = split_validation(
        Supervision(None, around(80)), NOWHERE, GazeSettings(steps=1, validation_zones=3), replace(PROBES, radius=0.15)
    )
    assert split.training.rays is None and split.validation.rays is None and split.centres is None
    assert split.views_held_out == 80 - len(split.training.views) >= len(split.validation.views) > 0


# ---- Training data: non-empty, identified by digests, with support ----


def test_the_support_is_of_all_rays_in_the_frame_of_the_place():
    rays = looking_at((1.5, 0, 1.2))
    double = Environment(None, BOX, "none", align=Similarity([[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]))
    plain, moved = (Supervision(rays).make_support(0.5, place) for place in (NOWHERE, double))
    assert plain.radius == 0.5 and moved.radius == pytest.approx(1.0)  # noqa: RUF069 (stored)
    assert plain.cells[:, 3].sum() == moved.cells[:, 3].sum() == 400
    np.testing.assert_allclose(moved.cells[:, :3], plain.cells[:, :3] * 2 + [1, 0, 0], atol=1e-5)
    assert Supervision(None, around(1)).make_support(0.5, NOWHERE) is None


# ---- Targets: escaping rays, features if needed, and merged sets ----


def test_misses_are_counted_by_directions_and_by_gaze():
    rng = np.random.default_rng(0)
    directions, truth, escaped = rng.normal(size=(3, 5, 3)), rng.random((3, 5)), rng.random((3, 5)) < 0.4
    targets = GazeTargets(np.zeros((3, 3)), directions, truth, truth, escaped)
    assert targets.miss_fraction == pytest.approx(escaped.sum() / 15)
    assert targets.miss_gaze_fraction == pytest.approx(truth[escaped].sum() / truth.sum())
    extent = np.array([1.0, 2.0, 3.0])
    gaze = truth * extent[:, None]
    assert replace(targets, solid_angle=extent).miss_gaze_fraction == pytest.approx(gaze[escaped].sum() / gaze.sum())


def test_features_are_those_of_a_radiance_field():
    positions, directions = np.zeros((1, 3)), np.array([[[1.0, 0, 0], [0, 1.0, 0]]])
    targets = make_observer_targets(positions, directions, np.ones((1, 2)), NOWHERE)
    assert targets.semantic is None and (targets.distance == 2).all() and not targets.misses.any()
    assert targets.positions.dtype == targets.directions.dtype == targets.truth.dtype == np.float32
    with pytest.raises(NergError, check=mentions("environment")):
        make_observer_targets(
            positions, directions, np.ones((1, 2)), NOWHERE, requirements=TargetRequirements(semantic="snapshot")
        )


# ---- Views as targets: content, likelihood and losses within a view, and training from views ----

VIEW_TARGETS_PROBES = ProbeSettings(directions=512, radius=0.25, min_rays=1)


def test_directions_and_densities_of_a_view():
    views = around(3)
    result = make_targets_from_views(views, NOWHERE, VIEW_TARGETS_PROBES)
    assert result.truth.shape == (3, 512) and result.prior_table is None
    np.testing.assert_allclose(result.truth.mean(axis=1) * result.solid_angle, 1, rtol=1e-5)
    np.testing.assert_allclose(result.solid_angle, pixel_solid_angles(LENS).sum(), rtol=1e-5)
    for k, v in enumerate(views):
        np.testing.assert_allclose(result.positions[k], v.camera.center, atol=1e-6)
        assert v.evaluate(result.directions[k])[1].all()
        # Pixels of 6 degrees average the steep density.
        options = lobe(v.camera.center, result.directions[k].astype(float))
        options /= options.mean() * result.solid_angle[k]
        assert np.corrcoef(options, result.truth[k])[0, 1] > 0.9


def test_the_likelihood_is_conditioned_on_the_view():
    """Sampled loss and validation, compared with the field's densities normalised over the view in NumPy."""
    data = make_targets_from_views(
        around(4), NOWHERE, VIEW_TARGETS_PROBES, TargetRequirements.from_config(VIEW_TARGETS_SMALL)
    )
    settings = GazeSettings(
        steps=1, loss="likelihood", integral_weight=0.0, probes=4, directions=512, rays=2048, validation_zones=0
    )
    trainer = LikelihoodTrainer(data, BOX, replace(VIEW_TARGETS_SMALL, mix=0.0, geometry="none"), settings, ns)
    field = trainer.initial_field
    r_o, p_o = data.directions.reshape(-1, 3), np.repeat(data.positions, 512, axis=0)
    jit = lambda v: ns.Array3f(np.ascontiguousarray(v.T, np.float32))
    emit, capture = field.unnormalized(jit(p_o), jit(p_o), jit(r_o))
    density = np.array(emit * capture, np.float64).reshape(4, 512)
    density /= density.mean(axis=1, keepdims=True) * data.solid_angle[:, None]
    part = data.truth.astype(float) * data.solid_angle[:, None] / 512
    scores = trainer.evaluate(data)
    assert scores.kld == pytest.approx(np.mean(np.sum(part * np.log(data.truth / density), axis=1)), abs=1e-4)
    assert scores.mae == pytest.approx(np.abs(density - data.truth).mean(), rel=1e-3)
    assert scores.integral == pytest.approx(1, abs=1e-5)
    loss = trainer.compute_loss(trainer.draw_batch())
    assert float(loss[0]) == pytest.approx(np.mean(np.sum(-part * np.log(density), axis=1)), abs=0.02)


def test_the_losses_of_a_density_do_not_see_its_scale_through_views():
    """But they do for probes of rays in the same batch."""
    data = make_targets_from_views(around(3), NOWHERE, VIEW_TARGETS_PROBES)
    sphere = GazeTargets(
        data.positions,
        np.broadcast_to(fibonacci_directions(512), (3, 512, 3)).astype(np.float32),
        np.full((3, 512), 1 / (4 * np.pi), np.float32),
        data.distance,
        data.misses,
    )
    settings = GazeSettings(steps=1, validation_zones=0)
    source = lambda data, scale: ProductTrainer(data, BOX, replace(PLAIN, emit_scale=scale), settings, ns).evaluate(
        data
    )
    np.testing.assert_allclose(source(data, 0.1), source(data, 0.7), rtol=1e-4, atol=1e-6)
    assert source(data, 0.1).integral == pytest.approx(1, abs=1e-5)
    both = concatenate_targets(sphere, data)
    assert both.truth.shape == (6, 512) and both.solid_angle[0] == pytest.approx(4 * np.pi)
    for scale in (0.1, 0.7):
        parts = np.array(source(sphere, scale)), np.array(source(data, scale))
        np.testing.assert_allclose(source(both, scale), np.mean(parts, axis=0), rtol=1e-4, atol=1e-6)
    assert source(sphere, 0.7).mae > 2 * source(sphere, 0.1).mae


@pytest.mark.nightly
def test_a_law_is_learnt_from_views_alone_and_holds_around():
    settings = GazeSettings(
        steps=120,
        loss="likelihood",
        integral_weight=0.0,
        probes=12,
        directions=128,
        rays=64,
        learning_rate=1e-2,
        weight_decay=0.1,
        validation_zones=2,
        ema_decay=0.9,
        num_validations=4,
    )
    config = replace(VIEW_TARGETS_SMALL, mix=0.05, geometry="none", prior=16)
    views = Supervision(None, around(90))
    field, provenance = train(NOWHERE, settings, config, replace(VIEW_TARGETS_PROBES, radius=0.1), views)
    assert (
        provenance["rays"] == 0
        and provenance["salience_views"] == 90
        and provenance["validation"]["views_held_out"] >= 10
    )
    from nerg_mi.evaluation.gaze import FieldDensity

    rng, d = np.random.default_rng(5), fibonacci_directions(1024)
    positions = rng.uniform((-0.9, -0.9, 1.45), (0.9, 0.9, 1.75), (8, 3))
    truth = np.stack([lobe(p, d) for p in positions])
    result = FieldDensity(field, None)(positions, d)
    # Error of 1,024 directions and of an integral accurate to 2e-3.
    np.testing.assert_allclose(4 * np.pi * result.mean(axis=1), 1, atol=4e-3)
    kld = lambda q: np.mean(truth * np.log(truth / q)) * 4 * np.pi
    cc = np.mean([np.corrcoef(a, b)[0, 1] for a, b in zip(truth, result)])
    assert kld(np.full(1024, 1 / (4 * np.pi))) > 0.8
    assert kld(result) < 0.25 and cc > 0.85


def test_rays_and_views_train_one_field():
    both = Supervision(looking_at((1.5, 0.4, 1.2)), around(6))
    settings = GazeSettings(
        steps=4, probes=4, directions=32, validation_zones=1, validation_probes=4, num_validations=2
    )
    probes = ProbeSettings(radius=0.25, probes=8, max_rays=64, min_rays=4, directions=64)
    for config, options in ((PLAIN, {}), (VIEW_TARGETS_SMALL, {"loss": "likelihood"})):
        field, provenance = train(NOWHERE, replace(settings, **options), config, probes, both)
        assert provenance["rays"] == 400 and provenance["salience_views"] == 6 and provenance["probes_made"] == 14
        assert all(np.isfinite(np.array(v)).all() for v in field.parameters().values())


# ---- Hits of observers' rays: escaping rays end on the box, or at the neighbouring depth ----


def test_misses_end_at_the_box(wall):
    positions = np.array([[-0.5, 0, 1.6], [0.2, -0.4, 1.5]])
    directions = np.tile(fibonacci_directions(256), (2, 1, 1))
    distance, escaped = compute_surface_distances(wall, positions, directions)
    p = positions[:, None] + directions * distance[..., None]
    # The wall is at x = 1.5, everything else ends on the box.
    assert np.abs(p[~escaped][:, 0] - 1.5).max() < 0.02
    on_box = np.minimum(np.abs(p - BOX.lower), np.abs(p - BOX.upper)).min(axis=-1)
    assert on_box[escaped].max() < 1e-5 and 0.5 < escaped.mean() < 0.95


def test_observers_have_their_own_directions(wall):
    positions = np.array([[-0.5, 0, 1.6], [0.2, -0.4, 1.5]])
    directions = np.stack([fibonacci_directions(256), fibonacci_directions(256)[::-1, [1, 2, 0]]])
    together = compute_surface_distances(wall, positions, directions)
    for k in range(2):
        alone = compute_surface_distances(wall, positions[[k]], directions[[k]])
        for one, both in zip(alone, together):
            np.testing.assert_array_equal(one[0], both[k])


def test_holes_are_filled_with_the_depth_around_them(wall):
    """Directions that pass the wall take the depth of the neighbouring ones."""
    positions, directions = np.array([[-0.5, 0, 1.6]]), fibonacci_directions(1024)[None]
    plain, escaped = compute_surface_distances(wall, positions, directions)
    filled, same = compute_surface_distances(wall, positions, directions, fill_misses=True)
    np.testing.assert_array_equal(escaped, same)
    np.testing.assert_array_equal(filled[~escaped], plain[~escaped])
    assert plain[~escaped].min() <= filled[escaped].min() and filled[escaped].max() <= plain[~escaped].max()
    empty = np.array([[[-1.0, 0, 0], [-0.8, 0.6, 0]]])
    np.testing.assert_array_equal(
        *(compute_surface_distances(wall, positions, empty, fill_misses=f)[0] for f in (True, False))
    )


def test_without_geometry_everything_is_equally_far():
    distance, escaped = compute_surface_distances(NOWHERE, np.zeros((3, 3)), np.ones((3, 5, 3)))
    assert distance.shape == (3, 5) and (distance == NOWHERE_FAR).all() and not escaped.any()


def test_exits_of_a_box():
    o = np.array([[0, 0, 1.0], [0, 0, 1], [5, 0, 1], [5, 0, 1], [0, 2, 1]])
    d = np.array([[1.0, 0, 0], [0, 0, -1], [-1, 0, 0], [1, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(compute_box_exit(BOX, o, d), [2, 1, 7, BOX.diagonal, 2])
