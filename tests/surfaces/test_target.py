"""Rays that end on a surface, at something else, or nowhere."""

import numpy as np

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.surfaces.mesh import Target
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.surfaces.meshes import box, joined


def test01_each_ray_ends_where_it_should(rgb):
    room, inner = joined(box((0, 0, 0), (4, 3, 2), without=1)), box((2, 1, 0.5), (3, 2, 1.5))
    target = Target(room, [inner])
    d = fibonacci_directions(4000)[1:]
    eye = np.array([1.0, 1.5, 1.0])
    found = target.ends(np.broadcast_to(eye, d.shape), d)
    # Slabs, in NumPy: the inner box first, then the open side, then the room.
    with np.errstate(divide="ignore"):
        t = (np.array([(2, 1, 0.5), (3, 2, 1.5)])[:, None] - eye) / d
        hits = t.min(0).max(1) < t.max(0).min(1)
        hits &= t.min(0).max(1) > 0
        walls = np.where(d > 0, (np.array([4, 3, 2]) - eye) / d, -eye / d)
    out = ~hits & (walls.argmin(1) == 0) & (d[:, 0] > 0)
    assert np.array_equal(found.elsewhere, hits)
    assert np.mean((found.face < 0) == (hits | out)) > 0.9995
    on = found.face >= 0
    p = np.einsum("pi,pik->pk", found.place, room.corners[found.face])[on]
    assert np.allclose(p, (eye + walls.min(1)[:, None] * d)[on], atol=1e-5)


def test02_a_ray_may_end_in_a_medium_before(rgb):
    fog = rgb.load_dict({"type": "constvolume", "value": 100.0, "to_world": rgb.ScalarTransform4f().scale(0.5)})
    sheet = (np.array([(-2.0, -2, 2), (2, -2, 2), (2, 2, 2), (-2, 2, 2)]), np.array([(0, 1, 2), (0, 2, 3)]))
    target = Target(joined(sheet), medium=VolumeMedium(fog))
    origins = np.array([(0.25, 0.25, -1), (1.0, 1.0, -1)])
    found = target.ends(origins, np.broadcast_to([0.0, 0, 1], (2, 3)))
    assert found.elsewhere.tolist() == [True, False] and (found.face >= 0).tolist() == [False, True]
