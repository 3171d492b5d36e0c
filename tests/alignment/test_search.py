import numpy as np

from nerg_mi.alignment.constraints import surface_of_traces
from nerg_mi.alignment.tracking import close, scale_range, search

from . import rooms


def test_turn_shift_and_scale_are_guessed_from_hit_points_and_heads():
    rays, truth = rooms.people(1500), rooms.similarity(np.random.default_rng(2), upright=True)
    surface = surface_of_traces(rooms.traces().moved(truth), 1 << 16)
    scales = scale_range(surface, rays.hit)
    scale = np.cbrt(np.linalg.det(truth[:3, :3]))
    assert scales[0] > scale > scales[-1] and np.abs(np.log(scales / scale)).min() < 0.04
    near = scales[np.abs(np.log(scales / scale)) < 0.3]
    best, *others = search(surface, rays.hit, rays.origin, near, (0.0, truth[2, 3]))
    moved, right = (rooms.carried(m, rays.origin) for m in (best.matrix, truth))
    assert np.median(np.linalg.norm(moved - right, axis=1)) < 0.3 * scale
    assert all(o.score <= best.score and not close(o.matrix, best.matrix, 0.02) for o in others)
