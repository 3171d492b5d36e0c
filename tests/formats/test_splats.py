"""Tests of `nerg_mi.formats.splats`."""

import gzip
import json
import struct
import tracemalloc
import zipfile
from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.kinds import detect_kind
from nerg_mi.errors import MissingFile, NergError
from nerg_mi.fields.splats import Splats
from nerg_mi.formats import ply as ply_tables
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.gltf import encode_unlit_glb, pack_glb, read_glb_chunks
from nerg_mi.formats.ply import parse_ply, write_columns
from nerg_mi.formats.splats import (
    READERS,
    choose_plugin,
    is_splat_file,
    make_splats,
    read_gltf_splats,
    read_ply_splats,
    read_splat,
    read_splats,
    read_spz,
    refuse_unsupported_splats,
    write_ply_splats,
)
from nerg_mi.maths.sphere import SH_C0
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import trace_depth
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium
from tests.conftest import ROOT
from tests.formats.splats.writers import (
    random_splats,
    write_antimatter,
    write_inria,
    write_khronos,
    write_sog,
    write_spz,
)
from tests.fuzz.mutations import iter_damaged_documents
from tests.fuzz.watch import PYTHON_WORDS

# ---- .splat ----


def test_splat_file_is_decoded_exactly(tmp_path):
    splats = random_splats(degree=1)
    write_antimatter(tmp_path / "a.splat", splats)
    read = read_splat(tmp_path / "a.splat")
    assert read.degree == 0
    assert np.array_equal(read.centers, splats.centers) and np.array_equal(read.scales, splats.scales)
    assert np.abs(read.opacities - splats.opacities).max() < 1 / 255
    seen = np.clip(0.5 + SH_C0 * splats.harmonics[:, 0], 0, 1)
    assert np.abs(0.5 + SH_C0 * read.harmonics[:, 0] - seen).max() < 1 / 255
    # A rotation determines its quaternion up to the sign.
    assert np.abs(np.abs((read.rotations * splats.rotations).sum(axis=1)) - 1).max() < 1e-3


def test_invalid_splat_file_is_refused(tmp_path):
    (tmp_path / "a.splat").write_bytes(b"x" * 33)
    with pytest.raises(NergError, match=r"a\.splat.*multiple of 32"):
        read_splat(tmp_path / "a.splat")
    (tmp_path / "a.splat").write_bytes(b"")
    with pytest.raises(NergError, match="no Gaussians"):
        read_splat(tmp_path / "a.splat")


def test_memory_is_a_small_multiple_of_the_file(tmp_path):
    rows = np.ones((1 << 19, 32), np.uint8)
    rows[:, :24] = np.full(6, 0.5, "<f4").view(np.uint8)
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    tracemalloc.start()
    assert len(read_splat(tmp_path / "a.splat")) == len(rows)
    assert tracemalloc.get_traced_memory()[1] < 2.7 * rows.nbytes
    tracemalloc.stop()


# ---- Files ----

WRITERS = {".ply": write_inria, ".splat": write_antimatter, ".spz": write_spz, ".sog": write_sog, ".glb": write_khronos}


def test_suffix_selects_format(tmp_path):
    assert set(WRITERS) == set(READERS)
    for suffix, write in WRITERS.items():
        write(tmp_path / f"a{suffix.upper()}", random_splats(7, degree=0))
        assert len(read_splats(tmp_path / f"a{suffix.upper()}")) == 7


def test_unsupported_formats_name_converter(tmp_path):
    with pytest.raises(NergError, match=r"splat-transform.*out\.ply"):
        read_splats(tmp_path / "a.ksplat")
    with pytest.raises(NergError, match=r"supported formats: \.ply"):
        read_splats(tmp_path / "a.txt")


