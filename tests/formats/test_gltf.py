"""Binary glTF: what is written opens elsewhere, and what others write is read within limits."""

import json
import struct

import numpy as np
import pytest
import trimesh

from nerg_mi.errors import NergError
from nerg_mi.formats.gltf import pack_glb, read_glb, shown_unlit
from tests.surfaces.meshes import box

V, F = box((0, 0, 0), (1, 2, 3))


def document_of(raw):
    length = struct.unpack_from("<I", raw, 12)[0]
    return json.loads(raw[20 : 20 + length]), raw[28 + length :]


def changed(path, **values):
    """A file of the box whose document has other ``values``."""
    document, data = document_of(b"".join(shown_unlit([("POSITION", V.astype("<f4"), False)], F, up="y")))
    path.write_bytes(b"".join(pack_glb({**document, **values}, data)))
    return path


def test01_trimesh_reads_what_is_written(tmp_path):
    colors = np.full((8, 4), 65535, "<u2")
    colors[:, 0] = np.linspace(0, 65535, 8)
    parts = [("POSITION", V.astype("<f4"), False), ("COLOR_0", colors, True), ("_VALUE", V[:, 0].astype("<f4"), False)]
    path = tmp_path / "a.glb"
    path.write_bytes(b"".join(shown_unlit(parts, F, up="y", extras={"unit": "1/m²"})))
    found = trimesh.load(path, process=False, force="mesh")
    assert np.allclose(found.vertices, V) and np.array_equal(found.faces, F)
    assert document_of(path.read_bytes())[0]["asset"]["extras"] == {"unit": "1/m²"}
    # All that is bound to a multiple of four bytes is.
    document, _ = document_of(path.read_bytes())
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])


def test02_what_trimesh_writes_is_read_with_its_nodes(tmp_path):
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(1)
    for k in range(2):
        where = trimesh.transformations.rotation_matrix(0.3 + k, (1, 2, 3), (k, 0, 1))
        scene.add_geometry(ball, node_name=str(k), transform=where)
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    vertices, faces = read_glb(tmp_path / "a.glb")
    whole = scene.to_geometry()
    assert len(faces) == len(whole.faces) == 160
    order = lambda t: t[np.lexsort(np.round(t.reshape(len(t), -1), 4).T)]
    assert np.allclose(order(vertices[faces].mean(1)), order(whole.triangles.mean(1)), atol=1e-5)
    assert np.isclose(trimesh.Trimesh(vertices, faces).volume, whole.volume, rtol=1e-5)


@pytest.mark.parametrize(
    "values, said",
    [
        ({"nodes": [{"children": [0]}]}, "nested too deep, or in a circle"),
        ({"nodes": [{}]}, "no triangles"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": 10**12, "type": "VEC3"}] * 2}, "ends before"),
        ({"accessors": [{"bufferView": 0, "componentType": 5126, "count": -1, "type": "VEC3"}] * 2}, "no whole number"),
        ({"bufferViews": []}, "list index out of range"),
        ({"nodes": [{"mesh": 0, "scale": [1, 1, "nan"]}]}, "stands nowhere"),
        ({"buffers": [{"uri": "b.bin"}]}, "in another file"),
        (
            {
                "meshes": [
                    {"primitives": [{"attributes": {"POSITION": 0}, "extensions": {"KHR_draco_mesh_compression": {}}}]}
                ]
            },
            "compressed",
        ),
    ],
)
def test03_damaged_files_are_a_sentence(tmp_path, values, said):
    with pytest.raises(NergError, match=said):
        read_glb(changed(tmp_path / "a.glb", **values))


def test04_mirrored_nodes_turn_their_triangles(tmp_path):
    vertices, faces = read_glb(changed(tmp_path / "a.glb", nodes=[{"mesh": 0, "scale": [-1, 1, 1]}]))
    plain = trimesh.Trimesh(V, F).volume
    assert np.isclose(trimesh.Trimesh(vertices, faces).volume, plain)


@pytest.mark.parametrize("cut", [3, 15, 40, 300])
def test05_what_ends_early(tmp_path, cut):
    whole = changed(tmp_path / "a.glb").read_bytes()
    (tmp_path / "b.glb").write_bytes(whole[: min(cut, len(whole) - 5)])
    with pytest.raises(NergError, match="cannot be read"):
        read_glb(tmp_path / "b.glb")
