"""Every medium answers all that the protocol asks, and densities are fit to be marched."""

import inspect
from types import FunctionType

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.medium import MAX_DENSITY, LocalRay, Medium, bounded
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.transport.media.splats.scenes import medium_of, stack

from .test_field import field

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
