import numpy as np
import pytest

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.formats.gltf import shown_unlit
from nerg_mi.formats.splats.files import READERS, is_splats, read_splats
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
