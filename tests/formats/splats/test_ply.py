import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.field.splats import Splats
from nerg_mi.formats.splats import ply
from nerg_mi.formats.splats.ply import read_ply_splats, write_ply_splats
from tests.formats.splats.writers import random_splats, write_inria

NAMES = ("centers", "scales", "rotations", "opacities", "harmonics")


def equal(a: Splats, b: Splats, tolerance: float = 2e-6) -> bool:
    return all(np.allclose(getattr(a, n), getattr(b, n), rtol=tolerance, atol=tolerance) for n in NAMES)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("style", ["binary_little_endian", "ascii"])
def test_a_model_of_the_reference_training_is_read(tmp_path, degree, style):
    splats = random_splats(degree=degree)
    write_inria(tmp_path / "a.ply", splats, style)
    read = read_ply_splats(tmp_path / "a.ply")
    assert equal(read, splats) and not read.extra


def test_columns_are_found_by_name_and_others_kept(tmp_path):
    splats = random_splats()
    write_inria(tmp_path / "a.ply", splats, shuffled=True)
    read = read_ply_splats(tmp_path / "a.ply")
    assert equal(read, splats) and list(read.extra) == ["label"]
    assert np.array_equal(read.extra["label"], np.arange(len(splats)))


def test_what_is_written_is_read_again(tmp_path):
    splats = random_splats(degree=2)
    attention = np.linspace(0, 1, len(splats), dtype=np.float32)
    splats = Splats(*(getattr(splats, n) for n in NAMES), extra={"attention": attention})
    write_ply_splats(tmp_path / "a.ply", splats, comments=("by nerg_mi",))
    read = read_ply_splats(tmp_path / "a.ply")
    assert equal(read, splats) and np.array_equal(read.extra["attention"], attention)


def test_opacities_of_0_and_1_are_written(tmp_path):
    splats = random_splats(2)
    splats = Splats(splats.centers, splats.scales, splats.rotations, [0, 1], splats.harmonics)
    write_ply_splats(tmp_path / "a.ply", splats)
    assert np.allclose(read_ply_splats(tmp_path / "a.ply").opacities, [0, 1], atol=1e-6)


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
    (b"property float x", b"property list uchar int x", "no numbers"),
    (b"property float x", b"property float y", "one name"),
    (b"binary_little_endian", b"binary_big_endian", "binary_big_endian"),
    (b"property float f_rest_44", b"property float f_rest_45", "f_rest"),
    (b"end_header", b"and_header", "header"),
    (b"property float f_dc_0", b"property float packed_position", "splat-transform"),
    (b"element vertex", b"element chunk 3\nelement vertex", "chunk"),
]


@pytest.mark.parametrize(("old", "new", "said"), BAD, ids=[said for *_, said in BAD])
def test_a_damaged_file_is_one_sentence(tmp_path, old, new, said):
    write_inria(tmp_path / "a.ply", random_splats())
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(old, new, 1))
    with pytest.raises(NergError, match=said) as error:
        read_ply_splats(tmp_path / "a.ply")
    assert "a.ply" in str(error.value)


def test_text_has_a_limit_of_its_own(tmp_path, monkeypatch):
    write_inria(tmp_path / "a.ply", random_splats(), "ascii")
    monkeypatch.setattr(ply, "TEXT_BYTES", 100)
    with pytest.raises(NergError, match="more than 100 bytes"):
        read_ply_splats(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:2000])
    monkeypatch.undo()
    with pytest.raises(NergError, match="announces 40"):
        read_ply_splats(tmp_path / "a.ply")
