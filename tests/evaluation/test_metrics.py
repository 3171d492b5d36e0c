"""Tests of `nerg_mi.evaluation.metrics`."""

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation import metrics
from nerg_mi.evaluation.metrics import FieldRenderer, compute_depth_score, score_views, ssim
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.formats.fields import save_radiance
from nerg_mi.maths import vmf
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import latlong_grid
from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.photos.images import PhotoView

# ---- Images ----
#
# Image scores compared with direct implementations and closed forms, and the command on a field with known pictures.


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


def test_depth_is_scored_where_truth_exists():
    truth = np.array([[1.0, 2.0, 0.0, 4.0]])
    score = compute_depth_score(np.array([[1.05, 2.5, 9.0, 0.0]]), np.array([[1, 0.5, 1, 0.0]]), truth)
    assert score.median == pytest.approx(0.5) and score.outlier_fraction == pytest.approx(2 / 3)
    assert score.opacity == pytest.approx(0.5) and score.translucent_fraction == pytest.approx(2 / 3)
    assert compute_depth_score(truth, truth, 0 * truth) is None


@pytest.fixture
def fog(tmp_path):
    """A field of density 1.5 and colour (0.5, 0.5, 0.5) in the cube [-1, 1]³, with zero weights."""
    config = RadianceConfig(
        grid=HashGridConfig(levels=2, log2_rows=8, base=4, finest=8), width=16, color_hidden=1, density_scale=1.5
    )
    field = RadianceNetwork.random(config, Box((-1, -1, -1), (1, 1, 1)), ns, 0, march_step=0.05)
    field.set_parameters({k: type(v)(np.zeros(v.shape, np.float32)) for k, v in field.parameters().items()})
    path = tmp_path / "fog.safetensors"
    save_radiance(field, path, {})
    return path


def camera(k1=0.0):
    pose = np.eye(4)
    pose[2, 3] = 3.0
    return PosedCamera(Intrinsics(16, 12, 40.0, 40.0, 8.0, 6.0, k1), pose)


def test_ctrl_c_ends_a_picture_between_two_parts(fog, monkeypatch):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    monkeypatch.setattr(metrics, "_MAX_LAUNCH", 16 * 12)
    seeds, rendered, render = [], mi.render, FieldRenderer(fog, 4)

    def stopped(scene, **how):
        seeds.append(how["seed"])
        picture = rendered(scene, **how)
        # As Mitsuba's handler does, which receives the signal while it renders.
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
    seen = FieldRenderer(fog)(camera())
    middle = np.s_[5:7, 7:9]
    alpha = 1 - np.exp(-3)
    assert np.allclose(seen.opacity[middle], alpha, atol=2e-3)
    assert np.allclose(seen.color[middle], 0.5 * alpha, atol=2e-3)
    assert np.allclose(seen.depth[middle], 2 - np.log(1 - alpha / 2) / 1.5, atol=0.005)


def test_many_samples_are_rendered_in_parts(fog, rgb, monkeypatch):
    """As many as the option allows, which exceed memory at once."""
    render, parts = rgb.render, []

    def render_part(*args, spp, **options):
        parts.append(spp)
        return render(*args, spp=spp, **options)

    monkeypatch.setattr(rgb, "render", render_part)
    monkeypatch.setattr(metrics, "_MAX_LAUNCH", 4 * 16 * 12 + 5)
    seen = FieldRenderer(fog, 9)(camera())
    assert parts == [4, 4, 1]
    assert np.allclose(seen.opacity[5:7, 7:9], 1 - np.exp(-3), atol=2e-3)
    monkeypatch.setattr(metrics, "_MAX_LAUNCH", 1)
    FieldRenderer(fog, 2)(camera())
    assert parts[3:] == [1, 1]


def test_distorted_cameras_are_supported(fog):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    plain, bent = FieldRenderer(fog)(camera()), FieldRenderer(fog)(camera(0.1))
    assert bent.mask.all()
    assert np.allclose(bent.opacity[5:7, 7:9], plain.opacity[5:7, 7:9], atol=5e-3)
    assert bent.color.shape == plain.color.shape


