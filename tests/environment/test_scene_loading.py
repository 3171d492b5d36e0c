"""Tests of `nerg_mi.environment.scene_loading`."""

from __future__ import annotations

import struct
import subprocess
import sys

import pytest

from nerg_mi import llvm
from nerg_mi.environment.scene_loading import (
    MAX_DEPTH,
    activate_mitsuba,
    activate_variant,
    check_scene_file,
    get_array_module,
    load_scene,
)
from nerg_mi.errors import NergError, UnusableLLVM
from nerg_mi.figures.frames import find_sensor

# ---- Variants and loading ----


def test_default_variant_is_set():
    code = "import nerg_mi as nerg, mitsuba as mi; nerg.Scene; print(mi.variant()); "
    code += "from nerg_mi.environment.scene_loading import activate_mitsuba; print(activate_mitsuba().variant())"
    before, after = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert before == "None" and after in ("cuda_ad_rgb", "llvm_ad_rgb")


def test_active_variant_is_kept(mono):
    assert activate_mitsuba() is mono and mono.variant() == "llvm_ad_mono"
    assert get_array_module().__name__ == "drjit.llvm.ad"
    assert mono.variant() == "llvm_ad_mono"


def test_scalar_variants_are_refused(rgb):
    rgb.set_variant("scalar_rgb")
    with pytest.raises(NergError, match='"scalar_rgb".*mi.set_variant'):
        activate_mitsuba()


def test_best_variant_is_activated(rgb, monkeypatch):
    tried = []
    monkeypatch.setattr(rgb, "set_variant", tried.append)
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    assert activate_variant() == "cuda_ad_rgb" and activate_variant("llvm_ad_mono") == "llvm_ad_mono"
    monkeypatch.setattr(llvm, "has_cuda", lambda: False)
    assert activate_variant() == "llvm_ad_rgb" and tried == ["cuda_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"]


def test_failing_backend_falls_back(rgb, monkeypatch):
    def only_llvm(name):
        if name.startswith("cuda"):
            raise ImportError("no device")

    monkeypatch.setattr(rgb, "set_variant", only_llvm)
    monkeypatch.setattr(llvm, "has_cuda", lambda: True)
    assert activate_variant() == "llvm_ad_rgb"
    with pytest.raises(NergError, match='"cuda_ad_rgb"'):
        activate_variant("cuda_ad_rgb")


def test_unusable_libllvm_is_reported(rgb, monkeypatch):
    def refuse(name):
        raise UnusableLLVM("LLVM 15 cannot")

    monkeypatch.setattr(rgb, "set_variant", refuse)
    with pytest.raises(UnusableLLVM):
        activate_variant()


def test_values_for_defaults(rgb, tmp_path):
    (tmp_path / "s.xml").write_text(
        '<scene version="3.0.0"><default name="wide" value="6"/><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="$wide"/></film></sensor></scene>'
    )
    width = lambda scene: scene.sensors()[0].film().size()[0]
    assert width(load_scene(tmp_path / "s.xml")) == 6 and width(load_scene(tmp_path / "s.xml", {"wide": "9"})) == 9
    with pytest.raises(NergError, match=r'does not use "\$tall"'):
        load_scene(tmp_path / "s.xml", {"tall": "2"})


_OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 9 9 9\nf 1 2 3\nf 1 3 4\n"
_DAMAGED_OBJ = {
    "mark": (b"\xef\xbb\xbf" + _OBJ.encode(), "byte order mark"),
    "mac": (_OBJ.replace("\n", "\r").encode(), "CR"),
    "comma": (_OBJ.replace("v 1 1 0", "v 1,0 1,0 0,0").encode(), "line 3"),
    "statement": (_OBJ.replace("v 1 1", "vv 1 1").encode(), "vv"),
    "utf-16": (_OBJ.encode("utf-16"), "UTF-16"),
}


