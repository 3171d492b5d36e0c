"""A gaze field in the scene, and which of several observers a lane belongs to."""

from types import SimpleNamespace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.maths.box import Box
from nerg_mi.maths.similarity import Similarity
from nerg_mi.transport.observer.gaze_medium import GazeMedium, at_nearest
from tests.maths.test_similarity import turn

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = Box((0, 0, 0), (1, 1, 2))


def test01_gaze_turns_and_does_not_scale(rgb):
    g = GazeField.random(GazeConfig(GRID, width=16), BOX, ns)
    g.set_parameters(
        {"grid.table": ns.Float(np.random.default_rng(0).normal(size=len(g.grid.table)).astype(np.float32))}
    )
    p_o, p_od = np.array([0.2, 0.3, 0.1]), np.array([0.7, 0.6, 1.5])
    r = (p_od - p_o) / np.linalg.norm(p_od - p_o)
    plain = GazeMedium(g).evaluate(
        rgb.Point3f(p_od.tolist()), rgb.Point3f(p_o.tolist()), rgb.Vector3f(r.tolist()), True
    )
    m = turn(50.0)
    moved = GazeMedium(g, Similarity(m)).evaluate(
        rgb.Point3f((m @ [*p_od, 1])[:3].tolist()),
        rgb.Point3f((m @ [*p_o, 1])[:3].tolist()),
        rgb.Vector3f((m[:3, :3] @ r / 50).tolist()),
        True,
    )
    assert np.allclose([v.numpy()[0] for v in plain], [v.numpy()[0] for v in moved], rtol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 5])
def test02_each_lane_has_what_belongs_to_the_nearest(rgb, count):
    rng = np.random.default_rng(count)
    centers, p = rng.normal(size=(count, 3)), rng.normal(size=(60, 3))
    known = [SimpleNamespace(center=rgb.Point3f(*map(float, c)), number=rgb.Float(k)) for k, c in enumerate(centers)]
    found = at_nearest(known, rgb.Point3f(np.ascontiguousarray(p.T, np.float32)), lambda k: k.number).numpy()
    assert np.array_equal(np.broadcast_to(found, 60), np.linalg.norm(p[:, None] - centers, axis=2).argmin(axis=1))
