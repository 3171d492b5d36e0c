"""Attention on surfaces: solid angles, visibility, derivatives, and the integrator's picture."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.environment.surface_attention import Patches, attention_on, attention_per_patch, make_patches
from nerg_mi.transport.geometry import SceneGeometry, pixel_solid_angles
from nerg_mi.transport.mitsuba_mesh import make_mesh, pack_positions, positions_key, unpack_positions
from tests.plugins import fields
from tests.plugins.scenes import camera


def uniform(p_od, p_o, r_o, active):
    return type(p_o.x)(1 / (4 * np.pi))


def sheet(mi, a=0.6, b=0.4, z=0.0):
    corners = [(-a, -b, z), (a, -b, z), (a, b, z), (-a, b, z)]
    return make_mesh(np.array(corners), np.array([(0, 1, 2), (0, 2, 3)]), "sheet")


def solid_angle(a, b, p):
    """Solid angle of the rectangle 2a x 2b in z = 0 from p above it: arctangents of four corners."""
    x, y, z = p
    out = 0
    for i, u in ((1, a - x), (-1, -a - x)):
        for j, v in ((1, b - y), (-1, -b - y)):
            out += i * j * np.arctan2(u * v, z * np.sqrt(u * u + v * v + z * z))
    return out


EYES = np.array([(0, 0, 1), (0.9, -0.3, 0.8), (2.0, 1.5, 0.5), (0.1, 0.2, -1.0)], np.float32)


def test01_patches_tile_the_mesh(rgb):
    cube = make_patches(rgb.load_dict({"type": "cube", "to_world": rgb.ScalarTransform4f().scale([1, 2, 3])}), 3)
    assert dr.width(cube.p) == 12 * 9
    assert np.isclose(dr.sum(cube.area)[0], 2 * (2 * 4 + 4 * 6 + 2 * 6))
    # Gauss: the flux of x through a closed surface is three times its volume, exactly, facets being flat.
    assert np.isclose(dr.sum(dr.dot(cube.p, cube.n) * cube.area)[0], 3 * 2 * 4 * 6, rtol=1e-5)


def test15_a_rectangle_is_a_mesh_that_follows_its_transform(rgb):
    flat = rgb.load_dict({"type": "rectangle"})
    params, x = rgb.traverse(flat), rgb.Float(0.5)
    dr.enable_grad(x)
    params["to_world"] = rgb.Transform4f().translate(rgb.Point3f(x, 0, -1)).scale(rgb.Point3f(0.6, 0.4, 1))
    params.update()
    pieces = make_patches(flat, 24)
    assert np.isclose(dr.sum(pieces.area)[0], 4 * 0.6 * 0.4) and np.allclose(np.array(pieces.n), [[0], [0], [1]])
    share = attention_on(None, uniform, rgb.Point3f(0, 0, 1), pieces)
    wanted = lambda x: solid_angle(0.6, 0.4, (-x, 0, 2)) / (4 * np.pi)
    assert np.isclose(share[0], wanted(0.5), rtol=1e-3)
    dr.backward(share)
    assert np.isclose(dr.grad(x)[0], (wanted(0.5001) - wanted(0.4999)) / 2e-4, rtol=2e-3)


@pytest.mark.parametrize("bad", ["sphere", "divisions"])
def test02_invalid_meshes_are_refused(rgb, bad):
    shape = rgb.load_dict({"type": "sphere" if bad == "sphere" else "cube"})
    with pytest.raises(ValueError, match="not a mesh" if bad == "sphere" else "divisions must be at least 1"):
        make_patches(shape, 4 if bad == "sphere" else 0)


def test03_a_uniform_density_gives_the_share_of_the_solid_angle(rgb):
    got = attention_on(None, uniform, rgb.Point3f(EYES.T), make_patches(sheet(rgb), 24)).numpy()
    expected = [solid_angle(0.6, 0.4, p) / (4 * np.pi) for p in EYES[:3]]
    assert np.allclose(got[:3], expected, rtol=5e-4)
    assert got[3] == 0  # from behind
    both = attention_on(None, uniform, rgb.Point3f(EYES.T), make_patches(sheet(rgb), 24), two_sided=True).numpy()
    behind = solid_angle(0.6, 0.4, EYES[3] * [1, 1, -1]) / (4 * np.pi)
    assert np.allclose(both, [*expected, behind], rtol=5e-4)


def test05_inside_a_box_attention_sums_to_one(rgb):
    observers = rgb.Point3f([0.1, -0.3], [0.2, 0.0], [0.0, 0.4])
    box = make_patches(rgb.load_dict({"type": "cube"}), 24)
    assert np.allclose(attention_on(None, uniform, observers, box, two_sided=True).numpy(), 1, rtol=1e-3)
    assert np.allclose(attention_on(None, uniform, observers, box).numpy(), 0)


def test06_occluders_hide_surfaces(rgb):
    # A plate over x < 0 halfway to the observer hides the part of z = 0 below it.
    plate = sheet(rgb, 10, 10, 0.5)
    params, key = rgb.traverse(plate), positions_key()
    points = unpack_positions(params[key])
    points.x = dr.minimum(points.x, 0)
    params[key] = pack_positions(points)
    params.update()
    place = SceneGeometry(None, rgb.load_dict({"type": "scene", "plate": plate}))
    eye, surface = rgb.Point3f(0, 0, 1), make_patches(sheet(rgb), 8)
    each = attention_per_patch(place, uniform, eye, surface).numpy()
    free = attention_per_patch(None, uniform, eye, surface).numpy()
    right = surface.p.numpy()[0] > 0
    assert np.array_equal(each[right], free[right]) and not each[~right].any() and right.mean() == pytest.approx(0.5)


@pytest.mark.parametrize("falloff, share", [(0.0, 0.0), (0.5, 0.6), (4.0, 0.95)])
def test07_the_fall_off_behind_a_plate(rgb, falloff, share):
    # The plate is 0.2 above a small patch directly below the observer.
    place = SceneGeometry(None, rgb.load_dict({"type": "scene", "plate": sheet(rgb, 0.5, 0.5, 0.2)}))
    eye, surface = rgb.Point3f(0, 0, 1), make_patches(sheet(rgb, 0.01, 0.01), 2)
    got = attention_on(place, uniform, eye, surface, falloff)[0] / attention_on(None, uniform, eye, surface)[0]
    assert got == pytest.approx(share, abs=1e-3)


def test08_a_surface_of_the_scene_does_not_hide_itself(rgb):
    box = rgb.load_dict({"type": "cube"})
    place = SceneGeometry(None, rgb.load_dict({"type": "scene", "box": {"type": "cube"}}))
    observers = rgb.Point3f(np.array([(3, 2, 1.5), (1.001, 4, 0), (0, 0, 1.2)], np.float32).T)
    surface = make_patches(box, 6)
    assert np.allclose(
        attention_on(place, uniform, observers, surface).numpy(),
        attention_on(None, uniform, observers, surface).numpy(),
        rtol=1e-5,
    )


@pytest.mark.parametrize("z", [0.9, -0.9])
def test14_neither_side_of_an_open_sheet_hides_itself(rgb, z):
    surface, eye = make_patches(sheet(rgb), 8), rgb.Point3f(0.2, -0.1, z)
    each = attention_per_patch(
        SceneGeometry(None, rgb.load_dict({"type": "scene", "sheet": sheet(rgb)})),
        uniform,
        eye,
        surface,
        two_sided=True,
    )
    free = attention_per_patch(None, uniform, eye, surface, two_sided=True).numpy()
    assert (free > 0).all() and np.allclose(each.numpy(), free, rtol=1e-5)


def moved(rgb, surface, x, kind):
    if kind == "observer":
        return rgb.Point3f(0.4 + 0.5 * x, x, 0.9 - x), surface
    return rgb.Point3f(0.4, 0, 0.9), surface.translate(rgb.Vector3f(-0.5 * x, -x, x))


@pytest.mark.parametrize("kind", ["observer", "surface"])
def test09_derivatives_of_a_solid_angle(rgb, kind):
    surface, x = make_patches(sheet(rgb), 24), rgb.Float(0)
    dr.enable_grad(x)
    eye, is_valid = moved(rgb, surface, x, kind)
    dr.backward(attention_on(None, uniform, eye, is_valid))
    h = 1e-4
    ends = [solid_angle(0.6, 0.4, (0.4 + 0.5 * s, s, 0.9 - s)) / (4 * np.pi) for s in (h, -h)]
    assert np.isclose(dr.grad(x)[0], (ends[0] - ends[1]) / (2 * h), rtol=2e-3)


def test10_derivatives_of_vertices_and_of_the_fall_off(rgb):
    plate = sheet(rgb)
    params = rgb.traverse(plate)
    scale, falloff = rgb.Float(1), rgb.Float(0.5)
    dr.enable_grad(scale, falloff)
    params[positions_key()] = pack_positions(scale * unpack_positions(params[positions_key()]))
    params.update()
    dr.backward(attention_on(None, uniform, rgb.Point3f(0, 0, 1), make_patches(plate, 24)))
    ends = [solid_angle(0.6 * s, 0.4 * s, (0, 0, 1)) / (4 * np.pi) for s in (1.0001, 0.9999)]
    assert np.isclose(dr.grad(scale)[0], (ends[0] - ends[1]) / 2e-4, rtol=2e-3)

    place = SceneGeometry(None, rgb.load_dict({"type": "scene", "plate": sheet(rgb, 0.5, 0.5, 0.2)}))
    eye, surface = rgb.Point3f(0, 0, 1), make_patches(sheet(rgb, 0.01, 0.01), 2)
    dr.backward(attention_on(place, uniform, eye, surface, falloff))
    # d/dd_f of 1 - 0.2 / d_f
    assert np.isclose(dr.grad(falloff)[0] / attention_on(None, uniform, eye, surface)[0], 0.2 / 0.25, rtol=0.01)


def test11_no_derivative_is_nan_where_the_eye_touches_the_surface(rgb):
    p, n = rgb.Point3f([0, 1], [0, 0], [0, 0]), rgb.Vector3f([0, 0], [0, 0], [1, 1])
    x = rgb.Float(0)
    dr.enable_grad(x)
    total = dr.sum(attention_on(None, uniform, rgb.Point3f(x, 0, 0), Patches(p, n, rgb.Float(0.1))))
    dr.backward(total)
    assert np.isfinite(total[0]) and np.isfinite(dr.grad(x)[0])


def test12_the_integrator_sees_the_same_attention(rgb, tmp_path):
    # Pixels over the whole sphere, times their solid angle: the same integral over directions.
    fields.gaze(tmp_path / "gaze.safetensors")
    eye, h = (-0.2, 0.3, 0.8), 96
    box = {"type": "cube", "to_world": rgb.ScalarTransform4f().translate([0.3, 0.1, -0.2]).scale([0.3, 0.2, 0.25])}
    field = {"type": "gazefield", "filename": str(tmp_path / "gaze.safetensors")}
    sensor = camera(rgb, kind="panorama", size=2 * h, film={"height": h})
    scene = rgb.load_dict(
        {
            "type": "scene",
            "hidden": {"type": "sphere", "center": [0.1, 0.25, 0.3], "radius": 0.12},
            "box": box,
            "integrator": {"type": "nerg", "gaze": field, "aovs": "gaze,position", "radiance": False},
            "sensor": {**sensor, "to_world": rgb.ScalarTransform4f().translate(list(eye))},
        }
    )
    picture = np.array(rgb.render(scene, spp=1, sensor=0))
    gaze, p = picture[..., -4], picture[..., -3:]
    inside = np.all(np.abs(p - (0.3, 0.1, -0.2)) < np.array([0.3, 0.2, 0.25]) + 1e-3, axis=-1)
    expected = np.sum(gaze * inside * pixel_solid_angles(2 * h, h))
    made, place = scene.integrator(), SceneGeometry(None, scene)
    observed = made.gaze.for_observers([rgb.Point3f(*eye)], place, made.observer_settings)

    def density(*args):
        return observed.evaluate(*args)[0]

    box = next(s for s in scene.shapes() if s.is_mesh())
    got = attention_on(place, density, rgb.Point3f(*eye), make_patches(box, 24))[0]
    assert expected > 0 and got == pytest.approx(expected, rel=0.03)
