"""Files that tasks read: called by where they lie to each other, known by their bytes."""

import hashlib
import os

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import inputs as module
from nerg_mi.tasks.inputs import ChangedInput, Checksums, InputFile, check_unchanged, name_of, read_input, read_inputs


@pytest.fixture
def place(tmp_path):
    (tmp_path / "scene" / "meshes").mkdir(parents=True)
    (tmp_path / "scene" / "scene.xml").write_text("<scene/>")
    (tmp_path / "scene" / "meshes" / "a.ply").write_text("ply")
    (tmp_path / "field.safetensors").write_text("field")
    return tmp_path


def test_names_tell_how_files_lie_to_each_other(place):
    paths = [place / "scene" / "scene.xml", place / "scene" / "meshes" / "a.ply"]
    assert [f.name for f in read_inputs(paths)] == ["scene.xml", "meshes/a.ply"]
    found = read_inputs([*paths, place / "field.safetensors", paths[0]])
    assert [f.name for f in found] == ["scene/scene.xml", "scene/meshes/a.ply", "field.safetensors"]
    assert [f.size for f in found] == [8, 3, 5]
    assert found[1].sha256 == hashlib.sha256(b"ply").hexdigest() and found[1].path == str(paths[1])
    assert name_of(paths[0], found) == "scene/scene.xml" and read_inputs([]) == ()


@pytest.mark.parametrize("name", ["", "/etc/passwd", "../a", "a/../../b", "a\\b"])
def test_names_lead_nowhere_else(name):
    with pytest.raises(ValueError, match="relative path that goes down"):
        InputFile(name, "", 0, "")


def test_a_file_that_is_missing_is_named(place):
    with pytest.raises(NergError, match=r"none\.xml"):
        read_inputs([place / "none.xml"])


def test_a_file_is_read_once_while_it_stays(place, monkeypatch):
    read, checksums = [], Checksums()
    original = module.file_sha256
    monkeypatch.setattr(module, "file_sha256", lambda path: read.append(path) or original(path))
    file = place / "field.safetensors"
    first = checksums.of(file)
    assert checksums.of(file) == first and len(read) == 1
    file.write_text("other")
    os.utime(file, ns=(1, 1))
    assert checksums.of(file) == hashlib.sha256(b"other").hexdigest() and len(read) == 2
    # A file of another size is another one, whatever its time of change says.
    file.write_text("longer")
    os.utime(file, ns=(1, 1))
    assert checksums.of(file) == hashlib.sha256(b"longer").hexdigest() and len(read) == 3


def test_a_file_that_changes_while_it_is_read_is_not_remembered(place, monkeypatch):
    """Bytes that were there for the length of a reading are not those of the file that was there before, though its
    time of change is put back with its bytes."""
    file, checksums, original = place / "field.safetensors", Checksums(), module.file_sha256
    before = os.stat(file)

    def change_and_read(path):
        file.write_bytes(b"FIELD")
        os.utime(file, ns=(1, 1))
        return original(path)

    monkeypatch.setattr(module, "file_sha256", change_and_read)
    assert checksums.of(file) == hashlib.sha256(b"FIELD").hexdigest()
    monkeypatch.setattr(module, "file_sha256", original)
    file.write_bytes(b"field")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert checksums.of(file) == hashlib.sha256(b"field").hexdigest()


def test_a_change_is_told(place):
    file, checksums = place / "field.safetensors", Checksums()
    planned, where = read_input("field", file), {"field": file}
    check_unchanged((planned,), where, checksums)
    file.write_text("another")
    with pytest.raises(ChangedInput, match="changed while the job"):
        check_unchanged((planned,), where, checksums)
