"""Views as supervision: what they hold, likelihood and losses given a view, the blind density, a law learnt from
views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.capture.cameras import Camera, pixel_directions
from nerg_mi.capture.intrinsics import Intrinsics
from nerg_mi.capture.salience.solid_angle import pixel_solid_angles
from nerg_mi.capture.salience.views import SalienceView
from nerg_mi.field.backend import namespace
from nerg_mi.field.gaze.log_density import look_up
from nerg_mi.maths.similarity import Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.training.gaze.likelihood import LikelihoodTrainer
from nerg_mi.training.gaze.run import train_gaze
from nerg_mi.training.gaze.salience import (
    blind_of_views,
    digest_views,
    far_views,
    split_views,
    supervise_views,
    together,
)
from nerg_mi.training.gaze.settings import GazeSettings, ProbeSettings
from nerg_mi.training.gaze.supervision import Supervision
from nerg_mi.training.gaze.trainer import GazeTrainer
from tests.field.gaze.test_log_density import BOX, SMALL

from .test_trainer import SMALL as PLAIN
from .test_trainer import looking_at

LENS = Intrinsics(24, 18, 14.0, 14.0, 12.0, 9.0, k1=-0.08)
HOW = ProbeSettings(directions=512, radius=0.25, min_rays=1)
TARGET = np.array([1.9, 0.5, 1.6])


def pose(centre, towards):
    """OpenGL camera-to-world, z up."""
    back = -np.asarray(towards, float) / np.linalg.norm(towards)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = np.stack([right, np.cross(back, right), back], axis=1), centre
    return m


def view(density, centre, towards, lens=LENS, name="a"):
    """What an observer with ``density(p, d)`` sees of it through a lens."""
    camera = Camera(lens, pose(centre, towards))
    directions = pixel_directions(lens) @ camera.to_world[:3, :3].T
    solid = pixel_solid_angles(lens)
    share = density(camera.center, directions.reshape(-1, 3)).reshape(solid.shape) * solid
    return SalienceView(name, camera, (share / share.sum()).astype(np.float32), solid.astype(np.float32))


def lobe(p, d, kappa=12.0):
    """Most look at one point, the others anywhere."""
    mean = (TARGET - p) / np.linalg.norm(TARGET - p)
    return 0.8 * kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(kappa * (d @ mean - 1)) + 0.2 / (4 * np.pi)


def around(count, seed=0, density=lobe):
    """Cameras in the room that look about them, and a little down."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform((-1, -1, 1.4), (1, 1, 1.8), (count, 3))
    angle = rng.uniform(0, 2 * np.pi, count)
    towards = np.stack([np.cos(angle), np.sin(angle), rng.uniform(-0.4, 0.2, count)], axis=1)
    return [view(density, c, t, name=f"v{k}") for k, (c, t) in enumerate(zip(centres, towards))]


def test_directions_and_densities_of_a_view():
    views = around(3)
    found = supervise_views(views, None, BOX, HOW)
    assert found.truth.shape == (3, 512) and found.blind is None
    np.testing.assert_allclose(found.truth.mean(axis=1) * found.extent, 1, rtol=1e-5)
    np.testing.assert_allclose(found.extent, pixel_solid_angles(LENS).sum(), rtol=1e-5)
    for k, v in enumerate(views):
        np.testing.assert_allclose(found.positions[k], v.camera.center, atol=1e-6)
        assert v.look_up(found.directions[k])[1].all()
        # Pixels of 6 degrees are averages: the law is as steep as it is.
        given = lobe(v.camera.center, found.directions[k].astype(float))
        given /= given.mean() * found.extent[k]
        assert np.corrcoef(given, found.truth[k])[0, 1] > 0.9
    assert (
        digest_views(views) == digest_views(around(3)) != digest_views(around(3, seed=1)) and digest_views([]) is None
    )


