"""What every gaze field answers: each kind that the library has answers all of it."""

import inspect

import pytest

from nerg_mi.fields import gaze_base
from nerg_mi.fields.gaze_ensemble import GazeEnsemble
from nerg_mi.fields.gaze_log_density import LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, GazeField
from nerg_mi.fields.mlp import namespace

from .test_log_density import BOX, GRID, SMALL


def asked(of) -> set:
    """Names of what a protocol asks for."""
    inherited = set().union(*(vars(c) for c in of.__mro__ if c.__module__ == of.__module__))
    annotated = set().union(*(inspect.get_annotations(c) for c in of.__mro__ if c.__module__ == of.__module__))
    return {n for n in inherited | annotated if not n.startswith("_")}


def fields():
    ns = namespace("llvm")
    log = [LogGazeField.random(SMALL, BOX, ns, seed) for seed in (1, 2)]
    return {
        "product": GazeField.random(GazeConfig(GRID, width=16), BOX, ns),
        "log_density": log[0],
        "ensemble": GazeEnsemble(log),
    }


@pytest.mark.parametrize("kind", ["product", "log_density", "ensemble"])
def test_every_kind_answers_what_the_protocol_asks(kind):
    field = fields()[kind]
    assert field.kind == kind in gaze_base.kinds()
    one = len(field.members) == 1
    assert all(hasattr(field, n) for n in asked(gaze_base.GazeDensity if one else gaze_base.AnyGazeField))
    assert all(hasattr(field.config, n) for n in asked(gaze_base.GazeFieldConfig))
    assert one == (field.members[0] is field)
    assert field.networks == (4 if kind == "ensemble" else 2)
    # What it says of itself is what it is built of.
    assert field.architecture().get("kind", "product") == kind
