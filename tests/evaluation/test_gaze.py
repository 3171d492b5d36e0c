"""Tests of `nerg_mi.evaluation.gaze`."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.evaluation import gaze, metrics
from nerg_mi.evaluation.baselines import make_prior_baseline, make_uniform_baseline
from nerg_mi.evaluation.gaze import FieldDensity, compute_map_scores
from nerg_mi.evaluation.uncertainty import measure_calibration
from nerg_mi.fields.kde import SphericalKde
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.probes import place_probes
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_folds import hold_out
from tests.evaluation.gaze_fields import KINDS, made, saved
from tests.kernels import list_kernels_each
from tests.plugins import fields
from tests.plugins.scenes import camera, channels
from tests.refusals import mentions

# ---- Evaluation of gaze: truth from participants, scores against closed forms, held-out data ----


def crowd(n=3000, people=4, seed=0):
    """Participants along a corridor who look at the wall x = 1.5, each at a different height."""
    rng = np.random.default_rng(seed)
    origin = np.stack([rng.uniform(-1, 0, n), rng.uniform(-5, 5, n), rng.uniform(1.5, 1.7, n)], axis=1)
    person = rng.integers(0, people, n)
    hit = np.stack([np.full(n, 1.5), rng.normal(0, 0.2, n), 1 + 0.3 * person + rng.normal(0, 0.1, n)], axis=1)
    direction = hit - origin
    return Rays(
        np.arange(n),
        person,
        tuple("abcdefghijkl"[:people]),
        origin,
        direction / np.linalg.norm(direction, axis=1, keepdims=True),
        np.ones(n),
        hit,
    )


@pytest.fixture(scope="module")
def rays_evaluation():
    return crowd()


@pytest.fixture(scope="module")
def test_set(rays_evaluation):
    return gaze.make_test(
        rays_evaluation, np.array([[-0.5, 0, 1.6], [-0.5, 3, 1.6], [40, 0, 0]]), 0.6, 20.0, 512, min_rays=20
    )


def test_truth_is_the_probes(rays_evaluation, test_set):
    assert len(test_set.centres) == 2
    probes = place_probes(
        rays_evaluation,
        0.6,
        queries=test_set.centres,
        max_rays=1024,
        min_rays=1,
        kappa_rule="fixed",
        kappa=20.0,
        centre="query",
    )
    np.testing.assert_allclose(test_set.truth, probes.density(test_set.directions), rtol=1e-4, atol=1e-6)
    assert (test_set.counts.sum(axis=1) == probes.counts).all() and set(test_set.participants) == set("abcd")


def test_scores_of_the_truth_and_of_the_uniform_density(test_set):
    test_set = replace(test_set, kappa=None)
    rows = gaze.score_methods(
        test_set,
        {
            "truth": lambda p, d: test_set.truth if d.ndim == 2 else np.ones(d.shape[:2]),
            "uniform": make_uniform_baseline(),
        },
        make_uniform_baseline(),
        20,
    )
    best, flat = rows
    assert best["KLD"] < 1e-6 and best["CC"] == pytest.approx(1) and best["SIM"] == pytest.approx(1)
    assert best["MAE"] == 0
    assert flat["CC"] == 0 and flat["NSS"] == 0 and [flat["AUC"], flat["sAUC"]] == pytest.approx([0.5, 0.5])
    assert flat["bits"] == 0 and flat["loglik"] == pytest.approx(-np.log(4 * np.pi))
    assert flat["integral"] == pytest.approx(1)
    assert flat["KLD"] == pytest.approx(float(metrics.kld(test_set.truth, np.ones((2, 512)), eps=1e-6).mean()))
    assert best["KLD.less"] == pytest.approx(best["KLD"] - flat["KLD"])
    assert best["KLD.less.low"] < best["KLD.less"] < best["KLD.less.high"]
    assert flat["bits.low"] == 0 and flat["KLD.low"] < flat["KLD"] < flat["KLD.high"]
    for end in ("", ".low", ".high"):
        assert flat[f"KLD.gap{end}"] == best[f"KLD.less{end}"]
    assert not any(".gap" in key for key in best)


def test_other_rays_are_farther_than_two_radii_if_possible(rays_evaluation):
    """A to C are in a row; B is within 2R of A, C of none."""
    centres = np.array([[-0.5, 0, 1.6], [-0.5, 1, 1.6], [-0.5, 4, 1.6]])
    source = lambda a: {tuple(v) for v in a.reshape(-1, 3)}
    result = gaze.make_test(rays_evaluation, centres, 0.6, 20.0, 64, min_rays=20)
    (a, b, c), other_values = map(source, result.sample_directions), [source(o) for o in result.other_directions]
    assert a.isdisjoint(c) and b.isdisjoint(c)
    assert (
        other_values[0] <= c
        and other_values[1] <= c
        and other_values[2] <= a | b
        and other_values[2] & a
        and other_values[2] & b
    )
    # If all are nearer, any other position is used, or the position itself if it is the only one.
    result = gaze.make_test(rays_evaluation, centres[:2], 0.6, 20.0, 64, min_rays=20)
    a, b = map(source, result.sample_directions)
    assert source(result.other_directions[0]) <= b and source(result.other_directions[1]) <= a
    result = gaze.make_test(rays_evaluation, centres[:1], 0.6, 20.0, 64, min_rays=20)
    assert np.array_equal(result.other_directions, result.sample_directions)


def by_hand(persons: int) -> gaze.GazeTest:
    """One position and sixteen directions; each participant looks in another one, and the rays alternate between
    them."""
    d = np.eye(16, 3)
    parts = 16 / (4 * np.pi) * np.eye(16)[None, :persons]
    who = np.arange(4 * persons)[None] % persons
    at, counts, names = np.zeros((1, 4 * persons, 3)), np.full((1, persons), 4.0), tuple("abcdefgh"[:persons])
    rays = np.zeros((4 * persons, 3)), np.zeros((4 * persons, 1, 3)), who[0]
    return gaze.GazeTest(np.zeros((1, 3)), d, parts.mean(axis=1), parts, counts, names, at, who, at, *rays)


def test_intervals_are_a_bootstrap_over_persons():
    """For three participants all 27 resamples can be enumerated: the error of one participant is the weight of the
    others.
    """
    test = by_hand(3)
    sees = lambda k: lambda p, d: test.participant_densities[:, k] if d.ndim == 2 else np.ones(d.shape[:2])
    row, _ = gaze.score_methods(test, {"first": sees(0), "second": sees(1)}, make_uniform_baseline(), resamples=1000)
    draws = list(itertools.product(range(3), repeat=3))
    mae = [2 * (1 - draw.count(0) / 3) / (4 * np.pi) for draw in draws]
    assert row["MAE"] == pytest.approx(np.mean(mae))
    assert row["MAE.high"] - row["MAE"] == pytest.approx(1.96 * np.std(mae), rel=0.1)
    assert row["MAE"] - row["MAE.low"] == pytest.approx(1.96 * np.std(mae), rel=0.1)
    # The interval of a difference uses the same resamples.
    less = [2 * (draw.count(1) - draw.count(0)) / 3 / (4 * np.pi) for draw in draws]
    assert row["MAE.less.high"] - row["MAE.less"] == pytest.approx(1.96 * np.std(less), rel=0.1)
    assert row["MAE.less"] - row["MAE.less.low"] == pytest.approx(1.96 * np.std(less), rel=0.1)


@pytest.mark.parametrize("persons, has_interval", [(2, False), (3, True), (4, True)])
def test_fewer_than_three_persons_have_no_interval(persons, has_interval):
    for row in gaze.score_methods(
        by_hand(persons),
        {"a": make_uniform_baseline(), "b": make_uniform_baseline()},
        make_uniform_baseline(),
        resamples=5,
    ):
        assert all((f"{k}.low" in row) == has_interval and (f"{k}.high" in row) == has_interval for k in gaze.SCORES)


def test_maps_are_smoothed_with_the_kernel_of_the_truth(test_set, rays_evaluation):
    """A sharp density of the rays themselves resembles the truth only after the smoothing."""
    near = [np.linalg.norm(rays_evaluation.origin - c, axis=1) <= 0.6 for c in test_set.centres]
    offsets = np.cumsum([0, *map(np.count_nonzero, near)])
    directions = np.concatenate([rays_evaluation.direction[n] for n in near])
    sharp = SphericalKde(directions, offsets, 400.0).evaluate(test_set.directions)
    error = lambda maps: compute_map_scores(test_set.truth, maps)["KLD"]
    assert error(test_set.smooth(sharp)) < 0.03 < 0.1 < error(sharp)
    assert replace(test_set, kappa=None).smooth(sharp) is sharp
    flat = np.full((1, len(test_set.directions)), 1 / (4 * np.pi))
    np.testing.assert_allclose(test_set.smooth(flat), flat, rtol=1e-12)


def test_rays_are_also_scored_at_their_own_origins(test_set, rays_evaluation):
    """A density of the hit points seen from an observer is sharper there than at the centre of a position."""
    assert 0 < len(test_set.own_origins) <= len(rays_evaluation)
    away = np.linalg.norm(test_set.own_origins[:, None] - test_set.centres[None], axis=2).min(axis=1)
    assert away.max() <= 0.6 and away.min() > 0

    def towards_the_wall(positions, directions):
        """One where a ray meets the square below the middle of the wall, as seen from the position."""
        hit = positions[:, None] + directions * ((1.5 - positions[:, :1]) / directions[..., 0])[..., None]
        return np.where(np.abs(hit[..., 1]) < 0.25, 2.0, 1e-3)

    (row,) = gaze.score_methods(test_set, {"wall": towards_the_wall}, make_uniform_baseline(), resamples=20)
    assert row["bits at own origin"] > 0 and "bits at own origin.low" in row
    rows = gaze.score_participants(test_set, {"wall": towards_the_wall}, make_uniform_baseline())
    counts = np.bincount(test_set.own_participants)
    mean = np.average([r["bits at own origin"] for r in rows], weights=counts)
    assert mean == pytest.approx(row["bits at own origin"])


def test_ray_scores_by_hand():
    maps = np.array([[0.0, 1.0, 2.0, 5.0]]) / (4 * np.pi * 2)
    at, other_values = maps[:, [3, 1]], maps[:, [0, 0, 1, 3]]
    prior_values = np.array([[1, 2, 1, 1, 1, 20.0]])
    scores = gaze.compute_ray_scores(maps, np.hstack([at, other_values]), prior_values, np.zeros((1, 2)))
    np.testing.assert_allclose(scores["AUC"], [[3.5 / 4, 1.5 / 4]])
    # Ratios to the prior: 5 and 0.5 at the rays, and 0, 0, 1, 0.25 at those of other positions.
    np.testing.assert_allclose(scores["sAUC"], [[1, 3 / 4]])
    np.testing.assert_allclose(scores["loglik"], np.log(at), rtol=1e-6)
    np.testing.assert_allclose(scores["bits"], np.log2(at), rtol=1e-6)
    values = np.array([0, 1, 2, 5.0])
    np.testing.assert_allclose(scores["NSS"], [[(5 - 2) / values.std(), (1 - 2) / values.std()]])


def test_participants_are_scored_on_their_own_rays(rays_evaluation, test_set):
    prior = make_prior_baseline(rays_evaluation, kappa=50)
    rows = gaze.score_participants(test_set, {"prior": prior}, prior, min_rays=10)
    assert [r["person"] for r in rows] == list(test_set.participants)
    assert sum(r["rays"] for r in rows) == test_set.counts.sum()
    assert all(r["bits"] == pytest.approx(0) for r in rows)
    # The participants look at different heights, so one common density fits them differently.
    assert np.ptp([r["KLD"] for r in rows]) > 0.01


def test_maps_of_participants_need_enough_rays(test_set):
    """Map scores are means over the positions at which a participant has enough rays."""
    uniform = make_uniform_baseline()
    counts = test_set.counts[:, 0]
    for min_rays in (counts.min(), counts.min() + 1, counts.max() + 1):
        row = gaze.score_participants(test_set, {"uniform": uniform}, uniform, int(min_rays))[0]
        truth = test_set.participant_densities[counts >= min_rays, 0]
        expected = metrics.kld(truth, np.ones_like(truth), eps=1e-6).mean() if len(truth) else np.nan
        np.testing.assert_allclose(row["KLD"], expected, rtol=1e-6)


def test_training_and_test_rays_are_disjoint(rays_evaluation):
    _, account = hold_out(rays_evaluation, 0.3, zones=2, positions=8, min_rays=8, participant_fraction=0.5)
    for split in gaze.SPLITS:
        train, scored, centres = gaze.select_held_out_rays(rays_evaluation, account, split)
        named = lambda r: {rays_evaluation.persons[i] for i in np.unique(r.person)}
        assert named(train).isdisjoint(account["people"])
        assert named(scored) == (named(train) if split == "pos" else set(account["people"]))
        assert np.linalg.norm(train.origin[:, None] - np.array(account["centres"])[None], axis=2).min() > 0.6
    _, without = hold_out(rays_evaluation, 0.3, zones=2, positions=8, min_rays=8)
    with pytest.raises(ValueError, match="test_participants"):
        gaze.select_held_out_rays(rays_evaluation, without, "both")
    with pytest.raises(ValueError, match="both, pos, people"):
        gaze.select_held_out_rays(rays_evaluation, account, "time")


def test_positions_without_rays_are_refused(rays_evaluation):
    with pytest.raises(ValueError, match="min_rays"):
        gaze.make_test(rays_evaluation, np.array([[40.0, 0, 0]]), 0.5)


def test_maps_that_exceed_memory_are_refused(rays_evaluation, monkeypatch):
    monkeypatch.setattr(gaze, "_MAX_BYTES", 1e5)
    with pytest.raises(NergError, check=mentions("directions")):
        gaze.make_test(rays_evaluation, np.array([[-0.5, 0, 1.6], [-0.5, 3, 1.6]]), 0.6, 20.0, 512, min_rays=20)


def score_half(rays, centres=((-0.5, 0, 1.6), (-0.5, 3, 1.6)), **options):
    prior = make_uniform_baseline()
    return gaze.score_split_half(rays, np.array(centres, float), 0.6, options.pop("kappa", 20.0), prior, 20, **options)


@pytest.mark.filterwarnings("error")
def test_split_half_uses_positions_of_both_halves():
    rays = crowd(people=12)
    row, note = score_half(rays, ((-0.5, 0, 1.6), (-0.5, 3, 1.6), (40, 0, 0)), resamples=20)
    assert row["method"] == "split half" and 0 < row["CC"] < 1 and row["KLD"] > 0 and not note
    row, note = score_half(rays, ((40, 0, 0),))
    assert row is None and "no position" in note
    row, note = score_half(rays.select(rays.person == 0))
    assert row is None and "one participant" in note
    with pytest.raises(ValueError, match="not negative|kappa is negative"):
        # Errors are raised and not mistaken for missing rays.
        score_half(rays, kappa=-1.0)


def test_split_half_that_is_noise_is_left_out():
    """Few participants, and participants who look in different directions."""
    row, note = score_half(crowd(people=9), resamples=5)
    assert row is None and "participants: 4" in note
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(12, 3))
    rays = crowd(people=12)
    scattered = replace(rays, direction=(directions / np.linalg.norm(directions, axis=1, keepdims=True))[rays.person])
    row, note = score_half(scattered, kappa=200.0, resamples=20)
    assert row is None and "does not exceed 0" in note
    assert not gaze.find_split_half_fault(5, 0.1) and gaze.find_split_half_fault(5, 0.1, -0.01)
    assert gaze.find_split_half_fault(4, 0.1) and gaze.find_split_half_fault(5, float("nan"))


def test_resamples_without_a_scored_ray_do_not_count(test_set):
    """All scored rays are of one participant, whom some resamples lack."""
    who, origins = np.zeros_like(test_set.sample_participants), np.zeros_like(test_set.own_participants)
    test = replace(test_set, sample_participants=who, own_participants=origins)
    peaked = lambda positions, directions: np.exp(
        3 * np.broadcast_to(directions[..., 0], (len(positions), directions.shape[-2]))
    )
    (row,) = gaze.score_methods(test, {"peaked": peaked}, make_uniform_baseline(), 40)
    # Every resample with this participant has the same mean.
    for score in (*gaze.RAY_SCORES, *gaze.OWN_SCORES):
        assert row[f"{score}.low"] == pytest.approx(row[score]) == pytest.approx(row[f"{score}.high"])
    assert row["KLD.low"] < row["KLD"]
    at = np.ones(who.shape)
    (row,) = measure_calibration(test, {"peaked": (test.truth, at)}, 40)
    assert row["80%.low"] == pytest.approx(row["80%"]) == pytest.approx(row["80%.high"])


def test_intervals_of_ray_scores_resample_participants(test_set):
    """The interval of each score of rays equals that of draws of whole participants with the same seed."""
    # A field that suits some participants only, so that scores depend on the participant.
    peak = test_set.sample_directions[test_set.sample_participants == 0].mean(axis=0)
    peaked = lambda positions, directions: np.exp(
        3 * np.broadcast_to(directions @ peak, (len(positions), directions.shape[-2]))
    )
    prior, count, seed = make_uniform_baseline(), 40, 3
    (row,) = gaze.score_methods(test_set, {"peaked": peaked}, prior, count, seed)
    (evaluated,) = gaze._evaluate_methods(test_set, {"peaked": peaked}, prior)
    rng, num = np.random.default_rng(seed), len(test_set.participants)
    draws = [rng.multinomial(num, np.full(num, 1 / num)) for _ in range(count)]
    for name, values, who in [
        *((k, evaluated.rays[k], test_set.sample_participants) for k in gaze.RAY_SCORES),
        *((k, evaluated.own_rays[k], test_set.own_participants) for k in gaze.OWN_SCORES),
    ]:
        sums = np.array([[values[who == p].sum(), (who == p).sum()] for p in range(num)])
        resampled = [float(times @ sums[:, 0] / (times @ sums[:, 1])) for times in draws]
        half_width = 1.96 * np.std(resampled)
        assert row[f"{name}.high"] - row[name] == pytest.approx(half_width, rel=1e-6), name
        assert row[name] - row[f"{name}.low"] == pytest.approx(half_width, rel=1e-6), name
    other_seed = gaze.score_methods(test_set, {"peaked": peaked}, prior, count, seed + 1)[0]
    assert other_seed["bits.low"] != row["bits.low"] and other_seed["KLD.low"] != row["KLD.low"]


# ---- Scores ----
#
# The evaluated densities equal the rendered ones, for every kind of field.

BOX = Box((-1, -1, -1), (1, 1, 1))
EYES = [(0.1, -0.2, 0.3), (-0.4, 0.3, -0.1)]

ROOM = """<scene version="3.0.0">
  <shape type="cube"><boolean name="flip_normals" value="true"/>
    <transform name="to_world"><scale value="0.9"/></transform></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.2"/><translate x="0.5"/></transform></shape></scene>"""


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """Geometries of gaze fields, and the same as children of an integrator and of a scene."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("places")
    (folder / "room.xml").write_text(ROOM)
    shapes = {f"s{i}": s for i, s in enumerate(mi.load_string(ROOM).shapes())}
    fields.radiance(folder / "field.safetensors", density_scale=30.0)
    volume = {"type": "nerf", "filename": str(folder / "field.safetensors")}
    return {
        "shapes": (Environment.open(folder / "room.xml").medium, {}, shapes),
        "field": (Environment.open(folder / "field.safetensors").medium, {"field": volume}, {}),
    }


def pictured(mi, gaze, children: dict, shapes: dict, eye) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) in which the observer at ``eye`` sees a surface, and the gaze (N,) that a panorama shows
    there."""
    to_world = mi.ScalarTransform4f().translate(list(eye))
    sensor = {**camera(mi, kind="panorama", size=32, film={"height": 16}), "to_world": to_world}
    field = {"type": "gazefield", "filename": str(gaze)}
    integrator = {"type": "nerg", "aovs": "opacity,position,gaze", "radiance": False, "gaze": field, **children}
    out = channels(mi, integrator, sensor, **shapes)
    hits = out["opacity.Y"] >= 0.5
    direction = np.stack([out[f"position.{c}"][hits] for c in "XYZ"], axis=-1) - np.array(eye)
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True), out["gaze.Y"][hits]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", ["shapes", "field"])
def test01_densities_equal_the_rendering(rgb, places, tmp_path, place, kind):
    """To 2e-4 of the largest density: directions are recovered from positions in single precision."""
    medium, children, shapes = places[place]
    field = saved(tmp_path / "g.safetensors", kind, BOX)
    density = FieldDensity(field, medium)
    for eye in EYES:
        directions, expected = pictured(rgb, tmp_path / "g.safetensors", children, shapes, eye)
        assert len(expected) > 50 and np.ptp(expected) > 0.2 * expected.max()
        result = density(np.array([eye]), directions)
        assert result.shape == (1, len(expected))
        np.testing.assert_allclose(result[0], expected, atol=2e-4 * expected.max())


