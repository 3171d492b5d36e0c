"""Tests of `nerg_mi.train.gaze_folds`."""

from __future__ import annotations

import json
from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_hits import FAR, HitKernel
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_ensemble import train_ensemble
from nerg_mi.train.gaze_folds import (
    ALL_HIT_KERNELS,
    HIT_KERNELS,
    PRIOR_WEIGHTS,
    SELECTION_KEY,
    FoldDensities,
    FoldResults,
    PriorSelection,
    _calibrate_regions,
    _round_values,
    _select_best,
    _select_weight,
    evaluate_folds,
    make_hits,
)
from nerg_mi.train.gaze_run import KIND, StateSettings, fit_gaze
from nerg_mi.train.gaze_settings import ProbeSettings
from nerg_mi.train.gaze_trainer import GazeProgress, StagedProgress
from tests.fields.gaze.test_hits import reference

from .looks import LIKELIHOOD, LOG, NOWHERE, planned

# ---- Progress of a run with several stages ----


def test_stages_fill_the_progress_in_proportion_to_their_costs():
    """Also if one ends early, and if the cost of a later one turns out to be lower."""
    seen = []
    progress = StagedProgress(lambda p: seen.append(p.fraction))
    report = lambda stage, *fractions: [stage(GazeProgress("a", f, 1, 1.0, None)) for f in fractions]
    report(progress.start(0.0), 0.0)
    report(progress.start(1.0, 1.0, 2.0), 0.5, 1.0)
    report(progress.start(0.0), 0.0, 1.0)
    report(progress.start(1.0, 2.0), 0.5)
    report(progress.start(1.0), 0.2, 0.1, 1.0)
    early = 0.25 + 0.75 / 6
    assert seen == pytest.approx([0, 0.125, 0.25, 0.25, 0.25, early, *[early + 0.2 * (1 - early)] * 2, 1])


# ---- Selection of the prior by held-out participants and positions ----

PLAIN = replace(LOG, prior_factor=False)
PROBES_HERE = ProbeSettings(radius=0.3, probes=48, min_rays=1, kappa=20.0, directions=128, ray_weights="person")


def people(law: float, seed: int = 0, count: int = 6, each: int = 400) -> Rays:
    """Participants on a floor of 3 x 3 m.

    With ``law`` 1 all look at one point; with 0 each has an individual direction, independent of the position.
    """
    rng = np.random.default_rng(seed)
    n = count * each
    person = np.repeat(np.arange(count), each)
    origin = np.column_stack([rng.uniform(-1.5, 1.5, (n, 2)), np.full(n, 1.6)])
    away = np.array([0.0, 0.0, 1.6]) - origin
    individual = np.column_stack([rng.normal(size=(count, 2)), np.zeros(count)])
    d = np.where(rng.random((n, 1)) < law, away / np.linalg.norm(away, axis=1, keepdims=True), individual[person])
    d = d / np.linalg.norm(d, axis=1, keepdims=True) + 0.2 * rng.normal(size=(n, 3))
    names = tuple("abcdefghij"[:count])
    return Rays(np.arange(n) * 0.2, person, names, origin, d / np.linalg.norm(d, axis=1, keepdims=True), np.ones(n))


def plan_of(**changes):
    settings = replace(
        LIKELIHOOD,
        **{"prior_folds": 3, "validation_zones": 0, "steps": 300, "probes": 16, "weight_decay": 0.0, **changes},
    )
    return planned(PLAIN, settings, PROBES_HERE)


def make_fold(person, field, prior, field_maps, prior_maps, hits=None, hit_maps=None):
    """Densities of a fold; ``hits`` (n, C) and ``hit_maps`` (n, D) are those of re-aimed hits."""
    densities = np.column_stack([field, prior, *([] if hits is None else [hits])])
    return FoldDensities(person, densities, field_maps, prior_maps, lambda kernels, rows: hit_maps[rows])


