"""Scene files and what they name: meshes and grid volumes, which Mitsuba reads once they have been looked at."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from tests.fuzz.describe import Reader

_SCENE = """<scene version="3.0.0">
    <default name="side" value="8"/>
    <integrator type="nerg">
        <volume name="density" type="gridvolume">
            <string name="filename" value="fog.vol"/>
        </volume>
        <string name="aovs" value="depth,opacity"/>
    </integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, -4" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$side"/><integer name="height" value="4"/></film>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
    </sensor>
    <shape type="ply"><string name="filename" value="binary.ply"/></shape>
    <shape type="ply"><string name="filename" value="text.ply"/></shape>
    <shape type="obj"><string name="filename" value="a.obj"/></shape>
</scene>
"""
_PLY = """\
ply
format {} 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""
_CORNERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def _make(folder: Path) -> None:
    (folder / "scene.xml").write_text(_SCENE)
    triangle = np.array(_CORNERS, "<f4").tobytes() + struct.pack("<Biii", 3, 0, 1, 2)
    (folder / "binary.ply").write_bytes(_PLY.format("binary_little_endian").encode() + triangle)
    (folder / "text.ply").write_text(_PLY.format("ascii") + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    (folder / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    head = struct.pack("<3sBiiiii6f", b"VOL", 3, 1, 3, 2, 2, 1, 0, 0, 0, 1, 1, 1)
    (folder / "fog.vol").write_bytes(head + np.ones(12, "<f4").tobytes())


def _read(folder: Path) -> object:
    import mitsuba as mi

    import nerg_mi  # noqa: F401
    from nerg_mi.rendering.scene import load_scene

    if mi.variant() != "llvm_ad_rgb":
        mi.set_variant("llvm_ad_rgb")
    scene = load_scene(folder / "scene.xml")
    return [shape.bbox() for shape in scene.shapes()]


def _nest(folder: Path) -> object:
    from nerg_mi.rendering.nested_scene import nested_place
    from nerg_mi.rendering.scene_writer import Eye, GazeFiles, SceneText

    place = nested_place(folder / "theirs.xml", folder / "ours")
    camera = Eye(np.zeros(3), np.ones(3))
    return SceneText(place, GazeFiles(), camera, None, np.array([0.0, 0, 1])).xml()


def _make_nested(folder: Path) -> None:
    _make(folder)
    integrator = '<integrator type="$kind" id="light"><integer name="max_depth" value="3"/></integrator>'
    path = '<default name="kind" value="path"/><path value="."/><include filename="more.xml"/>'
    theirs = _SCENE.replace(_SCENE[_SCENE.index("    <integrator") : _SCENE.index("    <sensor")], integrator + path)
    (folder / "theirs.xml").write_text(theirs)
    (folder / "more.xml").write_text('<scene version="3.0.0"><!-- more --><shape type="cube"/></scene>')


def _make_frames(folder: Path) -> None:
    (folder / "walk.frames.csv").write_text('eye,ahead,falloff\n"1, 2, 3","4, 5, 6",0.1\n"1,2,3","""a"" b",\n')


def _make_regions(folder: Path) -> None:
    first, second = (
        '{"name": "a", "min": [0, 0, 0], "max": [1, 1, 1]}',
        '{"name": "b", "min": [0, 1, 2], "max": [3, 4, 5]}',
    )
    text = f'{{"regions": [{first}, {second}]}}'
    (folder / "areas.json").write_text(text)


def _read_regions(folder: Path) -> object:
    from nerg_mi.formats.areas import read_regions

    return read_regions(folder / "areas.json")


def _read_frames(folder: Path) -> object:
    from nerg_mi.rendering.files import read_frames

    return read_frames(folder / "walk.frames.csv")


def _make_glb(folder: Path) -> None:
    from nerg_mi.formats.gltf import shown_unlit

    corners = [("POSITION", np.array(_CORNERS, "<f4"), False)]
    whole = b"".join(shown_unlit(corners, np.array([[0, 1, 2]])))
    (folder / "a.glb").write_bytes(whole)
    # Its document by itself, of which damage may keep the structure.
    (folder / "document.json").write_bytes(whole[20 : 20 + struct.unpack_from("<I", whole, 12)[0]])


def _read_glb(folder: Path) -> object:
    from nerg_mi.files.safe_read import JSON_BYTES, read_bytes
    from nerg_mi.formats.gltf import parse_glb
    from nerg_mi.formats.meshes import read_mesh_file

    text = read_bytes(folder / "document.json", "document", JSON_BYTES)
    data = np.array(_CORNERS, "<f4").tobytes() + np.array([0, 1, 2], "<u4").tobytes()
    head = struct.pack("<IIIII", 0x46546C67, 2, 28 + len(text) + len(data), len(text), 0x4E4F534A)
    made = head + text + struct.pack("<II", len(data), 0x004E4942) + data
    return parse_glb(made, folder / "b.glb"), read_mesh_file(folder / "a.glb")


def _make_path(folder: Path) -> None:
    (folder / "walk.csv").write_text("x,y,z,weight\n1,2,1.6,0.5\n2,2,1.6,1\n")


def _read_path(folder: Path) -> object:
    from nerg_mi.workflows.bake_chunks import read_path

    return read_path(folder / "walk.csv")


def _reader(name: str, *kinds: str) -> Reader:
    return Reader(f"scene's {name}", _make, {name: kinds}, _read)


SCENES = [
    _reader("scene.xml", "text"),
    _reader("binary.ply"),
    _reader("text.ply", "text"),
    _reader("a.obj", "text"),
    _reader("fog.vol"),
    Reader("scene to be nested", _make_nested, {"theirs.xml": ("text",), "more.xml": ("text",)}, _nest),
    Reader("areas of interest", _make_regions, {"areas.json": ("json",)}, _read_regions),
    Reader("mesh of glTF", _make_glb, {"a.glb": (), "document.json": ("json",)}, _read_glb),
    Reader("path of observers", _make_path, {"walk.csv": ("text",)}, _read_path),
    Reader("frames of a sequence", _make_frames, {"walk.frames.csv": ("text",)}, _read_frames),
]
