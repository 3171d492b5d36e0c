"""Tests of `nerg_mi.workflows.ablation`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation import ablation
from nerg_mi.workflows import ablation as ablation_bench
from nerg_mi.workflows.ablation import Bench, ablate, law_of, plan_of
from nerg_mi.workflows.gaze_commands import AblationOptions
from tests.evaluation.test_gaze import crowd
from tests.formats.splats.writers import random_splats, write_inria

# ---- The ablation as a job: rows that are kept and found again, frames, laws, what is refused ----


OPTIONS = AblationOptions(
    geometry="hits",
    recipes="default",
    variant=("capture", "emit_capture"),
    seeds=2,
    default_steps=2,
    zones=2,
    positions=6,
    min_rays=8,
    radius=0.5,
    cameras=1,
    size="16x8",
    probes=12,
)


class Uniform:
    """A law under which people look anywhere."""

    def density(self, positions, directions):
        return np.full((len(positions), len(directions)), 1 / (4 * np.pi))


@pytest.mark.nightly
def test_rows_are_made_once(tmp_path, monkeypatch):
    """With two variants, for the time that compiling takes; the trainers know all of them."""
    found = ablate(crowd(3000), tmp_path, OPTIONS)
    assert len(found.rows) == 4 and {r["seed"] for r in found.rows} == {0, 1}
    whole = [r["test_relative"] for r in found.rows if r["variant"] == "emit_capture"]
    assert np.mean(whole) == pytest.approx(1)
    assert all(r["frame_seconds"] > 0 and np.isfinite(r["test_loss"]) for r in found.rows)
    assert (tmp_path / "default_capture_0.safetensors").exists() and all(p.is_file() for p in found.files)
    assert json.loads((tmp_path / "ablation.json").read_text())["rows"] == found.rows
    # What is there already is not trained again; what would be another training is.
    trained = []
    monkeypatch.setattr(
        ablation_bench, "_train", lambda made, plan, path, bench: trained.append(path.stem) or found.rows[0]
    )
    ablate(crowd(3000), tmp_path, OPTIONS)
    assert trained == []
    other = replace(OPTIONS, law="tests.workflows.test_ablation:Uniform", seeds=1, variant=("capture",))
    ablate(crowd(3000), tmp_path, other)
    assert trained == ["default_capture_0"]


@pytest.mark.parametrize(
    "change, said",
    [
        ({"law": "nowhere"}, "MODULE:CLASS"),
        ({"law": "tests.workflows.test_ablation:Nobody"}, "MODULE:CLASS"),
        ({"variant": ("emitt",)}, 'emit_capture here, got "emitt"'),
        ({"size": "320"}, "WIDTHxHEIGHT"),
        ({"recipes": "default,best"}, '"best"'),
        ({"geometry": None}, "one of --field FILE"),
    ],
)
def test_what_is_wrong_is_told_before_any_work(tmp_path, change, said):
    with pytest.raises(NergError, match=said):
        ablate(crowd(100), tmp_path / "new", replace(OPTIONS, **change))
    assert not (tmp_path / "new").exists()


def test_splats_have_no_features_of_a_radiance_field(tmp_path):
    write_inria(tmp_path / "place.ply", random_splats(5))
    given = replace(
        OPTIONS, geometry=None, field=tmp_path / "place.ply", recipes="small", variant=("semantic snapshot",)
    )
    with pytest.raises(NergError, match="loss code here, got"):
        ablate(crowd(100), tmp_path / "new", given)


@pytest.mark.parametrize("recipe, seeds, steps, refit", [("default", [0, 1], 2, True), ("small", [0], 5, False)])
def test_only_quick_recipes_are_repeated(tmp_path, monkeypatch, recipe, seeds, steps, refit):
    """And have steps of their own."""
    plans = {}
    row = {"test_KLD": 1.0, "test_CC": 0.5, "train_seconds": 1.0, "test_loss": 1.0, "train_loss": 1.0, "steps": 1}

    def kept(made, plan, path, bench):
        plans[made["seed"]] = plan
        path.write_bytes(b"")
        return {**made, **row}

    monkeypatch.setattr(ablation_bench, "_train", kept)
    options = replace(OPTIONS, recipes=recipe, variant=("emit",), steps=5, refit=False, cameras=0)
    ablate(crowd(1000), tmp_path, options)
    assert sorted(plans) == seeds
    for seed, plan in plans.items():
        s = plan.settings
        assert (s.seed, s.steps, s.refit, plan.config.variant, plan.probes.count) == (seed, steps, refit, "emit", 12)
        assert s.watched_rays == 8


def test_another_first_seed_holds_others_out(tmp_path, monkeypatch):
    made = []

    def kept(row, plan, path, bench):
        made.append((row["seed"], plan.settings.seed, bench.centres.tobytes()))
        path.write_bytes(b"")
        return {**row, "test_KLD": 1.0, "test_CC": 0.5, "train_seconds": 1.0, "test_loss": 1.0, "train_loss": 1.0}

    monkeypatch.setattr(ablation_bench, "_train", kept)
    monkeypatch.setattr(ablation, "write_ablation", lambda *args: [])
    for first in (0, 5):
        ablate(crowd(1000), tmp_path / str(first), replace(OPTIONS, first=first, variant=("emit",), cameras=0))
    assert [m[:2] for m in made] == [(0, 0), (1, 1), (5, 5), (6, 6)]
    assert made[0][2] == made[1][2] != made[2][2] == made[3][2]


# ---- How variants are planned, and the laws that are named ----


def test_a_semantic_variant_is_planned_with_the_features_of_the_place(tmp_path):
    import drjit.llvm.ad as ns

    from nerg_mi.train.geometry import place_of_field
    from tests.plugins import fields

    fields.radiance(tmp_path / "field.safetensors")
    place = place_of_field(tmp_path / "field.safetensors", ns)
    bench = Bench(None, {}, None, 0, place, tmp_path, ns, replace(OPTIONS, geometry=None))
    for variant in ablation.all_variants(True, ["small"]):
        plan = plan_of(variant, 0, bench)
        c = plan.config
        assert (c.variant, c.semantic, c.semantic_own) == (variant.gaze, variant.semantic, variant.semantic_own)
        assert (plan.initial is not None, plan.settings.frozen) == (variant.begin, variant.frozen)
        assert plan.settings.loss == (variant.loss or "paper")
        if variant.semantic or variant.begin:
            assert c.geometry == place.radiance.config.geometry


def test_a_law_is_that_of_the_class_that_is_named():
    assert law_of("tests.workflows.test_ablation:Uniform")([[0, 0, 0]], [[1, 0, 0]] * 3).shape == (1, 3)
    for name in ("nowhere:Law", "tests.workflows.test_ablation:Nobody", "tests.workflows.test_ablation"):
        with pytest.raises(NergError, match="MODULE:CLASS"):
            law_of(name)
