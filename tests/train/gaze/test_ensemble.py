"""Ensembles: resampling, individual members, resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import DataSummary
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.interruption import Interrupted
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_ensemble import assign_blocks, resample_rays, resample_views, train_ensemble
from nerg_mi.train.gaze_run import StateSettings

from .looks import LIKELIHOOD, LOG, NOWHERE, PROBES, around, looking_at, planned, train

PLACE = replace(LOG, geometry="none")
SHORT = replace(LIKELIHOOD, steps=4, validation_zones=0)


def crowd(people=6, n=1200, seconds=100.0):
    """Rays of several participants, interleaved, with individual times."""
    rays = looking_at((1.5, 0, 1.2), n, spread=2.0)
    who = np.arange(n) % people
    t = np.sort(np.random.default_rng(1).uniform(0, seconds, n)) + 1000 * who
    return Rays(t, who, tuple("abcdefgh"[:people]), rays.origin, rays.direction, np.ones(n))


def together(members=3, rays=None, *, place=NOWHERE, config=PLACE, settings=SHORT, probes=PROBES, **options):
    on_progress, write = options.pop("on_progress", None), options.pop("write", None)
    return train_ensemble(
        members,
        Supervision(rays or crowd()),
        place,
        planned(config, settings, probes),
        ns,
        state=StateSettings(**options),
        on_progress=on_progress,
        write=write,
    )


def arrays(field):
    return {k: np.array(v) for k, v in field.parameters().items()}


def test_blocks_are_participants_or_time_intervals():
    rays = crowd()
    block, kind = assign_blocks(rays)
    assert kind == "people" and np.array_equal(block, rays.person)
    few = crowd(people=2)
    block, kind = assign_blocks(few)
    assert kind == "blocks of 30 s" and block.max() + 1 == 8
    for b in range(8):
        assert len(set(few.person[block == b])) == 1 and np.ptp(few.t[block == b]) < 30
    with pytest.raises(ValueError, match="2 blocks of 30 s of 1 participants are too few"):
        assign_blocks(crowd(people=1, seconds=40.0))


def test_resamples_hold_whole_participants():
    rays, times = crowd(), []
    for seed in range(300):
        drawn = resample_rays(rays, seed)
        # A participant drawn twice becomes two with 200 rays each and different names.
        each = np.bincount(drawn.person, minlength=len(drawn.persons))
        assert set(each) <= {0, 200} and drawn.persons[:6] == rays.persons
        counts = np.bincount(drawn.person % 6, minlength=6) / 200
        assert np.array_equal(counts, counts.round()) and counts.sum() == 6
        times.append(counts)
    # Multinomial with six trials and probabilities of a sixth: mean 1, variance 5/6, and one in three is left out.
    times = np.array(times)
    assert np.abs(times.mean(axis=0) - 1).max() < 0.2 and times.var() == pytest.approx(5 / 6, rel=0.1)
    assert (times == 0).mean() == pytest.approx((5 / 6) ** 6, abs=0.03)


def test_members_are_trainings_of_resamples(threads):
    threads(1)
    rays = crowd()
    ensemble, provenance = together(3, rays)
    for k, member in enumerate(ensemble.members):
        individual = Supervision(resample_rays(rays, (SHORT.seed, k)))
        alone, _ = train(NOWHERE, replace(SHORT, seed=100 * k), PLACE, supervision=individual)
        for name, value in arrays(alone).items():
            np.testing.assert_array_equal(arrays(member)[name], value, err_msg=name)
    assert (
        provenance["ensemble"] == {"members": 3, "resampled": "people", "seeds": [0, 100, 200]}
        and provenance["steps"] == 12
    )
    # The support of all rays, not of a resample.
    assert (
        ensemble.support.cells[:, 3].sum() == len(rays) == provenance["rays"]
        and ensemble.support.radius == PROBES.radius
    )
    assert ensemble.basis == DataSummary(len(rays), len(rays.persons)) and provenance["people"] == len(rays.persons)


def test_an_interrupted_ensemble_resumes(threads, tmp_path):
    """Interrupted in the second member: the first is not trained again, and the result is that of an uninterrupted
    run."""
    threads(1)
    path, seen = tmp_path / "a.run", []

    def stop(state):
        seen.append(state.stage)
        if state.stage == "2/3 fit" and state.steps == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="2.*3.*resume"):
        together(path=path, on_progress=stop)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.member0.safetensors", "a.run"]
    with pytest.raises(NergError, match=r"started with different probes\.kappa"):
        together(path=path, resume=True, probes=replace(PROBES, kappa=9.0))
    seen.clear()
    written = []
    shares = []
    got, provenance = together(
        path=path,
        resume=True,
        on_progress=lambda s: (seen.append(s.stage), shares.append(s.fraction)),
        write=lambda *_: written.append(sorted(p.name for p in tmp_path.iterdir())),
    )
    assert set(seen) == {"2/3 probes", "2/3 fit", "3/3 probes", "3/3 fit"} and seen.count("2/3 fit") == 2
    # Each member is a third of the progress, the first of them already done.
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1)
    assert all(int(stage[0]) - 1 - 1e-9 <= 3 * share <= int(stage[0]) + 1e-9 for stage, share in zip(seen, shares))
    assert written == [[f"a.member{k}.safetensors" for k in range(3)]] and not list(tmp_path.iterdir())
    assert provenance["steps"] == 12
    expected = arrays(together()[0])
    for name, value in arrays(got).items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


def test_an_ensemble_interrupted_in_its_folds_resumes(threads, tmp_path):
    """All members are kept, and the folds start again."""
    threads(1)
    path, stages, folded = tmp_path / "a.run", [], replace(SHORT, prior_folds=2)

    def stop(state):
        if state.stage == "fold 1":
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as end:
        together(2, path=path, settings=folded, on_progress=stop)
    assert "resume=True" in str(end.value) and str(tmp_path / "a.member0.safetensors") in str(end.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.member0.safetensors", "a.member1.safetensors"]
    resumed, provenance = together(
        2, path=path, resume=True, settings=folded, on_progress=lambda s: stages.append(s.stage), write=lambda *_: None
    )
    complete, expected = together(2, settings=folded)
    assert set(stages) == {"fold 1", "fold 2", "folds"} and not list(tmp_path.iterdir())
    assert provenance["mix"] == expected["mix"] and provenance["mix"]["folds"] == 2
    for name, value in arrays(complete).items():
        np.testing.assert_array_equal(value, arrays(resumed)[name], err_msg=name)
    with pytest.raises(KeyboardInterrupt) as end:  # without a file there is nothing to resume
        together(2, settings=folded, on_progress=stop)
    assert "resume" not in str(end.value)


@pytest.mark.parametrize(
    "change, said", [({"config": replace(PLACE, width=8)}, "architecture"), ({"rays": crowd(people=7)}, "rays")]
)
def test_members_of_another_run_are_refused(tmp_path, change, said):
    """Finished members count only for their own run: members of another architecture must not be averaged."""
    path = tmp_path / "a.run"

    def stop(state):
        if state.stage == "2/2 fit":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        together(2, path=path, on_progress=stop)
    assert (tmp_path / "a.member0.safetensors").is_file()
    with pytest.raises(NergError, match=f"a.member0.safetensors.*started with different .*{said}"):
        together(2, **change, path=path, resume=True)
    assert (tmp_path / "a.member0.safetensors").is_file()


def test_an_ensemble_that_cannot_be_written_is_saved(threads, tmp_path):
    """The final write fails: the next start trains no member again, nor one that was killed before its state was
    removed.
    """
    threads(1)
    path, stages = tmp_path / "a.run", []

    def refuse(field, provenance):
        raise NergError("a weight does not fit into fp16; leave out half")

    with pytest.raises(NergError, match="fp16.*resume"):
        together(path=path, write=refuse)
    members = sorted(p.name for p in tmp_path.iterdir())
    assert members == [f"a.member{k}.safetensors" for k in range(3)]
    write_checkpoint(path, "gaze run", {"x": np.zeros(1)}, {"about": {"member": [1, 3]}})
    _, provenance = together(
        path=path, resume=True, on_progress=lambda s: stages.append(s.stage), write=lambda *_: None
    )
    assert not stages and provenance["steps"] == 12 and not list(tmp_path.iterdir())


def test_unsuitable_data_for_resampling_are_refused():
    for members, said, options in (
        (1, "at least two members", {}),
        (2, "would predict themselves", {"probes": replace(PROBES, kappa_rule="loo")}),
    ):
        with pytest.raises(ValueError, match=said):
            together(members, **options)
    with pytest.raises(NergError, match="4 salience images are too few to resample"):
        train_ensemble(2, Supervision(None, around(4)), NOWHERE, planned(PLACE, SHORT), ns)
    with pytest.raises(NergError, match="cannot resume"):
        together(path=Path("nowhere.run"), resume=True)


def test_views_are_resampled_one_by_one():
    views = around(12)
    drawn = resample_views(views, (0, 1))
    assert len(drawn) == 12 and 5 <= len(set(drawn)) < 12 and set(drawn) <= set(views)
    assert drawn == resample_views(views, (0, 1)) != resample_views(views, (0, 2))
    plan = planned(PLACE, replace(SHORT, prior_folds=3))
    field, provenance = train_ensemble(2, Supervision(None, views), NOWHERE, plan, ns)
    assert (
        provenance["ensemble"]["resampled"] == "views"
        and provenance["salience_views"] == 12
        and provenance["rays"] == 0
    )
    assert field.support is None and "mix" not in provenance
    assert not np.array_equal(arrays(field)["0.capture_net.0"], arrays(field)["1.capture_net.0"])
    _, provenance = train_ensemble(2, Supervision(crowd(), views), NOWHERE, planned(PLACE, SHORT), ns)
    assert provenance["ensemble"]["resampled"] == "people and views" and provenance["people"] == 6