def test_unsupported_splats_are_refused_by_all_commands(tmp_path):
    (tmp_path / "a.ksplat").write_bytes(b"PK")
    for commands in (refuse_unsupported_splats, detect_kind, Environment.open):
        with pytest.raises(NergError, match=r'splat-transform "a\.ksplat" out\.ply'):
            commands(tmp_path / "a.ksplat")
    refuse_unsupported_splats(tmp_path / "a.obj")
    assert choose_plugin(tmp_path / "a.splat") == "splats" and choose_plugin("a.safetensors") == "nerf"


def test_mesh_is_recognized_by_header(tmp_path):
    write_inria(tmp_path / "a.ply", random_splats(3))
    assert is_splat_file(tmp_path / "a.ply") and is_splat_file("b.spz") and not is_splat_file("b.obj")
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    assert not is_splat_file(tmp_path / "a.ply")
    shaped = ("x", "y", "z", "opacity", "scale_0", "rot_0", "red")
    write_columns(tmp_path / "shaped.ply", {name: np.zeros(3) for name in shaped})
    assert is_splat_file(tmp_path / "shaped.ply")
    write_khronos(tmp_path / "a.glb", random_splats(3))
    (tmp_path / "b.glb").write_bytes(b"".join(encode_unlit_glb([("POSITION", np.eye(3, dtype="<f4"), False)], None)))
    assert is_splat_file(tmp_path / "a.glb") and not is_splat_file(tmp_path / "b.glb")


def test_missing_files(tmp_path):
    for suffix in READERS:
        with pytest.raises(MissingFile, match="correct its name"):
            read_splats(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".glb"])
def test_reader_errors_name_file(tmp_path, suffix):
    splats = random_splats(degree=0)
    splats.centers[3] = np.nan
    WRITERS[suffix](tmp_path / f"a{suffix}", splats)
    with pytest.raises(NergError, match=rf"a\{suffix}.*centers.*not finite"):
        read_splats(tmp_path / f"a{suffix}")


# ---- Ply ----

NAMES = ("centers", "scales", "rotations", "opacities", "harmonics")


def assert_equal(a: Splats, b: Splats, tolerance: float = 2e-6) -> bool:
    return all(np.allclose(getattr(a, n), getattr(b, n), rtol=tolerance, atol=tolerance) for n in NAMES)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("style", ["binary_little_endian", "ascii"])
def test_ply_of_3dgs_is_read(tmp_path, degree, style):
    splats = random_splats(degree=degree)
    write_inria(tmp_path / "a.ply", splats, style)
    read = read_ply_splats(tmp_path / "a.ply")
    assert assert_equal(read, splats) and not read.extra


def test_columns_are_read_by_name_and_others_preserved(tmp_path):
    splats = random_splats()
    write_inria(tmp_path / "a.ply", splats, shuffled=True)
    read = read_ply_splats(tmp_path / "a.ply")
    assert assert_equal(read, splats) and list(read.extra) == ["label"]
    assert np.array_equal(read.extra["label"], np.arange(len(splats)))


def test_written_splats_round_trip(tmp_path):
    splats = random_splats(degree=2)
    attention = np.linspace(0, 1, len(splats), dtype=np.float32)
    splats.opacities[:2] = 0, 1
    splats = Splats(*(getattr(splats, n) for n in NAMES), extra={"attention": attention})
    write_ply_splats(tmp_path / "a.ply", splats, comments=("by nerg_mi",))
    read = read_ply_splats(tmp_path / "a.ply")
    assert assert_equal(read, splats) and np.array_equal(read.extra["attention"], attention)


def test_surfels_without_a_third_scale_are_thin(tmp_path):
    write_inria(tmp_path / "a.ply", random_splats(degree=0), "ascii")
    raw = (tmp_path / "a.ply").read_text().replace("property float scale_2\n", "")
    head, rows = raw.split("end_header\n")
    at = [line.split()[-1] for line in head.splitlines() if line.startswith("property")].index("scale_1") + 1
    rows = "\n".join(" ".join(w for i, w in enumerate(row.split()) if i != at) for row in rows.splitlines())
    (tmp_path / "b.ply").write_text(f"{head}end_header\n{rows}\n")
    scales = read_ply_splats(tmp_path / "b.ply").scales
    assert np.allclose(scales[:, 2], 1e-3 * scales[:, :2].min(axis=1))