def test_the_likelihood_is_given_the_view():
    """Drawn loss and validation against the field's own densities, divided by their sum over the view in NumPy."""
    views, ns = around(4), namespace("llvm")
    data = supervise_views(views, None, BOX, HOW, config=SMALL)
    settings = GazeSettings(steps=1, loss="likelihood", integral=0.0, probes=4, directions=512, rays=2048, zones=0)
    trainer = LikelihoodTrainer(data, BOX, replace(SMALL, mix=0.0, geometry="none"), settings, ns)
    field = trainer.initial
    r_o, p_o = data.directions.reshape(-1, 3), np.repeat(data.positions, 512, axis=0)
    jit = lambda v: ns.Array3f(np.ascontiguousarray(v.T, np.float32))
    emit, capture = field.unnormalized(jit(p_o), jit(p_o), jit(r_o))
    density = np.array(emit * capture, np.float64).reshape(4, 512)
    density /= density.mean(axis=1, keepdims=True) * data.extent[:, None]
    part = data.truth.astype(float) * data.extent[:, None] / 512
    scores = trainer.measure(data)
    assert scores.kld == pytest.approx(np.mean(np.sum(part * np.log(data.truth / density), axis=1)), abs=1e-4)
    assert scores.mae == pytest.approx(np.abs(density - data.truth).mean(), rel=1e-3)
    assert scores.integral == pytest.approx(1, abs=1e-5)
    trainer._backward()
    assert float(trainer.loss[0]) == pytest.approx(np.mean(np.sum(-part * np.log(density), axis=1)), abs=0.02)


def test_the_losses_of_a_density_do_not_see_its_scale_through_views():
    """But do for probes of rays that are beside them."""
    data, ns = supervise_views(around(3), None, BOX, HOW), namespace("llvm")
    sphere = Supervision(
        data.positions,
        np.broadcast_to(fibonacci_directions(512), (3, 512, 3)).astype(np.float32),
        np.full((3, 512), 1 / (4 * np.pi), np.float32),
        data.distance,
        data.escaped,
    )
    settings = GazeSettings(steps=1, zones=0)
    of = lambda data, scale: GazeTrainer(data, BOX, replace(PLAIN, emit_scale=scale), settings, ns).measure(data)
    np.testing.assert_allclose(of(data, 0.1), of(data, 0.7), rtol=1e-4, atol=1e-6)
    assert of(data, 0.1).integral == pytest.approx(1, abs=1e-5)
    both = together(sphere, data)
    assert both.truth.shape == (6, 512) and both.extent[0] == pytest.approx(4 * np.pi)
    for scale in (0.1, 0.7):
        parts = np.array(of(sphere, scale)), np.array(of(data, scale))
        np.testing.assert_allclose(of(both, scale), np.mean(parts, axis=0), rtol=1e-4, atol=1e-6)
    assert of(sphere, 0.7).mae > 2 * of(sphere, 0.1).mae


def test_a_blind_law_is_put_together_from_its_parts():
    """No view shows more than a sixth of the sphere; the law does not depend on the position."""
    law = lambda p, d: np.exp(1.5 * d[:, 0] - 4 * (d[:, 2] + 0.1) ** 2)
    table = blind_of_views(around(60, density=law), 24)
    ns, d = namespace("llvm"), fibonacci_directions(4000)
    found = np.exp(np.array(look_up(ns.Float(table.ravel()), 24, ns.Array3f(np.ascontiguousarray(d.T, np.float32)))))
    assert 4 * np.pi * found.mean() == pytest.approx(1, abs=1e-3)
    seen = np.abs(d[:, 2]) < 0.7
    found, expected = (v[seen] / v[seen].mean() for v in (found, law(None, d)))
    assert np.corrcoef(found, expected)[0, 1] > 0.97 and np.mean(expected * np.log(expected / found)) < 0.05


def test_one_view_counts_as_much_as_the_uniform_one_that_links_all():
    """Closed form for one view of A sr, of density p in it: inside b is in proportion to p + 1/4π."""
    right = lambda p, d: (d[:, 1] < 0).astype(float)
    one = view(right, (0, 0, 1.6), (1.0, 0, 0))
    table = blind_of_views([one], 24)
    ns = namespace("llvm")
    # Farther from the middle than densities are smoothed.
    angle = np.radians(32)
    d = np.array([[np.cos(angle), s * np.sin(angle), z] for s in (1, -1) for z in (-0.1, 0, 0.1)])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    log = look_up(ns.Float(table.ravel()), 24, ns.Array3f(np.ascontiguousarray(d.T, np.float32)))
    found = np.exp(np.array(log)).reshape(2, 3).mean(axis=1)
    extent = pixel_solid_angles(LENS).sum()
    assert found[0] / found[1] == pytest.approx(1 / (1 + 8 * np.pi / extent), rel=0.2)


