"""Depth, opacity and colour of Gaussian splats against closed forms and against a look at all of them in float64."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.depth import escape_distance, surface_depth
from nerg_mi.transport.march import march
from nerg_mi.transport.march_primal import HITS_STOP, MarchSettings, Occlusion, default_stop
from nerg_mi.transport.medium import ColorPainter
from tests.formats.splats.writers import random_splats
from tests.reference.splats import trace
from tests.transport.media.splats.scenes import medium_of, rays, stack

SETTINGS = MarchSettings(0.01, stop=HITS_STOP)


def marched(mi, medium, o, d, t1=np.inf, kinds=("expected", "median", "refined"), **options):
    """``(result, depth of each kind)``."""
    ray = medium.local(mi.Point3f(np.atleast_2d(o).T), mi.Vector3f(np.atleast_2d(d).T))
    t0, t1, active = dr.maximum(ray.t_near, 0), dr.minimum(ray.t_far, t1), mi.Bool(True)
    result = march(medium, ray, t0, t1, active, SETTINGS, **options)
    depths = [surface_depth(k, result, medium, ray, t0, t1, active, SETTINGS).numpy() for k in kinds]
    return result, depths


def test_random_places_are_as_in_float64(rgb):
    splats, (o, d) = random_splats(60, degree=3, size=0.3), rays(400)
    medium = medium_of(splats)
    result, depths = marched(rgb, medium, o, d, color=ColorPainter(rgb.Color3f), count=True)
    opacity, color, expected, median = trace(splats, o, d, stop=HITS_STOP)
    assert np.abs(result.opacity.numpy() - opacity).max() < 2e-6
    assert np.abs(result.color.numpy().T - color).max() < 5e-6
    assert np.abs(depths[0] - expected).max() < 1e-5
    # Half of the opacity may be reached to a rounding by one Gaussian or the next.
    assert (np.abs(depths[1] - median) < 1e-5).mean() > 0.995 and np.array_equal(depths[1], depths[2])
    assert result.color_evals.numpy().mean() < result.density_evals.numpy().mean() < 200


def test_stacked_gaussians_are_sums_by_hand(rgb):
    medium = medium_of(stack([3, 1, 2], [0.5, 0.3, 0.8]))
    result, depths = marched(rgb, medium, (0, 0, 0), (0, 0, 1))
    weights = np.array([0.3, 0.7 * 0.8, 0.7 * 0.2 * 0.5])
    assert np.isclose(result.opacity[0], weights.sum(), atol=1e-6)
    assert (
        np.isclose(depths[0][0], weights @ [1, 2, 3] / weights.sum(), atol=1e-6) and depths[1][0] == depths[2][0] == 2
    )
    # A ray that ends before the second, as on a shape, and one that begins in the middle of the third.
    result, depths = marched(rgb, medium, (0, 0, 0), (0, 0, 1), t1=1.9)
    assert np.isclose(result.opacity[0], 0.3, atol=1e-6) and np.isclose(depths[1][0], 1)
    result, _ = marched(rgb, medium, (0, 0, 2.9999), (0, 0, 1))
    assert np.isclose(result.opacity[0], 0.5, atol=1e-5)
    result, depths = marched(rgb, medium, (0, 0, 3.001), (0, 0, 1))
    assert result.opacity[0] == 0 and depths[0][0] == depths[1][0] == 0


def test_off_the_axis_a_gaussian_is_its_exponential(rgb):
    result, depths = marched(rgb, medium_of(stack([2], [0.8])), (0.15, 0, 0), (0, 0, 1))
    assert np.isclose(result.opacity[0], 0.8 * np.exp(-0.5 * 1.5**2), atol=1e-6) and np.isclose(depths[0][0], 2)
    result, _ = marched(rgb, medium_of(stack([2], [0.8])), (0.31, 0, 0), (0, 0, 1))
    assert result.opacity[0] == 0


def test_an_opaque_one_hides_and_light_goes_no_deeper(rgb):
    result, depths = marched(rgb, medium_of(stack([1, 2], [1, 1])), (0, 0, 0), (0, 0, 1))
    assert result.opacity[0] >= 0.9999 and np.isclose(depths[0][0], 1, atol=2e-4) and result.half[0] == 1
    assert escape_distance("median", result, result.half)[0] == 0


@pytest.mark.parametrize(("before", "hides", "known", "far"), [(1.5, 1.4, True, True), (3, 2.9, True, False)])
def test_a_question_ends_a_ray_with_its_answer(rgb, before, hides, known, far):
    medium = medium_of(stack([2, 4], [0.9, 0.9]))
    question = Occlusion(rgb.Float(before), rgb.Float(hides), 0.5)
    result, _ = marched(rgb, medium, (0, 0, 0), (0, 0, 1), kinds=(), occlusion=question)
    assert result.known[0] == known and np.isinf(result.half[0]) == far


def test_light_goes_on_as_far_as_splats_are_trained(rgb):
    medium = medium_of(stack([2], [0.9]))
    assert default_stop(medium) == HITS_STOP and default_stop(None) == MarchSettings.stop
