"""The volume `gazefield`: equation 1 in the scene, its place and its parameters."""

import numpy as np
import pytest

from . import fields
from .scenes import observed


def volume(path, **kwargs):
    return {"type": "gazefield", "filename": str(path), **kwargs}


def load(mi, path):
    return mi.load_dict(volume(path))


def ask(mi, gaze, p_od, p_o, r_o):
    points = (mi.Vector3f(np.asarray(x, float).tolist()) for x in (p_od, p_o, r_o))
    return [v.numpy()[0] for v in observed(mi, gaze, mi.Point3f(*map(float, p_o))).evaluate(*points, True)]


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test01_placed_in_the_scene(rgb, tmp_path, variant):
    fields.gaze(tmp_path / "g.safetensors", variant)
    p_o, p_od = np.array([-0.5, 0.1, -0.7]), np.array([0.4, 0.3, 0.6])
    r_o = (p_od - p_o) / np.linalg.norm(p_od - p_o)
    plain = ask(rgb, volume(tmp_path / "g.safetensors"), p_od, p_o, r_o)
    to_world = rgb.ScalarTransform4f().translate([1, 2, 3]).rotate([0, 1, 0], 30).scale(4)
    m = np.array(to_world.matrix)
    moved = volume(tmp_path / "g.safetensors", to_world=to_world)
    assert np.allclose(
        ask(rgb, moved, (m @ [*p_od, 1])[:3], (m @ [*p_o, 1])[:3], m[:3, :3] @ r_o / 4), plain, rtol=1e-4
    )


def test02_parameters_and_text(rgb, tmp_path):
    field = fields.gaze(tmp_path / "g.safetensors")
    volume = load(rgb, tmp_path / "g.safetensors")
    assert set(rgb.traverse(volume).keys()) == set(field.parameters())
    assert "variant = emit_capture" in str(volume) and "g.safetensors" in str(volume)
    assert np.allclose(np.array(volume.bbox().max).ravel(), 1)


def test03_wrong_files(rgb, tmp_path):
    fields.radiance(tmp_path / "f.safetensors")
    with pytest.raises(RuntimeError, match="holds a radiance field"):
        load(rgb, tmp_path / "f.safetensors")


def test04_constant_weights_change_no_gaze(rgb, tmp_path):
    fields.gaze(tmp_path / "g.safetensors")
    where = (0.4, 0.3, 0.6), (-0.5, 0.1, -0.7), (0.6, 0.0, 0.8)
    plain = volume(tmp_path / "g.safetensors")
    constant = {**plain, "constant_weights": True}
    assert rgb.load_dict(constant).field.emit_head.constant
    assert ask(rgb, plain, *where)[0] > 0 and ask(rgb, constant, *where) == ask(rgb, plain, *where)