@pytest.mark.parametrize("kind", ["normalised", "default recipe", "ensemble"])
def test02_each_position_has_its_integral(rgb, places, kind):
    """The same number of new positions: the cache does not depend on the count."""
    medium, field, d = places["shapes"][0], made(kind, BOX), fibonacci_directions(256)
    density = FieldDensity(field, medium)
    first, second = (np.array([eye]) for eye in EYES)
    alone = FieldDensity(field, medium)(second, d)
    a = density(first, d)
    np.testing.assert_array_equal(density(second, d), alone)
    # Cached, and in another order.
    np.testing.assert_array_equal(density(np.concatenate([second, first]), d), np.concatenate([alone, a]))
    integral = density(first, fibonacci_directions(4096)).mean() * 4 * np.pi
    assert integral == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("kind", ["linear", "default recipe"])
def test03_alignment_moves_turns_and_scales(rgb, places, kind):
    medium, field, d = places["shapes"][0], made(kind, BOX), fibonacci_directions(64)
    scaled = np.array([[0, -0.5, 0, 0.1], [0.5, 0, 0, -0.2], [0, 0, 0.5, 0.05], [0, 0, 0, 1]])
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    at = np.array(EYES)
    inside = FieldDensity(field, medium)(at @ scaled[:3, :3].T + scaled[:3, 3], d @ turn.T)
    np.testing.assert_allclose(FieldDensity(field, medium, Similarity(scaled))(at, d), inside, rtol=2e-4)
    assert np.ptp(inside) > 1e-2


