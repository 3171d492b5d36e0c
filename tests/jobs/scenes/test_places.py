"""Places as parts of a scene: colours of meshes, lamps, and files that are no such place."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.volumes import write_volume
from nerg_mi.jobs.scenes.files import GivenFiles
from nerg_mi.jobs.scenes.places import colors_of, place_of_files
from nerg_mi.rendering.scene_writer import document

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
    "kind, values, said",
    [
        (None, "", 'name="reflectance" value="0.5"'),
        ("float", "0.2 0.4 0.6", 'value="vertex_color"'),
        ("uchar", "51 102 153", 'name="scale" value="0.003921569"'),
    ],
)
def test_colours_of_a_mesh(rgb, tmp_path, kind, values, said):
    names = ("r", "g", "b")
    colors = "\n".join(f"property {kind} {name}" for name in names) if kind else "comment grey"
    (tmp_path / "a.ply").write_text(PLY.format(colors=colors, a=values))
    place, text = text_of(tmp_path, tmp_path / "a.ply", "mesh")
    assert said in text and ('name="scale"' in text) == (kind == "uchar")
    assert place.files == {"place": "a.ply"} and text.count('<emitter type="point">') == 2
    assert 'value="$eye"' in text and 'value="$camera"' in text


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
