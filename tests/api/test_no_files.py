"""A study in memory writes no file."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.conftest import ROOT

STUDY = """
import json, os, sys
import matplotlib.font_manager, numpy as np, pandas as pd, trimesh  # Matplotlib writes its cache when it is imported
import nerg_mi as nerg
written = []


def note_writing(event, args):
    if event == "open" and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        written.append(str(args[0]))
    if event in ("os.mkdir", "os.rename", "tempfile.mkstemp", "tempfile.mkdtemp"):
        written.append(f"{event} {args[0]}")


sys.addaudithook(note_writing)
rng = np.random.default_rng(0)
eyes = np.array([(1.2, 1.2, 1.6), (4.5, 2.8, 1.6)])[np.arange(600) // 300] + rng.uniform(-0.1, 0.1, (600, 3))
seen = rng.uniform((0, 0, 0), (6, 4, 3), (600, 3)) - eyes
table = pd.DataFrame({"t": np.arange(600) / 30, "who": np.array(list("abcd"))[np.arange(600) % 4]})
table[["x", "y", "z"]], table[["dx", "dy", "dz"]] = eyes, seen
columns = {"time": "t", "participant": "who", "origin": ["x", "y", "z"], "direction": ["dx", "dy", "dz"]}
rays = nerg.Rays.from_dataframe(table, columns)
room = trimesh.creation.box((6, 4, 3)).apply_translation((3, 2, 1.5))
small = {"steps": 3, "probes": 16, "directions": 64, "min_rays": 4, "radius": 0.5}
small |= {"validation_zones": 0, "prior_folds": 1}
in_hits = nerg.Rays.from_arrays(eyes, seen, times=table["t"], participants=table["who"], hits=eyes + seen)
assert nerg.train_gaze(in_hits, "hits", voxel_size=0.3, **small).environment.kind == "hits"  # sets the variant
gaze = nerg.train_gaze(rays, room, test_zones=1, test_positions=4, **small)
scores = nerg.evaluate_gaze(gaze, rays, directions=64, resamples=4, min_rays=4)
scene = nerg.make_scene(room, gaze, camera=nerg.Camera((1, 1, 2), (5, 2, 1), width=24, height=16))
picture = nerg.render(scene, [(2, 2, 1.6)], spp=1)
share = nerg.attention(scene, [[5.9, 1, 1], [6.1, 3, 2]], [(2, 2, 1.6)]).share
result = nerg.statistics([rays, gaze], {"window": [[5.9, 1, 1], [6.1, 3, 2]]}, resamples=199, viewpoints=4)
report = nerg.report([gaze, rays], observer=(2, 2, 1.6), width=24, spp=1, viewpoints=2, max_points=200).html
row = result.aois[0]
extra = {"interval": [row["share_low"], row["share_high"]], "html": report[:15]}
print(json.dumps({"written": written, "kld": scores.rows[0]["KLD"], "share": share.tolist(), **extra}))
"""


@pytest.mark.slow
def test_a_study_of_a_data_frame_and_a_mesh_writes_no_file(tmp_path):
    pytest.importorskip("pandas")
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", STUDY], capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["html"] == "<!DOCTYPE html>" and result["written"] == [] and not list(tmp_path.iterdir())
    assert result["kld"] > 0 and 0 < result["share"][0] < 1 and result["interval"][0] < result["interval"][1]
