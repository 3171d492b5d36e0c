"""The density of the next look, compared with simulations whose weights are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation.baselines import MIN_AIM_DISTANCE
from nerg_mi.evaluation.gaze import EPS
from nerg_mi.evaluation.next_look import (
    COMPONENTS,
    FIELD,
    HEAD_METHODS,
    METHODS,
    NEXT_LOOK,
    Component,
    LookSample,
    NextLook,
    PastLooks,
    evaluate_components,
    evaluate_on_grid,
    find_heading,
    find_past_looks,
    fit_next_look,
    measure_gaze_in_head,
    score_next_look,
)
from nerg_mi.maths import vmf
from nerg_mi.maths.sphere import aim, fibonacci_directions, sample_uniform_directions
from nerg_mi.tracking.rays import Rays

TARGETS = np.array([[1.0, 0, 0], [0, 0.8, 0.6], [-0.6, 0, -0.8]])


def field(origins, directions):
    """Three targets, whose weights depend on the position."""
    share = np.stack([np.ones(len(origins)), 1 + origins[:, 0] ** 2, np.full(len(origins), 0.5)], axis=1)
    kernels = np.exp(20 * (directions @ TARGETS.T - 1) + vmf.log_normaliser(20.0))
    # Not normalised: twice a density.
    return 2 * (share * kernels).sum(axis=1) / share.sum(axis=1)


def make_past(count: int, seed: int = 0, earlier: int = 3) -> PastLooks:
    rng = np.random.default_rng(seed)
    looks = sample_uniform_directions(count * earlier, rng).reshape(count, earlier, 3)
    looks[::3, 1:] = np.nan
    heading = find_heading(rng.normal(size=(count, 3)), np.full(count, 2.0))
    origin, last = rng.normal(size=(count, 3)), sample_uniform_directions(count, rng)
    return PastLooks(origin, np.full(count, 1.0), last, heading, looks)


# ---- Densities ----


@pytest.mark.parametrize("component", [c for c in COMPONENTS if c.last <= 256], ids=str)
def test01_each_component_integrates_to_one(component):
    past, directions = make_past(4), fibonacci_directions(1 << 14)
    everywhere = np.broadcast_to(directions, (4, *directions.shape))
    at = field(np.repeat(past.origin, len(directions), 0), everywhere.reshape(-1, 3)).reshape(4, -1)
    density = evaluate_components([component], past, everywhere, at, evaluate_on_grid(field, past.origin))[..., 0]
    assert (density > 0).all() or component.last > 64
    assert 4 * np.pi * density.mean(axis=1) == pytest.approx(np.ones(4), abs=2e-3)


def test02_a_product_is_the_field_times_the_kernel():
    past, directions = make_past(2), fibonacci_directions(500)
    component, model = (
        Component(True, 4.0, 1.0),
        NextLook((Component(True, 4.0, 1.0),), np.array([1.0]), np.ones((1, 1))),
    )
    density = model.density(past, directions, field)
    for row in range(2):
        eta = component.last * past.last[row] + component.heading * past.heading[row]
        product = field(np.repeat(past.origin[[row]], 500, 0), directions) * np.exp(directions @ eta)
        assert density[row] / density[row, 0] == pytest.approx(
            product / product[0], rel=1e-3, abs=1e-3 * product.max() / product[0]
        )


def test03_products_do_not_depend_on_the_scale_of_the_field():
    past, directions = make_past(3), fibonacci_directions(64)
    model = NextLook(COMPONENTS, np.array([1.0]), np.full((1, len(COMPONENTS)), 1 / len(COMPONENTS)))
    scaled = model.density(past, directions, lambda o, d: 7 * field(o, d))
    assert model.density(past, directions, field) == pytest.approx(scaled, rel=1e-9)


# ---- Fit ----


def test04_known_weights_are_recovered():
    components = (Component(), Component(last=64), FIELD, Component(True, 4.0), Component(earlier=64))
    weights = np.array([[0.05, 0.6, 0.1, 0.15, 0.1], [0.15, 0.05, 0.4, 0.1, 0.3]])
    truth = NextLook(components, np.array([0.5, 4.0]), weights)
    past, rng = make_past(3000), np.random.default_rng(0)
    past = PastLooks(past.origin, rng.choice([0.5, 4.0], len(past)), past.last, past.heading, past.earlier)
    on_grid = evaluate_on_grid(field, past.origin, 512)
    grid = fibonacci_directions(512)
    looks = np.empty((len(past), 3))
    for k, row in enumerate(truth.weights_at(past.elapsed)):
        component = components[rng.choice(len(components), p=row)]
        mass = component.kernel(past.select(slice(k, k + 1)), grid)[0] * (on_grid[k] if component.field else 1)
        looks[k] = grid[rng.choice(512, p=mass / mass.sum())]
    at = field(past.origin, looks)[:, None]
    densities = evaluate_components(components, past, looks[:, None], at, on_grid)[:, 0]
    model = fit_next_look(components, densities, past.elapsed, truth.knots)
    assert model.weights.sum(axis=1) == pytest.approx([1, 1])
    assert model.weights == pytest.approx(weights, abs=0.08)
    likelihood = lambda m: np.log(np.einsum("nc,nc->n", densities, m.weights_at(past.elapsed))).mean()
    # The maximum: at least the likelihood of the truth.
    assert likelihood(model) >= likelihood(truth)


def test05_weights_are_linear_in_the_logarithm_of_the_time():
    model = NextLook((Component(), FIELD), np.array([1.0, 4.0]), np.array([[1.0, 0.0], [0.0, 1.0]]))
    expected = [[1, 0], [1, 0], [0.5, 0.5], [0, 1], [0, 1]]
    assert model.weights_at(np.array([0.1, 1, 2, 4, 9])) == pytest.approx(np.array(expected))


# ---- What precedes a look ----


def make_rays(hit=None) -> Rays:
    """Two participants, the second with a pause, who walk along x at 1 m/s and turn by 0.1 rad per second."""
    t = np.r_[np.arange(0, 20, 0.1), np.arange(0, 5, 0.1), np.arange(100, 110, 0.1)]
    person = np.repeat([0, 1], [200, 150])
    direction = np.stack([np.cos(0.1 * t), np.sin(0.1 * t), 0 * t], axis=1)
    origin = np.stack([t, 0 * t, 1.6 + 0 * t], axis=1)
    return Rays(t, person, ("a", "b"), origin, direction, np.ones(len(t)), hit)


def test06_the_past_is_that_of_the_same_recording():
    rays = make_rays()
    rows = np.array([5, 100, 205, 255, 345])
    past, matched = find_past_looks(rays, rows, 1.0, earlier=4, interval=1.0)
    # Rows 5, 205 and 255 are within a second of the start of a recording.
    assert matched.tolist() == [100, 345]
    assert past.elapsed == pytest.approx([1, 1])
    assert past.last == pytest.approx(rays.direction[[90, 335]])
    assert past.earlier == pytest.approx(rays.direction[[[80, 70, 60, 50], [325, 315, 305, 295]]])
    assert past.heading == pytest.approx(np.array([[1.0, 0, 0]] * 2))
    past, _ = find_past_looks(rays, np.array([30]), 1.0, earlier=4, interval=1.0)
    assert np.isnan(past.earlier[0, :, 0]).tolist() == [False, False, True, True]


def test07_looks_at_known_points_are_aimed_at_them():
    rays = make_rays()
    points = rays.origin + 3 * rays.direction
    past, rows = find_past_looks(make_rays(points), np.array([100]), 2.0, earlier=1, interval=1.0)
    offset = points[[80, 70]] - rays.origin[100]
    expected = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    assert np.concatenate([past.last, past.earlier[0]]) == pytest.approx(expected)
    traced, _ = find_past_looks(rays, rows, 2.0, earlier=1, interval=1.0, distance=lambda o, d: np.full(len(o), 3.0))
    assert traced.last == pytest.approx(past.last) and traced.earlier == pytest.approx(past.earlier)
    missed, _ = find_past_looks(rays, rows, 2.0, earlier=1, interval=1.0, distance=lambda o, d: np.full(len(o), np.inf))
    assert missed.last == pytest.approx(rays.direction[[80]])
    # A point next to the eye has no direction.
    assert aim(np.array([0, 0, 0.01]), np.array([1.0, 0, 0]), np.zeros(3), MIN_AIM_DISTANCE) == pytest.approx([1, 0, 0])


def test08_slow_displacements_are_short_headings():
    heading = find_heading(np.array([[0.1, 0, 5.0], [0, 2.0, 0], [0, 0, 0]]), np.array([1.0, 2, 1]))
    assert heading == pytest.approx(np.array([[0.2, 0, 0], [0, 1, 0], [0, 0, 0]]))


# ---- Simulation ----


def test09_sampled_looks_follow_the_density():
    components = (Component(last=256), Component(True, 4.0))
    model = NextLook(components, np.array([1.0]), np.array([[0.6, 0.4]]))
    times, positions = np.arange(900.0), np.zeros((900, 3))
    looks = model.sample(times, positions, field, seed=1)
    assert np.linalg.norm(looks, axis=1) == pytest.approx(np.ones(900))
    past = PastLooks(positions[1:], np.ones(899), looks[:-1], np.zeros((899, 3)), np.empty((899, 0, 3)))
    on_grid = np.repeat(evaluate_on_grid(field, np.zeros((1, 3))), 899, axis=0)
    at = field(past.origin, looks[1:])[:, None]
    densities = evaluate_components(components, past, looks[1:, None], at, on_grid)[:, 0]
    assert fit_next_look(components, densities, past.elapsed, [1.0]).weights == pytest.approx(model.weights, abs=0.06)
    first = model.sample(times[:20], positions[:20], field, seed=1)
    assert np.array_equal(first, model.sample(times[:20], positions[:20], field, seed=1))


def test10_simulated_looks_stay_at_surface_points_and_return():
    # The wall x = 2, along which the observer walks.
    distance = lambda o, d: np.where(d[:, 0] > 0, (2 - o[:, 0]) / np.where(d[:, 0] > 0, d[:, 0], 1), np.inf)
    times = np.arange(60.0)
    positions = np.stack([0 * times, 0.05 * times, 0 * times], axis=1)
    ahead = lambda o, d: np.exp(vmf.log_density(d, np.array([1.0, 0, 0]), 200.0))
    stay = NextLook((Component(last=1e6),), np.array([1.0]), np.ones((1, 1)))
    looks = stay.sample(times, positions, ahead, distance=distance)
    points = positions + distance(positions, looks)[:, None] * looks
    assert np.ptp(points, axis=0) == pytest.approx(np.zeros(3), abs=0.1)
    back = NextLook((Component(earlier=1e6),), np.array([1.0]), np.ones((1, 1)))
    looks = back.sample(times, np.zeros((60, 3)), ahead, seed=3)
    # The second and third look have no earlier ones and are uniform; all others are at one of the first looks.
    assert (looks[4:] @ looks[:4].T).max(axis=1) == pytest.approx(np.ones(56), abs=1e-3)
    with pytest.raises(NergError, match="increasing"):
        stay.sample(times[::-1], positions, ahead)
    with pytest.raises(NergError, match="head"):
        replace(stay, gaze_in_head=np.array([1.0, 0, 0])).sample(times, positions, ahead)


def test11_a_model_round_trips_as_json():
    model = NextLook(COMPONENTS, np.array([1.0, 2.0]), np.random.default_rng(0).dirichlet(np.ones(len(COMPONENTS)), 2))
    again = NextLook.from_json(json.loads(json.dumps(model.to_json())))
    assert again.components == model.components and np.array_equal(again.weights, model.weights)


# ---- Scores ----


def make_sample(seed: int, keeps: float, count: int = 900) -> LookSample:
    """Looks of six participants of which a fraction ``keeps`` stays; the others follow the field."""
    rng, past = np.random.default_rng(seed), make_past(count, seed)
    grid = fibonacci_directions(512)
    on_grid = evaluate_on_grid(field, past.origin, 512)
    from_field = np.stack([grid[rng.choice(512, p=row / row.sum())] for row in on_grid])
    stays = (rng.random(count) < keeps)[:, None]
    looks = np.where(stays, vmf.sample(past.last, 64.0, rng), from_field)
    prior = np.full(count, 1 / (4 * np.pi)), np.full((count, 512), 1 / (4 * np.pi))
    return LookSample(
        past,
        looks,
        np.arange(count) % 6,
        np.zeros(count, int),
        np.arange(count) % 2,
        (field(past.origin, looks) / 2, on_grid / 2),
        prior,
    )


def test12_scores_are_bits_over_the_prior_with_intervals():
    model, rows = score_next_look(make_sample(1, 0.5), make_sample(2, 0.5), [1.0], resamples=50)
    rows = {row["method"]: row for row in rows}
    assert list(rows) == list(METHODS) and model.components == COMPONENTS
    test = make_sample(2, 0.5)
    alone = np.log2(test.field[0] * 4 * np.pi + EPS).mean()
    assert rows["gaze field"]["bits"] == pytest.approx(alone, abs=1e-3)
    # Half of the looks stay: both the last look and the field are needed.
    best = rows[NEXT_LOOK]["bits"]
    assert best > rows["last look"]["bits"] + 0.3 and best > rows["gaze field"]["bits"] + 0.3
    row = rows["last look"]
    assert row["gap"] == pytest.approx(best - row["bits"]) and row["gap.low"] < row["gap"] < row["gap.high"]


def test13_a_zone_is_scored_with_weights_of_the_others():
    # In zone 0 everybody stays, in zone 1 nobody.
    parts = [make_sample(seed, keeps, 200) for seed, keeps in ((1, 1.0), (2, 0.0))]
    zones = [replace(part, zone=np.full(200, k)) for k, part in enumerate(parts)]
    join = lambda name: np.concatenate([getattr(zone, name) for zone in zones])
    both = LookSample(
        PastLooks.concatenate([zone.past for zone in zones]),
        *(join(name) for name in ("direction", "person", "knot", "zone")),
        *(tuple(np.concatenate([getattr(z, f)[k] for z in zones]) for k in (0, 1)) for f in ("field", "prior")),
    )
    bits = lambda train, test: score_next_look(train, test, [1.0], resamples=0)[1][0]["bits"]
    assert bits(both, zones[0]) == pytest.approx(bits(zones[1], zones[0]), abs=1e-6)
    assert bits(both, zones[0]) < bits(zones[0], zones[0]) - 0.5


# ---- Heads ----


def make_head_rays(pitch: float, count: int = 3000) -> Rays:
    """Gaze around a direction below the heads of three participants; a tenth of the heads is unknown."""
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-np.pi, np.pi, count), rng.uniform(-0.5, 0.5, count)
    ahead = lambda e: np.stack([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)], axis=1)
    gaze, head = vmf.sample(ahead(elevation + pitch), 40.0, rng), ahead(elevation)
    head[::10] = np.nan
    person = np.repeat([0, 1, 2], [count // 2, count // 4, count // 4])
    return Rays(np.arange(count), person, ("a", "b", "c"), np.zeros((count, 3)), gaze, np.ones(count), head=head)


def test14_the_mean_direction_of_gaze_in_the_head_is_recovered():
    rays = make_head_rays(np.radians(-10))
    in_head = measure_gaze_in_head(rays)
    assert np.degrees(np.arcsin(in_head[[1, 2]])) == pytest.approx([0, -10], abs=0.5)
    a, b = np.radians(-10), np.arctan2(0.8, 0.6) - np.radians(10)
    past = PastLooks.from_heads(np.zeros((2, 3)), np.array([[0.0, 1, 0], [0.6, 0, 0.8]]), in_head)
    assert past.last == pytest.approx(np.array([[0, np.cos(a), np.sin(a)], [np.cos(b), 0, np.sin(b)]]), abs=0.01)
    with pytest.raises(NergError, match="head"):
        measure_gaze_in_head(replace(rays, head=None))


def test15_gaze_given_the_head_uses_the_head_and_the_field():
    """Gaze is drawn from the product of the field and a kernel around the head."""
    rng, grid = np.random.default_rng(1), fibonacci_directions(1024)
    heads = sample_uniform_directions(900, rng)
    past = PastLooks.from_heads(rng.normal(size=(900, 3)), heads, np.array([1.0, 0, 0]))
    assert past.last == pytest.approx(heads)
    on_grid = evaluate_on_grid(field, past.origin)
    truth = on_grid * Component(last=16).kernel(past, grid)
    looks = np.stack([grid[rng.choice(1024, p=row / row.sum())] for row in truth])
    uniform = np.full(900, 1 / (4 * np.pi)), np.full((900, 1024), 1 / (4 * np.pi))
    sample = LookSample(
        past,
        looks,
        np.arange(900) % 6,
        np.zeros(900, int),
        np.arange(900) % 2,
        (field(past.origin, looks) / 2, on_grid / 2),
        uniform,
    )
    model, rows = score_next_look(sample, sample, [1.0], resamples=50, methods=HEAD_METHODS)
    bits = {row["method"]: row["bits"] for row in rows}
    assert list(bits) == list(HEAD_METHODS)
    assert bits["head and field"] > max(bits["head"], bits["gaze field"], bits["head and prior"]) + 0.3
    assert model.weights[0, model.components.index(Component(True, 16))] > 0.5
    assert NextLook.from_json(replace(model, gaze_in_head=np.array([1.0, 0, 0])).to_json()).gaze_in_head[0] == 1
