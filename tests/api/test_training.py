"""Trainings from a call: options are passed on, and what comes back is a field in memory with its provenance."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.workflows import train_gaze as gaze_job
from nerg_mi.workflows import train_radiance as radiance_job
from nerg_mi.workflows.train_gaze import GazeOptions
from nerg_mi.workflows.train_radiance import RadianceOptions


class Asked(Exception):
    """Ends a job before it begins, with what it was asked."""


@pytest.fixture
def asked(monkeypatch):
    """What the jobs were asked last."""

    def raise_it(*arguments):
        raise Asked(*arguments)

    monkeypatch.setattr(gaze_job, "train_gaze", raise_it)
    monkeypatch.setattr(radiance_job, "train_radiance", raise_it)


def test01_options_reach_the_jobs(asked, tmp_path):
    with pytest.raises(Asked) as found:
        nerg.train_radiance(str(tmp_path), "out.safetensors", options=RadianceOptions(seed=3), steps=7)
    photos, output, options, _ = found.value.args
    assert (photos, output) == (tmp_path, "out.safetensors")
    assert options == RadianceOptions(seed=3, steps=7, mode="llvm_ad_rgb")
    with pytest.raises(Asked) as found:
        nerg.train_gaze(None, geometry="none", kappa=9.0)
    assert found.value.args[2] == GazeOptions(geometry="none", kappa=9.0, mode="llvm_ad_rgb")


def test02_wrong_options_are_told(asked):
    with pytest.raises(nerg.NergError, match='train_gaze.*"kapa".*"kappa"'):
        nerg.train_gaze(None, kapa=9.0)
    with pytest.raises(nerg.NergError, match="train_radiance"):
        nerg.train_radiance("photos", mode="scalar_rgb")


def test03_the_variant_in_use_stays(mono, asked, tmp_path):
    with pytest.raises(Asked) as found:
        nerg.train_radiance(tmp_path)
    assert found.value.args[2].mode == "llvm_ad_mono" and mono.variant() == "llvm_ad_mono"


@pytest.mark.nightly
def test04_what_is_trained_can_be_shown(rgb, tmp_path):
    rng = np.random.default_rng(0)
    origin = rng.uniform((1, 1, 1.5), (2, 2, 1.6), (500, 3))
    direction = rng.normal(size=(500, 3)) * (1, 1, 0.2)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = nerg.Rays(np.arange(500.0), np.zeros(500, int), ("Ada",), origin, direction, np.ones(500))
    field = nerg.train_gaze(rays, tmp_path / "gaze.safetensors", geometry="none", steps=1, zones=0, probes=4)
    assert field.name == "gaze.safetensors" and field.provenance["steps"] == 1
    again = nerg.load_gaze(tmp_path / "gaze.safetensors")
    walls = {"type": "cube", "to_world": rgb.ScalarTransform4f().scale(4)}
    a, b = (
        nerg.trace(nerg.make_scene(gaze=g, shapes=walls), (1.5, 1.5, 1.5), [(1, 0, 0), (0, 1, 0.1)], "gaze").gaze
        for g in (field, again)
    )
    assert np.array_equal(a, b) and (a > 0).all()