BAD = [
    (b"property float opacity", b"property float dullness", "opacity"),
    (b"element vertex 40", b"element vertex 4000000000", "4,000,000,000"),
    (b"property float x", b"property list uchar int x", "is truncated"),
    (b"f_dc_0", b"red", "f_dc_0"),
    (b"property float x", b"property float y", "two properties named"),
    (b"binary_little_endian", b"binary_odd_endian", "binary_odd_endian"),
    (b"property float f_rest_44", b"property float f_rest_45", "f_rest"),
    (b"end_header", b"and_header", "header"),
    (b"property float f_dc_0", b"property float packed_position", "splat-transform"),
    (b"element vertex", b"element chunk 3\nelement vertex", "chunk"),
]


@pytest.mark.parametrize(("old", "new", "said"), BAD, ids=[said for *_, said in BAD])
def test_damaged_ply_is_refused(tmp_path, old, new, said):
    write_inria(tmp_path / "a.ply", random_splats())
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(old, new, 1))
    with pytest.raises(NergError, match=said) as error:
        read_ply_splats(tmp_path / "a.ply")
    assert "a.ply" in str(error.value)


def test_compressed_ply_is_recognised_and_refused(tmp_path):
    """As SuperSplat writes it: chunks, which a reader of meshes would not expect, come first."""
    packed = ("position", "rotation", "scale", "color")
    lines = ["ply", "format binary_little_endian 1.0", "element chunk 1", "property float min_x", "element vertex 1"]
    lines += [*(f"property uint packed_{name}" for name in packed), "end_header\n"]
    (tmp_path / "a.ply").write_bytes("\n".join(lines).encode() + bytes(20))
    assert is_splat_file(tmp_path / "a.ply")
    with pytest.raises(NergError, match="a.ply.*compressed.*splat-transform in.ply out.ply$"):
        read_ply_splats(tmp_path / "a.ply")


def test_text_ply_is_limited(tmp_path, monkeypatch):
    write_inria(tmp_path / "a.ply", random_splats(), "ascii")
    monkeypatch.setattr(ply_tables, "MAX_TEXT_BYTES", 100)
    with pytest.raises(NergError, match="more than 100 bytes"):
        read_ply_splats(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:2000])
    monkeypatch.undo()
    with pytest.raises(NergError, match="40 rows of vertex"):
        read_ply_splats(tmp_path / "a.ply")


def write_columns_of(path, splats, **columns):
    """Write ``splats`` with modified ``columns``."""
    write_ply_splats(path, splats)
    table = {name: values() for name, values in parse_ply(np.fromfile(path, np.uint8)).tables["vertex"].columns.items()}
    write_columns(path, table | columns)


@pytest.mark.parametrize("size, room", [(0.02, 1), (0.05, 8), (30, 1000)])
def test_lengths_in_place_of_logarithms_are_recognised(tmp_path, size, room):
    splats = random_splats(4000, 0, size=size)
    splats = replace(splats, centers=splats.centers * np.float32([room, room, 0.01 * room]))
    write_columns_of(tmp_path / "a.ply", splats, **{f"scale_{i}": splats.scales[:, i] for i in range(3)})
    read = read_ply_splats(tmp_path / "a.ply")
    assert assert_equal(read, splats) and "lengths" in read.assumptions[0]


@pytest.mark.parametrize("low, high", [(0.001, 0.99), (0, 1), (0.5, 0.7)])
def test_plain_opacities_are_recognised(tmp_path, low, high):
    splats = replace(random_splats(100, 1), opacities=np.linspace(low, high, 100, dtype=np.float32))
    write_columns_of(tmp_path / "a.ply", splats, opacity=splats.opacities)
    read = read_ply_splats(tmp_path / "a.ply")
    assert assert_equal(read, splats) and "logits" in read.assumptions[0]


