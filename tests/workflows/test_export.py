"""Exports by jobs: from a file and from a field that is loaded."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.splats import read_splats
from nerg_mi.workflows.export import (
    PointOptions,
    SplatOptions,
    VolumeOptions,
    export_points,
    export_splats,
    export_volume,
)
from tests.plugins import fields
from tests.workflows.recorder import Recorder


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
