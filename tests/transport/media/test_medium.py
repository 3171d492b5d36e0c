"""Tests of `nerg_mi.transport.medium`."""

import inspect
from types import FunctionType

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.medium import MAX_DENSITY, ColorPainter, LocalRay, Medium, bound, bounded
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.transport.media.splats.scenes import medium_of, stack
from tests.transport.media.test_field import field

# ---- Cells ----
#
# The bound of a grid volume: nothing that its interpolant can return lies in a cell that counts as empty.


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


# ---- What samples contribute to a sum: the medium's colour, in the array type that was asked for ----


@pytest.mark.parametrize("kind", ["Color3f", "Spectrum", "Vector3f"])
def test01_the_mediums_colour(rgb, kind):
    array_type = getattr(rgb, kind)
    data = np.broadcast_to(np.float32([0.2, 0.5, 0.8]), (2, 2, 2, 3)).copy()
    color = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(data), "raw": True})
    medium, painter = (
        VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 1.0}), color),
        ColorPainter(array_type),
    )
    p, w = rgb.Point3f(0.5, 0.5, 0.5), rgb.Vector3f(0, 0, 1)
    found = painter.paint(medium, [], p, w, rgb.Bool(True))
    assert type(found) is type(painter.zero()) is array_type
    assert np.allclose(np.array(found).ravel(), [0.2, 0.5, 0.8], atol=1e-6)
    assert not np.array(painter.zero()).any()
    assert painter.color(medium, found, rgb.Float(0.5), medium.local(p, w), rgb.Bool(True)) is found


# ---- Every medium answers all that the protocol asks, and densities are fit to be marched ----


ASKED = {name: what for name, what in vars(Medium).items() if isinstance(what, (FunctionType, property))}


ASKED = {name: what for name, what in ASKED.items() if not name.startswith("_")}


def media(mi):
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2), np.float32))}
    fog = {"type": "constvolume", "value": 2.0}
    return [
        FieldMedium(field()),
        VolumeMedium(mi.load_dict(fog)),
        VolumeMedium(mi.load_dict(grid), mi.load_dict(fog)),
        medium_of(stack([0.2, 0.8], [0.5, 0.5], scale=0.25)),
    ]


def test01_every_medium_has_what_is_asked(rgb):
    assert len(ASKED) > 15
    for medium in media(rgb):
        for name, what in ASKED.items():
            found = getattr(medium, name)
            if isinstance(what, property):
                assert not callable(found), name
            else:
                wanted = list(inspect.signature(what).parameters)[1:]
                assert list(inspect.signature(found).parameters) == wanted, (type(medium), name)


def test02_and_answers_as_it_says(rgb):
    for medium in media(rgb):
        assert medium.color_space in ("srgb", "linear", "spectrum") and medium.length_scale > 0
        assert medium.step is None or 0 < medium.step < medium.length_scale
        lower, upper = medium.bounds()
        assert lower.shape == upper.shape == (3,) and (upper > lower).all()
        o, d = rgb.Point3f(0.4, 0.6, -1), rgb.Vector3f(0, 0, 1)
        ray = medium.local(o, d)
        assert isinstance(ray, LocalRay) and 0 < ray.t_near[0] < ray.t_far[0] < 10
        assert medium.refresh() is None and medium.parameters()
        if medium.hits is not None:
            continue
        p = medium.to_local(rgb.Point3f(0.4, 0.6, 0.5))
        sigma, features = medium.density_features(p, True)
        assert sigma[0] == medium.density(p, True)[0] > 0 and len(features) == medium.feature_count
        if medium.has_color:
            color = np.array(medium.color(features, p, ray.w, True)).ravel()
            assert color.shape == (3,) and (color >= 0).all()


@pytest.mark.parametrize("wrong, right", [(-1, 0), (np.nan, 0), (np.inf, MAX_DENSITY), (3e38, MAX_DENSITY), (2.5, 2.5)])
def test03_densities_are_finite_and_not_negative(wrong, right):
    assert bounded(ns.Float(wrong))[0] == np.float32(right)
