"""Binary glTF: what is written opens elsewhere, and what others write is read within limits."""

import json
import struct

import numpy as np
import pytest
import trimesh

from nerg_mi.errors import NergError
from nerg_mi.formats.gltf import GltfTriangles, pack_glb, parse_glb, shown_unlit
from tests.surfaces.meshes import box

V, F = box((0, 0, 0), (1, 2, 3))


def document_of(raw):
    length = struct.unpack_from("<I", raw, 12)[0]
    return json.loads(raw[20 : 20 + length]), raw[28 + length :]


def read_glb(path) -> GltfTriangles:
    return parse_glb(path.read_bytes(), path)


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
    read = read_glb(tmp_path / "a.glb")
    vertices, faces = read.vertices, read.faces
    whole = trimesh.util.concatenate(scene.dump())
    assert len(faces) == len(whole.faces) == 160
    order = lambda t: t[np.lexsort(np.round(t.reshape(len(t), -1), 4).T)]
    assert np.allclose(order(vertices[faces].mean(1)), order(whole.triangles.mean(1)), atol=1e-5)
    assert np.isclose(trimesh.Trimesh(vertices, faces).volume, whole.volume, rtol=1e-5)


@pytest.mark.parametrize(
    "values, said",
    [
        ({"nodes": [{"children": [0]}]}, "nested too deep"),
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
    read = read_glb(changed(tmp_path / "a.glb", nodes=[{"mesh": 0, "scale": [-1, 1, 1]}]))
    plain = trimesh.Trimesh(V, F).volume
    assert np.isclose(trimesh.Trimesh(read.vertices, read.faces).volume, plain)


@pytest.mark.parametrize("cut", [3, 15, 40, 300])
def test05_what_ends_early(tmp_path, cut):
    whole = changed(tmp_path / "a.glb").read_bytes()
    (tmp_path / "b.glb").write_bytes(whole[: min(cut, len(whole) - 5)])
    with pytest.raises(NergError, match="cannot be read"):
        read_glb(tmp_path / "b.glb")


_SIZES = {5121: 1, 5123: 2, 5125: 4, 5126: 4}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@pytest.mark.parametrize("image", [None, b"\x89PNG\r\n\x1a\n odd"])
@pytest.mark.parametrize("faces", [F, None])
def test06_what_is_written_keeps_the_rules_of_the_format(image, faces):
    """Of glTF 2.0, sections 3.6 and 4.4: lengths, alignment, bounds and kinds."""
    parts = [("POSITION", V.astype("<f4"), False), ("NORMAL", V.astype("<f4"), False)]
    parts += [("TEXCOORD_0", V[:, :2].astype("<f4"), False), ("COLOR_0", np.full((8, 4), 9, "<u2"), True)]
    raw = b"".join(shown_unlit([*parts, ("_VALUE", V[:, 0].astype("<f4"), False)], faces, image=image))
    assert struct.unpack_from("<III", raw) == (0x46546C67, 2, len(raw))
    length, kind = struct.unpack_from("<II", raw, 12)
    rest, binary = struct.unpack_from("<II", raw, 20 + length)
    assert (kind, binary) == (0x4E4F534A, 0x004E4942) and length % 4 == rest % 4 == 0
    assert len(raw) == 28 + length + rest
    document, data = document_of(raw)
    # The chunk is as long as the buffer, but for what fills it up to four bytes.
    assert 0 <= len(data) - document["buffers"][0]["byteLength"] < 4
    end = 0
    for view in document["bufferViews"]:
        assert end <= view["byteOffset"] and view["byteLength"] > 0
        end = view["byteOffset"] + view["byteLength"]
    assert end <= document["buffers"][0]["byteLength"]
    primitive = document["meshes"][0]["primitives"][0]
    for name, number in {**primitive["attributes"], "indices": primitive.get("indices")}.items():
        if number is None:
            continue
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        step = _SIZES[accessor["componentType"]] * _WIDTHS[accessor["type"]]
        assert accessor["count"] * step == view["byteLength"] and view["byteOffset"] % 4 == 0
        assert view["target"] == (34963 if name == "indices" else 34962)
        # Elements of vertices begin at multiples of four bytes; colours of integers are parts of the whole.
        assert name == "indices" or step % 4 == 0
        assert accessor.get("normalized", False) == (name == "COLOR_0")
        if name == "POSITION":
            assert np.array_equal(accessor["min"], V.min(0)) and np.array_equal(accessor["max"], V.max(0))
    assert primitive["mode"] == (0 if faces is None else 4)
    used = {name for m in document["materials"] for name in m.get("extensions", {})}
    assert used == set(document["extensionsUsed"]) and document["asset"]["version"] == "2.0"
    assert all(document["images"][t["source"]]["mimeType"] == "image/png" for t in document.get("textures", []))
