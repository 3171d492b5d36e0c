"""Mesh files: files of other programs are read correctly, or refused with an error that names the file."""

from __future__ import annotations

import struct
import tracemalloc

import numpy as np
import pytest
import trimesh

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.formats import meshes
from nerg_mi.formats.gltf import encode_unlit_glb, pack_glb, parse_glb, read_glb_chunks
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.ply import write_columns
from tests.surfaces.meshes import box

V, F = box((0, 0, 0), (4, 3, 2.5))
QUAD = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
TRIANGLES = [[0, 1, 2], [0, 2, 3]]


def write_ply_text(
    order: str, vertex: dict[str, str], faces: str, rows: list[tuple], after: list[tuple], options: bytes = b""
) -> bytes:
    """Write ``rows`` (vertices) and ``after`` (faces; lists as tuples), binary in ``order``, or text for "".

    ``vertex`` maps property names to types, and ``faces`` contains the property lines of faces.
    """
    style = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    names = "".join(f"property {kind} {name}\n" for name, kind in vertex.items())
    head = f"ply\nformat {style} 1.0\nelement vertex {len(rows)}\n{names}element face {len(after)}\n{faces}end_header\n"
    if not order:
        flat = lambda row: [w for v in row for w in ((len(v), *v) if isinstance(v, tuple) else (v,))]
        return (head + "\n".join(" ".join(map(str, flat(row))) for row in [*rows, *after]) + "\n").encode() + options
    codes = {"float": "f", "uchar": "B", "ushort": "H"}
    data = b"".join(struct.pack(order + "".join(codes[k] for k in vertex.values()), *row) for row in rows)
    for row in after:
        for value in row:
            data += (
                struct.pack(f"{order}B{len(value)}i", len(value), *value)
                if isinstance(value, tuple)
                else bytes([value])
            )
    return head.encode() + data + options


XYZ = dict.fromkeys("xyz", "float")
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)]
LIST = "property list uchar int vertex_indices\n"


@pytest.mark.parametrize("order", ["", "<", ">"])
@pytest.mark.parametrize(
    "faces, triangles, polygons",
    [
        ([((0, 1, 2, 3),)], TRIANGLES, [0, 0]),
        ([((0, 1, 2),), ((0, 2, 3),)], TRIANGLES, [0, 1]),
        (
            [((1, 4, 2),), ((0, 1, 2, 3),), ((0, 1, 4, 2, 3),)],
            [[1, 4, 2], *TRIANGLES, [0, 1, 4], [0, 4, 2], [0, 2, 3]],
            [0, 1, 1, 2, 2, 2],
        ),
    ],
)
def test_polygons_become_triangles(tmp_path, order, faces, triangles, polygons):
    (tmp_path / "a.ply").write_bytes(write_ply_text(order, XYZ, LIST, CORNERS, faces))
    mesh = read_mesh_file(tmp_path / "a.ply")
    assert mesh.vertices.tolist() == np.array(CORNERS).tolist() and mesh.faces.tolist() == triangles
    assert mesh.polygons.tolist() == polygons and mesh.is_readable_by_mitsuba == (len(triangles) == len(faces))
    assert ("split" in "".join(mesh.notes)) == (not mesh.is_readable_by_mitsuba)


FIFTH = ((0.2 + 0.055) / 1.055) ** 2.4
"""Of the light, for a fifth in sRGB."""
DARK = 1 / 255 / 12.92, 2 / 255 / 12.92


@pytest.mark.parametrize("order", ["", "<"])
@pytest.mark.parametrize(
    "kind, values, expected",
    [
        ("uchar", (51, 0, 255), (FIFTH, 0, 1)),
        ("ushort", (65535, 0, 13107), (1, 0, FIFTH)),
        ("ushort", (51, 0, 255), (FIFTH, 0, 1)),
        ("float", (51, 0, 255), (FIFTH, 0, 1)),
        ("float", (0.25, 0.5, 1), (0.25, 0.5, 1)),
    ],
)
@pytest.mark.parametrize("alpha", [False, True])
def test_colours_of_vertices(tmp_path, order, kind, values, expected, alpha):
    names = ("red", "green", "blue", *(("alpha",) if alpha else ()))
    rows = [(*corner, *values, *((values[0],) if alpha else ())) for corner in CORNERS]
    (tmp_path / "a.ply").write_bytes(
        write_ply_text(order, XYZ | dict.fromkeys(names, kind), LIST, rows, [((0, 1, 2),)])
    )
    mesh = read_mesh_file(tmp_path / "a.ply")
    assert np.allclose(mesh.colors, expected) and mesh.encodes_colors == (FIFTH in expected)
    assert mesh.is_readable_by_mitsuba == (not alpha and FIFTH not in expected)
    assert mesh.notes == (("unused columns of vertex: alpha",) if alpha else ())


