"""Places as parts of a scene: colours of meshes, lamps, and files that are no such place."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.color import encode_srgb
from nerg_mi.rendering.scene_writer import document
from nerg_mi.workflows.scene_places import GivenFiles, colors_of, place_of_files
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


def given(path, kind):
    return GivenFiles(path, kind, None, None, {}, {})


def text_of(folder, path, kind, lamps=None):
    place = place_of_files(given(path, kind), folder / "out.xml").make(folder, lamps or {"eye": 3.0, "camera": 1.5})
    return place, document([*place.inside, *place.beside], "h")


@pytest.mark.parametrize(
    "names, values, said",
    [
        ("", "", 'name="reflectance" value="0.5"'),
        ("rgb", "0.2 0.4 0.6", 'value="vertex_color"'),
        (("color_0", "color_1", "color_2"), "0.2 0.4 0.6", 'value="vertex_color"'),
    ],
    ids=["grey", "rgb", "of Mitsuba"],
)
def test_colours_of_a_mesh(rgb, tmp_path, names, values, said):
    colors = "\n".join(f"property float {name}" for name in names) or "comment grey"
    (tmp_path / "a.ply").write_text(PLY.format(colors=colors, a=values))
    place, text = text_of(tmp_path, tmp_path / "a.ply", "mesh")
    assert said in text
    assert place.files == {"place": "a.ply"} and text.count('<emitter type="point">') == 2
    assert 'value="$eye"' in text and 'value="$camera"' in text


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
def test_a_mesh_that_mitsuba_does_not_show_is_written_again(rgb, tmp_path, name, text):
    (tmp_path / name).write_text(text)
    written = place_of_files(given(tmp_path / name, "mesh"), tmp_path / "out.xml")
    place, xml = text_of(tmp_path, tmp_path / name, "mesh")
    assert written.files == (tmp_path / "out.mesh.ply",) and place.files == {"place": "out.mesh.ply"}
    assert '"vertex_color"' in xml and 'type="ply"' in xml
    params = rgb.traverse(rgb.load_dict({"type": "ply", "filename": str(tmp_path / "out.mesh.ply")}))
    shown = np.array(params["vertex_color"]).reshape(-1, 3)
    assert np.allclose(encode_srgb(shown), (0.2, 0.4, 0.6), atol=1e-6)
    assert np.array(params["faces"])[:3].tolist() == [0, 1, 2]


def test_the_given_mesh_is_not_written_over(tmp_path):
    text = PLY.format(colors="comment grey", a="").replace("3 0 1 2", "4 0 1 2 0")
    (tmp_path / "out.mesh.ply").write_text(text)
    with pytest.raises(NergError, match="another name"):
        place_of_files(given(tmp_path / "out.mesh.ply", "mesh"), tmp_path / "out.xml")
    assert (tmp_path / "out.mesh.ply").read_text() == text


@pytest.mark.parametrize("shape", [(1, 6, 8), (6, 1, 8), (6, 8, 1), (2, 2, 2), (1, 1, 1)])
def test_hit_points_of_one_cell_are_shaded(tmp_path, shape):
    write_volume(tmp_path / "a.vol", np.full(shape, 100.0), (0, 0, 0), (1, 1, 1))
    place_of_files(given(tmp_path / "a.vol", "hits"), tmp_path / "out.xml")
    colors = np.fromfile(colors_of(tmp_path / "out.xml"), "<f4", offset=48)
    assert np.isfinite(colors).all() and (colors > 0.1).all()
    if shape.count(1) == 1:
        # A sheet faces along the axis in which it has no extent.
        assert np.allclose(colors, [0.55, 0.16, 0.34][shape.index(1)], atol=0.02)


def test_splats_that_cannot_be_read_are_refused_by_their_own_name(tmp_path):
    splats = random_splats(degree=0)
    splats.centers[0] = np.nan
    write_inria(tmp_path / "a.ply", splats)
    with pytest.raises(NergError, match=r'"[^"]*a\.ply" cannot be read: some of the centers'):
        place_of_files(given(tmp_path / "a.ply", "field"), tmp_path / "out.xml")


def test_hit_points_get_colours_beside_the_scene(rgb, tmp_path):
    density = np.zeros((6, 8, 10), np.float32)
    density[2:4] = 100
    write_volume(tmp_path / "a.vol", density, (0, 0, 0), (1, 0.8, 0.6))
    place, text = text_of(tmp_path, tmp_path / "a.vol", "hits")
    assert place.files == {"density": "a.vol", "color": "out.color.vol"} and '"nearest"' in text
    colors = rgb.load_dict({"type": "gridvolume", "filename": str(colors_of(tmp_path / "out.xml")), "raw": True})
    assert tuple(np.array(rgb.traverse(colors)["data"]).shape) == (3, 4, 5, 3)
    write_volume(tmp_path / "rgb.vol", np.zeros((2, 2, 2, 3)), (0, 0, 0), (1, 1, 1))
    with pytest.raises(NergError, match="is no place of hit points"):
        place_of_files(given(tmp_path / "rgb.vol", "hits"), tmp_path / "out.xml")


def test_a_sphere_where_nothing_is_known(tmp_path):
    place, text = text_of(tmp_path, None, "none")
    assert 'name="center" value="$eye"' in text and 'name="radius" value="2"' in text and not place.files
