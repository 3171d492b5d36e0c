"""What controls a march, and what its results mean."""

import math
from dataclasses import FrozenInstanceError
from types import SimpleNamespace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.march_primal import MarchResult, MarchSettings, default_step


@pytest.mark.parametrize("stop, depth", [(0.0, math.inf), (1.0, 0.0), (1e-4, -math.log(1e-4))])
def test01_the_optical_depth_that_ends_a_march(stop, depth):
    assert MarchSettings(0.1, stop=stop).opaque == depth


def test02_settings_do_not_change():
    with pytest.raises(FrozenInstanceError):
        MarchSettings(0.1).step = 0.2


@pytest.mark.parametrize(
    "medium, step",
    [(None, 1), (SimpleNamespace(step=None, length_scale=512), 0.5), (SimpleNamespace(step=0.3, length_scale=9), 0.3)],
)
def test03_the_step_where_none_is_asked_for(medium, step):
    assert default_step(medium) == step


def test04_opacity_and_expected_depth():
    tau, moment = ns.Float([0, 1e-9, math.log(2), 40]), ns.Float([0, 3e-9, 1, 2])
    nothing = dict.fromkeys(("lost_tau", "lost_moment", "half", "half_slope", "enter", "enter_tau"), ns.Float(0))
    result = MarchResult(tau=tau, moment=moment, **nothing, origin=ns.Float(10))
    assert np.allclose(result.opacity.numpy(), [0, 1e-9, 0.5, 1], rtol=1e-6)
    # Nothing is met on the first; the others lie beyond where the march began.
    assert np.allclose(result.expected_depth.numpy(), [0, 13, 12, 12], rtol=1e-6)