def test04_each_position_may_have_its_own_directions(rgb, places):
    medium, field, d = places["shapes"][0], made("default recipe", BOX), fibonacci_directions(64)
    density, individual = FieldDensity(field, medium), np.stack([d, d[::-1]])
    common, result = density(np.array(EYES), d), density(np.array(EYES), individual)
    np.testing.assert_array_equal(result[0], common[0])
    np.testing.assert_allclose(result[1], common[1][::-1], rtol=1e-5)


def test05_a_field_with_surfaces_needs_geometry(rgb):
    with pytest.raises(NergError, check=mentions("environment")):
        FieldDensity(made("default recipe", BOX), None)
    without = made("default recipe", BOX, geometry="none", reach=1.5)
    d = fibonacci_directions(2048)
    assert FieldDensity(without, None)(np.array(EYES), d).mean() * 4 * np.pi == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("kind", ["default recipe", "re-aimed hits", "ensemble"])
def test05_new_positions_need_no_new_kernels(rgb, places, kind):
    density, rng = FieldDensity(made(kind, BOX), places["shapes"][0]), np.random.default_rng(0)
    positions, directions = rng.uniform(*np.sort(EYES, axis=0), (10, 1, 3)), fibonacci_directions(8192)
    kernels = list_kernels_each(lambda k: density(positions[k], directions), len(positions))
    assert kernels[0] and set.union(*kernels[2:]) <= kernels[0] | kernels[1]