def test02_the_best_weight_is_selected_where_the_field_is_clearly_better():
    rising, last = np.linspace(-1, 0, len(PRIOR_WEIGHTS)), len(PRIOR_WEIGHTS) - 1
    assert _select_weight(np.array([rising, rising])) == last
    falling = -rising
    assert _select_weight(np.array([falling, falling])) == 0 == _select_weight(falling[None])
    # The gain over the prior is 0.5 or 0.3, with a standard error of 0.1 or 0.01.
    gains = np.full((2, len(PRIOR_WEIGHTS)), -1.0)
    gains[:, last] = 0
    gains[:, 2], gains[:, 8] = (0.4, 0.6), (0.29, 0.31)
    assert _select_weight(gains) == 2
    # After a standard error less than nothing is left of 0.11, and 0.045 of 0.05.
    gains[:, 2], gains[:, 8] = (-0.01, 0.23), (0.045, 0.055)
    assert _select_weight(gains) == 8
    gains[:, 8] = (-0.06, 0.15)
    assert _select_weight(gains) == last


def test03_the_weight_maximises_the_held_out_likelihood():
    """The field holds for half of the rays of each participant, and the prior for the others."""
    field, prior = np.tile([1.0, 0.01], 1000), np.tile([0.02, 0.3], 1000)
    uniform, person = np.full((2000, 8), 1 / (4 * np.pi)), np.repeat(np.arange(200), 10)
    fold = make_fold(person, field, prior, uniform, uniform)._replace(train_fraction=0.6)
    result = FoldResults(0.1, 20.0, [fold, fold]).select()
    expected = max(np.linspace(0.01, 0.99, 99), key=lambda m: np.log((1 - m) * field + m * prior).mean())
    assert result.prior_weight == pytest.approx(expected, abs=0.03) and result.bits > max(0, result.bits_field)
    assert result.folds == 2 and result.prior_kappa == 20.0 and result.train_fraction == 0.6  # noqa: RUF069 (stored)


def test03a_bits_with_weights_of_other_folds():
    """The participants of the first fold are predicted by the field, and those of the second by the prior."""
    person, uniform = np.arange(40), np.full((40, 8), 1 / (4 * np.pi))
    densities = ((1.0, 0.1), (0.01, 1.0))
    folds = [make_fold(person, np.full(40, f), np.full(40, p), uniform, uniform) for f, p in densities]
    alone = [FoldResults(0.1, 20.0, [fold]).select() for fold in folds]
    assert alone[0].prior_weight < 0.1 and alone[1].prior_weight == 1
    # The weights of one fold fail in the other, so hardly more than the prior is used.
    selection = FoldResults(0.1, 20.0, folds).select()
    assert selection.prior_weight > 0.9 and selection.bits_crossed <= selection.bits
    # Equal folds select equal weights; of a single participant nobody else is there.
    same = FoldResults(0.1, 20.0, [folds[0], folds[0]]).select()
    assert 0 < same.bits_crossed < same.bits < np.log2(10)
    one = make_fold(np.zeros(1, int), np.ones(1), np.full(1, 0.1), uniform[:1], uniform[:1])
    assert FoldResults(0.1, 20.0, [one]).select().bits_crossed is None


def test03b_hits_have_weight_if_they_improve_the_mixture():
    """Field, prior and the hits with two of the kernels hold for a quarter of the rays each."""
    quarter = np.tile(np.eye(4), (150, 1)) + 0.01
    person, uniform = np.repeat(np.arange(50), 12), np.full((600, 8), 1 / (4 * np.pi))
    hits = np.full((600, len(HIT_KERNELS)), 0.01)
    useless = make_fold(person, *quarter[:, :2].T, uniform, uniform, hits, uniform)
    assert FoldResults(0.1, 20.0, [useless]).select().hits == ()
    hits[:, [4, 9]] = quarter[:, 2:]
    results = FoldResults(0.1, 20.0, [make_fold(person, *quarter[:, :2].T, uniform, uniform, hits, uniform)])
    selection = results.select()
    assert [kernel[1:] for kernel in selection.hits] == [HIT_KERNELS[4], HIT_KERNELS[9]]
    assert selection.prior_weight == pytest.approx(0.25, abs=0.06)
    assert [kernel.weight for kernel in selection.hits] == pytest.approx([0.25, 0.25], abs=0.06)
    gains = results.compute_selected_gains(selection, 1)
    assert gains.mean() / np.log(2) == pytest.approx(selection.bits) and selection.bits > selection.bits_field
    restored = PriorSelection.from_dict(json.loads(json.dumps(selection.to_dict())))
    assert restored == PriorSelection(**{k: _round_values(v) for k, v in vars(selection).items()})
    for rows in ([[0.9, 0.1, 10.0]], [[0.1, 0.0, 10.0]], [[0.1, 0.1, -1.0]]):
        with pytest.raises(ValueError, match="hits"):
            PriorSelection.from_dict({**selection.to_dict(), "hits": rows})


