"""Radiance fields by jobs: what a notebook gets, and what it is told."""

import json
from dataclasses import dataclass

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.train.radiance_settings import RadianceSettings
from nerg_mi.workflows import train_radiance as radiance
from nerg_mi.workflows.radiance_commands import RadianceOptions, RadianceScoreOptions
from nerg_mi.workflows.train_radiance import evaluate_radiance, train_radiance
from tests.cli.test_eval import place  # noqa: F401  (fixture)
from tests.workflows.recorder import Recorder


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """A density grid of 32 cells an edge, and not of 128, most of which is looked through at the end of a training."""

    @dataclass(frozen=True)
    class Coarse(RadianceSettings):
        resolution: int = 32

    monkeypatch.setattr(radiance, "RadianceSettings", Coarse)


class Impatient(Recorder):
    """Presses Ctrl-C when it is told of the first step."""

    def progress(self, share, text=""):
        if "step" in text:
            raise KeyboardInterrupt


def test_a_result_without_any_file(place):  # noqa: F811
    before, told = set(place.iterdir()), Recorder()
    result = train_radiance(place, options=RadianceOptions(steps=3, holdout=3), reporter=told)
    assert set(place.iterdir()) == before and result.output is None and not result.interrupted
    assert result.provenance["steps"] == 3 and result.psnr == result.provenance["psnr_held_out"]["mean"]
    assert result.field.box.lower == pytest.approx((-1.025,) * 3) and result.field.occupancy is not None
    assert "2 views to train on, 1 held out, 16 x 14 pixels" in told.messages
    assert told.warnings == result.provenance["complaints"] and told.warnings
    shares = [share for share, _ in told.steps]
    assert shares == sorted(shares) and shares[-1] == 1 and told.steps[1][1].endswith("step 1")


def test_a_deferred_field(place, tmp_path):  # noqa: F811
    """As trained, as written, and as evaluated by the integrator."""
    out, options = tmp_path / "f.safetensors", RadianceOptions(steps=3, holdout=3, deferred=True)
    result = train_radiance(place, out, options)
    assert result.field.config.deferred
    scores = evaluate_radiance(out, place, RadianceScoreOptions(holdout=3, spp=4))
    assert np.isfinite(scores.psnr_mean)


def test_an_interrupted_run_without_any_file_is_a_result(place):  # noqa: F811
    result = train_radiance(place, options=RadianceOptions(steps=10**6, holdout=0), reporter=Impatient())
    assert result.interrupted and result.provenance["steps"] == 1 and result.psnr is None


def test_an_interrupted_run_with_an_output_can_be_resumed(place):  # noqa: F811
    out = place / "a.safetensors"
    with pytest.raises(KeyboardInterrupt, match="go on with --resume"):
        train_radiance(place, out, RadianceOptions(steps=2, holdout=3), Impatient())
    assert out.is_file() and out.with_suffix(".run").is_file()
    result = train_radiance(place, out, RadianceOptions(steps=2, holdout=3, resume=True))
    assert result.provenance["steps"] == 2 and not out.with_suffix(".run").exists()
    assert read_checkpoint(out, "radiance")[1]["provenance"]["steps"] == 2


def test_nothing_to_resume_without_an_output(place):  # noqa: F811
    with pytest.raises(NergError, match="nothing to resume"):
        train_radiance(place, options=RadianceOptions(steps=2, resume=True))


def test_scores_without_any_file(place):  # noqa: F811
    before, told = set(place.iterdir()), Recorder()
    scores = evaluate_radiance(place / "cube.safetensors", place, RadianceScoreOptions(holdout=2, spp=4), told)
    assert set(place.iterdir()) == before
    assert scores.psnr_mean == pytest.approx(np.mean(scores.psnr)) and scores.depth is None and scores.spp == 4
    assert len(told.messages) == len(scores.views) + 3 and told.messages[-2].startswith("mean")
    assert told.messages[-1].endswith(f"{np.mean(scores.psnr_fitted):.2f} dB")


def test_views_too_small_for_a_score_have_none(place, tmp_path):  # noqa: F811
    """One pixel has no right half to fit colours for, and no window of structural similarity."""
    told, out, table = Recorder(), tmp_path / "f.safetensors", tmp_path / "s.json"
    result = train_radiance(place, out, RadianceOptions(steps=2, holdout=3, width=1), told)
    assert result.provenance["psnr_held_out"]["mean_fitted"] is None and np.isfinite(result.psnr)
    evaluate_radiance(out, place, RadianceScoreOptions(holdout=3, width=1, spp=1, json_file=table), told)
    scores = json.loads(table.read_text())
    assert scores["ssim"] == scores["psnr_fitted"] == [None] and scores["psnr_mean"] > 0
    assert not any("nan" in text for text in told.messages) and "11 x 11" in told.warnings[-1]


def test_views_that_were_trained_on_are_no_held_out_views(place):  # noqa: F811
    out = place / "a.safetensors"
    train_radiance(place, out, RadianceOptions(steps=2, holdout=3))
    with pytest.raises(NergError, match="was trained on"):
        evaluate_radiance(out, place, RadianceScoreOptions(holdout=2))
    assert evaluate_radiance(out, place, RadianceScoreOptions(holdout=2, train=True, spp=1)).views
