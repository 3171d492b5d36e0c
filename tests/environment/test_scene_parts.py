"""What scene files show of environments: colours of meshes, hit points, splats and directions."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.scene_parts import show_directions, show_field, show_hits, show_mesh
from nerg_mi.environment.scene_writer import SceneContent, format_document
from nerg_mi.errors import NergError
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.color import encode_srgb
from tests.formats.splats.writers import random_splats, write_inria

PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
{colors}
element face 1
property list uchar int vertex_indices
end_header
0 0 0 {a}
1 0 0 {a}
0 1 0 {a}
3 0 1 2
"""


def text_of(content: SceneContent) -> str:
    return format_document([*content.integrator_children, *content.scene_children], "h")


@pytest.mark.parametrize(
    "names, values, said",
    [
        ("", "", 'name="reflectance" value="0.5"'),
        ("rgb", "0.2 0.4 0.6", 'value="vertex_color"'),
        (("color_0", "color_1", "color_2"), "0.2 0.4 0.6", 'value="vertex_color"'),
    ],
    ids=["grey", "rgb", "of Mitsuba"],
)
def test_vertex_colours_of_a_mesh_are_used(rgb, tmp_path, names, values, said):
    colors = "\n".join(f"property float {name}" for name in names) or "comment grey"
    (tmp_path / "a.ply").write_text(PLY.format(colors=colors, a=values))
    content = show_mesh(tmp_path / "a.ply", tmp_path / "out.xml")
    text = text_of(content)
    assert said in text
    assert (
        content.files == {"place": tmp_path / "out.mesh.ply"} and 'name="headlight"' in text and "<emitter" not in text
    )


@pytest.mark.parametrize(
    "name, text",
    [
        (
            "a.ply",
            PLY.format(
                colors="property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha",
                a="51 102 153 9",
            ),
        ),
        (
            "a.ply",
            PLY.format(colors="property float r\nproperty float g\nproperty float b", a="51 102 153").replace(
                "3 0 1 2", "4 0 1 2 0"
            ),
        ),
        ("a.ply", PLY.format(colors="property uchar red\nproperty uchar green\nproperty uchar blue", a="51 102 153")),
        ("a.obj", "".join(f"v {p} 0.2 0.4 0.6\n" for p in ("0 0 0", "1 0 0", "0 1 0")) + "f -3 -2 -1"),
        ("a.obj", "".join(f"v {p} 51 102 153\n" for p in ("0 0 0", "1 0 0", "0 1 0")) + "f 1 2 \\\n3"),
    ],
    ids=["RGBA", "quads", "RGB", "negative", "continued"],
)
def test_a_mesh_that_mitsuba_cannot_show_is_converted(rgb, tmp_path, name, text):
    (tmp_path / name).write_text(text)
    content = show_mesh(tmp_path / name, tmp_path / "out.xml")
    xml = text_of(content)
    assert content.written == (tmp_path / "out.mesh.ply",) and content.files == {"place": tmp_path / "out.mesh.ply"}
    assert '"vertex_color"' in xml and 'type="ply"' in xml
    params = rgb.traverse(rgb.load_dict({"type": "ply", "filename": str(tmp_path / "out.mesh.ply")}))
    shown = np.array(params["vertex_color"]).reshape(-1, 3)
    assert np.allclose(encode_srgb(shown), (0.2, 0.4, 0.6), atol=1e-6)
    assert np.array(params["faces"])[:3].tolist() == [0, 1, 2]


def test_the_input_mesh_is_not_overwritten(tmp_path):
    text = PLY.format(colors="comment grey", a="").replace("3 0 1 2", "4 0 1 2 0")
    (tmp_path / "out.mesh.ply").write_text(text)
    with pytest.raises(NergError, match="another name"):
        show_mesh(tmp_path / "out.mesh.ply", tmp_path / "out.xml")
    assert (tmp_path / "out.mesh.ply").read_text() == text


@pytest.mark.parametrize("shape", [(1, 6, 8), (6, 1, 8), (6, 8, 1), (2, 2, 2), (1, 1, 1)])
def test_hit_points_of_one_cell_are_shaded(tmp_path, shape):
    write_volume(tmp_path / "a.vol", np.full(shape, 100.0), (0, 0, 0), (1, 1, 1))
    (file,) = show_hits(tmp_path / "a.vol", tmp_path / "out.xml").written
    colors = np.fromfile(file, "<f4", offset=48)
    assert np.isfinite(colors).all() and (colors > 0.1).all()
    if shape.count(1) == 1:
        # The normal of a sheet is along the axis in which it has no extent.
        assert np.allclose(colors, [0.55, 0.16, 0.34][shape.index(1)], atol=0.02)


def test_an_error_about_splats_names_their_file(rgb, tmp_path):
    splats = random_splats(degree=0)
    splats.centers[0] = np.nan
    write_inria(tmp_path / "a.ply", splats)
    with pytest.raises(NergError, match=r'"[^"]*a\.ply" cannot be read: some of the centers'):
        Environment.open(tmp_path / "a.ply")


def test_coloured_hit_points_are_written_next_to_the_scene(rgb, tmp_path):
    density = np.zeros((6, 8, 10), np.float32)
    density[2:4] = 100
    write_volume(tmp_path / "a.vol", density, (0, 0, 0), (1, 0.8, 0.6))
    content, colored = show_hits(tmp_path / "a.vol", tmp_path / "out.xml"), tmp_path / "out.color.vol"
    assert content.files == {"density": tmp_path / "a.vol", "color": colored}
    assert content.written == (colored,) and '"nearest"' not in text_of(content)
    colors = rgb.load_dict({"type": "gridvolume", "filename": str(colored), "raw": True})
    assert tuple(np.array(rgb.traverse(colors)["data"]).shape) == (3, 4, 5, 3)
    write_volume(tmp_path / "rgb.vol", np.zeros((2, 2, 2, 3)), (0, 0, 0), (1, 1, 1))
    with pytest.raises(NergError, match="is not a volume of hit points; give one that"):
        show_hits(tmp_path / "rgb.vol", tmp_path / "out.xml")


def test_without_geometry_the_scene_is_a_sphere():
    content = show_directions(2.0)
    text = text_of(content)
    assert 'name="center" value="$eye"' in text and 'name="radius" value="2"' in text and not content.files


def test_splats_are_shown_by_their_plugin(tmp_path):
    write_inria(tmp_path / "place.ply", random_splats(3))
    content = show_field(tmp_path / "place.ply", tmp_path)
    assert content.subject == "The Gaussian splats place.ply" and 'type="splats"' in text_of(content)