def test_colours_of_faces_go_with_their_triangles(tmp_path):
    tints = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    faces = [((1, 4, 2), 255, 0, 0), ((0, 1, 2, 3), 0, 255, 51)]
    (tmp_path / "a.ply").write_bytes(write_ply_text("<", XYZ, LIST + tints, CORNERS, faces))
    assert np.allclose(read_mesh_file(tmp_path / "a.ply").face_colors, [(1, 0, 0), (0, 1, FIFTH), (0, 1, FIFTH)])


@pytest.mark.parametrize("normal", [(0, 0, 0), (float("nan"), 0, 1)])
def test_unused_data_is_noted(tmp_path, normal):
    vertex = XYZ | dict.fromkeys(("nx", "ny", "nz", "quality"), "float")
    rows = [(*corner, *normal, 1) for corner in CORNERS]
    texture = LIST + "property list uchar int texnumbers\n"
    (tmp_path / "a.ply").write_bytes(write_ply_text("", vertex, texture, rows, [((0, 1, 2), (1, 2))]))
    mesh = read_mesh_file(tmp_path / "a.ply")
    for said in ("normals are not used", "unused columns of vertex: quality", "unused columns of face: texnumbers"):
        assert said in "; ".join(mesh.notes)
    assert mesh.normals is None and mesh.unreadable_reason


@pytest.mark.parametrize(
    "text",
    [
        QUAD + "f 1 2 3 4",
        QUAD + "f -4 -3 -2 -1",
        QUAD + "f 1 2 \\\n 3 \\\n4",
        QUAD + "vt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf -4/-1/-1 -2//-1 4/1",
        "v 0 0 0\nv 1 0 0 # right\n  v 1 1 0\nf 1 2 3\nv 0 1 0\nf -4 -2 -1\n",
        "f 1 2 3\nf 1 3 4\n" + QUAD,
        "# \xe4\no a\nusemtl red\n" + QUAD.replace("0\n", "0 1 0 0\n") + "f 1 2 3 4\r\n",
    ],
)
def test_valid_obj(tmp_path, text):
    (tmp_path / "a.obj").write_text(text, encoding="latin-1")
    mesh = read_mesh_file(tmp_path / "a.obj")
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]] and mesh.faces.tolist() == TRIANGLES
    assert ("usemtl" in "".join(mesh.notes)) == ("usemtl" in text)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("suffix", [".obj", ".ply"])
@pytest.mark.parametrize(
    "outline, area, beyond",
    [
        ([(0, 0), (2, 2), (4, 0), (2, 4)], 4, False),  # an arrow
        ([(0, 0), (4, 0), (4, 1), (1, 1), (1, 3), (0, 3)], 6, False),  # an L
        ([(1, 1), (1, 3), (0, 3), (0, 0), (4, 0), (4, 1)], 6, False),
        ([(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)], 8, True),  # a U
        ([(0, 0), (2, 0), (2, 2), (1, 2), (0, 2)], 4, False),
    ],
)
def test_concave_polygons_are_covered(tmp_path, outline, area, beyond, suffix, order):
    outline = outline[::order]
    rows, n = [(*p, 1.5) for p in outline], len(outline)
    if suffix == ".obj":
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in rows) + "f " + " ".join(map(str, range(1, n + 1)))
        (tmp_path / "a.obj").write_text(text)
    else:
        (tmp_path / "a.ply").write_bytes(write_ply_text("<", XYZ, LIST, rows, [(tuple(range(n)),)]))
    mesh = read_mesh_file(tmp_path / f"a{suffix}")
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a) / 2
    assert np.isclose(normals[:, 2].sum(), order * area) and len(mesh.faces) == n - 2
    assert np.isclose(np.abs(normals[:, 2]).sum(), area) == (not beyond)
    assert ("triangulated incorrectly" in "".join(mesh.notes)) == beyond
    # Mitsuba triangulates as a fan from the first corner.
    x, y = (np.array(outline) - outline[0])[1:].T
    fan = order * (x[:-1] * y[1:] - x[1:] * y[:-1])
    assert suffix == ".ply" or bool(mesh.unreadable_reason) == (fan.min() < 0)


@pytest.mark.parametrize("lines", [1, 3])
def test_continued_lines_across_blocks(tmp_path, monkeypatch, lines):
    monkeypatch.setattr("nerg_mi.formats.meshes._BLOCK", 12 * lines)
    (tmp_path / "a.obj").write_text(QUAD + "f 1 \\\n2 \\\n3\nf 1 \\\n3 4")
    assert read_mesh_file(tmp_path / "a.obj").faces.tolist() == TRIANGLES


