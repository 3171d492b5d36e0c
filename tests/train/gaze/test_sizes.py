"""Architectures of a size, and the scale that makes weights of zero the uniform density."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.train.gaze_product import sized_gaze_config

from .looks import BOX


@pytest.mark.parametrize("variant", ["emit", "emit_capture"])
@pytest.mark.parametrize("activation", ["softplus", "exp"])
def test_weights_of_zero_are_the_uniform_density(variant, activation):
    config = sized_gaze_config("small", variant, activation)
    field = GazeField.random(config, BOX, namespace("llvm"), 0)
    field.set_parameters({k: v * 0 for k, v in field.parameters().items()})
    ns = namespace("llvm")
    p, d = ns.Array3f(0.1, 0.2, 1.0), ns.Array3f(0.6, 0, 0.8)
    assert float(field.evaluate(p, p, d)[0][0]) == pytest.approx(1 / (4 * np.pi), rel=1e-5)
    with pytest.raises(ValueError, match="scale"):
        replace(config, emit_scale=0.0)


def test_a_larger_field_has_more_of_everything():
    small, paper = sized_gaze_config("small"), sized_gaze_config("paper")
    assert (
        small.grid.size < paper.grid.size
        and small.grid.levels < paper.grid.levels
        and small.grid.log2_rows < paper.grid.log2_rows
    )


def test_the_papers_size_is_the_papers():
    assert sized_gaze_config("paper").grid == GazeConfig().grid
    with pytest.raises(NergError, match="one of small, paper"):
        sized_gaze_config("huge")