@pytest.mark.parametrize("kind", _DAMAGED_OBJ)
@pytest.mark.parametrize("form", ["file", "include", "default", "dict", "nested dict"])
def test_mitsuba_does_not_open_an_obj_that_it_would_misread(rgb, tmp_path, kind, form):
    content, said = _DAMAGED_OBJ[kind]
    (tmp_path / "a.obj").write_bytes(content)
    shape = '<shape type="obj"><string name="filename" value="a.obj"/></shape>'
    if form == "include":
        (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">{shape}</scene>')
        shape = '<include filename="part.xml"/>'
    if form == "default":
        shape = '<default name="kind" value="obj"/>' + shape.replace('"obj"', '"$kind"')
    (tmp_path / "s.xml").write_bytes(f'\ufeff<scene version="3.0.0">{shape}</scene>'.encode())
    with pytest.raises(NergError, match=rf"a\.obj.*{said}"):
        if "dict" in form:
            from nerg_mi.environment.contents import load_content

            child = {"type": "obj", "filename": str(tmp_path / "a.obj")}
            group = {"type": "shapegroup", "a": child}
            load_content({"type": "scene", "a": child if form == "dict" else group})
        else:
            load_scene(tmp_path / "s.xml")


@pytest.mark.parametrize("name", ["path", "parallel", "optimize"])
def test_reserved_names_are_refused(rgb, tmp_path, name):
    file = tmp_path / "scene.xml"
    file.write_text(f'<scene version="3.0.0"><default name="{name}" value="1"/></scene>')
    with pytest.raises(NergError, match=f'"{name}" is reserved by Mitsuba.*scene.xml"'):
        load_scene(file, {name: "2"})


def test_missing_scene_is_reported(tmp_path):
    with pytest.raises(NergError, match="there is no scene file"):
        load_scene(tmp_path / "s.xml")


SCENE = '<scene version="3.0.0">{}</scene>'
SCALED = '<shape type="{}"><transform name="to_world"><scale value="{}"/></transform></shape>'


@pytest.mark.parametrize(
    "inside, said",
    [
        *[(f'<shape type="sphere"><float name="radius" value="{r}"/></shape>', "Sphere") for r in ("nan", "inf", 1e38)],
        *[(SCALED.format("cube", scale), "Mesh|Cube") for scale in ("nan", 1.1e7, -1e200)],
        (SCALED.format("disk", "inf"), "corners of the Disk"),
        (SCALED.format("cube", 1) + SCALED.format("cube", 1e9), "corners"),  # merged by Mitsuba
        (
            '<sensor type="perspective"><transform name="to_world"><translate x="1e30"/></transform></sensor>',
            "the to_world of sensor 0",
        ),
    ],
)
def test_too_distant_shapes_and_sensors_are_refused(rgb, tmp_path, inside, said):
    (tmp_path / "s.xml").write_text(SCENE.format(inside))
    with pytest.raises(NergError, match=f"({said}).* must have coordinates from"):
        load_scene(tmp_path / "s.xml")


def test_largest_shapes_are_accepted(rgb, tmp_path):
    (tmp_path / "s.xml").write_text(SCENE.format(SCALED.format("cube", 9.9e6) + SCALED.format("sphere", 1e-6)))
    assert len(load_scene(tmp_path / "s.xml").shapes()) == 2


def test_missing_integrator_is_refused(rgb, tmp_path):
    (tmp_path / "s.xml").write_text(SCENE.format('<sensor type="perspective"/>'))
    with pytest.raises(NergError, match="s.xml"):
        find_sensor(tmp_path / "s.xml", load_scene(tmp_path / "s.xml"), 0)


# ---- Checks of scene files, for each entry point ----

SENSOR = """<sensor type="perspective"><sampler type="{sampler}"><integer name="sample_count" value="{spp}"/></sampler>
<film type="hdrfilm"><integer name="width" value="{width}"/><integer name="height" value="{height}"/></film></sensor>"""


def scene(*elements: str, sampler="independent", spp="1", width="8", height="8") -> str:
    sensor = SENSOR.format(sampler=sampler, spp=spp, width=width, height=height)
    content = "".join(elements) + sensor
    return f'<scene version="3.0.0"><integrator type="direct"/><emitter type="constant"/>{content}</scene>'


def shape(kind: str, file: str) -> str:
    return f'<shape type="{kind}"><string name="filename" value="{file}"/></shape>'


def mesh(corner: int) -> bytes:
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    )
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    return head.encode() + struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + b"\x03" + struct.pack("<3i", 0, 1, corner)


EMPTY_VOLUME = b"VOL\x03" + struct.pack("<5i6f", 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1)
GRID = """<shape type="cube"><medium name="interior" type="heterogeneous"><volume name="sigma_t" type="gridvolume">
<string name="filename" value="a.vol"/></volume></medium></shape>"""
DEEP = '<shape type="cube">' * 20000 + "</shape>" * 20000


