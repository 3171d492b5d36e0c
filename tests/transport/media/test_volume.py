"""Mitsuba volumes as a medium: errors, what a march skips, and what a change of their data changes."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.transport.volume_medium import KnownEmpty, VolumeMedium


def test01_a_volume_without_extent_is_refused(rgb):
    class Endless(rgb.Volume):
        def __init__(self, lower, upper):
            super().__init__(rgb.Properties())
            self.box = rgb.ScalarBoundingBox3f(lower, upper)

        def bbox(self):
            return self.box

    for lower, upper in (([-np.inf] * 3, [np.inf] * 3), ([0, 0, 0], [1, 1, 0])):
        with pytest.raises(ValueError, match='"density".*to_world'):
            VolumeMedium(Endless(lower, upper))


def test02_volume_answers(rgb):
    density = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.array([[[-3.0, 5.0]]], np.float32))})
    medium = VolumeMedium(density)
    p = rgb.Point3f([0.1, 0.9], 0.5, 0.5)
    # Negative density would make light.
    assert np.allclose(medium.density(p, True).numpy(), [0, 5]) and not medium.has_color and medium.occupancy is None
    assert np.isclose(medium.length_scale, 3**0.5)
    ray = medium.local(rgb.Point3f(0.5, 0.5, -2), rgb.Vector3f(0, 0, 1))
    assert (ray.t_near.numpy()[0], ray.t_far.numpy()[0]) == (2, 3)


def corner(n=8):
    """Matter in one voxel only."""
    data = np.zeros((n, n, n), np.float32)
    data[0, 0, 0] = 2
    return data


def grid(mi, data):
    return mi.load_dict({"type": "gridvolume", "grid": mi.VolumeGrid(data)})


def test03_a_grid_is_skipped_and_its_steps_are_short_enough_for_its_voxels(rgb):
    medium = VolumeMedium(grid(rgb, corner()))
    assert medium.occupancy is not None and medium.occupancy.fraction < 0.1
    assert medium.step == pytest.approx(min(3**0.5 / 1024, 0.5 / 8)) and medium.cells.edge == pytest.approx(1 / 8)
    assert VolumeMedium(grid(rgb, np.ones((200, 2, 2), np.float32))).step == pytest.approx(3**0.5 / 1024)
    fog = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0}))
    assert fog.occupancy is None and fog.cells is None and fog.step is None


def test04_nothing_is_skipped_while_derivatives_of_it_are_tracked(rgb):
    volume = grid(rgb, corner())
    medium, params = VolumeMedium(volume), rgb.traverse(volume)
    dr.enable_grad(params["data"])
    params.update()
    medium.refresh()
    assert medium.occupancy is None
    params["data"] = dr.detach(params["data"])
    params.update()
    medium.refresh()
    assert medium.occupancy is not None


def test05_refreshing_reads_voxels_that_have_changed_and_no_others(rgb, monkeypatch):
    from nerg_mi.transport import volume_medium as module

    volume, read = grid(rgb, corner()), []
    describe = module.describe
    monkeypatch.setattr(module, "describe", lambda v: read.append(1) or describe(v))
    medium, params = VolumeMedium(volume), rgb.traverse(volume)
    first = medium.occupancy
    medium.refresh()
    assert len(read) == 1 and medium.occupancy is first
    medium.refresh(anyway=True)
    assert len(read) == 2
    moved = np.ascontiguousarray(corner()[::-1, ::-1, ::-1])
    params["data"] = rgb.TensorXf(moved[..., None])
    params.update()
    medium.refresh()
    far = rgb.Point3f(0.97, 0.97, 0.97)
    assert len(read) == 3
    assert medium.density(far, True).numpy()[0] > 0 and medium.occupancy.empty_cells(far).numpy()[0] == 0


def test06_voxels_that_are_not_finite_are_refused(rgb):
    data = np.ones((3, 3, 3), np.float32)
    data[2, 0, 1] = np.nan
    with pytest.raises(NergError, match=r"1 values that are not finite.*\(2, 0, 1\)"):
        VolumeMedium(grid(rgb, data))
    with pytest.raises(NergError, match="2 channels"):
        VolumeMedium(grid(rgb, np.ones((3, 2, 4, 2), np.float32)))


def test07_its_coordinates_are_the_scenes(rgb):
    to_world = rgb.ScalarTransform4f().translate([1, 2, 3]).scale([1, 2, 4])
    medium = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0, "to_world": to_world}))
    lower, upper = medium.bounds()
    assert lower.tolist() == [1, 2, 3] and upper.tolist() == [2, 4, 7]
    p = rgb.Point3f(1.5, 3, 4)
    assert medium.to_local(p) is p
    assert np.allclose(np.array(medium.to_unit(p)).ravel(), [0.5, 0.5, 0.25])
    assert np.allclose(np.array(medium.vector_to_unit(rgb.Vector3f(1, 1, 1))).ravel(), [1, 0.5, 0.25])


def test08_what_is_skipped_can_be_put_aside_and_back(rgb):
    """As a recorded function does, which replaces what it finds by what it is called with."""
    medium = VolumeMedium(grid(rgb, corner()))
    known = KnownEmpty(medium)
    kept, known.bound = known.bound, None
    assert kept is not None and medium.occupancy is None
    known.bound = kept
    assert medium.occupancy is kept
