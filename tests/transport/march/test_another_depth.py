"""Another kind of depth is one object: registered, it is traced and rendered, with and without shapes, studied, and
stands in the manual."""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.evaluation import study
from nerg_mi.evaluation.study_subject import open_subject
from nerg_mi.transport.depth import DEPTHS, Expected
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.plugins.scenes import channels, constant, straight


class Entered:
    """Where the march begins, and the shape itself where there is one."""

    name = "entered"
    summary = "where the march begins"
    mean_free_paths = 0.0
    at_half = False
    finds = "entered"

    def exact(self, profile):
        return profile.quantile(0)

    def inside(self, marched):
        return dr.select(marched.result.tau > 0, marched.t0, 0)

    def with_shape(self, result, front, inside, hit, distance):
        return distance


@pytest.fixture
def entered():
    kind = DEPTHS.register(Entered())
    yield kind
    DEPTHS.unregister("entered")


def test01_it_is_traced(rgb, entered):
    fog = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": 3.0}))
    depth, opacity = trace_depth(fog, [[0.5, 0.5, -1.5], [3, 0.5, -1]], [[0, 0, 1], [0, 0, 1]], kind="entered")
    assert depth.tolist() == [1.5, 0] and opacity[0] > 0.9


def test02_it_is_rendered_with_and_without_shapes(rgb, entered):
    plate = {"type": "rectangle", "to_world": rgb.ScalarTransform4f().translate([0, 0, 0.5]).scale(2)}
    asked = constant(3.0, depth="entered", aovs="depth,position")
    sensor = straight(rgb, "perspective")
    # The camera stands at z = -2, and its rays start a hundredth in front of it.
    for more, want in (({}, 1.99), ({"plate": plate}, 2.49)):
        found = channels(rgb, asked, sensor, **more)
        assert np.allclose(found["depth.T"], want, rtol=1e-5) and np.allclose(
            found["position.Z"], want - 1.99, atol=1e-4
        )


def test03_it_is_offered_where_depths_are_and_only_while_it_is_registered(rgb, entered):
    assert DEPTHS.names()[-1] == "entered"
    assert DEPTHS.manual().endswith("``entered``: where the march begins.")
    DEPTHS.unregister("entered")
    with pytest.raises(RuntimeError, match='"depth"'):
        rgb.load_dict(constant(depth="entered"))
    DEPTHS.register(entered)


def test04_the_surface_lies_as_deep_as_light_goes(rgb):
    """The kinds' mean free paths are those of a thick slab of constant density."""
    sigma = 500.0
    slab = VolumeMedium(rgb.load_dict({"type": "constvolume", "value": sigma}))
    for kind in DEPTHS:
        depth, _ = trace_depth(slab, [[0.5, 0.5, 0.0]], [[0, 0, 1]], kind=kind.name)
        assert np.isclose(depth[0] * sigma, kind.mean_free_paths, rtol=1e-3), kind.name
    assert Expected().mean_free_paths == 1


@pytest.mark.parametrize("hits", [False, True], ids=["marched", "splats"])
def test05_a_study_has_it(entered, hits):
    """Among its settings, but for splats not what finds the depth of another kind."""
    subject = SimpleNamespace(marched=True, hits=hits, extent=1.0, has_gaze=True, normalized=False, resampled=True)
    kinds = {s.params["depth"] for s in study.settings(subject) if s.group == "depth"}
    assert kinds >= {"expected", "median", "entered"} and ("refined" in kinds) is not hits


def test06_a_study_compares_it_with_its_own_exact_value(rgb, entered):
    subject = open_subject("slab", "auto", 8, 8)
    entry, median, refined = (subject.truth(1, kind, "depth") for kind in ("entered", "median", "refined"))
    rendered = subject.channels(subject.integrator({"depth": "entered"}), 1, 1)["depth"]
    assert np.allclose(entry.depth, rendered, rtol=1e-4) and (entry.depth < median.depth).any() and refined is median