# Scenes that crash the process without the checks.
CRASHING = {
    "deep": (scene(DEEP), {}, f"more than {MAX_DEPTH} levels deep"),
    "corner": (scene(shape("ply", "a.ply")), {"a.ply": mesh(999999999)}, "its 3 vertices"),
    "volume": (scene(GRID), {"a.vol": EMPTY_VOLUME}, "0 x 0 x 0 voxels"),
    "samples": (scene(spp="0"), {}, "must lie in 1 .. 16777216, got 0"),
    "multijitter": (scene(sampler="multijitter", spp="0"), {}, "must lie in 1 .. 16777216, got 0"),
    "film": (scene(width="2000000000", height="2000000000"), {}, "pixels"),
    "long film": (scene(width="2000000000", height="1"), {}, "pixels"),
}


def written(folder, name):
    """Write a crashing scene and return its file and the expected message."""
    text, files, said = CRASHING[name]
    (folder / "s.xml").write_text(text)
    for file, data in files.items():
        (folder / file).write_bytes(data)
    return folder / "s.xml", said


@pytest.mark.parametrize("name", [name for name in CRASHING if "film" not in name])
def test_crashing_scenes_are_refused_before_loading(tmp_path, name):
    path, said = written(tmp_path, name)
    with pytest.raises(NergError, match=said):
        check_scene_file(path)


@pytest.mark.parametrize("name", ["corner", "film", "long film"])
def test_command_reports_one_line(tmp_path, name):
    path, said = written(tmp_path, name)
    main = [sys.executable, "-c", "from nerg_mi.cli import main; main()"]
    run = [*main, "render", path.name, "-o", "a.exr", "-m", "llvm_ad_rgb"]
    done = subprocess.run(run, cwd=tmp_path, capture_output=True, text=True, timeout=180)
    assert done.returncode == 1, done.stderr[-500:]
    # A slow machine also shows the progress.
    lines = [line for line in done.stderr.strip().splitlines() if not line.lstrip().startswith("0%")]
    assert len(lines) == 1 and said in lines[0]
    assert not (tmp_path / "a.exr").exists()


def refused(tmp_path, text, said, **defaults):
    (tmp_path / "s.xml").write_text(text)
    with pytest.raises(NergError, match=said) as error:
        load_scene(tmp_path / "s.xml", defaults)
    assert "\n" not in str(error.value)


def test_exponential_defaults_are_refused(tmp_path):
    grown = "".join(f'<default name="{b}" value="{f"${a}" * 100}"/>' for a, b in zip("abcdef", "bcdefg"))
    (tmp_path / "s.xml").write_text(scene(f'<default name="a" value="{"x" * 1000}"/>{grown}'))
    with pytest.raises(NergError, match="more than 256 MB of XML"):
        check_scene_file(tmp_path / "s.xml")


def test_valid_scenes_load(rgb, tmp_path):
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "part.xml").write_text('<scene version="3.0.0"><shape type="cube"/></scene>')
    (tmp_path / "a.ply").write_bytes(mesh(2))
    text = scene(
        '<default name="part" value="more/part.xml"/><include filename="$part"/>', shape("ply", "$mesh"), spp="$n"
    )
    (tmp_path / "s.xml").write_text(text.replace("<integrator", '<default name="n" value="3"/><integrator', 1))
    loaded = load_scene(tmp_path / "s.xml", {"mesh": "a.ply"})
    assert len(loaded.shapes()) == 2 and loaded.sensors()[0].sampler().sample_count() == 3


def test_given_values_replace_defaults(tmp_path):
    text = scene(spp="$spp").replace("<integrator", '<default name="spp" value="4"/><integrator', 1)
    refused(tmp_path, text, "must lie in 1 .. 16777216, got 0", spp="0")
    refused(tmp_path, text, "got -3", spp="-3")
    (tmp_path / "s.xml").write_text(text)
    check_scene_file(tmp_path / "s.xml", {})
    assert load_scene(tmp_path / "s.xml", {"spp": 2}).sensors()[0].sampler().sample_count() == 2


def test_entities_are_not_expanded(tmp_path):
    levels = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 12))
    refused(
        tmp_path,
        f'<!DOCTYPE scene [<!ENTITY e0 "lol">{levels}]><scene version="3.0.0" id="&e11;"/>',
        "declares an entity",
    )


def test_includes_are_followed(tmp_path):
    refused(tmp_path, scene('<include filename="s.xml"/>'), "includes itself")
    (tmp_path / "b.xml").write_text(f'<scene version="3.0.0">{DEEP}</scene>')
    refused(tmp_path, scene('<include filename="b.xml"/>'), 'b.xml" .line 1. nests')
    for k in range(40):
        (tmp_path / f"i{k}.xml").write_text(f'<scene version="3.0.0"><include filename="i{k + 1}.xml"/></scene>')
    refused(tmp_path, scene('<include filename="i0.xml"/>'), "includes deep")


