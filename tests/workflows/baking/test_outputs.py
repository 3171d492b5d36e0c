"""Files of a bake open elsewhere, with the same mesh, colours and values."""

import csv
import io
import json
import struct

import numpy as np
import pytest
import trimesh

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.bake import bake, check_texture, vertex_normals
from nerg_mi.workflows.scene_commands import BakeOptions
from tests.surfaces.meshes import box, joined


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    import mitsuba as mi

    from nerg_mi.formats.ply import write_columns

    mi.set_variant("llvm_ad_rgb")
    folder, (v, f) = tmp_path_factory.mktemp("baked"), box((0, 0, 0), (4, 3, 2.5))
    write_columns(folder / "room.ply", dict(zip("xyz", v.T)), f)
    n, rng = 300, np.random.default_rng(0)
    d = rng.normal((1.0, 0.4, -0.1), 0.2, (n, 3))
    rays = Rays(
        np.arange(n) / 10,
        np.arange(n) // 75,
        tuple("abcd"),
        np.tile([1.0, 1, 1.5], (n, 1)),
        d / np.linalg.norm(d, axis=1, keepdims=True),
        np.ones(n),
    )
    names = [folder / f"a{suffix}" for suffix in (".ply", ".glb", ".csv", ".json")]
    options = BakeOptions(detail=0.5, smooth=0.1, halves=True, mode="llvm_ad_rgb")
    return folder, bake(folder / "room.ply", names, options, rays=rays)


def test01_ply_and_glb_are_the_same_to_trimesh(baked):
    folder, result = baked
    ply = trimesh.load(folder / "a.ply", process=False)
    glb = trimesh.load(folder / "a.glb", process=False, force="mesh")
    assert np.array_equal(ply.faces, result.mesh.faces) and np.array_equal(glb.faces, result.mesh.faces)
    assert np.allclose(ply.vertices, result.mesh.vertices, atol=1e-6)
    # The node turns z up into glTF's y.
    assert np.allclose(
        glb.vertices, np.stack([ply.vertices[:, 0], ply.vertices[:, 2], -ply.vertices[:, 1]], 1), atol=1e-5
    )
    values = ply.metadata["_ply_raw"]["vertex"]["data"]["value"]
    assert np.allclose(np.ravel(values), result.density, rtol=1e-6)
    # Of a mesh with a material trimesh keeps the colours beside it; they are linear, those of a PLY are as shown.
    (inner,) = trimesh.load(folder / "a.glb", process=False).geometry.values()
    linear = np.array(inner.visual.vertex_attributes["color"], float)[:, :3] / 65535
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(shown - np.array(ply.visual.vertex_colors)[:, :3] / 255).max() < 0.6 / 255
    assert np.allclose(np.ravel(inner.vertex_attributes["_VALUE"]), result.density, rtol=1e-6)
    assert len(np.unique(ply.visual.vertex_colors, axis=0)) > 20


def test02_the_table_adds_up_and_the_summary_says_what_was_done(baked):
    folder, result = baked
    rows = list(csv.DictReader(io.StringIO((folder / "a.csv").read_text())))
    assert (
        len(rows) == 12 and [int(r["face"]) for r in rows] == list(range(12)) and {r["shape"] for r in rows} == {"room"}
    )
    share = np.array([float(r["share"]) for r in rows])
    assert np.isclose(share.sum(), result.on_surface) and np.isclose(result.on_surface, 1, atol=1e-6)
    assert np.allclose([float(r["value"]) * float(r["area_m2"]) for r in rows], share, rtol=1e-6)
    assert np.isclose(sum(float(r["area_m2"]) for r in rows), 2 * (12 + 10 + 7.5))
    told = json.loads((folder / "a.json").read_text())
    assert told["lookers"] == 300 and 0.3 < told["halves_cc"] <= 1 and told["shapes"] == {"room": pytest.approx(1)}
    assert list(told["provenance"]["inputs"]) == ["room.ply"] and told["provenance"]["settings"]["smooth"] == 0.1
    raw = (folder / "a.glb").read_bytes()
    document = json.loads(raw[20 : 20 + struct.unpack_from("<I", raw, 12)[0]])
    assert document["asset"]["extras"]["provenance"]["what"] == "nerg bake"
    assert b"comment nerg_mi" in (folder / "a.ply").read_bytes()[:4000]


def test03_a_texture(baked, tmp_path):
    pytest.importorskip("xatlas", reason="xatlas is not installed")
    folder, _ = baked
    rays = Rays([0.0, 0.1], [0, 0], ("a",), np.ones((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]]), np.ones(2))
    options = BakeOptions(detail=0.4, texture=128, mode="llvm_ad_rgb")
    bake(folder / "room.ply", [tmp_path / "t.glb"], options, rays=rays)
    found = trimesh.load(tmp_path / "t.glb", process=False, force="mesh")
    picture = np.asarray(found.visual.material.baseColorTexture)
    assert picture.shape[:2] == (128, 128) and len(found.faces) == 12
    # Where somebody looks it is brighter than where nobody does.
    assert picture[..., 0].max() > picture[..., 0][picture[..., 0] > 0].min() + 50


def test04_normals_and_textures_that_go_nowhere(tmp_path):
    mesh = joined(box((0, 0, 0), (1, 1, 1)))
    normals = vertex_normals(mesh)
    # Of a cube's corners they point along the diagonals.
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.all(np.abs(np.abs((normals * np.sign(mesh.vertices - 0.5)).sum(axis=1))) > 1.6)
    with pytest.raises(NergError, match=r"\.glb"):
        check_texture([tmp_path / "a.ply"], 64)
