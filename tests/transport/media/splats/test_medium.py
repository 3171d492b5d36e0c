import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.maths.geometry import Similarity
from tests.formats.splats.writers import random_splats
from tests.transport.media.splats.scenes import medium_of, rays, stack


def test_a_placed_medium_meets_what_placed_splats_would(rgb):
    splats, (o, d) = random_splats(20, degree=2), rays(50)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2.5 * Rotation.random(random_state=np.random.default_rng(1)).as_matrix(), [1, 0, 2]
    to_world = Similarity(matrix)
    placed, there = medium_of(splats, to_world), medium_of(splats.placed(to_world))
    assert np.isclose(placed.step, there.step, rtol=1e-5)
    # A turned box has a larger one around it.
    (low, high), (least, most) = placed.bounds(), there.bounds()
    assert (low <= least + 1e-5).all() and (most <= high + 1e-5).all()
    of = []
    for medium in (placed, there):
        ray = medium.local(rgb.Point3f((2.5 * o).T), rgb.Vector3f(d.T))
        index = np.argsort(np.array(medium.arrays.order))[np.arange(50) % 20]
        t, share = medium.hits.again(ray, rgb.UInt32(index), True)
        color = medium.color([rgb.UInt32(index)], None, ray.w, True)
        of.append(np.stack([np.array(v) for v in (t, share, *color)]))
    assert np.allclose(of[0], of[1], rtol=1e-3, atol=1e-4)


def test_there_is_no_density(rgb):
    medium = medium_of(stack([1], [0.5]))
    for ask in (medium.density, medium.density_features):
        with pytest.raises(ValueError, match="along rays"):
            ask(rgb.Point3f(0), True)
    assert medium.background(None, None) is None and medium.refresh() is None and len(medium.parameters()) == 2
    assert np.allclose(medium.to_unit(medium.to_local(rgb.Point3f(0, 0, 1))), 0.5)
    assert np.allclose(medium.vector_to_unit(rgb.Vector3f(0.6, 0, 0)), [[1], [0], [0]], atol=1e-5)