def test_colours_of_an_obj(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0 1 0 0.2 1\nf 1 2 3")
    mesh = read_mesh_file(tmp_path / "a.obj")
    assert np.allclose(mesh.colors, [(1, 0, 0), (0.5, 0.5, 0.5), (0, FIFTH, 1)]) and mesh.hides_colors
    assert mesh.notes == (
        "of the four numbers after vertex coordinates, the first is interpreted as a weight",
        "1 vertices have no colour and are grey",
    )


@pytest.mark.parametrize(
    "rests, colors, said",
    [
        (["1 0 0 1", "0 1 0 1"], [(1, 0, 0), (0, 1, 0)], "the last is interpreted as alpha"),
        (["255 0 0 255", "0 255 51 255"], [(1, 0, 0), (0, 1, FIFTH)], "the last is interpreted as alpha"),
        (["1 0 0.2 1", "1 1 0 1"], [(0, FIFTH, 1), (1, 0, 1)], "the first is interpreted as a weight"),
        (["255 0 0", "0 255 51"], [(1, 0, 0), (0, 1, FIFTH)], ""),
    ],
)
def test_numbers_after_the_coordinates_of_an_obj(tmp_path, rests, colors, said):
    rows = "".join(f"v {k} {k * k} 0 {rests[k % 2]}\n" for k in range(4))
    (tmp_path / "a.obj").write_text(rows + "f 1 2 3 4")
    mesh = read_mesh_file(tmp_path / "a.obj")
    assert np.allclose(mesh.colors[:2], colors) and said in "".join(mesh.notes) and bool(mesh.notes) == bool(said)


# ---- Text: byte order marks, line ends, decimal commas and unknown statements ----

OBJ = "# a box\n" + "".join("v {:g} {:g} {:g}\n".format(*v) for v in V) + "vt .5 .5\nvn 0 0 1\n"
OBJ += "".join("f {}/1/1 {}/1/1 {}/1/1\n".format(*(f + 1)) for f in F)
PLY = write_ply_text("", XYZ, LIST, [tuple(v) for v in V], [(tuple(f),) for f in F]).decode()
BOM = b"\xef\xbb\xbf"
ENDS = {"unix": b"\n", "dos": b"\r\n", "mac": b"\r"}


@pytest.mark.parametrize("mark", [b"", BOM], ids=["plain", "mark"])
@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("name, text", [("a.obj", OBJ), ("a.obj", OBJ.removeprefix("# a box\n")), ("a.ply", PLY)])
def test_marks_and_line_ends_change_no_value(tmp_path, mark, end, name, text):
    (tmp_path / name).write_bytes(mark + text.encode().replace(b"\n", ENDS[end]))
    mesh = read_mesh_file(tmp_path / name)
    np.testing.assert_allclose(mesh.vertices, V)
    np.testing.assert_array_equal(mesh.faces, F)
    # Mitsuba's own readers would drop the first line, or find no line.
    assert mesh.is_readable_by_mitsuba == (not mark and end != "mac")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("mark", [b"", BOM], ids=["plain", "mark"])
def test_binary_rows_may_begin_like_a_line_end(tmp_path, order, mark):
    rows = [(np.frombuffer(b"\n\n\n\n", order + "f4")[0].item(), 0, 0), (1, 0, 0), (0, 1, 0)]
    raw = write_ply_text(order, XYZ, LIST, rows, [((0, 1, 2),)])
    head, _, data = raw.partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(mark + head.replace(b"\n", b"\r") + b"end_header\r" + data)
    np.testing.assert_allclose(read_mesh_file(tmp_path / "a.ply").vertices, rows)


@pytest.mark.parametrize("block", [64, 65, 66, 67])
def test_line_ends_at_the_ends_of_blocks(tmp_path, monkeypatch, block):
    monkeypatch.setattr(meshes, "_BLOCK", block)
    for end in ENDS.values():
        (tmp_path / "a.obj").write_bytes((OBJ + "w 1\n").encode().replace(b"\n", end))
        with pytest.raises(NergError, match=f"line {OBJ.count(chr(10)) + 1} "):
            read_mesh_file(tmp_path / "a.obj")


@pytest.mark.parametrize("name, text", [("a.obj", OBJ), ("a.ply", PLY)])
@pytest.mark.parametrize("encoding", ["utf-16", "utf-32"])
def test_other_encodings_are_named(tmp_path, name, text, encoding):
    (tmp_path / name).write_text(text, encoding=encoding)
    with pytest.raises(NergError, match=encoding.upper()):
        read_mesh_file(tmp_path / name)


@pytest.mark.parametrize(
    "name, text, old, new, cell",
    [
        ("a.obj", OBJ, "v 4 0 0", "v 4,0 0,0 0,0", "4,0"),
        ("a.obj", OBJ, "vt .5 .5", "vt 0,5 0,5", "0,5"),
        ("a.obj", OBJ, "vn 0 0 1", "vn 0 0 1,0", "1,0"),
        ("a.obj", OBJ, "v 4 0 0", "v 4 0 0 0,5 0,5 0,5", "0,5"),
        ("a.obj", OBJ, "v 4 0 0", "v 4.0.0 0", None),
        ("a.obj", OBJ, "v 4 0 0", "v 4.0.0 0 0", "4.0.0"),
        ("a.obj", OBJ, "f 1/1/1", "f 1/x/1", "x"),
        ("a.obj", OBJ, "f 1/1/1", "f 1.0/1/1", "1.0"),
        ("a.ply", PLY, "4.0 0.0 0.0", "4,0 0,0 0,0", "4,0"),
        ("a.ply", PLY, "4.0 0.0 0.0", "4.0.0 0.0 0.0", "4.0.0"),
        ("a.ply", PLY, "4.0 0.0 0.0", "4.0 0.0 zero", "zero"),
    ],
)
@pytest.mark.parametrize("end", ENDS)
def test_cell_without_a_number_is_named_with_its_line(tmp_path, name, text, old, new, cell, end):
    line = text[: text.index(old)].count("\n") + 1
    (tmp_path / name).write_bytes(text.replace(old, new, 1).encode().replace(b"\n", ENDS[end]))
    with pytest.raises(NergError) as error:
        read_mesh_file(tmp_path / name)
    said = str(error.value)
    assert f"line {line}" in said and (cell is None or f'"{cell}"' in said)
    assert ("comma" in said) == ("," in (cell or ""))


@pytest.mark.parametrize(
    "statement", ["V 0 0 0", "vertex 0 0 0", "ve 0 0 0", "\ufeffv 0 0 0", "fo 1 2 3", "\x00v 0 0 0"]
)
def test_unknown_statement_of_an_obj_is_named(tmp_path, statement):
    (tmp_path / "a.obj").write_text(OBJ + statement + "\n", encoding="utf-8")
    with pytest.raises(NergError, match=f"line {OBJ.count(chr(10)) + 1} begins with"):
        read_mesh_file(tmp_path / "a.obj")


def test_statements_without_triangles_are_noted(tmp_path):
    rest = "o a\ng b\ns off\nmtllib a.mtl\nusemtl wood\nl 1 2\np 1\nvp 0 0\n#MRGB ff\n"
    (tmp_path / "a.obj").write_text(rest + OBJ)
    mesh = read_mesh_file(tmp_path / "a.obj")
    assert all(word in "".join(mesh.notes) for word in ("usemtl", "l,", "p,", "vp")) and len(mesh.faces) == len(F)


def test_comment_that_ends_in_a_backslash_ends(tmp_path):
    (tmp_path / "a.obj").write_text("# from C:\\models\\\n" + OBJ)
    np.testing.assert_allclose(read_mesh_file(tmp_path / "a.obj").vertices, V)


@pytest.mark.parametrize(
    "old, new, word",
    [
        ("element face", "faces", "faces"),
        ("property float x", "property float", "property float"),
        ("element vertex 8", "element vertex many", "many"),
        ("ascii 1.0\n", "ascii 1.0\nproperty float w\n", "property float w"),
        ("element vertex 8", "element vertex 7", "numbers"),
        ("4.0 0.0 0.0", "4.0 0.0 0.0 1.0", "row 1 of face"),
    ],
)
def test_header_of_a_ply_that_differs_from_its_rows_is_refused(tmp_path, old, new, word):
    assert old in PLY
    (tmp_path / "a.ply").write_text(PLY.replace(old, new, 1))
    with pytest.raises(NergError, match=word):
        read_mesh_file(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", ["int", "uint", "short", "ushort"])
@pytest.mark.parametrize("values, expected", [((51, 0, 255), (FIFTH, 0, 1)), ((0, 1, 2), (0, *DARK))])
def test_bytes_in_wider_numbers_are_colours_of_8_bits(tmp_path, kind, values, expected):
    tints = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    faces = "3 0 1 2 " + " ".join(map(str, values))
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {a}\n" for a in "xyz")
    rows = "0 0 0\n1 0 0\n0 1 0\n"
    (tmp_path / "a.ply").write_text(f"{head}element face 1\n{LIST}{tints}end_header\n{rows}{faces}\n")
    assert np.allclose(read_mesh_file(tmp_path / "a.ply").face_colors, [expected])


@pytest.mark.parametrize(
    "text, said",
    [
        ("v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "vertex 1 is not finite"),
        ("v 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "vertex 1 has fewer than three coordinates"),
        (QUAD + "f 1 2 9", "beyond its 4 vertices"),
        (QUAD + "f 1 2 99999999999999999999999", "a.obj"),
        (QUAD + "f -9 -2 -1", "beyond its 4 vertices"),
        (QUAD + "f 0 1 2", "indices start at 1"),
        (QUAD + "f 1 2", "fewer than three corners"),
        (QUAD + "f 1/1/1 2/2/1 3/3/1", "texture coordinate 1, but only 0"),
        (QUAD + "vn 0 0 1\nf 1//1 2//2 3//1", "normal 2, but only 1"),
        (QUAD + "f a b c", "a.obj"),
        ("v 1e999 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "not finite"),
        ("", "no vertices"),
    ],
)
def test_invalid_obj_is_refused(tmp_path, text, said):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(NergError, match=said) as error:
        read_mesh_file(tmp_path / "a.obj")
    assert "a.obj" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("allow_points", [False, True])
def test_ply_with_strips_only_is_refused_for_them(tmp_path, allow_points):
    vertices = "element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    strips = "element tristrips 1\nproperty list int int vertex_indices\n"
    head = f"ply\nformat ascii 1.0\n{vertices}{strips}end_header\n"
    (tmp_path / "a.ply").write_text(head + "0 0 0\n1 0 0\n0 1 0\n1 1 0\n5 0 1 2 3 -1\n")
    with pytest.raises(NergError, match="tristrips"):
        read_mesh_file(tmp_path / "a.ply", allow_points)


def test_non_mesh_files_are_refused(tmp_path):
    with pytest.raises(NergError, match=r"ends in \.ply, \.obj"):
        read_mesh_file(tmp_path / "a.stl")
    with pytest.raises(MissingFile, match="there is no mesh"):
        read_mesh_file(tmp_path / "a.glb")


def write_glb_file(path, attributes, document=None, primitive=None, faces=F):
    """Write a file with ``attributes`` and modified JSON values."""
    raw = b"".join(encode_unlit_glb([("POSITION", V.astype("<f4"), False), *attributes], faces, up="y"))
    changed, data = read_glb_chunks(raw, path)
    changed["meshes"][0]["primitives"][0] |= primitive or {}
    path.write_bytes(b"".join(pack_glb({**changed, **(document or {})}, data)))
    return read_mesh_file(path)


@pytest.mark.parametrize("kind, code", [("u2", 5123), ("i2", 5122), ("u1", 5121), ("i1", 5120)])
@pytest.mark.parametrize("normalized", [False, True])
def test_quantised_positions(tmp_path, kind, code, normalized):
    steps = 80
    grid = np.rint(V / 4 * steps).astype(f"<{kind}")
    data = grid.tobytes() + F.astype("<u2").tobytes()
    scale = 4 / steps * (np.iinfo(kind).max if normalized else 1)
    document = {
        "asset": {"version": "2.0"},
        "extensionsRequired": ["KHR_mesh_quantization"],
        "extensionsUsed": ["KHR_mesh_quantization"],
        "nodes": [{"mesh": 0, "scale": [scale] * 3, "rotation": [-(0.5**0.5), 0, 0, 0.5**0.5]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [{"buffer": 0}, {"buffer": 0, "byteOffset": grid.nbytes}],
        "accessors": [
            {"bufferView": 0, "componentType": code, "count": 8, "type": "VEC3", "normalized": normalized},
            {"bufferView": 1, "componentType": 5123, "count": F.size, "type": "SCALAR"},
        ],
    }
    (tmp_path / "a.glb").write_bytes(b"".join(pack_glb(document, data)))
    mesh = read_mesh_file(tmp_path / "a.glb")
    assert np.allclose(mesh.vertices, V, atol=1e-6) and np.array_equal(mesh.faces, F) and not mesh.notes
    del document["extensionsRequired"], document["extensionsUsed"]
    (tmp_path / "a.glb").write_bytes(b"".join(pack_glb(document, data)))
    if not normalized:
        with pytest.raises(NergError, match="unsupported type"):
            read_mesh_file(tmp_path / "a.glb")


def test_colours_and_unused_parts_of_gltf(tmp_path):
    colors = np.full((8, 4), 65535, "<u2")
    colors[:, 1] = 13107
    mesh = write_glb_file(tmp_path / "a.glb", [("COLOR_0", colors, True), ("_MARK", V[:, 0].astype("<f4"), False)])
    assert np.allclose(mesh.colors, (1, 0.2, 1), atol=1e-4)
    assert mesh.notes == ("parts that are not used: materials, _MARK, KHR_materials_unlit",)


@pytest.mark.parametrize(
    "mode, expected", [(5, [[0, 1, 2], [1, 3, 2], [2, 3, 7]]), (6, [[0, 1, 2], [0, 2, 3], [0, 3, 7]])]
)
def test_strips_and_fans(tmp_path, mode, expected):
    indices = np.array([[0, 1, 2, 3, 7]])
    assert write_glb_file(tmp_path / "a.glb", [], primitive={"mode": mode}, faces=indices).faces.tolist() == expected


@pytest.mark.parametrize(
    "document",
    [
        {"extensionsRequired": ["EXT_meshopt_compression"]},
        {"extensionsRequired": ["KHR_draco_mesh_compression"]},
        {"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]},
    ],
)
def test_extensions_that_move_triangles_are_refused(tmp_path, document):
    with pytest.raises(NergError, match="a.glb.*(EXT|KHR)_.*export it without"):
        write_glb_file(tmp_path / "a.glb", [], document)


@pytest.mark.parametrize("offset", [(500_000, 5_600_000, 0), (4_027_000, 307_000, 4_919_000), (0, 0, -30_000)])
def test_survey_coordinates_are_refused(tmp_path, offset):
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in V + offset)
    (tmp_path / "a.obj").write_text(rows + "f 1 2 3\n")
    with pytest.raises(
        NergError, match="a.obj.*single precision has steps of .*; subtract ([-0-9]+),([-0-9]+),([-0-9]+)"
    ) as error:
        read_mesh_file(tmp_path / "a.obj")
    named = [float(v) for v in str(error.value).split("subtract ")[1].split(" ")[0].split(",")]
    assert np.abs(np.array(named) - offset).max() <= 60


@pytest.mark.parametrize("scale, offset", [(1e-4, 0), (1e6, 0), (1000, 20_000), (1, 15_000)])
def test_other_units_are_read(tmp_path, scale, offset):
    rows = "".join(f"v {x} {y} {z}\n" for x, y, z in scale * V + offset)
    (tmp_path / "a.obj").write_text(rows + "f 1 2 3\n")
    assert np.allclose(read_mesh_file(tmp_path / "a.obj").vertices, scale * V + offset)


def test_a_line_of_gigabytes_is_refused_in_bounded_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(meshes, "_BLOCK", 1 << 20)
    with (tmp_path / "a.obj").open("wb") as out:
        out.truncate(meshes.MAX_TEXT_BYTES)
    tracemalloc.start()
    with pytest.raises(NergError, match="a.obj.* line of more than"):
        read_mesh_file(tmp_path / "a.obj")
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()
    (tmp_path / "a.obj").write_bytes(b"v 0 0 \\\n" * (1 << 18))
    with pytest.raises(NergError, match="a.obj.* line of more than"):
        read_mesh_file(tmp_path / "a.obj")


def test_unused_gltf_data_takes_no_memory(tmp_path):
    corners = [("POSITION", np.eye(3, dtype="<f4"), False)]
    raw, spare = b"".join(encode_unlit_glb(corners, np.array([[0, 1, 2]]))), 512 << 20
    at = 20 + struct.unpack_from("<I", raw, 12)[0]
    length = struct.unpack_from("<I", raw, at)[0]
    with (tmp_path / "a.glb").open("wb") as out:
        out.write(raw[:at] + struct.pack("<I", length + spare) + raw[at + 4 :])
        out.truncate(len(raw) + spare)
    tracemalloc.start()
    assert len(read_mesh_file(tmp_path / "a.glb").faces) == 1
    assert tracemalloc.get_traced_memory()[1] < 16 << 20
    tracemalloc.stop()


# ---- PLY files with custom columns, read by trimesh and Mitsuba ----

TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
TWO_FACES = np.array([[0, 1, 2], [0, 3, 1]])


def test_triangles_with_columns(tmp_path):
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 8, 7]], np.uint8)
    columns = dict(zip("xyz", TETRAHEDRON.T)) | dict(zip(("red", "green", "blue"), colors.T))
    write_columns(tmp_path / "new" / "a.ply", columns, TWO_FACES)
    body = trimesh.load(tmp_path / "new" / "a.ply", process=False)
    assert np.array_equal(body.vertices, TETRAHEDRON) and np.array_equal(body.faces, TWO_FACES)
    assert np.array_equal(body.visual.vertex_colors[:, :3], colors)


def test_points_have_no_faces(tmp_path):
    write_columns(tmp_path / "p.ply", dict(zip("xyz", TETRAHEDRON.T)))
    raw = (tmp_path / "p.ply").read_bytes()
    head, _, data = raw.partition(b"end_header\n")
    assert b"element face" not in head and np.array_equal(np.frombuffer(data, "<f4").reshape(-1, 3), TETRAHEDRON)


def test_columns_of_faces_are_an_attribute_in_mitsuba(rgb, tmp_path):
    tints = np.array([[0.25, 0.5, 0.75], [1, 0, 0.125]])
    of_faces = {f"color_{k}": tints[:, k] for k in range(3)}
    write_columns(tmp_path / "f.ply", dict(zip("xyz", TETRAHEDRON.T)), TWO_FACES, of_faces)
    mesh = rgb.load_dict({"type": "ply", "filename": str(tmp_path / "f.ply")})
    assert np.allclose(np.array(rgb.traverse(mesh)["face_color"]).reshape(-1, 3), tints)


# ---- Binary glTF: other programs read written files, and files of other programs are read within limits ----


def test_trimesh_reads_written_glb(tmp_path):
    colors = np.full((8, 4), 65535, "<u2")
    colors[:, 0] = np.linspace(0, 65535, 8)
    parts = [("POSITION", V.astype("<f4"), False), ("COLOR_0", colors, True), ("_VALUE", V[:, 0].astype("<f4"), False)]
    path = tmp_path / "a.glb"
    path.write_bytes(b"".join(encode_unlit_glb(parts, F, up="y", extras={"unit": "1/m²"})))
    mesh = trimesh.load(path, process=False, force="mesh")
    assert np.allclose(mesh.vertices, V) and np.array_equal(mesh.faces, F)
    assert read_glb_chunks(path.read_bytes(), path)[0]["asset"]["extras"] == {"unit": "1/m²"}
    # Data that must be aligned to four bytes is aligned.
    document, _ = read_glb_chunks(path.read_bytes(), path)
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])


def test_parts_have_the_names_of_nodes_and_objects(tmp_path):
    scene = trimesh.Scene()
    for name, offset in (("book.1", 0), ("book.2", 2), ("door", 4)):
        box = trimesh.creation.box((1, 1, 1))
        scene.add_geometry(box.apply_translation((offset, 0, 0)), node_name=name, geom_name=f"mesh of {name}")
    scene.export(tmp_path / "a.glb")
    mesh = read_mesh_file(tmp_path / "a.glb")
    parts = mesh.split_parts()
    assert parts.keys() == {"book.1", "book.2", "door"}
    assert np.allclose([mesh.vertices[faces, 0].mean() for faces in map(parts.get, sorted(parts))], [0, 2, 4])
    triangle = "v 0 0 {0}\nv 1 0 {0}\nv 0 1 {0}\n"
    text = (
        triangle.format(0)
        + "f -3 -2 -1\n"
        + "".join(
            f"o {name}\n{triangle.format(z)}f -3 -2 -1\n" for z, name in enumerate(("red book", "door", "red book"), 1)
        )
    )
    (tmp_path / "a.obj").write_text(text)
    mesh = read_mesh_file(tmp_path / "a.obj")
    heights = {name: mesh.vertices[faces, 2].mean(axis=1).tolist() for name, faces in mesh.split_parts().items()}
    assert heights == {"mesh": [0], "red book": [1, 3], "door": [2]}
    (tmp_path / "a.ply").write_bytes(trimesh.creation.box().export(file_type="ply"))
    assert read_mesh_file(tmp_path / "a.ply").split_parts().keys() == {"mesh"}


def test_glb_of_trimesh_is_read_with_nodes(tmp_path):
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(1)
    for k in range(2):
        where = trimesh.transformations.rotation_matrix(0.3 + k, (1, 2, 3), (k, 0, 1))
        scene.add_geometry(ball, node_name=str(k), transform=where)
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    read = parse_glb((tmp_path / "a.glb").read_bytes(), tmp_path / "a.glb")
    vertices, faces = read.vertices, read.faces
    expected = trimesh.util.concatenate(scene.dump())
    assert len(faces) == len(expected.faces) == 160
    order = lambda t: t[np.lexsort(np.round(t.reshape(len(t), -1), 4).T)]
    assert np.allclose(order(vertices[faces].mean(1)), order(expected.triangles.mean(1)), atol=1e-5)
    assert np.isclose(trimesh.Trimesh(vertices, faces).volume, expected.volume, rtol=1e-5)


@pytest.mark.parametrize(
    "values, said",
    [
        ({"nodes": [{"children": [0]}]}, "nested too deep"),
        ({"nodes": [{}]}, "no triangles"),
        (
            {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 10**12, "type": "VEC3"}] * 2},
            "is truncated",
        ),
        (
            {"accessors": [{"bufferView": 0, "componentType": 5126, "count": -1, "type": "VEC3"}] * 2},
            r"accessors\[0\].count",
        ),
        ({"bufferViews": []}, "refers to number 0 of 0 bufferViews"),
        ({"nodes": [{"mesh": 0, "scale": [1, 1, "nan"]}]}, r"nodes\[0\].scale\[2\]"),
        ({"nodes": [{"mesh": 0, "matrix": [1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}]}, "last row"),
        ({"nodes": [{"mesh": 0, "rotation": [0, 0, 0, 0]}]}, "length 1"),
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
def test_damaged_glb_is_refused(tmp_path, values, said):
    with pytest.raises(NergError, match=said):
        write_glb_file(tmp_path / "a.glb", [], values)


def test_mirrored_nodes_flip_triangles(tmp_path):
    read = write_glb_file(tmp_path / "a.glb", [], {"nodes": [{"mesh": 0, "scale": [-1, 1, 1]}]})
    plain = trimesh.Trimesh(V, F).volume
    assert np.isclose(trimesh.Trimesh(read.vertices, read.faces).volume, plain)


@pytest.mark.parametrize("cut", [3, 15, 40, 300])
def test_truncated_glb_is_refused(tmp_path, cut):
    write_glb_file(tmp_path / "a.glb", [])
    content = (tmp_path / "a.glb").read_bytes()
    (tmp_path / "b.glb").write_bytes(content[: min(cut, len(content) - 5)])
    with pytest.raises(NergError, match="cannot be read"):
        read_mesh_file(tmp_path / "b.glb")


_SIZES = {5121: 1, 5123: 2, 5125: 4, 5126: 4}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@pytest.mark.parametrize("image", [None, b"\x89PNG\r\n\x1a\n odd"])
@pytest.mark.parametrize("faces", [F, None])
def test_written_glb_follows_specification(image, faces):
    """Sections 3.6 and 4.4 of glTF 2.0: lengths, alignment, bounds and types."""
    parts = [("POSITION", V.astype("<f4"), False), ("NORMAL", V.astype("<f4"), False)]
    parts += [("TEXCOORD_0", V[:, :2].astype("<f4"), False), ("COLOR_0", np.full((8, 4), 9, "<u2"), True)]
    raw = b"".join(encode_unlit_glb([*parts, ("_VALUE", V[:, 0].astype("<f4"), False)], faces, image=image))
    assert struct.unpack_from("<III", raw) == (0x46546C67, 2, len(raw))
    length, kind = struct.unpack_from("<II", raw, 12)
    rest, binary = struct.unpack_from("<II", raw, 20 + length)
    assert (kind, binary) == (0x4E4F534A, 0x004E4942) and length % 4 == rest % 4 == 0
    assert len(raw) == 28 + length + rest
    document, data = read_glb_chunks(raw, "a.glb")
    # The chunk has the length of the buffer, padded to four bytes.
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
        # Vertex attributes are aligned to four bytes; integer colours are normalised.
        assert name == "indices" or step % 4 == 0
        assert accessor.get("normalized", False) == (name == "COLOR_0")
        if name == "POSITION":
            assert np.array_equal(accessor["min"], V.min(0)) and np.array_equal(accessor["max"], V.max(0))
    assert primitive["mode"] == (0 if faces is None else 4)
    used = {name for m in document["materials"] for name in m.get("extensions", {})}
    assert used == set(document["extensionsUsed"]) and document["asset"]["version"] == "2.0"
    assert all(document["images"][t["source"]]["mimeType"] == "image/png" for t in document.get("textures", []))


# ---- Normals for shading ----


def test_shading_normals_keep_creases_and_smooth_the_rest(tmp_path):
    box_mesh = trimesh.creation.box((4, 3, 2.5))
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.concatenate([box_mesh.vertices, ball.vertices + (9, 0, 0)])
    faces = np.concatenate([box_mesh.faces, ball.faces + len(box_mesh.vertices)])
    colors = np.random.default_rng(0).random((len(vertices), 3))
    mesh = meshes.MeshFile(vertices, faces, np.arange(len(faces)), colors=colors)
    shaded = meshes.with_shading_normals(mesh)
    # The surface and its colours are unchanged; each face of the box has four vertices of its own.
    assert np.array_equal(shaded.vertices[shaded.faces], vertices[faces])
    assert np.array_equal(shaded.colors[shaded.faces], colors[faces])
    assert len(shaded.vertices) == 24 + len(ball.vertices)
    normals = shaded.normals[shaded.faces]
    assert np.allclose(normals[:12], box_mesh.face_normals[:, None], atol=1e-12)
    assert np.allclose(normals[12:], ball.vertices[ball.faces], atol=0.02)
    assert meshes.with_shading_normals(shaded) is shaded


def test_unwelded_faces_are_smoothed_across_duplicate_vertices():
    ball = trimesh.creation.icosphere(subdivisions=3)
    soup = meshes.MeshFile(
        ball.vertices[ball.faces].reshape(-1, 3), np.arange(ball.faces.size).reshape(-1, 3), np.arange(len(ball.faces))
    )
    shaded = meshes.with_shading_normals(soup)
    assert np.allclose(shaded.normals, shaded.vertices, atol=0.02)