def test_a_law_is_learnt_from_views_alone_and_holds_around():
    views, ns = around(90), namespace("llvm")
    settings = GazeSettings(
        steps=120,
        loss="likelihood",
        integral=0.0,
        probes=12,
        directions=128,
        rays=64,
        learning_rate=1e-2,
        weight_decay=0.1,
        zones=2,
        average=0.9,
        looks=4,
    )
    config = replace(SMALL, mix=0.05, geometry="none", prior=16)
    field, about = train_gaze(None, None, BOX, config, settings, replace(HOW, radius=0.1), ns, views=views)
    assert about["rays"] == 0 and about["salience_views"] == 90 and about["validation"]["views_held_out"] >= 10
    from nerg_mi.evaluation.gaze.scores import gaze_field

    rng, d = np.random.default_rng(5), fibonacci_directions(1024)
    positions = rng.uniform((-0.9, -0.9, 1.45), (0.9, 0.9, 1.75), (8, 3))
    truth = np.stack([lobe(p, d) for p in positions])
    found = gaze_field(field, None)(positions, d)
    np.testing.assert_allclose(4 * np.pi * found.mean(axis=1), 1, atol=1e-3)
    kld = lambda q: np.mean(truth * np.log(truth / q)) * 4 * np.pi
    cc = np.mean([np.corrcoef(a, b)[0, 1] for a, b in zip(truth, found)])
    assert kld(np.full(1024, 1 / (4 * np.pi))) > 0.8
    assert kld(found) < 0.25 and cc > 0.85


def test_rays_and_views_train_one_field():
    rays, views = looking_at((1.5, 0.4, 1.2)), around(6)
    settings = GazeSettings(steps=4, probes=4, directions=32, zones=1, watched=4, looks=2)
    how = ProbeSettings(radius=0.25, count=8, cap=64, min_rays=4, directions=64)
    for config, more in ((PLAIN, {}), (SMALL, {"loss": "likelihood"})):
        field, about = train_gaze(
            rays, None, BOX, config, replace(settings, **more), how, namespace("llvm"), views=views
        )
        assert about["rays"] == 400 and about["salience_views"] == 6 and about["probes_made"] == 14
        assert all(np.isfinite(np.array(v)).all() for v in field.parameters().values())


def test_watched_views_are_far_from_the_others():
    views = around(80)
    learn, watched = split_views(views, 3, 0.3, seed=4)
    assert 8 <= len(watched) <= 12 and len(learn) < 80 - len(watched)
    centres = np.array([v.camera.center for v in watched])
    assert all(np.linalg.norm(centres - v.camera.center, axis=1).min() > 0.3 for v in learn)
    with pytest.raises(ValueError, match="--zones"):
        split_views(views, 3, 5.0)
    moved = Similarity([[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
    at = (views[0].camera.center - [1, 0, 0]) / 2
    near = far_views(views, at[None], 0.1, moved)
    assert views[0] not in near and far_views(near, views[0].camera.center[None], 0.2) == near


def in_a_row(count):
    """Cameras a metre apart, on a line."""
    return [view(lobe, (float(k), 0, 1.6), (0, 1, 0), name=f"v{k}") for k in range(count)]


@pytest.mark.parametrize("seed", range(12))
def test_zones_lie_far_from_one_another(seed):
    """Of two, the second is around one of the quarter of the views that is farthest from the first; an eighth is
    watched."""
    views = in_a_row(40)
    learn, watched = split_views(views, 2, 0.5, seed)
    at = sorted(int(v.name[1:]) for v in watched)
    assert {int(v.name[1:]) for v in learn} == set(range(40)) - set(at)
    gap = int(np.argmax(np.diff(at)))
    groups = [at[: gap + 1], at[gap + 1 :]]
    assert [len(g) for g in groups] == [2, 2] and all(np.ptp(g) == 1 for g in groups)
    apart = [abs(k - groups[0][0]) for k in range(40)], [abs(k - groups[1][0]) for k in range(40)]
    far = lambda of, group: max(of[k] for k in group) >= sorted(of)[-10] - 1
    assert far(apart[0], groups[1]) or far(apart[1], groups[0])


@pytest.mark.parametrize("seed", range(8))
def test_of_few_views_the_farthest_is_the_second_zone(seed):
    learn, watched = split_views(in_a_row(7), 2, 0.5, seed)
    at = sorted(int(v.name[1:]) for v in watched)
    assert len(at) == 2 and len(learn) == 5 and (at[0] == 0 or at[1] == 6)
    # From either one the other is the farthest, or the other way round.
    assert at[1] - at[0] == max(at[0], 6 - at[0]) or at[1] - at[0] == max(at[1], 6 - at[1])


def test_as_many_views_must_be_left_as_a_quarter():
    views = in_a_row(12)
    for distance in np.arange(0.5, 12.0):
        try:
            learn, _ = split_views(views, 1, distance, 3)
        except ValueError:
            break
        assert len(learn) >= 3
    left = len(far_views(views, np.array([v.camera.center for v in split_views(views, 1, 0.5, 3)[1]]), distance))
    assert left < 3
