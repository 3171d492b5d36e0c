"""Fields and rays in memory, from files and back."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.scene import TrainedField


def test01_a_field_is_what_its_file_says(files):
    field = nerg.load_field(files / "field.safetensors")
    assert field.kind == "radiance" and field.name == "field.safetensors" and field.provenance == {"test": 0}
    assert np.array_equal(field.bounds, [(-1, -1, -1), (1, 1, 1)])
    assert field.weights == sum(value.numpy().size for value in field.network.parameters().values())
    assert repr(field).startswith("<radiance field field.safetensors: ") and "box (-1, -1, -1) to (1, 1, 1)>" in repr(
        field
    )


def test02_what_is_saved_is_the_same_field(files, tmp_path):
    for load, name in ((nerg.load_field, "field"), (nerg.load_gaze, "gaze")):
        field = load(str(files / f"{name}.safetensors"))
        path = field.save(tmp_path / f"{name}.safetensors")
        again = load(path)
        assert again.provenance == field.provenance
        for key, value in field.network.parameters().items():
            assert np.array_equal(value.numpy(), again.network.parameters()[key].numpy()), key


def test03_half_the_size(files, tmp_path):
    field = nerg.load_field(files / "field.safetensors")
    whole, half = (field.save(tmp_path / f"{h}.safetensors", half=h).stat().st_size for h in (False, True))
    assert half < 0.7 * whole


@pytest.mark.parametrize(
    "load, name, said",
    [
        (nerg.load_field, "gaze.safetensors", "holds a gaze field"),
        (nerg.load_gaze, "field.safetensors", "holds a radiance field"),
        (nerg.load_field, "nowhere.safetensors", "does not exist"),
        (nerg.load_rays, "nowhere.npz", "nowhere.npz"),
        (nerg.load_rays, "field.safetensors", "rays are kept"),
    ],
)
def test04_errors_are_sentences(files, load, name, said):
    with pytest.raises((nerg.NergError, FileNotFoundError), match=said):
        load(files / name)


def test05_what_is_no_name(files):
    with pytest.raises(nerg.NergError, match="named by a string"):
        nerg.load_field(3)
    with pytest.raises(nerg.NergError, match="saved as .safetensors"):
        nerg.load_field(files / "field.safetensors").save(files / "field.ckpt")


def test06_a_field_without_a_file(files):
    network = nerg.load_gaze(files / "gaze.safetensors").network
    assert repr(TrainedField(network)).startswith("<gaze field in memory: ")