def test03c_hits_are_seen_from_the_observer():
    """The column of each kernel is the density of the re-aimed hits."""
    rng = np.random.default_rng(2)
    rays = people(0.5, each=30)
    positions, directions = rng.uniform(0, 2, (7, 3)), fibonacci_directions(7)
    for hit in (None, rays.origin + 3 * rays.direction):
        rays = replace(rays, hit=hit)
        columns = make_hits(rays, NOWHERE, ALL_HIT_KERNELS).evaluate_kernels(positions, directions)
        widest = max(bandwidth for bandwidth, _ in HIT_KERNELS)
        far = rays.origin + FAR * widest * rays.direction
        for column, (bandwidth, kappa) in zip(columns.T, HIT_KERNELS):
            points = far if hit is None else hit
            expected = [
                reference(rays.origin, points, bandwidth, kappa, p, d, widest) for p, d in zip(positions, directions)
            ]
            np.testing.assert_allclose(column, expected, rtol=5e-3, atol=1e-5)


@pytest.mark.parametrize(("law", "has_weight"), [(1.0, True), (0.0, False)])
def test04_the_field_has_weight_if_position_is_informative(law, has_weight, rgb):
    """If all look at one point, the field is not mixed; if each participant has an individual direction, position is
    not informative.
    """
    messages = []
    result = evaluate_folds(Supervision(people(law)), NOWHERE, plan_of(), ns, messages.append).select()
    assert result is not None and messages[-1].stage.startswith("fold") and 0 < messages[-1].fraction <= 1
    assert result.regions is not None and 0 < result.regions["50%"] < result.regions["80%"] < result.regions["95%"] < 1
    if has_weight:
        assert result.prior_weight < 0.3 and result.bits > 0.1 and result.folds <= 3
    else:
        assert result.prior_weight > 0.6 and result.bits >= max(0, result.bits_field) and result.folds == 3


def test05_of_a_training_and_of_an_ensemble(rgb):
    rays = people(0.0)
    plan = plan_of(steps=20)
    field, provenance = fit_gaze(Supervision(rays), NOWHERE, plan, ns)
    assert field.config.mix == provenance["mix"]["mix"] > 0
    ensemble, provenance = train_ensemble(2, Supervision(rays), NOWHERE, plan, ns)
    assert [f.config.mix for f in ensemble.members] == [provenance["mix"]["mix"]] * 2
    # Nothing can be held out of one participant at one position, so the weight stays.
    seated = people(0.0, count=1)
    seated = replace(seated, origin=np.full_like(seated.origin, 1.6))
    few, provenance = fit_gaze(Supervision(seated), NOWHERE, plan, ns)
    assert few.config.mix == LOG.mix and provenance["mix"]["mix"] == LOG.mix and provenance["mix"]["folds"] == 0
    assert provenance["mix"]["regions"] is None
    assert PriorSelection(0.5, 1, regions={"80%": 0.71234}).to_dict()["regions"] == {"80%": 0.7123}

    # After Ctrl-C the field exists, without a selected weight.
    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    field, provenance = fit_gaze(Supervision(rays), NOWHERE, plan, ns, on_progress=stop)
    assert provenance["interrupted"] and "mix" not in provenance and field.config.mix == LOG.mix


