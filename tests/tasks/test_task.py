"""Keys of parts: what changes them, and what does not; and files wherever they are laid out."""

import hashlib
import os
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import task as module
from nerg_mi.tasks.task import (
    RENDERS,
    Checksums,
    Files,
    InputFile,
    Part,
    Plan,
    code_digest,
    digest_of_sources,
    digest_of_value,
    inputs_of,
    relocated,
)
from tests.tasks import works


@dataclass(frozen=True)
class Pair:
    first: object
    second: object = None


@dataclass(frozen=True)
class Other:
    first: object
    second: object = None


def key(value=1, common=None, work=works.mixed, suffix=".txt", label="", libraries=RENDERS):
    (task,) = Plan("p", work, common, [Part(value, label)], suffix, libraries).tasks
    return task.key


def test_what_changes_a_key_and_what_does_not(monkeypatch):
    assert key() == key(label="called otherwise") == key(1)
    others = [key(2), key(common=1), key(work=works.folder), key(suffix=".csv"), key(libraries=("numpy",)), key("1")]
    monkeypatch.setattr(module, "code_digest", lambda: "other")
    assert len({key(), *others}) == 7


@pytest.mark.parametrize(
    "one, other",
    [
        (Pair(1), Pair(2)),
        (Pair(1), Other(1)),
        (Pair(1), Pair(None, 1)),
        ((1, (2, 3)), ((1, 2), 3)),
        ("1", 1),
        (True, 1),
        (0.1 + 0.2, 0.3),
        (float("nan"), None),
        ({"a": 1}, {"b": 1}),
        (np.zeros(4), np.zeros((2, 2))),
        (np.zeros(4), np.zeros(4, np.float32)),
        (np.array([1.0, 2.0]), np.array([1.0, np.nextafter(2.0, 3)])),
        (np.array([0.0]), np.array([-0.0])),
    ],
)
def test_values_that_differ_have_other_digests(one, other):
    assert digest_of_value(one) != digest_of_value(other)


def test_equal_values_have_equal_digests():
    assert digest_of_value({"b": 1, "a": [2]}) == digest_of_value({"a": (2,), "b": np.int64(1)})
    whole = np.arange(6.0).reshape(2, 3)
    assert digest_of_value(whole[:, ::2]) == digest_of_value(whole[:, ::2].copy())
    for value in (object(), np.array([object()]), {1, 2}):
        with pytest.raises(TypeError, match="cannot be part of a key"):
            digest_of_value(value)


def test_a_plan_has_bounds_and_works_that_processes_find(monkeypatch):
    monkeypatch.setattr(module, "MOST", 3)
    with pytest.raises(NergError, match="has 4 parts"):
        works.plan(4)
    with pytest.raises(ValueError, match="is not a function of a module"):
        key(work=lambda common, value, output: None)
    for wrong in ("png", "/..", ".a/b", "..", ".part/"):
        with pytest.raises(ValueError, match="is not the suffix"):
            key(suffix=wrong)


# ---- Files ----


@pytest.fixture
def place(tmp_path):
    (tmp_path / "scene" / "meshes").mkdir(parents=True)
    (tmp_path / "scene" / "scene.xml").write_text("<scene/>")
    (tmp_path / "scene" / "meshes" / "a.ply").write_text("ply")
    (tmp_path / "gaze.safetensors").write_text("field")
    return tmp_path


def scene_of(place):
    return Files(place / "scene" / "scene.xml", (place / "scene" / "scene.xml", place / "scene" / "meshes" / "a.ply"))


def test_names_tell_how_files_lie_to_each_other_and_nothing_of_the_machine(place, tmp_path):
    value = {"scene": scene_of(place), "again": place / "scene" / "scene.xml", "gaze": place / "gaze.safetensors"}
    names = [file.name for file in inputs_of(value, Checksums()).values()]
    assert names == ["value/scene/scene.xml", "value/scene/meshes/a.ply", "value/gaze/gaze.safetensors"]
    before = key(value)
    place.joinpath("scene").rename(place / "moved")
    path = place / "moved" / "scene.xml"
    moved = Files(path, (path, place / "moved" / "meshes" / "a.ply"))
    assert key({"scene": moved, "again": moved.path, "gaze": place / "gaze.safetensors"}) == before
    (place / "moved" / "meshes" / "a.ply").write_text("plx")
    assert key({"scene": moved, "again": moved.path, "gaze": place / "gaze.safetensors"}) != before


def test_a_file_that_a_text_names_by_its_whole_path_is_its_bytes(place):
    scene = scene_of(place)
    texts = {"mesh": str(scene.all[1]), "level": "0.5"}
    before = key(Pair(scene, texts))
    assert key(Pair(scene, {**texts, "level": "0.6"})) != before
    laid = works.laid_out(Pair(scene, texts), place / "there")
    assert Path(laid.second["mesh"]).read_text() == "ply" and str(place / "there") in laid.second["mesh"]
    assert laid.second["level"] == "0.5" and key(laid) == before


def test_a_folder_is_the_files_that_are_read_in_it(place):
    files = Files(place / "scene", (place / "scene" / "meshes" / "a.ply",))
    laid = works.laid_out(files, place / "there")
    assert laid.path.is_dir() and (laid.path / "meshes" / "a.ply").read_text() == "ply" and key(laid) == key(files)
    (place / "scene" / "scene.xml").write_text("of no account")
    assert key(files) == key(laid)


def test_what_is_laid_out_replaces_paths_of_its_inputs_alone(place):
    value = Pair(place / "gaze.safetensors", ("text", 1, np.zeros(2)))
    inputs = tuple(inputs_of(value, Checksums()).values())
    there = relocated(value, inputs, place / "there")
    assert there.first == place / "there" / inputs[0].name and there.second is value.second
    assert relocated(value, (), place) is value


@pytest.mark.parametrize("name", ["", "/etc/passwd", "../a", "a/../../b", "a\\b"])
def test_names_lead_nowhere_else(name):
    with pytest.raises(ValueError, match="relative path that goes down"):
        InputFile(name, "", 0, "")


def test_a_file_that_is_missing_is_named(place):
    with pytest.raises(NergError, match=r"none\.xml"):
        key(place / "none.xml")


def test_a_file_is_read_once_while_it_stays(place, monkeypatch):
    read, checksums, original = [], Checksums(), module.file_sha256
    monkeypatch.setattr(module, "file_sha256", lambda path: read.append(path) or original(path))
    file = place / "gaze.safetensors"
    first = checksums.of(file)
    assert checksums.of(file) == first and len(read) == 1
    file.write_text("longer than before")
    assert checksums.of(file) != first and len(read) == 2


def test_a_file_that_changes_while_it_is_read_is_not_remembered(place, monkeypatch):
    """Bytes that were there for the length of a reading are not those of the file that was there before, though its
    time of change is put back with its bytes."""
    file, checksums, original = place / "gaze.safetensors", Checksums(), module.file_sha256
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


# ---- Code ----


def test_keys_name_code_and_programs():
    assert len(code_digest()) == 16 and int(code_digest(), 16) >= 0 and all(version(name) for name in RENDERS)


def test_the_digest_follows_the_sources_that_compute(tmp_path):
    sources = ("maths/vmf.py", "workflows/film.py", "cli/render.py", "tasks/store.py", "notes.txt")
    for name in sources:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    before = digest_of_sources([("nerg_mi", tmp_path)])
    for name in sources:
        (tmp_path / name).write_text("x = 2\n")
        changed = digest_of_sources([("nerg_mi", tmp_path)])
        assert (changed != before) == (name in sources[:2]), name
        before = changed