def test_scores_and_pictures_of_views(fog, tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    seen = FieldRenderer(fog)(camera())
    view = PhotoView("frame.png", camera(), (seen.color + 0.1).astype(np.float32), seen.depth.astype(np.float32))
    scores = score_views(fog, [view, view], picture_folder=tmp_path / "out")
    assert scores.psnr_mean == pytest.approx(20, abs=0.2) and len(scores.psnr) == 2
    assert (scores.width, scores.height, scores.views) == (16, 12, ["frame.png", "frame.png"])
    assert scores.depth.outlier_fraction == 0 and scores.depth.median < 0.02
    # Views of equal names have a picture each.
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["frame-2.png", "frame.png"]
    written = json.loads(scores.save(tmp_path / "scores.json").read_text())
    assert written["psnr_mean"] == scores.psnr_mean and written["depth"]["median"] == scores.depth.median
    without = score_views(fog, [PhotoView("frame.png", view.camera, view.color)])
    assert "depth" not in json.loads(without.save(tmp_path / "scores.json").read_text())
    with pytest.raises(ValueError, match="holdout"):
        score_views(fog, [])


# ---- Metrics against the constants of pysaliency's tests and a closed form on the sphere ----

y, x = np.mgrid[0:40, 0:40]
MODEL = np.exp(-0.5 * ((x - 20.0) ** 2 + (y - 20.0) ** 2) / np.sqrt(40**2 + 40**2)).ravel()
GOLD = np.exp(-0.5 * ((x - 10.0) ** 2 + (y - 25.0) ** 2) / 30).ravel()
FIXATIONS = [(0, 10), (1, 11), (2, 12), (2, 12), (2, 12), (1, 21), (5, 25), (3, 33)]  # x, y
AT_GAZE = np.array([MODEL[fy * 40 + fx] for fx, fy in FIXATIONS])


def test_pysaliency_constants():
    constant = np.ones(1600)
    assert np.isclose(metrics.kld(constant, MODEL), 0.8396272788909165, rtol=1e-12)
    assert np.isclose(metrics.sim(MODEL, constant), 0.5439198346677914, rtol=1e-12)
    assert np.isclose(metrics.kld(GOLD, MODEL), 1.2534306556652481, rtol=1e-12)
    assert np.isclose(metrics.sim(GOLD, MODEL), 0.3700539657911494, rtol=1e-12)
    assert np.isclose(metrics.cc(GOLD, MODEL), 0.23097615739142985, rtol=1e-12)
    nss = metrics.nss(MODEL, AT_GAZE)
    want = [
        -0.821596006113,
        -0.789526121554,
        -0.740616174533,
        -0.740616174533,
        -0.740616174533,
        -0.707322347863,
        -0.433094498355,
        -0.800070419267,
    ]
    assert np.allclose(nss, want, atol=1e-11)
    assert np.isclose(nss.mean(), -0.721682239594, atol=1e-11)
    assert np.isclose(0.5 * (nss[:5].mean() + nss[5:].mean()), -0.706711609374, atol=1e-11)


def sphere_pair(width, height):
    """κ = 30 at colatitude 20 degrees, κ = 10 at 40, on a panorama."""
    directions, weights = latlong_grid(width, height)
    mean = lambda degrees: np.array([np.sin(np.radians(degrees)), np.cos(np.radians(degrees)), 0.0])
    p = np.exp(vmf.log_density(directions, mean(20), 30.0))
    q = np.exp(vmf.log_density(directions, mean(40), 10.0))
    return p, q, weights


def test_sphere_needs_solid_angles():
    truth = 1.0149169523431745  # closed form of KL(vMF || vMF)
    p, q, w = sphere_pair(128, 64)
    assert np.isclose(metrics.kld(p, q, w), 1.0148220, atol=5e-7)
    assert np.isclose(metrics.kld(p, q), 0.6884715, atol=5e-7)  # unweighted: wrong by a third
    assert np.isclose(metrics.cc(p, q, w), 0.53400, atol=1e-5)
    assert np.isclose(metrics.cc(p, q), 0.58427, atol=1e-5)
    p, q, w = sphere_pair(1024, 512)
    assert np.isclose(metrics.kld(p, q, w), truth, atol=3e-6)
    A = vmf.mean_resultant_length
    closed = (
        vmf.log_normaliser(30.0)
        - vmf.log_normaliser(10.0)
        + 30 * (A(30.0) - 1)
        - 10 * (A(30.0) * np.cos(np.radians(20)) - 1)
    )
    assert np.isclose(closed, truth, rtol=1e-12)


def test_identity_scale_and_batches():
    rng = np.random.default_rng(0)
    p, q, w = rng.gamma(0.5, size=(4, 3, 50)), rng.gamma(0.5, size=(4, 3, 50)), rng.random(50)
    assert np.allclose(metrics.kld(p, 7 * p, w), 0, atol=1e-12) and np.allclose(metrics.cc(p, 3 * p + 2, w), 1)
    assert np.allclose(metrics.sim(p, 5 * p, w), 1) and np.allclose(metrics.mae(p, p, w), 0)
    for score in (metrics.kld, metrics.cc, metrics.sim, metrics.mae):
        batch = score(p, q, w)
        assert batch.shape == (4, 3) and np.isclose(batch[2, 1], score(p[2, 1], q[2, 1], w))
        assert np.allclose(score(p, q, w), score(p, q, 9 * w))  # any unit of solid angle
        each = rng.random(p.shape)  # individual weights of each map
        assert np.isclose(score(p, q, each)[2, 1], score(p[2, 1], q[2, 1], each[2, 1]))
    assert (metrics.kld(p, q, w) > 0).all()
    assert np.isclose(metrics.mae(np.array([1.0, 3]), np.array([2.0, 5]), np.array([1.0, 3])), 1.75)


@pytest.mark.parametrize("a", ["zeros", "ones", "peak", "tiny", "negative"])
@pytest.mark.parametrize("b", ["zeros", "ones", "peak", "tiny", "negative"])
def test_defined_everywhere(a, b):
    maps = {
        "zeros": np.zeros(64),
        "ones": np.full(64, 0.1),
        "peak": np.eye(64)[5],
        "tiny": np.eye(64)[9] * 1e-300,
        "negative": np.linspace(-1, 1, 64),
    }
    p, q = maps[a], maps[b]
    for score in (metrics.kld, metrics.cc, metrics.sim, metrics.mae):
        assert np.isfinite(score(p, q))
    assert np.isfinite(metrics.nss(p, p[:4])).all()
    if a == "ones":
        assert metrics.cc(p, q) == 0 and metrics.cc(q, p) == 0 and (metrics.nss(p, p[:4]) == 0).all()
        assert np.isclose(metrics.kld(p, maps["zeros"]), 0)  # zeros count as uniform


@pytest.mark.parametrize("scale", [1e-307, 1e-200, 1e-150, 1e150, 1e300])
def test_correlation_of_maps_of_any_scale(scale):
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 500)) - 0.3
    assert np.isclose(metrics.cc(a * scale, b), metrics.cc(a, b), rtol=1e-12)
    assert np.isclose(metrics.cc(a, b * scale), np.corrcoef(a, b)[0, 1], rtol=1e-12)
    assert np.isclose(metrics.nss(a * scale, a[:1] * scale), metrics.nss(a, a[:1]), rtol=1e-12)
    assert metrics.cc(np.full(500, scale), b) == 0


def test_refusals():
    with pytest.raises(ValueError, match="same directions"):
        metrics.cc(np.zeros(4), np.zeros(5))


@pytest.mark.parametrize("bad", [np.inf, np.nan, -1.0])
def test_invalid_weights_and_maps_are_named(bad):
    weights, values = np.array([1, 2, bad, 1.0]), np.arange(4.0)
    for score in (metrics.kld, metrics.cc, metrics.sim, metrics.mae, metrics.nss, metrics.auc):
        with pytest.raises(NergError, match=r"weights\[2\]"):
            score(values, values, weights)
    for weights in (np.zeros(4), np.ones(3)):
        with pytest.raises(NergError, match="weights"):
            metrics.cc(values, values, weights)
    for score in (metrics.kld, metrics.sim):
        with pytest.raises(NergError, match="infinite"):
            score(values, np.array([1, 2, np.inf, 1]))
