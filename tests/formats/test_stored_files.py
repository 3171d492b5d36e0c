"""Files that earlier versions wrote: they load, and what is in them is what it was.

``files/`` holds one of each kind of the first format, written by version 0.1, and ``expected.json``, what the fields in
them returned then. Files of a further format are added, never put in the place of these.
"""

import json

import drjit.llvm.ad as ns
import numpy as np
import pytest
from safetensors import safe_open

from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.formats.fields import load_gaze, load_radiance, save_gaze, save_radiance
from nerg_mi.rays.rays import Rays
from tests.conftest import ROOT

FILES = ROOT / "tests" / "formats" / "files"
EXPECTED = json.loads((FILES / "expected.json").read_text(encoding="utf-8"))
POINTS, DIRECTIONS, OBSERVERS = (
    ns.Array3f(np.array(EXPECTED[k], np.float32).T) for k in ("points", "directions", "observers")
)
GAZE = ("product", "layernorm", "log_density", "ensemble")


def metadata(path):
    with safe_open(path, framework="numpy") as f:
        return json.loads(f.metadata()["nerg"])


@pytest.mark.parametrize("name, occupancy", [("radiance", OccupancyGrid), ("cascades", CascadeGrid)])
def test_radiance_fields(name, occupancy):
    field, _ = load_radiance(FILES / f"{name}.safetensors", ns)
    expected = EXPECTED[name]
    sigma, features = field.density_features(POINTS)
    assert np.allclose(sigma.numpy(), expected["density"], rtol=1e-4) and np.max(expected["density"]) > 0.1
    color = np.stack([c.numpy() for c in field.color(features, DIRECTIONS)], 1)
    assert np.allclose(color, expected["color"], atol=1e-4)
    assert isinstance(field.occupancy, occupancy) and field.occupancy.fraction == pytest.approx(expected["occupied"])
    if name == "radiance":
        behind = np.stack([c.numpy() for c in field.background(OBSERVERS, DIRECTIONS)], 1)
        assert np.allclose(behind, expected["background"], atol=1e-4)


@pytest.mark.parametrize("name", GAZE)
def test_gaze_fields(name):
    field, _ = load_gaze(FILES / f"{name}.safetensors", ns)
    members = field.members if name == "ensemble" else [field]
    assert len(members) == len(EXPECTED[name]["unnormalized"])
    for member, expected in zip(members, EXPECTED[name]["unnormalized"]):
        emit, capture = member.unnormalized(POINTS, OBSERVERS, DIRECTIONS)
        assert np.allclose((emit * capture).numpy(), expected, rtol=1e-4, atol=1e-6)
    if "support" in EXPECTED[name]:
        # Kernels reached no farther than the radius then.
        field.support.reach = field.support.radius
        found = [field.support.at(ns.Array3f(*p))[0] for p in EXPECTED["observers"]]
        assert np.allclose(found, EXPECTED[name]["support"], rtol=1e-4) and max(found) >= 1
    else:
        assert field.support is None


@pytest.mark.parametrize("suffix", ["npz", "parquet"])
def test_rays(suffix):
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    rays, expected = Rays.load(FILES / f"rays.{suffix}"), EXPECTED["rays"]
    assert rays.t.tolist() == expected["t"] and rays.person.tolist() == expected["person"]
    assert list(rays.persons) == expected["persons"] and rays.cohorts == ("one", "two")
    assert np.allclose(rays.origin, EXPECTED["observers"]) and np.allclose(rays.hit, EXPECTED["points"])
    assert np.allclose(rays.direction, EXPECTED["directions"], atol=1e-6)


def test_the_fields_of_the_store():
    field, about = load_radiance(ROOT / "scenes" / "store" / "store.safetensors", ns)
    assert about["format"] == 1 and field.occupancy is not None and np.isfinite(field.density(POINTS).numpy()).all()
    gaze, about = load_gaze(ROOT / "scenes" / "store" / "shoppers.safetensors", ns)
    assert about["format"] == 1 and np.isfinite(gaze.unnormalized(POINTS, OBSERVERS, DIRECTIONS)[0].numpy()).all()


@pytest.mark.parametrize("name", ["radiance", "cascades", *GAZE])
def test_a_field_is_stored_as_it_was(tmp_path, name):
    """Metadata and arrays of a file that is loaded and saved: who has an older version can read the new file."""
    old, new = FILES / f"{name}.safetensors", tmp_path / "new.safetensors"
    load, save = (load_gaze, save_gaze) if name in GAZE else (load_radiance, save_radiance)
    field, about = load(old, ns)
    save(field, new, about["provenance"], half=name in ("cascades", "layernorm", "ensemble"))
    assert metadata(new) == metadata(old)
    with safe_open(old, framework="numpy") as a, safe_open(new, framework="numpy") as b:
        assert list(a.keys()) == list(b.keys())
        assert all(np.array_equal(a.get_tensor(k), b.get_tensor(k)) for k in a.keys())
