"""`nerg bake`: what it says, and what it writes."""

import json

import numpy as np
import pytest

import nerg_mi.cli
from nerg_mi.formats.ply import write_columns
from nerg_mi.rays.rays import Rays
from tests.surfaces.meshes import box


def test_rays_on_a_room_without_a_wall(rgb, tmp_path, capsys):
    v, f = box((0, 0, 0), (4, 3, 2.5), without=1)
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    d = np.array([(1.0, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
    Rays(np.arange(4) / 10, np.zeros(4), ("a",), np.ones((4, 3)), d, np.ones(4)).save(tmp_path / "a.npz")
    line = f"bake {tmp_path}/room.ply --rays {tmp_path}/a.npz --cone 0 --detail 1 -o {tmp_path}/a.json -m llvm_ad_rgb"
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main([*line.split(), "--weights", "equal"])
    assert not end.value.code
    said = capsys.readouterr().out
    assert "of the gaze of 4 rays 75.00% lies on the surface" in said and "25.00% meets no surface" in said
    assert json.loads((tmp_path / "a.json").read_text())["escaped"] == 0.25
