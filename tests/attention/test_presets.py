import gzip

import numpy as np
import pytest

from nerg_mi.attention import presets
from nerg_mi.attention.frames import to_rays_frame
from nerg_mi.attention.probes import place_probes


def test_frames():
    assert np.array_equal(to_rays_frame(), np.eye(4))
    for up in "yz":
        for hand, sign in (("right", 1), ("left", -1)):
            R = to_rays_frame(up=up, handedness=hand)[:3, :3]
            assert np.isclose(np.linalg.det(R), sign)
            assert np.array_equal(R @ np.eye(3)["xyz".index(up)], [0, 0, 1])
    assert np.isclose(to_rays_frame(units="mm")[0, 0], 1e-3)
    for wrong in ({"up": "x"}, {"handedness": "both"}, {"units": "inch"}):
        with pytest.raises(ValueError, match="known"):
            to_rays_frame(**wrong)


def test_table_of_another_frame(tmp_path):
    path = tmp_path / "unity.csv.gz"
    with gzip.open(path, "wt") as out:
        out.write("id,ms,px,py,pz,dx,dy,dz,ok\n")
        out.write("bo,0,100,160,300,0,0,2,1\nann,500,0,170,0,0,-1,0,0.2\nann,1000,0,170,0,1,0,0,.9\nann,1500,0,170,0,,,,1\n")
    mapping = "origin=px,py,pz direction=dx,dy,dz t=ms person=id confidence=ok"
    rays = presets.rays_from_table([path], mapping, up="y", handedness="left", units="cm", tick=1e-3, min_confidence=0.5)
    assert np.allclose(rays.origin, [[1, 3, 1.6], [0, 0, 1.7]])
    assert np.allclose(rays.direction, [[0, 1, 0], [1, 0, 0]])
    assert np.allclose(rays.t, [0, 1]) and [rays.persons[p] for p in rays.person] == ["bo", "ann"]
    assert {d["reason"]: d["rows"] for d in rays.metadata["dropped"]} == {
        "direction is missing": [[5, 5]],
        "confidence below 0.5": [[3, 3]],
    }
    assert rays.metadata["source_frame"] == {"up": "y", "handedness": "left", "units": "cm"}
    by_file = presets.rays_from_table([path], mapping, person_from="filename")
    assert by_file.persons == ("unity",)


def test_unknown_preset():
    with pytest.raises(ValueError, match="choose skeleton22 or vr_supermarket"):
        presets.preset("pupil")


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
