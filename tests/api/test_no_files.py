"""Studies and viewers in memory write no file."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from tests.conftest import ROOT

HOOK = """
import json, os, sys
import matplotlib.font_manager, numpy as np, trimesh  # Matplotlib writes its cache when it is imported
import nerg_mi as nerg
written = []


def note_writing(event, args):
    # A number is a pipe to another process.
    is_file = event == "open" and not isinstance(args[0], int)
    if is_file and isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        written.append(str(args[0]))
    if event in ("os.mkdir", "os.rename", "tempfile.mkstemp", "tempfile.mkdtemp"):
        written.append(f"{event} {args[0]}")


sys.addaudithook(note_writing)
"""

STUDY = """
import pandas as pd
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


VIEWER = """
import drjit.llvm.ad as ns
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.maths.geometry import Box
from nerg_mi.viewer import compilation

compilation._PROGRAM = compilation._PROGRAM.replace("()", "(resolution=32)")
grid, box = HashGridConfig(levels=2, log2_rows=10, base=4, finest=16), Box((-1, -1, -1), (1, 1, 1))
field = nerg.RadianceField(RadianceNetwork.random(RadianceConfig(grid=grid), box, ns, 0))
config = LogGazeConfig(grid=grid, width=16, prior=8)
gaze = [nerg.GazeField(LogGazeField.random(config, box, ns, seed, np.zeros((8, 16)))) for seed in (1, 2)]
rays = nerg.Rays.from_arrays(np.full((9, 3), 0.1), np.ones((9, 3)), times=np.arange(9), participants=["a"] * 9)
pictures = []
with nerg.view([field, *gaze, rays], observer=(0.1, 0, 0), width=32, spp=1, port=0) as viewer:
    session = viewer.page.session
    names, compilation = list(session.source.gaze), session._compilation
    session.place_observer(np.array([0.2, 0, 0]))
    session.select_gaze(names[1])
    compilation._thread.join(300)
    session.refine_picture("test", session.home_view, lambda picture, colors: pictures.append(colors.shape), 32, 1)
    assert session.worker.wait_idle(300) and viewer.page.problem == "", viewer.page.problem
    voxels = session.scene.integrator.medium.field.voxels
    print(json.dumps({"written": written, "voxels": voxels.resolution, "pictures": pictures, "names": names}))
mesh = trimesh.creation.box((6, 4, 3))
with nerg.view(mesh, observer=(0.1, 0, 0), port=0) as viewer:
    assert viewer.page.session.worker.wait_idle(300)
assert not written, written
"""


def run_script(script, folder):
    """Run the script and return the result that it prints, with the files that it has ``written``."""
    environment = {**os.environ, "TMPDIR": str(folder), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", HOOK + script], capture_output=True, text=True, cwd=folder, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert not list(folder.iterdir())
    return json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))


@pytest.mark.slow
def test_a_study_of_a_data_frame_and_a_mesh_writes_no_file(tmp_path):
    pytest.importorskip("pandas")
    result = run_script(STUDY, tmp_path)
    assert result["html"] == "<!DOCTYPE html>" and result["written"] == []
    assert result["kld"] > 0 and 0 < result["share"][0] < 1 and result["interval"][0] < result["interval"][1]


@pytest.mark.slow
@pytest.mark.nightly
def test_a_viewer_of_objects_in_memory_writes_no_file(tmp_path):
    pytest.importorskip("viser")
    result = run_script(VIEWER, tmp_path)
    assert result["written"] == [] and result["voxels"] == 32
    assert result["names"] == ["gaze 0", "gaze 1"] and result["pictures"]