def test07_regions_are_those_of_the_mixture():
    """Rays are in three of four directions, and the levels are quantiles: half of the rays are in the region of the
    second.
    """
    field, prior = np.array([[0.8, 0.4, 0.2, 0.0]]), np.array([[0.0, 0.2, 0.2, 0.4]])
    # Half of each: 0.4, 0.3, 0.2, 0.2.
    rays = [0, 1, 3]
    maps = (np.repeat(v, 3, axis=0) for v in (field, prior))
    fold = make_fold(np.zeros(3, int), field[0, rays], prior[0, rays], *maps)
    result = _calibrate_regions([fold], PriorSelection(0.5, 1))
    np.testing.assert_allclose([result[k] for k in ("50%", "80%", "95%")], [0.55 / 1.1, 0.9 / 1.1, 0.9 / 1.1])
    # The prior alone prefers the third direction, and the second as much as the direction without rays.
    np.testing.assert_allclose(_calibrate_regions([fold], PriorSelection(1.0, 1))["50%"], 1 - 0.5 * (0.2 + 0.2) / 0.8)


def test07b_regions_are_those_of_all_participants():
    """Of two participants in the order of the recording, one looks at the peaks and the other where nobody does."""
    count, size = 300, len(HIT_KERNELS)
    person = np.repeat([0, 1], count // 2)
    maps = np.tile(np.linspace(0, 1, 50), (count, 1))
    at_rays = np.where(person == 0, 1.0, 0.0)
    fold = make_fold(person, at_rays, at_rays, maps, maps, np.tile(at_rays[:, None], (1, size)), maps)
    regions = _calibrate_regions([fold], PriorSelection(0.1, 1, hits=(HitKernel(0.2, *HIT_KERNELS[0]),)))
    assert regions["50%"] < 0.2 and regions["80%"] > 0.9


# ---- Variants ----
#
# Selection of the architecture by held-out participants and positions, made once and stored for a resumed run.

CAPTURE, BOTH = replace(LOG, variant="capture", geometry="none"), replace(LOG, geometry="none")


def two(**changes):
    return replace(plan_of(**changes), config=CAPTURE, alternatives=(BOTH,))


class FixedWeight(FoldResults):
    """Folds that select the smallest weight of the prior."""

    def select(self):
        return PriorSelection(float(PRIOR_WEIGHTS[0]) if self.folds else self.default_weight, len(self.folds))


def scored(*gains):
    """Folds in which a field exceeds the prior by ``gains`` nats with the smallest weight."""
    uniform = np.ones((1, 4))
    scale = lambda gain: (np.exp(gain) - PRIOR_WEIGHTS[0]) / (1 - PRIOR_WEIGHTS[0])
    make = lambda gain: make_fold(np.zeros(1, int), np.full(1, scale(gain)), np.ones(1), uniform, uniform)
    return FixedWeight(0.1, None, [make(gain) for gain in gains])


def test01_the_first_variant_is_kept_unless_another_is_better():
    plan = replace(two(), alternatives=())
    for first, second, selected in (
        ((1.0, 1.0), (1.1, 1.1), BOTH),
        ((1.1, 1.1), (1.0, 1.0), CAPTURE),
        # Better by 0.1, with a standard error of 0.3, and of 0.15.
        ((1.0, 1.0), (1.4, 0.8), CAPTURE),
        ((1.0, 1.0), (1.25, 0.95), BOTH),
        # Over the common folds.
        ((1.0, 1.0, 1.9), (1.1, 1.1), BOTH),
    ):
        result, choice = _select_best(plan, (CAPTURE, BOTH), [scored(*first), scored(*second)])
        assert (
            result.config == selected and choice.variant == selected.variant and choice.prior_weight == PRIOR_WEIGHTS[0]
        )
        bits = {"capture": np.mean(first[:2]) / np.log(2), "emit_capture": np.mean(second) / np.log(2)}
        assert choice.variants == pytest.approx(bits)
    result, choice = _select_best(plan, (CAPTURE, BOTH), [FoldResults(0.1, None, [])] * 2)
    assert result.config == CAPTURE and choice == PriorSelection(0.1, 0)


@pytest.mark.nightly
def test02_the_variant_that_predicts_held_out_participants_is_trained(rgb):
    """A common direction, independent of position, is in the prior; one common point in the middle of a floor needs
    emit if capture has only one harmonic.
    """
    messages = []
    flat = replace(CAPTURE, sh_degree=1)
    plan = replace(two(), config=flat, alternatives=(replace(BOTH, reach=1.9, sh_degree=1),))
    field, provenance = fit_gaze(Supervision(people(1.0)), NOWHERE, plan, ns, on_progress=messages.append)
    bits = provenance["mix"]["variants"]
    assert provenance["mix"]["variant"] == field.config.variant == "emit_capture"
    assert bits["emit_capture"] > bits["capture"] and field.config.mix == provenance["mix"]["mix"]
    stages = [state.stage for state in messages]
    assert stages.index("fit") > max(i for i, s in enumerate(stages) if s.startswith("fold"))
    assert {"fold 1 of capture", "fold 1 of emit_capture"} <= set(stages)
    ensemble, provenance = train_ensemble(2, Supervision(people(1.0)), NOWHERE, plan, ns)
    assert {(f.config.variant, f.config.mix) for f in ensemble.members} == {("emit_capture", provenance["mix"]["mix"])}


@pytest.mark.parametrize("members", [0, 2])
def test04_a_resumed_run_keeps_its_selection(members, tmp_path, rgb, monkeypatch):
    supervision = Supervision(people(1.0))
    path, plan, steps = tmp_path / "a.run", two(steps=8), []

    def stop(progress):
        steps.append(progress)
        if progress.stage.endswith("fit") and progress.steps == 4:
            raise KeyboardInterrupt

    def trained(**options):
        if members:
            return train_ensemble(members, supervision, NOWHERE, plan, ns, **options)
        return fit_gaze(supervision, NOWHERE, plan, ns, write=lambda field, provenance: None, **options)

    state = StateSettings(path=path, interval=0.0)
    if members:
        with pytest.raises(KeyboardInterrupt):
            trained(state=state, on_progress=stop)
    else:
        assert trained(state=state, on_progress=stop)[1]["interrupted"]
    selected = read_checkpoint(path, KIND)[1]["about"][SELECTION_KEY]
    # Folds are not evaluated again.
    monkeypatch.setattr("nerg_mi.train.gaze_folds.evaluate_folds", None)
    tensors, meta = read_checkpoint(path, KIND)
    for wrong in ({"mix": 2.0, "folds": 1}, {"colour": 1}, "capture"):
        write_checkpoint(path, KIND, tensors, {**meta, "about": {**meta["about"], SELECTION_KEY: wrong}})
        with pytest.raises(NergError, match="damaged.*start again"):
            trained(state=replace(state, resume=True))
    for key, wrong in (
        ("found", [3]),
        ("found", {**meta["found"], "history": [{"kld": 1.0}]}),
        ("found", {**meta["found"], "scores": [1.0]}),
        ("found", {**meta["found"], "colour": 1}),
        ("found", {**meta["found"], "since": "2"}),
        ("stage", ["fit"]),
    ):
        write_checkpoint(path, KIND, tensors, {**meta, key: wrong})
        with pytest.raises(NergError, match="run state.*start again"):
            trained(state=replace(state, resume=True))
    write_checkpoint(path, KIND, tensors, meta)
    _, provenance = trained(state=replace(state, resume=True))
    assert not provenance["interrupted"] and provenance["mix"] == selected
    with pytest.raises(NergError, match="cannot resume"):
        fit_gaze(supervision, NOWHERE, plan, ns, state=StateSettings(path=tmp_path / "b.run", resume=True))


def test05_ctrl_c_during_folds_reports_that_no_state_is_saved(rgb):
    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="emit_capture"):
        fit_gaze(Supervision(people(1.0)), NOWHERE, two(), ns, on_progress=stop)
