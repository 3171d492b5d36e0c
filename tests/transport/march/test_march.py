"""The front of the march: which of the two it takes, and where its steps become fine."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.transport import march as front
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.medium import ColorPainter
from nerg_mi.transport.volume_medium import VolumeMedium

from .test_primal import grid, slab


@pytest.fixture
def taken(monkeypatch):
    """An entry for each march that can be differentiated."""
    calls, made = [], front.differentiable_march
    monkeypatch.setattr(front, "differentiable_march", lambda *a: calls.append(1) or made(*a))
    return calls


def through(mi, medium, settings, z=None, march=front.march, **more):
    ray = medium.local(mi.Point3f(0.5, 0.5, 0 if z is None else z), mi.Vector3f(0, 0, 1))
    return march(medium, ray, dr.maximum(ray.t_near, 0), ray.t_far, mi.Bool(True), settings, **more)


def test01_derivatives_are_paid_for_where_any_are_tracked(rgb, taken):
    settings, medium, z = MarchSettings(0.01), slab(rgb, 2, 1), rgb.Float(0)
    through(rgb, medium, settings, z)
    assert not taken
    dr.enable_grad(z)
    attached = through(rgb, medium, settings, z)
    assert len(taken) == 1 and dr.grad_enabled(attached.expected_depth)
    with dr.suspend_grad():
        through(rgb, medium, settings, z)
    assert len(taken) == 1


def test02_both_marches_find_the_same(rgb):
    z = rgb.Float(0)
    medium, settings = slab(rgb, 2, 1), MarchSettings(0.01)
    plain = through(rgb, medium, settings, z, count=True)
    dr.enable_grad(z)
    attached = through(rgb, medium, settings, z, count=True)
    for name in ("tau", "moment", "half", "half_slope", "enter", "enter_tau", "density_evals", "origin"):
        assert np.array_equal(getattr(plain, name).numpy(), dr.detach(getattr(attached, name)).numpy()), name
    tracked = {
        name for name in ("half", "half_slope", "enter", "enter_tau") if dr.grad_enabled(getattr(attached, name))
    }
    assert tracked == {"half"}


def test03_a_goal_carries_derivatives_too(rgb):
    goal = rgb.Float(0.4)
    dr.enable_grad(goal)
    found = through(rgb, slab(rgb, 2, 1), MarchSettings(0.01), until=goal)
    dr.backward(found.half)
    # Where σ s = goal: the crossing moves by 1 / σ with it.
    assert np.isclose(found.half[0], 1.2, rtol=1e-5) and np.isclose(dr.grad(goal)[0], 0.5, rtol=1e-4)


def test04_fine_steps_begin_before_matter_does(rgb):
    """A step of the scout before where it found the first trace, so that none of the matter is marched coarsely."""
    for face in (0.3, 0.55, 0.9):
        data = np.zeros((200, 1, 1))
        data[round(200 * face) :] = 30
        medium = grid(rgb, data, filter_type="nearest")
        ray = medium.local(rgb.Point3f(0.5, 0.5, 0), rgb.Vector3f(0, 0, 1))
        settings = MarchSettings(0.01, coarse=8)
        start, evals = front.fine_start(medium, ray, rgb.Float(0), rgb.Float(1), rgb.Bool(True), settings)
        assert face - 2.1 * 0.08 < start[0] < face and 1 <= evals[0] <= 14
    vacuum = grid(rgb, np.zeros((4, 1, 1)))
    assert front.fine_start(vacuum, ray, rgb.Float(0), rgb.Float(1), rgb.Bool(True), settings)[0][0] == np.inf


def test05_coarse_steps_spare_evaluations_and_their_scout_is_counted(rgb):
    data = np.zeros((200, 1, 1))
    data[150:] = 30
    medium = grid(rgb, data, filter_type="nearest")
    # As a medium that states no bound: nothing is skipped, and every step is evaluated.
    medium.bound = None
    fine, coarse = MarchSettings(0.005, stop=1e-6), MarchSettings(0.005, stop=1e-6, coarse=8)
    all_fine, scouted = (through(rgb, medium, s, march=front.scouted_march, count=True) for s in (fine, coarse))
    assert np.isclose(all_fine.expected_depth[0], scouted.expected_depth[0], atol=2e-3)
    # Most of the 150 steps in front of matter become 17 of the march, and 19 of its scout.
    assert 80 < all_fine.density_evals[0] - scouted.density_evals[0] < 115


def test06_what_is_not_asked_for_is_not_gathered(rgb):
    sigma, tint = (rgb.load_dict({"type": "constvolume", "value": v}) for v in (2.0, 0.25))
    colored = VolumeMedium(sigma, tint)
    assert through(rgb, colored, MarchSettings(0.01)).color is None
    gathered = through(rgb, colored, MarchSettings(0.01, color_cutoff=0), color=ColorPainter(rgb.Color3f))
    assert np.allclose(np.array(gathered.color).ravel(), 0.25 * gathered.opacity[0], rtol=1e-5)