@pytest.mark.parametrize("low, high", [(0, 255), (10, 200), (0, 40)])
def test_bytes_in_place_of_logits_are_recognised(tmp_path, low, high):
    stored = np.linspace(low, high, 100).round().astype(np.float32)
    splats = replace(random_splats(100, 1), opacities=stored / np.float32(255))
    write_columns_of(tmp_path / "a.ply", splats, opacity=stored)
    read = read_ply_splats(tmp_path / "a.ply")
    assert assert_equal(read, splats) and "0..255" in read.assumptions[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda s: replace(s, centers=1000 * s.centers, scales=1000 * s.scales),
        lambda s: replace(s, scales=np.full_like(s.scales, 1.05), centers=20 * s.centers),
        lambda s: replace(s, opacities=np.full_like(s.opacities, 0.6)),
        lambda s: replace(s, opacities=np.geomspace(0.005, 0.7, len(s)).astype(np.float32)),
        lambda s: replace(s, opacities=1 / (1 + np.exp(-np.linspace(0.1, 12, len(s)))).astype(np.float32)),
    ],
    ids=["millimetres", "large and alike", "of one opacity", "faint", "pruned"],
)
def test_encodings_of_trainings_are_not_misinterpreted(tmp_path, change):
    splats = change(random_splats(300, 0))
    write_ply_splats(tmp_path / "a.ply", splats)
    read = read_ply_splats(tmp_path / "a.ply")
    assert assert_equal(read, splats) and not read.assumptions


@pytest.mark.parametrize(
    "degree, change",
    [(2, {}), (0, {"nx": np.ones(50)}), (1, {"label": np.ones(50)}), (3, {"lengths": True}), (0, {"shares": True})],
    ids=["degree 2", "normals", "further columns", "lengths", "opacities as they are"],
)
def test_3d_filter_widens_and_preserves_mass(tmp_path, degree, change):
    """For files of trainings, and for decoded values."""
    splats = random_splats(100, degree, size=0.02)
    widths, change = np.linspace(0, 0.05, 100, dtype=np.float32), dict(change)
    columns = {name: np.resize(values, 100) for name, values in change.items() if values is not True}
    if "lengths" in change:
        columns |= {f"scale_{i}": splats.scales[:, i] for i in range(3)}
    if "shares" in change:
        columns["opacity"] = splats.opacities
    write_columns_of(tmp_path / "a.ply", splats, filter_3D=widths, **columns)
    read = read_ply_splats(tmp_path / "a.ply")
    assert np.allclose(read.scales**2 - splats.scales**2, widths[:, None] ** 2, atol=1e-5)
    assert np.allclose(read.opacities * read.scales.prod(axis=1), splats.opacities * splats.scales.prod(axis=1))
    assert len(read.assumptions) == len({"lengths", "shares"} & change.keys())
    # Written values include the filter, so it is not applied twice.
    write_ply_splats(tmp_path / "b.ply", read)
    again = read_ply_splats(tmp_path / "b.ply")
    assert assert_equal(again, read, 1e-5) and set(again.extra) == {"label"} & change.keys()


def test_unused_columns_are_noted(tmp_path):
    write_columns_of(tmp_path / "a.ply", random_splats(), motion_0=np.zeros(40), t=np.ones(40))
    assert read_ply_splats(tmp_path / "a.ply").notes == ("unused columns: motion_0, t",)


# ---- Khronos ----


@pytest.mark.parametrize("degree", [0, 3])
def test_a_primitive_is_read(tmp_path, degree):
    splats = random_splats(degree=degree)
    write_khronos(tmp_path / "a.glb", splats)
    assert assert_equal(read_gltf_splats(tmp_path / "a.glb"), splats)


