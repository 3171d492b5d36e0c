"""What media answer: scale, bounds, errors."""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.gaze.product import GazeConfig, GazeField
from nerg_mi.field.radiance import RadianceConfig, RadianceField
from nerg_mi.maths.box import Box
from nerg_mi.maths.similarity import Similarity
from nerg_mi.transport.march.march import march
from nerg_mi.transport.march.settings import MarchSettings
from nerg_mi.transport.media.field import FieldMedium
from nerg_mi.transport.media.painting import ColorPainter
from nerg_mi.transport.media.volume import VolumeMedium
from nerg_mi.transport.observer.gaze_medium import GazeMedium, at_nearest

GRID = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
BOX = Box((0, 0, 0), (1, 1, 2))


def field(**kwargs):
    import drjit.llvm.ad as ns

    f = RadianceField.random(
        RadianceConfig(GRID, width=16, geometry=3, sh_degree=2), BOX, ns, march_step=0.05, **kwargs
    )
    f.set_parameters(
        {"grid.table": ns.Float(np.random.default_rng(0).normal(size=len(f.grid.table)).astype(np.float32))}
    )
    return f


def turn(scale=1.0, angle=40, move=(1, -2, 3)):
    axis = np.array([0.6, 0.0, 0.8])
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    a = np.radians(angle)
    m = np.eye(4)
    m[:3, :3] = scale * (np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k)
    m[:3, 3] = np.multiply(move, scale)
    return m


@pytest.mark.parametrize("scale", [1e-3, 1, 1e3])
def test01_similarity(rgb, scale):
    m = turn(scale)
    s = Similarity(m)
    p = np.array([0.3, -0.2, 0.9])
    world = m @ [*p, 1]
    assert np.isclose(s.scale, scale) and not s.identity
    assert np.allclose(np.array(s.point_to_local(rgb.Point3f(world[:3].tolist()))).ravel(), p, atol=2e-6)
    w = m[:3, :3] @ p
    assert np.allclose(np.array(s.vector_to_local(rgb.Vector3f(w.tolist()))).ravel(), p, rtol=1e-5, atol=1e-6)
    unit = w / np.linalg.norm(w)
    assert np.allclose(
        np.array(s.direction_to_local(rgb.Vector3f(unit.tolist()))).ravel(), p / np.linalg.norm(p), atol=1e-6
    )


def test02_bounds_hold_the_corners():
    m = turn(2.0)
    lower, upper = Similarity(m).bounds((0, 0, 0), (1, 1, 2))
    corners = np.array([m[:3] @ [x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 2)])
    assert np.allclose(lower, corners.min(0)) and np.allclose(upper, corners.max(0))


SHEAR, UNEVEN, MIRROR, FLAT = (np.eye(4) for _ in range(4))
SHEAR[0, 1] = 0.3
UNEVEN[2, 2] = 1.5
MIRROR[0, 0] = -1
FLAT[1, 1] = 0
NAN = np.eye(4)
NAN[0, 0] = np.nan
PROJECTIVE = np.eye(4)
PROJECTIVE[3, 0] = 0.5
MOVED_TO_NAN = np.eye(4)
MOVED_TO_NAN[0, 3] = np.nan


@pytest.mark.parametrize("matrix", [SHEAR, UNEVEN, MIRROR, FLAT, NAN, PROJECTIVE, MOVED_TO_NAN])
def test03_other_transforms_are_refused(matrix):
    with pytest.raises(ValueError, match='"to_world"'):
        Similarity(matrix)


def gather(mi, medium, o, d, scale):
    ray = medium.local(mi.Point3f(o.tolist()), mi.Vector3f(d.tolist()))
    t0 = dr.maximum(ray.t_near, 0)
    result = march(medium, ray, t0, ray.t_far, True, MarchSettings(0.05 * scale), color=ColorPainter(mi.Color3f))
    return result.opacity.numpy()[0], result.expected_depth.numpy()[0], np.array(result.color).ravel()


def test04_scaling_place_and_camera_changes_no_opacity(rgb):
    f = field()
    o, d = np.array([0.4, 0.3, -1.0]), np.array([0.1, 0.05, 1.0])
    d /= np.linalg.norm(d)
    plain = gather(rgb, FieldMedium(f), o, d, 1)
    assert 0.2 < plain[0] < 0.999
    for scale in (1e-3, 1e3):
        m = turn(scale)
        moved = FieldMedium(f, Similarity(m))
        got = gather(rgb, moved, (m @ [*o, 1])[:3], m[:3, :3] @ d / scale, scale)
        assert np.isclose(got[0], plain[0], rtol=1e-4) and np.isclose(got[1], plain[1] * scale, rtol=1e-4)
        # The direction that colour depends on turns with the field.
        assert np.allclose(got[2], plain[2], rtol=1e-3)
        assert np.isclose(moved.step, 0.05 * scale) and np.isclose(moved.length_scale, 6**0.5 * scale)


def test05_gaze_turns_and_does_not_scale(rgb):
    import drjit.llvm.ad as ns

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


def test06_a_volume_without_extent_is_refused(rgb):
    class Endless(rgb.Volume):
        def __init__(self, lower, upper):
            super().__init__(rgb.Properties())
            self.box = rgb.ScalarBoundingBox3f(lower, upper)

        def bbox(self):
            return self.box

    for lower, upper in (([-np.inf] * 3, [np.inf] * 3), ([0, 0, 0], [1, 1, 0])):
        with pytest.raises(ValueError, match='"density" has no finite extent.*give it a to_world'):
            VolumeMedium(Endless(lower, upper))


def test07_volume_answers(rgb):
    density = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.array([[[-3.0, 5.0]]], np.float32))})
    medium = VolumeMedium(density)
    p = rgb.Point3f([0.1, 0.9], 0.5, 0.5)
    # Negative density would make light.
    assert np.allclose(medium.density(p, True).numpy(), [0, 5]) and not medium.has_color and medium.occupancy is None
    assert np.isclose(medium.length_scale, 3**0.5)
    ray = medium.local(rgb.Point3f(0.5, 0.5, -2), rgb.Vector3f(0, 0, 1))
    assert (ray.t_near.numpy()[0], ray.t_far.numpy()[0]) == (2, 3)


@pytest.mark.parametrize("count", [1, 2, 5])
def test08_each_lane_has_what_belongs_to_the_nearest(rgb, count):
    rng = np.random.default_rng(count)
    centers, p = rng.normal(size=(count, 3)), rng.normal(size=(60, 3))
    known = [SimpleNamespace(center=rgb.Point3f(*map(float, c)), number=rgb.Float(k)) for k, c in enumerate(centers)]
    found = at_nearest(known, rgb.Point3f(np.ascontiguousarray(p.T, np.float32)), lambda k: k.number).numpy()
    assert np.array_equal(np.broadcast_to(found, 60), np.linalg.norm(p[:, None] - centers, axis=2).argmin(axis=1))
