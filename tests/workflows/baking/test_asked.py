"""What is asked for, and what contradicts it."""

from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.workflows.bake_chunks import CONE, cone_of, source_of
from nerg_mi.workflows.scene_commands import BakeOptions

GAZE, RAYS = Path("gaze.safetensors"), Path("rays.npz")


@pytest.mark.parametrize(
    "options, with_gaze, source",
    [
        ({"gaze": GAZE, "rays": RAYS}, False, "field"),
        ({"gaze": GAZE, "rays": RAYS, "source": "rays"}, False, "rays"),
        ({"rays": RAYS}, True, "rays"),
        ({}, True, "field"),
    ],
)
def test01_whose_gaze(options, with_gaze, source):
    assert source_of(BakeOptions(**options), None, with_gaze) == source


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "whose gaze is it"),
        ({"source": "eyes"}, "--from"),
        ({"rays": RAYS, "unit": "hours"}, "--unit"),
        ({"gaze": GAZE, "halves": True}, "add --from rays"),
        ({"rays": RAYS, "observer": (0.0, 0.0, 0.0)}, "--observer and --path"),
    ],
)
def test02_what_contradicts_itself(options, said):
    with pytest.raises(NergError, match=said):
        source_of(BakeOptions(**options), None)


def test03_cones():
    assert cone_of(BakeOptions(), "rays") == np.radians(CONE) and cone_of(BakeOptions(), "field") == 0
    assert cone_of(BakeOptions(cone=3.0), "field") == np.radians(3.0)
