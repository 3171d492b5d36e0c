import numpy as np
import pytest

from nerg_mi.density.probes import place_probes
from nerg_mi.rays.readers import vr_supermarket as presets


def test_unknown_preset():
    with pytest.raises(ValueError, match="choose one of skeleton22, vr_supermarket"):
        presets.preset("etch")


def test_real_supermarket(recorded):
    files = sorted(recorded("vr_supermarket").glob("*.csv.gz"))[:2]
    rays = presets.vr_supermarket(files)
    assert rays.persons == ("user10", "user11") and 0.85 < len(rays) / rays.metadata["rows_read"] < 0.97
    # The gaze ray points at the recorded hit: the frame was decoded right.
    hit = np.isfinite(rays.hit).all(axis=1)
    to_hit = rays.hit[hit] - rays.origin[hit]
    to_hit /= np.linalg.norm(to_hit, axis=1, keepdims=True)
    angle = np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(to_hit - rays.direction[hit], axis=1)))
    assert np.median(angle) < 1e-3 and np.percentile(angle, 99) < 0.05
    assert 0.97 < hit.mean() < 1
    assert 1.2 < np.median(rays.origin[:, 2]) < 1.8  # z is up: eye heights
    probes = place_probes(rays, 0.25, count=64, min_rays=8, cap=100_000)
    assert 200 < np.median(probes.counts) < 2000