@pytest.mark.parametrize(
    "text, said", [("<scene", "well-formed"), ("", "well-formed"), ("<scene></shape>", "well-formed")]
)
def test_invalid_xml_is_refused(tmp_path, text, said):
    refused(tmp_path, text, said)


@pytest.mark.parametrize(
    "numbers, said",
    [("1 0 0 0 0 1 0 0 0 0 1 0 3 1 2 1", "transposed"), ("1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,2", "last row")],
)
def test_a_matrix_has_the_last_row_of_a_transform(tmp_path, numbers, said):
    matrix = '<shape type="cube"><transform name="to_world"><matrix value="{}"/></transform></shape>'
    refused(tmp_path, scene(matrix.format(numbers)), said)
    (tmp_path / "a.xml").write_text(scene(matrix.format("2 1 0 5 0 3 0 6 0 0 -1 7 0 0 0 1")))
    check_scene_file(tmp_path / "a.xml")


def test_too_many_elements(tmp_path, monkeypatch):
    monkeypatch.setattr("nerg_mi.environment.scene_loading.MAX_ELEMENTS", 100)
    refused(tmp_path, scene('<shape type="cube"/>' * 101), "more than 100 elements")


HUGE = {
    "a.png": b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", 100000, 100000, 1, 0, 0, 0, 0),
    "a.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n",
    "a.pfm": b"PF\n100000 100000\n-1.0\n",
    "a.bmp": b"BM" + struct.pack("<IHHIIiiHH", 94, 0, 0, 54, 40, 100000, 100000, 1, 24),
}


@pytest.mark.parametrize("name", HUGE)
def test_textures_are_checked(tmp_path, name):
    (tmp_path / name).write_bytes(HUGE[name] + bytes(40))
    texture = f'<texture name="reflectance" type="bitmap"><string name="filename" value="{name}"/></texture>'
    refused(tmp_path, scene(f'<shape type="cube"><bsdf type="diffuse">{texture}</bsdf></shape>'), "100,000 x 100,000")


def test_other_entry_points_are_checked(standins, tmp_path):
    from nerg_mi.cli.demo import make_demo
    from nerg_mi.environment.environment import Environment
    from nerg_mi.evaluation import study_subject

    (tmp_path / "s.xml").write_text(scene(DEEP))
    with pytest.raises(NergError, match="deep"):
        Environment.open(tmp_path / "s.xml")
    with pytest.raises(NergError, match="there is no file"):
        Environment.open(tmp_path / "missing.xml")
    with pytest.raises(NergError, match="deep"):
        study_subject.load_subject(tmp_path / "s.xml", 8, 8, {})
    with pytest.raises(NergError, match="deep"):
        make_demo(tmp_path / "out", scene=tmp_path / "s.xml", defaults=standins)


ROW = "0 0 0 {0}\n1 0 0 {0}\n0 1 0 {0}\n3 0 1 2\n"
PROPERTIES = "".join(f"property float {name}\n" for name in "xyz")
TINT = """<shape type="ply"><string name="filename" value="a.ply"/><bsdf type="diffuse"><texture name="reflectance"
type="mesh_attribute"><string name="name" value="vertex_color"/></texture></bsdf></shape>"""


@pytest.mark.parametrize(
    "columns, value, shown, said",
    [
        ("red green blue alpha", "9 9 9 9", TINT, "alpha"),
        ("red green blue alpha", "9 9 9 9", shape("ply", "a.ply"), None),
        ("red green blue", "9 9 9", TINT, None),
        ("nx ny nz", "0 0 0", shape("ply", "a.ply"), "normals are 0"),
        ("nx ny nz", "0 0 1", shape("ply", "a.ply"), None),
    ],
)
def test_meshes_with_unread_colors_are_refused(tmp_path, columns, value, shown, said):
    kind = "float" if columns.startswith("n") else "uchar"
    extra = "".join(f"property {kind} {name}\n" for name in columns.split())
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{PROPERTIES}{extra}element face 1\n"
    (tmp_path / "a.ply").write_text(f"{head}property list uchar int vertex_indices\nend_header\n{ROW.format(value)}")
    (tmp_path / "a.xml").write_text(scene(shown))
    if said is None:
        check_scene_file(tmp_path / "a.xml")
        return
    with pytest.raises(NergError, match=f"a.ply.*{said}.*nerg scene"):
        check_scene_file(tmp_path / "a.xml")
