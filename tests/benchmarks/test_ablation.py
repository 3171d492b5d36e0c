"""The ablation: variants of each recipe, held-out data, relative losses, known densities, and rows that are kept."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from nerg_mi.train.gaze_recipes import get_recipe
from tests.conftest import ROOT
from tests.evaluation.test_gaze import crowd

LINE = "--environment none --recipes default --steps 2 --test-zones 1 --test-positions 4 --min-rays 8 --radius 0.5"
LINE += " --variant capture --variant emit_capture --seeds 2 --threads 1"


class Uniform:
    """A true density that is uniform."""

    def density(self, positions, directions):
        return np.full((len(positions), len(directions)), 1 / (4 * np.pi))


@pytest.fixture
def ablation(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import ablation

    yield ablation
    del sys.modules["ablation"]


def test_variants_are_those_that_the_recipe_supports(ablation):
    default, paper = get_recipe("default"), get_recipe("paper")
    assert list(ablation.list_variants(default, True)) == ["emit", "capture", "emit_capture"]
    variants = ablation.list_variants(paper, True)
    options = variants["semantic snapshot, own too"]["recipe"].options
    assert (options.semantic, options.semantic_own) == ("snapshot", True)
    frozen = variants["begins as the field, frozen"]["recipe"]
    assert frozen.options.init_from_field and frozen.settings.freeze
    assert not {"semantic snapshot", "begins as the field"} & set(ablation.list_variants(paper, False))


def test_recipes_have_the_same_description_in_each_process(ablation):
    recipe = get_recipe("paper")
    text = json.dumps(recipe, default=ablation.describe)
    assert " at 0x" in str(recipe) and " at 0x" not in text
    described = json.loads(text)
    assert described["name"] == "paper" and described["settings"]["steps"] == recipe.settings.steps
    assert described["options"] != json.loads(json.dumps(get_recipe("default"), default=ablation.describe))["settings"]


def test_variants_are_trained_once_and_compared(ablation, tmp_path, monkeypatch):
    crowd(3000).save(tmp_path / "rays.npz")
    line = [str(tmp_path / "rays.npz"), *LINE.split(), "--out", str(tmp_path / "out")]
    rows = ablation.main(line)
    assert [(r["variant"], r["seed"]) for r in rows] == [(v, s) for v in ("capture", "emit_capture") for s in (0, 1)]
    whole = [r["test_relative"] for r in rows if r["variant"] == "emit_capture"]
    assert np.mean(whole) == pytest.approx(1) and all(np.isfinite(r["train_loss"]) for r in rows)
    for r in rows:
        assert r["test_loss"] == pytest.approx(r["test_KLD"] + 1 - r["test_CC"] + r["test_MAE"])
    again = ablation.main(line)
    assert [r["train_seconds"] for r in again] == [r["train_seconds"] for r in rows]
    # A row depends on the test data.
    exact = ablation.main([*line, "--seeds", "1", "--ground-truth", "tests.benchmarks.test_ablation:Uniform"])
    assert exact[0]["test_KLD"] != pytest.approx(rows[0]["test_KLD"], rel=1e-3)
