"""The bound of a grid volume: nothing that its interpolant can return lies in a cell that counts as empty."""

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.medium import bound


@pytest.mark.parametrize("filter_type", ["nearest", "trilinear"])
@pytest.mark.parametrize("wrap_mode", ["repeat", "mirror", "clamp"])
@pytest.mark.parametrize("voxel", [(0, 3, 3), (7, 3, 3), (3, 0, 7), (4, 4, 4)])
def test_no_matter_lies_in_an_empty_cell(rgb, wrap_mode, filter_type, voxel):
    """Also not where a grid that repeats shows its first voxel at its far side."""
    data = np.zeros((8, 8, 8), np.float32)
    data[voxel] = 1
    volume = rgb.load_dict(
        {"type": "gridvolume", "grid": rgb.VolumeGrid(data), "wrap_mode": wrap_mode, "filter_type": filter_type}
    )
    cells = bound(data, ns)
    it = dr.zeros(rgb.Interaction3f)
    it.p = rgb.Point3f(np.random.default_rng(0).random((3, 100_000)).astype(np.float32))
    matter, away = volume.eval_1(it).numpy() > 0, cells.empty_cells(it.p).numpy()
    assert matter.any() and not away[matter].any()
    # A bound that holds for all wrap modes, and yet leaves most of the box out.
    assert (away > 0).mean() > 0.8


@pytest.mark.parametrize("data", [np.ones((4, 4, 4)), np.pad([[[1.0]]], 1)])
def test_there_is_no_bound_where_nothing_could_be_skipped(data):
    assert bound(data, ns) is None
