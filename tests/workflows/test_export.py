"""Tests of `nerg_mi.workflows.export`."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import is_field, load_radiance
from nerg_mi.formats.splats import read_splats
from nerg_mi.workflows.export import (
    PointOptions,
    SplatOptions,
    VolumeOptions,
    export_points,
    export_splats,
    export_volume,
    refine_checkpoint,
)
from tests.plugins import fields
from tests.plugins.fields import radiance
from tests.workflows.recorder import Recorder

# ---- Exports by jobs: from a file and from a field that is loaded ----


@pytest.fixture
def field(tmp_path):
    fields.radiance(tmp_path / "f.safetensors")
    return tmp_path / "f.safetensors"


def test_a_field_and_its_file_are_exported_alike(field, tmp_path):
    options, told = PointOptions(resolution=16, density=3.0, count=50), Recorder()
    first = export_points(field, tmp_path / "a.ply", options, told)
    second = export_points(load_radiance(field, ns)[0], tmp_path / "b.ply", options)
    assert first.files == [tmp_path / "a.ply"] and len(first.surface.vertices) == 50
    assert np.array_equal(first.surface.vertices, second.surface.vertices)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert told.messages[0].startswith("50 points") and told.messages[1].startswith(f"wrote {tmp_path / 'a.ply'}")


def test_splats_lie_on_the_surface(field, tmp_path):
    told = Recorder()
    done = export_splats(field, tmp_path / "a.ply", SplatOptions(resolution=16, density=3.0), told)
    splats = read_splats(tmp_path / "a.ply")
    assert done.files == [tmp_path / "a.ply"] and told.messages[0].startswith(f"{len(splats):,} Gaussians")
    assert (np.abs(splats.centers) < 1.3).all()


def test_a_volume_with_its_colour(field, tmp_path):
    done = export_volume(field, tmp_path / "d.vol", VolumeOptions(resolution=8, color=tmp_path / "c.vol"))
    assert done.files == [tmp_path / "c.vol", tmp_path / "d.vol"] and done.surface is None
    assert all(path.is_file() for path in done.files)


def test_an_axis_that_is_none(field, tmp_path):
    with pytest.raises(NergError, match="must be z or y"):
        export_points(field, tmp_path / "a.glb", PointOptions(up="x"))


# ---- Checkpoints with a finer bound: the same field, known to those who name the old file ----


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("refined")
    bits = np.random.default_rng(0).random((6, 6, 6)) < 0.4
    radiance(folder / "old.safetensors", density_scale=8e-3, occupancy=OccupancyGrid(bits, ns, 0.05))
    found = refine_checkpoint(folder / "old.safetensors", folder / "new.safetensors")
    return folder / "old.safetensors", folder / "new.safetensors", found


def test_only_the_bound_is_another(files):
    old, new, found = files
    (tensors, meta), (again, about) = (read_checkpoint(p, "radiance") for p in (old, new))
    assert set(again) - set(tensors) == {"occupancy.parts"}
    assert all(
        np.array_equal(again[name], tensors[name]) and again[name].dtype == tensors[name].dtype for name in tensors
    )
    assert {k: v for k, v in about.items() if k not in ("occupancy", "refined_from")} == {
        k: v for k, v in meta.items() if k != "occupancy"
    }
    # Of readers that know no parts the cells are what they were.
    assert {k: v for k, v in about["occupancy"].items() if k != "refined"} == meta["occupancy"]
    loaded = load_radiance(new, ns)[0].occupancy
    assert np.array_equal(loaded.masks, found.occupancy.masks) and loaded.missed == found.occupancy.missed
    assert 0 < loaded.fraction < found.before == loaded.coarse.fraction


def test_a_gaze_field_knows_it(files, tmp_path):
    old, new, _ = files
    known = file_sha256(old)
    assert is_field(old, known) and is_field(new, known)
    assert not is_field(new, "0" * 64) and not is_field(new, None)
    refine_checkpoint(new, tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == new.read_bytes()


def test_new_weights_drop_it(files):
    field, _ = load_radiance(files[1], ns)
    refined = field.occupancy
    field.set_parameters({"density_net.0": field.parameters()["density_net.0"]})
    assert isinstance(field.occupancy, OccupancyGrid) and np.array_equal(field.occupancy.bits, refined.coarse_bits)


@pytest.mark.parametrize(
    "occupancy, what",
    [(None, "no occupancy grid to refine"), (CascadeGrid(np.ones((2, 4, 4, 4), bool), 2.0, ns, 0.1), "nested cubes")],
)
def test_fields_without_such_a_grid(tmp_path, occupancy, what):
    radiance(tmp_path / "f.safetensors", occupancy=occupancy)
    with pytest.raises(NergError, match=what):
        refine_checkpoint(tmp_path / "f.safetensors", tmp_path / "g.safetensors")
    assert not (tmp_path / "g.safetensors").exists()
