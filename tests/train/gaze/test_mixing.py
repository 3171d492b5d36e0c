"""The share of the blind density: chosen by people and places that are held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_ensemble import train_ensemble
from nerg_mi.train.gaze_folds import (
    SHARES,
    MixChoice,
    _choose,
    _Judgement,
    _kld,
    _regions,
    choose_mix,
    inner_folds,
    mixes,
)
from nerg_mi.train.gaze_run import train_gaze
from nerg_mi.train.gaze_settings import ProbeSettings

from .looks import LIKELIHOOD, LOG, NOWHERE, PRODUCT, SMALL, planned

PROBES_HERE = ProbeSettings(radius=0.3, count=48, min_rays=1, kappa=20.0, directions=128, weights="person")


def people(law: float, seed: int = 0, count: int = 6, each: int = 400) -> Rays:
    """People on a floor of 3 x 3 m. With ``law`` 1 all look at one point; with 0 each one has a direction of their own,
    wherever they stand."""
    rng = np.random.default_rng(seed)
    n = count * each
    person = np.repeat(np.arange(count), each)
    origin = np.column_stack([rng.uniform(-1.5, 1.5, (n, 2)), np.full(n, 1.6)])
    away = np.array([0.0, 0.0, 1.6]) - origin
    own = np.column_stack([rng.normal(size=(count, 2)), np.zeros(count)])
    d = np.where(rng.random((n, 1)) < law, away / np.linalg.norm(away, axis=1, keepdims=True), own[person])
    d = d / np.linalg.norm(d, axis=1, keepdims=True) + 0.2 * rng.normal(size=(n, 3))
    names = tuple("abcdefghij"[:count])
    return Rays(np.arange(n) * 0.2, person, names, origin, d / np.linalg.norm(d, axis=1, keepdims=True), np.ones(n))


def plan_of(**changes):
    settings = replace(
        LIKELIHOOD, **{"mix_folds": 3, "zones": 0, "steps": 300, "probes": 16, "weight_decay": 0.0, **changes}
    )
    return planned(LOG, settings, PROBES_HERE)


def test01_those_who_are_judged_are_not_learnt_from():
    rays = people(1.0)
    folds = list(inner_folds(rays, plan_of()))
    assert len(folds) == 3
    for learn, held, centres in folds:
        assert not set(learn.person) & set(held.person) and len(np.unique(held.person)) == 2
        assert np.linalg.norm(learn.origin[:, None] - centres[None], axis=2).min() > 2 * PROBES_HERE.radius
    assert set(np.concatenate([np.unique(held.person) for _, held, _ in folds])) == set(range(6))
    # People who sit: the zones take all that is theirs.
    seated = people(1.0)
    seated = replace(seated, origin=np.column_stack([seated.person, 0 * seated.person, 1.2 + 0 * seated.person]))
    assert [len(learn) for learn, _, _ in inner_folds(seated, plan_of())] == [1600] * 3
    for learn, held, _ in inner_folds(people(1.0, count=1), plan_of()):
        assert len(held) == 400 and 0 < len(learn) < 400


def test02_of_shares_that_cannot_be_told_apart_the_largest():
    low = np.linspace(1, 2, len(SHARES))
    assert _choose(np.array([low, low])).mix == SHARES[0]
    assert _choose(np.array([low[::-1], low[::-1]])).mix == 1.0
    # One fold likes the field as much as the other likes the blind density.
    unsure = _choose(np.array([low, 3.01 - low]))
    assert unsure.mix == 1.0 and unsure.folds == 2 and np.isclose(unsure.kld_blind, (2 + 1.01) / 2)
    assert np.isclose(_choose(low[None]).kld, 1)
    # The blind density alone is worse by .1 of KLD, with a standard error of .1, .15 and .25.
    for error, mix in ((0.1, SHARES[0]), (0.15, SHARES[0]), (0.25, 1.0)):
        curves = np.stack([low * 0 + 2, low * 0 + 2])
        curves[:, 1:], curves[:, -1] = 3, (2.1 - error, 2.1 + error)
        assert _choose(curves).mix == mix


def test03_divergence_of_densities():
    truth = np.array([[1.0, 3.0], [2.0, 2.0]])
    field = np.array([[2.0, 2.0], [1.0, 3.0]])
    expected = np.mean([0.25 * np.log(0.5) + 0.75 * np.log(1.5), 0.5 * np.log(2) + 0.5 * np.log(2 / 3)])
    assert np.isclose(_kld(truth, field), expected)


@pytest.mark.parametrize(("law", "kept"), [(1.0, True), (0.0, False)])
def test04_a_field_counts_where_position_tells(law, kept, rgb):
    """Where all look at one point the field stays as it is; where each person has a way of their own, position tells
    nothing of others."""
    from nerg_mi.fields.mlp import namespace

    ns = namespace(rgb.Float(0))
    told = []
    found = choose_mix(Supervision(people(law)), NOWHERE, plan_of(), ns, told.append)
    assert found is not None and told[-1].stage.startswith("fold") and 0 < told[-1].done <= 1
    assert found.regions is not None and 0 < found.regions["50%"] < found.regions["80%"] < found.regions["95%"] < 1
    if kept:
        assert found.mix < 0.3 and found.kld < found.kld_blind and found.folds <= 3
    else:
        assert found.mix > 0.6 and found.kld <= found.kld_field and found.folds == 3


def test05_of_a_training_and_of_an_ensemble(rgb):
    from nerg_mi.fields.mlp import namespace

    ns, rays = namespace(rgb.Float(0)), people(0.0)
    plan = plan_of(steps=20)
    field, about = train_gaze(Supervision(rays), NOWHERE, plan, ns)
    assert field.config.mix == about["mix"]["mix"] == SHARES[np.isclose(SHARES, about["mix"]["mix"])][0]
    ensemble, about = train_ensemble(2, Supervision(rays), NOWHERE, plan, ns)
    assert [f.config.mix for f in ensemble.members] == [about["mix"]["mix"]] * 2
    # Nobody can be held out at places that hold too few rays: the share stays.
    few, about = train_gaze(Supervision(people(0.0, each=12)), NOWHERE, plan, ns)
    assert few.config.mix == LOG.mix and about["mix"]["mix"] == LOG.mix and about["mix"]["folds"] == 0
    assert about["mix"]["regions"] is None
    assert MixChoice(0.5, 1, regions={"80%": 0.71234}).to_dict()["regions"] == {"80%": 0.7123}

    # After Ctrl-C the field is there, as it was before.
    def stop(progress):
        if progress.stage.startswith("fold"):
            raise KeyboardInterrupt

    field, about = train_gaze(Supervision(rays), NOWHERE, plan, ns, tell=stop)
    assert about["interrupted"] and "mix" not in about and field.config.mix == LOG.mix


def test06_only_log_densities_have_a_share():
    assert mixes(plan_of()) and not mixes(plan_of(mix_folds=0))
    assert not mixes(planned(SMALL, replace(PRODUCT, mix_folds=3)))


def test07_regions_are_those_of_the_mixture():
    """Of looks in three of four directions, the shares in which they lie are quantiles: half of the looks lie in the
    region of the second."""
    field, blind = np.array([[0.8, 0.4, 0.2, 0.0]]), np.array([[0.0, 0.2, 0.2, 0.4]])
    # Half of each: 0.4, 0.3, 0.2, 0.2.
    judgement = _Judgement(field, blind, np.array([0, 1, 3]), np.array([0, 3]))
    found = _regions([judgement], 0.5)
    np.testing.assert_allclose([found[k] for k in ("50%", "80%", "95%")], [0.55 / 1.1, 0.9 / 1.1, 0.9 / 1.1])
    # The blind density alone finds the third look the likeliest, and the second as likely as where nobody looked.
    np.testing.assert_allclose(_regions([judgement], 1.0)["50%"], 1 - 0.5 * (0.2 + 0.2) / 0.8)
