"""How variants are planned, and the laws that are named."""

from __future__ import annotations

from dataclasses import replace

import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation import ablation
from nerg_mi.workflows.ablation import Bench, law_of, plan_of
from tests.workflows.test_ablation import OPTIONS


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