def test_nodes_are_applied_and_integers_normalised(tmp_path):
    splats = random_splats(degree=0)
    node = {"rotation": [0, 0, 0.5**0.5, 0.5**0.5], "scale": [2, 2, 2], "translation": [1, 0, 0]}
    write_khronos(tmp_path / "a.glb", splats, node, shares=True)
    read = read_gltf_splats(tmp_path / "a.glb")
    x, y, z = 2 * splats.centers.T
    assert np.allclose(read.centers, np.stack([1 - y, x, z], axis=1), atol=1e-6)
    assert np.allclose(read.scales, 2 * splats.scales)
    assert np.abs(read.opacities - splats.opacities).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b'"KHR_gaussian_splatting": {"kernel"', b'"XHR_gaussian_splatting": {"kernel"', "no splats"),
        (b'"KHR_gaussian_splatting:OPACITY"', b'"KHR_gaussian_splatting:OPACITI"', "OPACITY"),
        (b'"KHR_gaussian_splatting:SH_DEGREE_0', b'"KHR_gaussian_splatting:SH_DEGREE_7', "no colour"),
        (b'"kernel": "ellipse"', b'"extensions": {"compression": 1}', "compressed"),
        (b'"kernel": "ellipse"', b'"kernel": "triangle"', 'kernel is "triangle"'),
        (b"srgb_rec709", b"rgbb_rec2020", "colour space"),
        (b'"buffer": 0,', b'"buffer": -1,', "whole number"),
        (b'"nodes": [{"mesh": 0', b'"nodes": [{"scale": [1, 2, 1], "mesh": 0', "uniform scale"),
        (
            b'"nodes": [{"mesh": 0',
            b'"nodes": [{"matrix": [1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "mesh": 0',
            "last row",
        ),
    ],
)
def test_unsupported_glb_splats_are_refused(tmp_path, old, new, said):
    write_khronos(tmp_path / "a.glb", random_splats(degree=0))
    raw = (tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(raw[12:16], "little")
    text = raw[20 : 20 + length].replace(old, new, 1)
    assert text != raw[20 : 20 + length]
    text += b" " * (-len(text) % 4)
    rest = raw[20 + length :]
    (tmp_path / "a.glb").write_bytes(raw[:12] + len(text).to_bytes(4, "little") + raw[16:20] + text + rest)
    with pytest.raises(NergError, match=f"a.glb.*{said}"):
        read_gltf_splats(tmp_path / "a.glb")


def test_two_degrees_are_refused(tmp_path):
    write_khronos(tmp_path / "a.glb", random_splats(degree=1))
    document, data = read_glb_chunks((tmp_path / "a.glb").read_bytes(), "a.glb")
    first = document["meshes"][0]["primitives"][0]
    few = {k: v for k, v in first["attributes"].items() if "DEGREE_1" not in k}
    document["meshes"][0]["primitives"].append(first | {"attributes": few})
    (tmp_path / "a.glb").write_bytes(b"".join(pack_glb(document, data)))
    with pytest.raises(NergError, match="several degrees"):
        read_gltf_splats(tmp_path / "a.glb")


@pytest.mark.parametrize(
    "name, change, said",
    [
        ("opacities", lambda v: np.log(v / (1 - v)), "opacities.*0 .. 1.*logits"),
        ("opacities", lambda v: v * 255, "logits"),
        ("scales", np.log, "scales.*logarithms"),
        ("rotations", lambda v: 3 * v, "not normalised"),
    ],
)
def test_values_outside_specification_are_refused(tmp_path, name, change, said):
    splats = random_splats(degree=0)
    object.__setattr__(splats, name, change(getattr(splats, name)))
    write_khronos(tmp_path / "a.glb", splats)
    with pytest.raises(NergError, match=said):
        read_gltf_splats(tmp_path / "a.glb")


def test_colour_space_is_read_and_other_attributes_noted(tmp_path):
    write_khronos(tmp_path / "a.glb", random_splats(degree=0))
    document, data = read_glb_chunks((tmp_path / "a.glb").read_bytes(), "a.glb")
    primitive = document["meshes"][0]["primitives"][0]
    primitive["attributes"]["_MARK"] = 0
    primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] = "lin_rec709_display"
    (tmp_path / "a.glb").write_bytes(b"".join(pack_glb(document, data)))
    read = read_gltf_splats(tmp_path / "a.glb")
    assert read.color_space == "linear" and read.notes == ("unused attributes: _MARK",)


