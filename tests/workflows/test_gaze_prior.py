"""A gaze field of other places: what it says, what its checkpoint holds, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.fields import load_gaze
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_log_density import elevation_density
from nerg_mi.workflows.evaluate import evaluate_gaze
from nerg_mi.workflows.train_prior import learn_prior


def looking(elevation: float, count: int = 200, seed: int = 0) -> Rays:
    """Two people who look at about one ``elevation`` (radians), to all sides."""
    rng = np.random.default_rng(seed)
    up, around = elevation + 0.1 * rng.normal(size=count), rng.uniform(0, 2 * np.pi, count)
    d = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)
    return Rays(np.arange(count), np.arange(count) % 2, ("a", "b"), rng.normal(size=(count, 3)), d, np.ones(count))


def test_its_checkpoint_is_the_density_of_other_places_anywhere(tmp_path, rgb):
    places = [looking(-0.6), looking(0.2, seed=1)]
    for k, rays in enumerate(places):
        rays.save(tmp_path / f"{k}.npz")
    path = tmp_path / "prior.safetensors"
    found = learn_prior([tmp_path / "0.npz", tmp_path / "1.npz"], path)
    assert [(p["file"], p["rays"], p["persons"]) for p in found.provenance["places"]] == [
        ("0.npz", 200, 2),
        ("1.npz", 200, 2),
    ]
    field, metadata = load_gaze(path, found.field.ns)
    assert metadata["provenance"] == found.provenance
    ns, sine = field.ns, np.array([-0.9, -0.56, 0.0, 0.2, 0.8])
    r = ns.Array3f(np.stack([np.sqrt(1 - sine**2), 0 * sine, sine]).astype(np.float32))
    gaze = np.array(field.evaluate(r, ns.Array3f(30.0, 4.0, 1.6), r, integral=ns.Float(1.0))[0])
    # Rows of the table are 2.8 degrees, and a thousandth is uniform.
    np.testing.assert_allclose(gaze, elevation_density(places, sine), atol=0.006)
    with pytest.raises(NergError, match="learnt in other places"):
        evaluate_gaze(path, places[0])
    assert learn_prior(tmp_path / "1.npz").provenance["places"] == found.provenance["places"][1:]
    # A notebook has the rays at hand.
    same = learn_prior(places)
    assert same.output is None and "file" not in same.provenance["places"][0]
    np.testing.assert_array_equal(np.array(same.field.prior.array), np.array(field.prior.array))


def test_what_is_refused(tmp_path):
    with pytest.raises(NergError, match="at least one file"):
        learn_prior([])
    with pytest.raises(NergError, match="safetensors"):
        learn_prior([looking(0.0)], tmp_path / "prior.npz")
    none = looking(0.0).select(np.zeros(200, bool))
    with pytest.raises(NergError, match="no ray is in place 2"):
        learn_prior([looking(0.0), none])
