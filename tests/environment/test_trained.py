"""Tests of `nerg_mi.environment.trained`, `radiance` and the files of `gaze`."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.gaze import GazeField


def test01_a_field_has_the_data_of_its_file(files):
    field = nerg.RadianceField.load(files / "field.safetensors")
    assert field.kind == "radiance" and field.name == "field.safetensors" and field.provenance == {"test": 0}
    assert np.array_equal(field.bounds, [(-1, -1, -1), (1, 1, 1)])
    assert field.num_weights == sum(value.numpy().size for value in field.network.parameters().values())
    assert repr(field).startswith("<radiance field field.safetensors: ") and "box (-1, -1, -1) to (1, 1, 1)>" in repr(
        field
    )


def test02_saved_fields_are_equal(files, tmp_path):
    for load, name in ((nerg.RadianceField.load, "field"), (nerg.GazeField.load, "gaze")):
        field = load(str(files / f"{name}.safetensors"))
        path = field.save(tmp_path / f"{name}.safetensors")
        again = load(path)
        assert again.provenance == field.provenance
        for key, value in field.network.parameters().items():
            assert np.array_equal(value.numpy(), again.network.parameters()[key].numpy()), key


@pytest.mark.parametrize("load, name", [(nerg.RadianceField.load, "field"), (nerg.GazeField.load, "gaze")])
def test03_half_the_size(files, tmp_path, load, name):
    field = load(files / f"{name}.safetensors")
    full, half = (field.save(tmp_path / f"{h}.safetensors", half=h).stat().st_size for h in (False, True))
    assert half < 0.7 * full
    # A field keeps the precision of its file.
    assert load(tmp_path / "True.safetensors").save(tmp_path / "again.safetensors").stat().st_size == half


@pytest.mark.parametrize(
    "load, name, said",
    [
        (nerg.RadianceField.load, "gaze.safetensors", "contains a gaze field"),
        (nerg.GazeField.load, "field.safetensors", "contains a radiance field"),
        (nerg.RadianceField.load, "nowhere.safetensors", "does not exist"),
        (nerg.Rays.load, "nowhere.npz", "nowhere.npz"),
        (nerg.Rays.load, "field.safetensors", "rays are saved"),
    ],
)
def test04_errors_are_sentences(files, load, name, said):
    with pytest.raises((nerg.NergError, FileNotFoundError), match=said):
        load(files / name)


def test05_invalid_names_are_refused(files):
    with pytest.raises(nerg.NergError, match="given as a string"):
        nerg.RadianceField.load(3)
    with pytest.raises(nerg.NergError, match="saved as .safetensors"):
        nerg.RadianceField.load(files / "field.safetensors").save(files / "field.ckpt")


def test06_a_field_without_a_file(files):
    network = nerg.GazeField.load(files / "gaze.safetensors").network
    assert repr(GazeField(network)).startswith("<gaze field in memory: ")