# ---- Spz ----


@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_is_decoded_exactly(tmp_path, version):
    splats = random_splats(degree=version)
    write_spz(tmp_path / "a.spz", splats, version)
    read = read_spz(tmp_path / "a.spz")
    assert np.abs(read.centers - splats.centers).max() < (1e-3 if version == 1 else 0.5 / 4096 + 1e-6)
    assert np.abs(np.log(read.scales / splats.scales)).max() <= 0.5 / 16 + 1e-5
    assert np.abs(read.opacities - splats.opacities).max() <= 0.5 / 255 + 1e-6
    assert np.abs(read.harmonics[:, 0] - splats.harmonics[:, 0]).max() <= 0.5 / 255 / 0.15 + 1e-5
    assert np.abs(read.harmonics[:, 1:] - np.clip(splats.harmonics[:, 1:], -1, 127 / 128)).max() <= 0.5 / 128 + 1e-6
    differences = np.abs((read.rotations * splats.rotations).sum(axis=1))
    # Version 3 exists because a small w is imprecise if it is computed from the other components.
    assert differences.min() > (1 - 1e-5 if version == 3 else 1 - 5e-3)


def packed(magic=0x5053474E, version=3, count=40, degree=3, fraction=12):
    return struct.pack("<IIIBBBB", magic, version, count, degree, fraction, 0, 0)


def squeezed(**header):
    return gzip.compress(packed(**header), mtime=0)


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (squeezed(version=5), "version 1 to 3"),
        (squeezed(magic=1), "version 1 to 3"),
        (squeezed(degree=4), "version 1 to 3"),
        (squeezed(count=4_000_000_000), "4,000,000,000"),
        (squeezed(), "is truncated"),
        (packed(version=4), 'version 4.*convert it by: npx @playcanvas/splat-transform "a.spz" out.ply'),
        (b"nothing", "cannot be read"),
    ],
    ids=["later", "other", "degree", "count", "short", "zstd", "no gzip"],
)
def test_damaged_spz_is_refused(tmp_path, raw, said):
    (tmp_path / "a.spz").write_bytes(raw)
    with pytest.raises(NergError, match=said) as error:
        read_spz(tmp_path / "a.spz")
    assert "a.spz" in str(error.value)


# ---- SOG: images in an archive ----


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sog_is_decoded_to_its_precision(tmp_path, degree):
    splats = random_splats(70, degree=degree)  # More than a row of the palette
    write_sog(tmp_path / "a.sog", splats)
    read = read_splats(tmp_path / "a.sog")
    half_step = lambda values: np.ptp(values) / 255 / 2 + 1e-6
    assert np.abs(read.centers - splats.centers).max() < 2 * np.log(2) / 65535 + 1e-6
    assert np.abs(np.log(read.scales / splats.scales)).max() <= half_step(np.log(splats.scales)) + 1e-5
    assert np.abs(read.opacities - splats.opacities).max() <= 0.5 / 255 + 1e-6
    assert np.abs(read.harmonics[:, 0] - splats.harmonics[:, 0]).max() <= half_step(splats.harmonics[:, 0])
    if degree:
        assert np.abs(read.harmonics[:, 1:] - splats.harmonics[:, 1:]).max() <= half_step(splats.harmonics[:, 1:])
    unit = lambda q: q / np.linalg.norm(q, axis=1, keepdims=True)
    assert np.abs((unit(read.rotations) * unit(splats.rotations)).sum(axis=1)).min() > 1 - 1e-4


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": 3}, "version is 3, not 2"),
        ({"count": 4_000_000_000}, "50,000,000, got 4000000000"),
        ({"count": 41}, "40 pixels for 41 Gaussians"),
        ({"count": "many"}, "count.* got .many"),
        ({"scales__codebook": [0.0]}, "codebook"),
        ({"shN__bands": 4}, "bands.* got 4"),
        ({"shN__bands": 1}, "image of its palette"),
        ({"shN__count": 9}, "palette entry 39 of 9"),
        ({"quats__files": ["sh0.webp"]}, "no largest component"),
        ({"quats__files": ["other.webp"]}, "other.webp"),
        ({"quats__files": ["meta.json"]}, "cannot be read"),
    ],
)
def test_damaged_sog_is_refused(tmp_path, changes, said):
    write_sog(tmp_path / "a.sog", random_splats(), **changes)
    with pytest.raises(NergError, match=said) as error:
        read_splats(tmp_path / "a.sog")
    assert "a.sog" in str(error.value)


