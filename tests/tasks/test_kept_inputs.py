"""Files of a worker: its own, or copies that it was sent."""

import shutil

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.inputs import read_inputs
from nerg_mi.tasks.kept_inputs import KeptInputs


@pytest.fixture
def files(tmp_path):
    (tmp_path / "scene" / "meshes").mkdir(parents=True)
    (tmp_path / "scene" / "scene.xml").write_text("<scene/>")
    (tmp_path / "scene" / "meshes" / "a.ply").write_bytes(bytes(range(256)) * 100)
    return [tmp_path / "scene" / "scene.xml", tmp_path / "scene" / "meshes" / "a.ply"]


def send(kept, file, parts=3):
    raw = file.read_bytes()
    step = -(-len(raw) // parts)
    (found,) = read_inputs([file])
    for k in range(parts):
        kept.receive(found.sha256, k, parts, raw[k * step : (k + 1) * step])


def test_files_that_are_where_they_were_planned_are_read_there(files):
    inputs = read_inputs(files)
    assert KeptInputs().paths(inputs) == {"scene.xml": str(files[0]), "meshes/a.ply": str(files[1])}


def test_files_that_are_elsewhere_are_sent_and_laid_out_alike(files, tmp_path):
    inputs, kept = read_inputs(files), KeptInputs()
    shutil.move(tmp_path / "scene", tmp_path / "client")
    assert kept.paths(inputs) is None and set(kept.missing(inputs)) == {f.sha256 for f in inputs}
    send(kept, tmp_path / "client" / "meshes" / "a.ply")
    assert kept.missing(inputs) == [inputs[0].sha256] and kept.paths(inputs) is None
    send(kept, tmp_path / "client" / "scene.xml", 1)
    found = kept.paths(inputs)
    laid = kept.folder.joinpath("laid")
    assert all(str(path).startswith(str(laid)) for path in found.values())
    for name, path in found.items():
        with open(path, "rb") as copy:
            assert copy.read() == (tmp_path / "client" / name).read_bytes() and path.endswith(name)
    assert kept.paths(inputs) == found and not list((kept.folder / "parts").iterdir())


def test_a_file_that_is_another_one_here_is_not_read(files):
    """Of two files one is the same here: it is copied, and laid out beside the one that was sent."""
    inputs, kept = read_inputs(files), KeptInputs()
    before = files[0].read_bytes()
    files[0].write_text("<other>/")
    assert kept.missing(inputs) == [inputs[0].sha256]
    kept.receive(inputs[0].sha256, 0, 1, before)
    found = kept.paths(inputs)
    with open(found["scene.xml"]) as copy:
        assert copy.read() == "<scene/>"


def test_what_arrives_wrong_is_refused(files):
    inputs, kept = read_inputs(files), KeptInputs()
    with pytest.raises(NergError, match="arrived with other bytes"):
        kept.receive(inputs[0].sha256, 0, 1, b"something else")
    assert not (kept.folder / "files" / inputs[0].sha256).exists()
