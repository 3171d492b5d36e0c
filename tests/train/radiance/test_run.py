"""Whole radiance trainings: they learn, and show how they do."""

from types import SimpleNamespace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.fields import load_radiance, save_radiance
from nerg_mi.train import radiance_run
from nerg_mi.train.radiance_run import train_field, write_preview

from .ball import TINY, settings


@pytest.mark.slow
def test_learns_a_ball_it_has_not_seen_from_there(dataset, tmp_path):
    """20 dB on held-out views after 300 small steps; the checkpoint says how."""
    seen = []
    field, provenance = train_field(dataset, TINY, settings(), ns, on_progress=seen.append)
    assert provenance["psnr_held_out"]["mean"] > 20
    assert provenance["depth_supervision"] and provenance["steps"] == 300 and seen[-1].done == 1
    save_radiance(field, tmp_path / "ball.safetensors", provenance, half=True)
    loaded, meta = load_radiance(tmp_path / "ball.safetensors", ns)
    assert meta["provenance"]["settings"]["seed"] == 1
    assert loaded.color_space == "srgb" and loaded.march_step == pytest.approx(2 / 64)


@pytest.mark.nightly
@pytest.mark.slow
def test_learns_without_depth(dataset):
    _, provenance = train_field(dataset, TINY, settings(), ns, depth=False)
    assert provenance["psnr_held_out"]["mean"] > 19 and not provenance["depth_supervision"]


def test_a_preview_shows_colours_within_their_range_beside_the_truth(dataset, tmp_path, rgb):
    """What is brighter than white is white, and not dark again."""
    seen = np.zeros((12, 12, 3), np.float32)
    seen[:, :4], seen[:, 4:8], seen[:, 8:] = 1.7, -0.4, 0.5
    found = SimpleNamespace(color=seen)
    trainer = SimpleNamespace(pixels_within=lambda views, most: 2, render=lambda view, every: found)
    write_preview(trainer, dataset.held_out[0], tmp_path / "a.png")
    picture = np.array(rgb.Bitmap(str(tmp_path / "a.png")))
    assert picture.shape == (12, 24, 3)
    assert (picture[:, :4] == 255).all() and (picture[:, 4:8] == 0).all() and (picture[:, 8:12] == 128).all()
    truth = 255 * dataset.held_out[0].over(0)[1::2, 1::2]
    assert np.abs(picture[:, 12:] - truth).max() <= 1


def test_previews_show_the_first_watched_view(dataset, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(radiance_run, "write_preview", lambda trainer, view, path: shown.append(view))
    monkeypatch.setattr(radiance_run, "LOOK_GAP", 1)
    train_field(dataset, TINY, settings(steps=3), ns, preview=tmp_path / "a.png")
    assert len(shown) > 1 and all(view is dataset.held_out[0] for view in shown)


def test_nothing_is_resumed_without_a_state(dataset):
    with pytest.raises(NergError, match="nothing to resume: name"):
        train_field(dataset, TINY, settings(steps=1), ns, resume=True)
