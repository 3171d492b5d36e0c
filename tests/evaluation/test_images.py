"""Scores of pictures against plain restatements and closed forms, and the command on a field whose pictures are
known."""

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation import metrics
from nerg_mi.evaluation.metrics import Renderer, depth_score, score_views, ssim
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.formats.fields import save_radiance
from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import Camera, Intrinsics
from nerg_mi.photos.images import View


def noisy():
    rng = np.random.default_rng(0)
    truth = rng.random((40, 30, 3))
    return np.clip(truth + 0.2 * rng.normal(size=truth.shape), 0, 1), truth


def test_ssim_equals_scikit_image_and_its_definition():
    """scikit-image 0.26, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1; and window by
    window."""
    picture, truth = noisy()
    assert ssim(picture, truth) == pytest.approx(0.8290167933876192, abs=1e-12)
    x = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    w = np.outer(x, x) / x.sum() ** 2
    scores = []
    for i in range(30):
        for j in range(20):
            for c in range(3):
                a, b = picture[i : i + 11, j : j + 11, c], truth[i : i + 11, j : j + 11, c]
                ma, mb = np.sum(w * a), np.sum(w * b)
                va, vb, cov = np.sum(w * (a - ma) ** 2), np.sum(w * (b - mb) ** 2), np.sum(w * (a - ma) * (b - mb))
                scores.append((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)))
    assert ssim(picture, truth) == pytest.approx(np.mean(scores), abs=1e-12)
    assert ssim(truth, truth) == pytest.approx(1)
    assert np.isnan(ssim(truth[:8], truth[:8]))


def test_depth_is_scored_where_it_is_known():
    truth = np.array([[1.0, 2.0, 0.0, 4.0]])
    score = depth_score(np.array([[1.05, 2.5, 9.0, 0.0]]), np.array([[1, 0.5, 1, 0.0]]), truth)
    assert score.median == pytest.approx(0.5) and score.off == pytest.approx(2 / 3)
    assert score.opacity == pytest.approx(0.5) and score.translucent == pytest.approx(2 / 3)
    assert depth_score(truth, truth, 0 * truth) is None


@pytest.fixture
def fog(tmp_path):
    """A field of density 1.5 and colour (0.5, 0.5, 0.5) in the cube [-1, 1]³; without weights it has no more to say."""
    config = RadianceConfig(
        grid=HashGridConfig(levels=2, log2_rows=8, base=4, finest=8), width=16, color_hidden=1, density_scale=1.5
    )
    field = RadianceField.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 0, march_step=0.05)
    field.set_parameters({k: type(v)(np.zeros(v.shape, np.float32)) for k, v in field.parameters().items()})
    path = tmp_path / "fog.safetensors"
    save_radiance(field, path, {})
    return path


def camera(k1=0.0):
    pose = np.eye(4)
    pose[2, 3] = 3.0
    return Camera(Intrinsics(16, 12, 40.0, 40.0, 8.0, 6.0, k1), pose)


def test_ctrl_c_ends_a_picture_between_two_parts(fog, monkeypatch):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    monkeypatch.setattr(metrics, "_LAUNCH", 16 * 12)
    seeds, rendered, render = [], mi.render, Renderer(fog, 4)

    def stopped(scene, **how):
        seeds.append(how["seed"])
        picture = rendered(scene, **how)
        # As Mitsuba's handler does, which takes the signal while it renders.
        scene.integrator().cancel()
        return picture

    monkeypatch.setattr(mi, "render", stopped)
    with pytest.raises(KeyboardInterrupt):
        render(camera())
    assert len(seeds) == 1


def test_rendered_through_mitsuba_it_is_the_closed_form(fog):
    """Opacity 1 - exp(-1.5 l), sRGB 0.5 opacity, depth where half of it is reached, from the camera's centre."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    seen = Renderer(fog)(camera())
    middle = np.s_[5:7, 7:9]
    alpha = 1 - np.exp(-3)
    assert np.allclose(seen.opacity[middle], alpha, atol=2e-3)
    assert np.allclose(seen.color[middle], 0.5 * alpha, atol=2e-3)
    assert np.allclose(seen.depth[middle], 2 - np.log(1 - alpha / 2) / 1.5, atol=0.005)


def test_many_samples_are_rendered_a_part_at_a_time(fog, rgb, monkeypatch):
    """As many as an option takes, which no memory holds at once."""
    render, parts = rgb.render, []

    def render_part(*args, spp, **more):
        parts.append(spp)
        return render(*args, spp=spp, **more)

    monkeypatch.setattr(rgb, "render", render_part)
    monkeypatch.setattr(metrics, "_LAUNCH", 4 * 16 * 12 + 5)
    seen = Renderer(fog, 9)(camera())
    assert parts == [4, 4, 1]
    assert np.allclose(seen.opacity[5:7, 7:9], 1 - np.exp(-3), atol=2e-3)
    monkeypatch.setattr(metrics, "_LAUNCH", 1)
    Renderer(fog, 2)(camera())
    assert parts[3:] == [1, 1]


def test_a_distorted_camera_is_followed(fog):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    plain, bent = Renderer(fog)(camera()), Renderer(fog)(camera(0.1))
    assert bent.mask.all()
    assert np.allclose(bent.opacity[5:7, 7:9], plain.opacity[5:7, 7:9], atol=5e-3)
    assert bent.color.shape == plain.color.shape


def test_scores_of_views_and_what_is_written(fog, tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    seen = Renderer(fog)(camera())
    view = View("frame.png", camera(), (seen.color + 0.1).astype(np.float32), seen.depth.astype(np.float32))
    scores = score_views(fog, [view, view], pictures=tmp_path / "out")
    assert scores.psnr_mean == pytest.approx(20, abs=0.2) and len(scores.psnr) == 2
    assert (scores.width, scores.height, scores.views) == (16, 12, ["frame.png", "frame.png"])
    assert scores.depth.off == 0 and scores.depth.median < 0.02
    assert (tmp_path / "out" / "frame.png").is_file()
    written = json.loads(json.dumps(scores.to_dict()))
    assert written["psnr_mean"] == scores.psnr_mean and written["depth"]["median"] == scores.depth.median
    assert "depth" not in score_views(fog, [View("frame.png", view.camera, view.color)]).to_dict()
    with pytest.raises(ValueError, match="--holdout"):
        score_views(fog, [])


@pytest.mark.parametrize("size", [(10, 30), (30, 10), (11, 11)])
def test_a_picture_smaller_than_the_window_has_no_similarity(size):
    a = np.random.default_rng(0).random((*size, 3))
    value = ssim(a, a)
    assert np.isnan(value) if min(size) < 11 else value == pytest.approx(1)
