"""What receives gaze."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.ply import write_columns
from nerg_mi.workflows.bake_chunks import cut, read_receivers
from tests.plugins import fields
from tests.surfaces.meshes import box
from tests.workflows.recorder import Recorder

SCENE = """<scene version="3.0.0">
    <shape type="cube" id="sign"/>
    <shape type="rectangle" id="wall"><transform name="to_world"><translate z="5"/></transform></shape>
    {more}
</scene>
"""


def test01_a_mesh_is_cut_as_finely_as_asked_in_metres(rgb, tmp_path):
    v, f = box((0, 0, 0), (2, 2, 2))
    write_columns(tmp_path / "a.ply", dict(zip("xyz", v.T)), np.concatenate([f, f[:2, ::-1]]))
    told = Recorder()
    found = read_receivers(tmp_path / "a.ply", (), 16, ns, told)
    assert found.names == ("a",) and found.index.tolist() == list(range(12)) and not found.others
    assert told.messages == ["a.ply: 2 faces that repeat others left out"]
    # Two scene units a metre.
    assert cut(found, 0.25, 2.0).mesh.longest.max() <= 0.5
    assert 50_000 < len(cut(found, None, 1.0).mesh.faces) < 250_000


def test02_shapes_of_a_scene_receive_or_hide(rgb, tmp_path):
    (tmp_path / "a.xml").write_text(SCENE.format(more=""))
    both = read_receivers(tmp_path / "a.xml", (), 16, ns, Recorder())
    assert both.names == ("sign", "wall") and np.bincount(both.shape).tolist() == [12, 2]
    sign = read_receivers(tmp_path / "a.xml", ("sign",), 16, ns, Recorder())
    assert sign.names == ("sign",) and len(sign.mesh.faces) == 12 and len(sign.others) == 1
    with pytest.raises(NergError, match='"door"'):
        read_receivers(tmp_path / "a.xml", ("door",), 16, ns, Recorder())
    (tmp_path / "b.xml").write_text(SCENE.format(more='<shape type="sphere" id="ball"/>'))
    with pytest.raises(NergError, match='"ball" .* is a Sphere'):
        read_receivers(tmp_path / "b.xml", (), 16, ns, Recorder())
    (tmp_path / "c.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(NergError, match="has no shapes"):
        read_receivers(tmp_path / "c.xml", (), 16, ns, Recorder())


def test03_a_field_gives_its_surface(rgb, tmp_path):
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    fields.radiance(tmp_path / "f.safetensors")
    found = read_receivers(tmp_path / "f.safetensors", (), 8, ns, Recorder())
    assert found.names == ("f",) and len(found.mesh.faces) > 10
    with pytest.raises(NergError, match="--shape"):
        read_receivers(tmp_path / "f.safetensors", ("a",), 8, ns, Recorder())
