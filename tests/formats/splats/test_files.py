import numpy as np
import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.formats.gltf import shown_unlit
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import READERS, is_splats, plugin_of_field, read_splats, refuse_others
from nerg_mi.train.geometry import place_of_field
from nerg_mi.workflows.scene_places import kind_of_file
from tests.formats.splats.writers import random_splats, write_antimatter, write_inria, write_khronos, write_spz

WRITERS = {".ply": write_inria, ".splat": write_antimatter, ".spz": write_spz, ".glb": write_khronos}


def test_the_ending_of_the_name_says_the_format(tmp_path):
    assert set(WRITERS) == set(READERS)
    for suffix, write in WRITERS.items():
        write(tmp_path / f"a{suffix.upper()}", random_splats(7, degree=0))
        assert len(read_splats(tmp_path / f"a{suffix.upper()}")) == 7


def test_other_formats_name_the_converter(tmp_path):
    with pytest.raises(NergError, match=r"splat-transform.*out\.ply"):
        read_splats(tmp_path / "a.sog")
    with pytest.raises(NergError, match=r"are read from \.ply"):
        read_splats(tmp_path / "a.txt")


def test_other_splats_are_refused_wherever_a_place_is_given(tmp_path):
    (tmp_path / "a.sog").write_bytes(b"PK")
    for asked in (refuse_others, kind_of_file, lambda path: place_of_field(path, None)):
        with pytest.raises(NergError, match=r'splat-transform "a\.sog" out\.ply'):
            asked(tmp_path / "a.sog")
    refuse_others(tmp_path / "a.obj")
    assert plugin_of_field(tmp_path / "a.splat") == "splats" and plugin_of_field("a.safetensors") == "nerf"


def test_a_mesh_is_told_by_its_header(tmp_path):
    write_inria(tmp_path / "a.ply", random_splats(3))
    assert is_splats(tmp_path / "a.ply") and is_splats("b.spz") and not is_splats("b.obj")
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    assert not is_splats(tmp_path / "a.ply")
    write_khronos(tmp_path / "a.glb", random_splats(3))
    (tmp_path / "b.glb").write_bytes(b"".join(shown_unlit([("POSITION", np.eye(3, dtype="<f4"), False)], None)))
    assert is_splats(tmp_path / "a.glb") and not is_splats(tmp_path / "b.glb")


def test_missing_files(tmp_path):
    for suffix in READERS:
        with pytest.raises(MissingFile, match="correct its name"):
            read_splats(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".glb"])
def test_a_reader_names_its_file(tmp_path, suffix):
    splats = random_splats(degree=0)
    splats.centers[3] = np.nan
    WRITERS[suffix](tmp_path / f"a{suffix}", splats)
    with pytest.raises(NergError, match=rf"a\{suffix}.*centers.*not finite"):
        read_splats(tmp_path / f"a{suffix}")


def test_splats_without_their_colours_are_splats(tmp_path):
    columns = ("x", "y", "z", "opacity", "scale_0", "rot_0", "red")
    write_columns(tmp_path / "a.ply", {name: np.zeros(3) for name in columns})
    assert is_splats(tmp_path / "a.ply")