def test_sog_with_any_damaged_value_is_read_or_refused_in_a_sentence(tmp_path):
    write_sog(tmp_path / "a.sog", random_splats())
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    num_refused = 0
    for meta in iter_damaged_documents(json.loads(files["meta.json"])):
        with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
            for name, data in (files | {"meta.json": json.dumps(meta).encode()}).items():
                archive.writestr(name, data)
        try:
            read_splats(tmp_path / "b.sog")
        except NergError as error:
            num_refused += 1
            assert "b.sog" in str(error) and not PYTHON_WORDS.search(str(error))
    assert num_refused > 200


@pytest.mark.parametrize("size", [(16383, 16383), (9000, 9000), (16383, 5000)])
def test_too_large_images_of_a_sog_are_refused(tmp_path, size):
    write_sog(tmp_path / "a.sog", random_splats())
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    # A WebP header that claims the size: width - 1 and height - 1 in 14 bits each.
    bits = (size[0] - 1) | (size[1] - 1) << 14
    data = b"\x2f" + bits.to_bytes(4, "little") + bytes(64)
    chunk = b"VP8L" + len(data).to_bytes(4, "little") + data + b"\0"
    files["quats.webp"] = b"RIFF" + (len(chunk) + 4).to_bytes(4, "little") + b"WEBP" + chunk
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    with pytest.raises(NergError, match="quats.webp.*pixels"):
        read_splats(tmp_path / "a.sog")


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "mark"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_marks_and_line_ends_of_splats_in_text_change_no_value(tmp_path, mark, end):
    write_inria(tmp_path / "a.ply", random_splats(), style="ascii")
    raw = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(mark + raw.replace(b"\n", end))
    assert is_splat_file(tmp_path / "b.ply")
    first, second = read_splats(tmp_path / "a.ply"), read_splats(tmp_path / "b.ply")
    np.testing.assert_array_equal(first.centers, second.centers)
    np.testing.assert_array_equal(first.opacities, second.opacities)


# ---- Splats of a field show its depth ----


@pytest.fixture(scope="module")
def store():
    return load_radiance(ROOT / "scenes" / "store" / "store.safetensors", ns)[0]


def test_surfel_depths_equal_field(store):
    splats = make_splats(store, 56)
    assert len(splats) > 5_000 and splats.shift < 0.5 * splats.cell
    rng = np.random.default_rng(0)
    d = rng.normal(size=(400, 3)).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o = np.tile(np.float32([4.4, 2.8, 1.6]), (400, 1))
    ours, opacity = trace_depth(SplatMedium(SplatArrays(splats, ns)), o, d)
    field, _ = trace_depth(FieldMedium(store), o, d)
    assert np.mean(opacity > 0.5) > 0.98 and np.median(np.abs(ours - field)) < 0.25 * splats.cell
