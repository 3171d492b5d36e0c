"""What one ray meets: shapes behind a medium, and derivatives of the distances to them."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport.geometry import Place
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.volume_medium import VolumeMedium

SETTINGS = MarchSettings(0.01)


def look(mi, place, o):
    """Along +z from the points ``o``, a row a ray."""
    return place.trace(mi.Ray3f(mi.Point3f(np.asarray(o, np.float32).T), mi.Vector3f(0, 0, 1)), True, SETTINGS)


@pytest.mark.parametrize("sigma", [0.3, 2.0])
def test_a_shape_is_opaque_and_a_medium_as_thick_as_it_is(rgb, sigma):
    medium = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": sigma}))
    ball = rgb.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0.25, 0.25, 3], "radius": 0.2}})
    # Through the unit cube to the ball, past the ball, and past both.
    view = look(rgb, Place(medium, ball), [(0.25, 0.25, -1), (0.75, 0.75, -1), (1.75, 0.75, -1)])
    thick = -np.expm1(-sigma)
    assert np.allclose(view.opacity.numpy(), [1, thick, 0], rtol=1e-5)
    assert np.allclose(view.front.numpy(), [thick, thick, 0], rtol=1e-5)
    assert view.hit.numpy().tolist() == [True, False, False]
    assert view.meets(0.5).numpy().tolist() == [True, thick > 0.5, False]
    assert view.meets(0.0).numpy().tolist() == [True, True, False]


def test_distances_follow_the_ray_where_no_shape_moves(rgb):
    place = Place(
        None, rgb.load_dict({"type": "scene", "ball": {"type": "sphere", "center": [0, 0, 5], "radius": 2.0}})
    )
    x, z = np.float32([-1.0, 0.0, 0.5, 1.2]), rgb.Float([0, 0, 0, 0])
    across = rgb.Float(x)
    dr.enable_grad(across, z)
    distance = place.trace(rgb.Ray3f(rgb.Point3f(across, 0, z), rgb.Vector3f(0, 0, 1)), True, SETTINGS).distance
    dr.backward(dr.sum(distance))
    assert np.allclose(distance.numpy(), 5 - np.sqrt(4 - x**2), rtol=1e-5)
    assert np.allclose(dr.grad(across).numpy(), x / np.sqrt(4 - x**2), rtol=1e-4, atol=1e-6)
    assert np.allclose(dr.grad(z).numpy(), -1, rtol=1e-5)


def test_distances_follow_a_shape_where_no_ray_moves(rgb):
    scene = rgb.load_dict(
        {"type": "scene", "plate": {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([0, 0, 4])}}
    )
    params, lift = rgb.traverse(scene), rgb.Float(0)
    dr.enable_grad(lift)
    key = next(k for k in params.keys() if k.endswith("to_world"))
    # Twice as far as it is lifted, whatever the place on it.
    params[key] = rgb.Transform4f().translate(rgb.Point3f(0, 0, 4 + 2 * lift))
    params.update()
    view = look(rgb, Place(None, scene), [(0, 0, 0), (0.4, -0.7, 1)])
    dr.forward(lift)
    assert np.allclose(view.distance.numpy(), [4, 3]) and np.allclose(dr.grad(view.distance).numpy(), 2, rtol=1e-5)