def test06_semantic_features_are_those_of_the_render(rgb, places, tmp_path):
    """Features of the radiance field, as the integrator provides them."""
    medium, children, shapes = places["field"]
    for kind in ("snapshot", "accumulated"):
        field = saved(tmp_path / "g.safetensors", "linear", BOX, semantic=kind)
        directions, expected = pictured(rgb, tmp_path / "g.safetensors", children, shapes, EYES[0])
        result = FieldDensity(field, medium)(np.array(EYES[:1]), directions)[0]
        np.testing.assert_allclose(result, expected, atol=2e-3 * expected.max())


def test_zero_density_counts_as_a_millionth_of_uniform():
    """Half of the sphere is empty, the other twice as dense: ½ ln 1/2 + ½ ln 1e6."""
    half = np.repeat([0.0, 2.0], 32)[None] / (4 * np.pi)
    flat = np.ones((1, 64)) / (4 * np.pi)
    millionth = np.where(half > 0, half, 1e-6 / (4 * np.pi))
    assert compute_map_scores(flat, half)["KLD"] == pytest.approx(0.5 * np.log(1e6 / 2), abs=1e-5)
    assert compute_map_scores(flat, half)["KLD"] == pytest.approx(np.mean(np.log(flat / millionth)), abs=1e-5)
    # In the other direction it has no influence.
    assert compute_map_scores(half, flat)["KLD"] == pytest.approx(np.log(2), abs=2e-5)
