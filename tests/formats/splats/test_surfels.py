"""Splats of a field show its depth."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.splats import splats_of_field
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium
from tests.conftest import ROOT


@pytest.fixture(scope="module")
def store():
    return load_radiance(ROOT / "scenes" / "store" / "store.safetensors", ns)[0]


def test_depths_are_the_fields(store):
    splats, done = splats_of_field(store, 56)
    assert len(splats) > 5_000 and done["moved"] < 0.5 * done["cell"]
    rng = np.random.default_rng(0)
    d = rng.normal(size=(400, 3)).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = np.tile(np.float32([4.4, 2.8, 1.6]), (400, 1))
    ours, opacity = trace_depth(SplatMedium(SplatArrays(splats, ns)), o, d)
    field, _ = trace_depth(FieldMedium(store), o, d)
    assert np.mean(opacity > 0.5) > 0.98 and np.median(np.abs(ours - field)) < 0.25 * done["cell"]
