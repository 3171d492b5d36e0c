import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.gltf import pack_glb, read_parts
from nerg_mi.formats.splats import read_gltf_splats
from tests.formats.splats.test_ply import equal
from tests.formats.splats.writers import random_splats, write_khronos


@pytest.mark.parametrize("degree", [0, 3])
def test_a_primitive_is_read(tmp_path, degree):
    splats = random_splats(degree=degree)
    write_khronos(tmp_path / "a.glb", splats)
    assert equal(read_gltf_splats(tmp_path / "a.glb"), splats)


def test_nodes_are_applied_and_integers_are_shares(tmp_path):
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
        (b'"buffer": 0,', b'"buffer": -1,', "no whole number"),
        (b'"nodes": [{"mesh": 0', b'"nodes": [{"scale": [1, 2, 1], "mesh": 0', "uniform scale"),
    ],
)
def test_what_is_not_read_is_one_sentence(tmp_path, old, new, said):
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
    document, data = read_parts((tmp_path / "a.glb").read_bytes(), "a.glb")
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
def test_values_beyond_the_specification_are_refused(tmp_path, name, change, said):
    splats = random_splats(degree=0)
    object.__setattr__(splats, name, change(getattr(splats, name)))
    write_khronos(tmp_path / "a.glb", splats)
    with pytest.raises(NergError, match=said):
        read_gltf_splats(tmp_path / "a.glb")


def test_the_colour_space_is_the_files_and_other_attributes_are_named(tmp_path):
    write_khronos(tmp_path / "a.glb", random_splats(degree=0))
    document, data = read_parts((tmp_path / "a.glb").read_bytes(), "a.glb")
    primitive = document["meshes"][0]["primitives"][0]
    primitive["attributes"]["_MARK"] = 0
    primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] = "lin_rec709_display"
    (tmp_path / "a.glb").write_bytes(b"".join(pack_glb(document, data)))
    read = read_gltf_splats(tmp_path / "a.glb")
    assert read.color_space == "linear" and read.notes == ("attributes that are not used: _MARK",)
