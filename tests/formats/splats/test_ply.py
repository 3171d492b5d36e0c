from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.splats import Splats
from nerg_mi.formats import ply as ply_tables
from nerg_mi.formats.ply import parse_ply, write_columns
from nerg_mi.formats.splats import read_ply_splats, write_ply_splats
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
    (b"property float x", b"property list uchar int x", "ends before"),
    (b"f_dc_0", b"red", "f_dc_0"),
    (b"property float x", b"property float y", "two properties of the name"),
    (b"binary_little_endian", b"binary_odd_endian", "binary_odd_endian"),
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
    monkeypatch.setattr(ply_tables, "TEXT_BYTES", 100)
    with pytest.raises(NergError, match="more than 100 bytes"):
        read_ply_splats(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:2000])
    monkeypatch.undo()
    with pytest.raises(NergError, match="the 40 rows of vertex"):
        read_ply_splats(tmp_path / "a.ply")


def write_columns_of(path, splats, **columns):
    """The file of ``splats`` with other ``columns``."""
    write_ply_splats(path, splats)
    table = {name: values() for name, values in parse_ply(np.fromfile(path, np.uint8)).tables["vertex"].columns.items()}
    write_columns(path, table | columns)


@pytest.mark.parametrize("size, room", [(0.02, 1), (0.05, 8), (30, 1000)])
def test_lengths_in_place_of_logarithms_are_recognised(tmp_path, size, room):
    splats = random_splats(4000, 0, size=size)
    splats = replace(splats, centers=splats.centers * np.float32([room, room, 0.01 * room]))
    write_columns_of(tmp_path / "a.ply", splats, **{f"scale_{i}": splats.scales[:, i] for i in range(3)})
    read = read_ply_splats(tmp_path / "a.ply")
    assert equal(read, splats) and "lengths" in read.guesses[0]


@pytest.mark.parametrize("low, high", [(0.001, 0.99), (0, 1), (0.5, 0.7)])
def test_shares_in_place_of_logits_are_recognised(tmp_path, low, high):
    splats = replace(random_splats(100, 1), opacities=np.linspace(low, high, 100, dtype=np.float32))
    write_columns_of(tmp_path / "a.ply", splats, opacity=splats.opacities)
    read = read_ply_splats(tmp_path / "a.ply")
    assert equal(read, splats) and "logits" in read.guesses[0]


@pytest.mark.parametrize("low, high", [(0, 255), (10, 200), (0, 40)])
def test_bytes_in_place_of_logits_are_recognised(tmp_path, low, high):
    stored = np.linspace(low, high, 100).round().astype(np.float32)
    splats = replace(random_splats(100, 1), opacities=stored / np.float32(255))
    write_columns_of(tmp_path / "a.ply", splats, opacity=stored)
    read = read_ply_splats(tmp_path / "a.ply")
    assert equal(read, splats) and "255ths" in read.guesses[0]


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
def test_what_trainings_write_is_not_taken_for_anything_else(tmp_path, change):
    splats = change(random_splats(300, 0))
    write_ply_splats(tmp_path / "a.ply", splats)
    read = read_ply_splats(tmp_path / "a.ply")
    assert equal(read, splats) and not read.guesses


@pytest.mark.parametrize(
    "degree, change",
    [(2, {}), (0, {"nx": np.ones(50)}), (1, {"label": np.ones(50)}), (3, {"lengths": True}), (0, {"shares": True})],
    ids=["degree 2", "normals", "further columns", "lengths", "opacities as they are"],
)
def test_the_3d_filter_widens_and_keeps_the_mass(tmp_path, degree, change):
    """Of what trainings write, and of activated values."""
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
    assert len(read.guesses) == len({"lengths", "shares"} & change.keys())
    # What is written again has the filter in it, and not twice.
    write_ply_splats(tmp_path / "b.ply", read)
    again = read_ply_splats(tmp_path / "b.ply")
    assert equal(again, read, 1e-5) and set(again.extra) == {"label"} & change.keys()


def test_columns_that_are_not_used_are_named(tmp_path):
    write_columns_of(tmp_path / "a.ply", random_splats(), motion_0=np.zeros(40), t=np.ones(40))
    assert read_ply_splats(tmp_path / "a.ply").notes == ("columns that are not used: motion_0, t",)
