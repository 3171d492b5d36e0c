"""Parts and their keys, and the store of their outputs."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks import task as module
from nerg_mi.tasks.engines import LocalEngine, run_plan
from nerg_mi.tasks.store import Store, delete_stale, list_files, read_contents, read_plan, read_status
from nerg_mi.tasks.task import (
    RENDER_LIBRARIES,
    Checksums,
    FileGroup,
    InputFile,
    Part,
    Plan,
    compute_code_digest,
    compute_sources_digest,
    compute_value_digest,
    find_inputs,
    relocate_paths,
)
from tests.tasks import works

# ---- Keys of parts, and layouts of files ----


@dataclass(frozen=True)
class Pair:
    first: object
    second: object = None


@dataclass(frozen=True)
class Other:
    first: object
    second: object = None


def key(value=1, common=None, work=works.write_mixture, suffix=".txt", label="", libraries=RENDER_LIBRARIES):
    (task,) = Plan("p", work, common, [Part(value, label)], suffix, libraries).tasks
    return task.key


def test_key_depends_on_results_only(monkeypatch):
    reference = key()
    assert reference == key(label="called otherwise") == key(1)
    others = [
        key(2),
        key("1"),
        key(common=1),
        key(work=works.write_folder),
        key(suffix=".csv"),
        key(libraries=("numpy",)),
    ]
    with monkeypatch.context() as patch:
        patch.setattr(module, "compute_code_digest", lambda: "other")
        others.append(key())
    with monkeypatch.context() as patch:
        patch.setattr(module, "version", lambda name: "other")
        others.append(key())
    with monkeypatch.context() as patch:
        patch.setattr(module, "FORMAT", module.FORMAT + 1)
        others.append(key())
    assert len({reference, *others}) == 10 and key() == reference


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
def test_different_values_have_different_digests(one, other):
    assert compute_value_digest(one) != compute_value_digest(other)


def test_equal_values_have_equal_digests():
    assert compute_value_digest({"b": 1, "a": [2]}) == compute_value_digest({"a": (2,), "b": np.int64(1)})
    complete = np.arange(6.0).reshape(2, 3)
    assert compute_value_digest(complete[:, ::2]) == compute_value_digest(complete[:, ::2].copy())
    for value in (object(), np.array([object()]), {1, 2}):
        with pytest.raises(TypeError, match="cannot be part of a key"):
            compute_value_digest(value)


def test_plan_limits(monkeypatch):
    monkeypatch.setattr(module, "MAX_PARTS", 3)
    with pytest.raises(NergError, match="has 4 parts"):
        works.make_plan(4)
    with pytest.raises(ValueError, match="is not a module-level function"):
        key(work=lambda common, value, output: None)
    for wrong in ("png", "/..", ".a/b", "..", ".part/"):
        with pytest.raises(ValueError, match="is not a valid output suffix"):
            key(suffix=wrong)


# ---- Files ----


@pytest.fixture
def scene_folder(tmp_path):
    (tmp_path / "scene" / "meshes").mkdir(parents=True)
    (tmp_path / "scene" / "scene.xml").write_text("<scene/>")
    (tmp_path / "scene" / "meshes" / "a.ply").write_text("ply")
    (tmp_path / "gaze.safetensors").write_text("field")
    return tmp_path


def make_scene_value(scene_folder):
    return FileGroup(
        scene_folder / "scene" / "scene.xml",
        (scene_folder / "scene" / "scene.xml", scene_folder / "scene" / "meshes" / "a.ply"),
    )


def test_names_are_relative_and_independent_of_machine(scene_folder, tmp_path):
    value = {
        "scene": make_scene_value(scene_folder),
        "again": scene_folder / "scene" / "scene.xml",
        "gaze": scene_folder / "gaze.safetensors",
    }
    names = [file.name for file in find_inputs(value, Checksums()).values()]
    assert names == ["value/scene/scene.xml", "value/scene/meshes/a.ply", "value/gaze/gaze.safetensors"]
    before = key(value)
    scene_folder.joinpath("scene").rename(scene_folder / "moved")
    path = scene_folder / "moved" / "scene.xml"
    moved = FileGroup(path, (path, scene_folder / "moved" / "meshes" / "a.ply"))
    assert key({"scene": moved, "again": moved.path, "gaze": scene_folder / "gaze.safetensors"}) == before
    (scene_folder / "moved" / "meshes" / "a.ply").write_text("plx")
    assert key({"scene": moved, "again": moved.path, "gaze": scene_folder / "gaze.safetensors"}) != before


def test_absolute_path_in_text_is_replaced_by_bytes(scene_folder):
    scene = make_scene_value(scene_folder)
    texts = {"mesh": str(scene.members[1]), "level": "0.5"}
    before = key(Pair(scene, texts))
    assert key(Pair(scene, {**texts, "level": "0.6"})) != before
    laid = works.lay_out(Pair(scene, texts), scene_folder / "there")
    assert Path(laid.second["mesh"]).read_text() == "ply" and str(scene_folder / "there") in laid.second["mesh"]
    assert laid.second["level"] == "0.5" and key(laid) == before


def test_folder_is_represented_by_its_files(scene_folder):
    files = FileGroup(scene_folder / "scene", (scene_folder / "scene" / "meshes" / "a.ply",))
    laid = works.lay_out(files, scene_folder / "there")
    assert laid.path.is_dir() and (laid.path / "meshes" / "a.ply").read_text() == "ply" and key(laid) == key(files)
    (scene_folder / "scene" / "scene.xml").write_text("of no account")
    assert key(files) == key(laid)


def test_relocation_replaces_only_input_paths(scene_folder):
    value = Pair(scene_folder / "gaze.safetensors", ("text", 1, np.zeros(2)))
    inputs = tuple(find_inputs(value, Checksums()).values())
    relocated = relocate_paths(value, inputs, scene_folder / "there")
    assert relocated.first == scene_folder / "there" / inputs[0].name and relocated.second is value.second
    assert relocate_paths(value, (), scene_folder) is value


@pytest.mark.parametrize("name", ["", "/etc/passwd", "../a", "a/../../b", "a\\b"])
def test_names_must_not_leave_folder(name):
    with pytest.raises(ValueError, match="not a relative path"):
        InputFile(name, "", 0, "")


def test_missing_file_is_named(scene_folder):
    with pytest.raises(NergError, match=r"none\.xml"):
        key(scene_folder / "none.xml")


def test_unchanged_file_is_read_once(scene_folder, monkeypatch):
    read, checksums, original = [], Checksums(), module.file_sha256
    monkeypatch.setattr(module, "file_sha256", lambda path: read.append(path) or original(path))
    file = scene_folder / "gaze.safetensors"
    first = checksums.compute(file)
    assert checksums.compute(file) == first and len(read) == 1
    file.write_text("longer than before")
    assert checksums.compute(file) != first and len(read) == 2


def test_file_that_changes_while_read_is_not_cached(scene_folder, monkeypatch):
    """Bytes that exist only during a read must not be cached for the original file, even if its modification time is
    restored with its bytes.
    """
    file, checksums, original = scene_folder / "gaze.safetensors", Checksums(), module.file_sha256
    before = os.stat(file)

    def change_and_read(path):
        file.write_bytes(b"FIELD")
        os.utime(file, ns=(1, 1))
        return original(path)

    monkeypatch.setattr(module, "file_sha256", change_and_read)
    assert checksums.compute(file) == hashlib.sha256(b"FIELD").hexdigest()
    monkeypatch.setattr(module, "file_sha256", original)
    file.write_bytes(b"field")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert checksums.compute(file) == hashlib.sha256(b"field").hexdigest()


# ---- Code ----


def test_keys_include_code_and_libraries():
    assert (
        len(compute_code_digest()) == 16
        and int(compute_code_digest(), 16) >= 0
        and all(version(name) for name in RENDER_LIBRARIES)
    )


def test_code_digest_covers_computing_sources(tmp_path):
    sources = ("maths/vmf.py", "workflows/render.py", "cli/render.py", "tasks/store.py", "notes.txt")
    for name in sources:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("x = 1\n")
    before = compute_sources_digest([("nerg_mi", tmp_path)])
    for name in sources:
        (tmp_path / name).write_text("x = 2\n")
        changed = compute_sources_digest([("nerg_mi", tmp_path)])
        assert (changed != before) == (name in sources[:2]), name
        before = changed


# ---- Stores: atomic outputs, verification, and status ----


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def make_output(store, plan):
    return list(run_plan(plan, store, LocalEngine()))


def test_output_has_manifest(store):
    plan = works.make_plan(1)
    make_output(store, plan)
    (task,), (receipt,) = plan.tasks, store.iter_manifests()
    output = store.output_path(task.key, ".txt")
    assert output == store.folder / task.key[:2] / f"{task.key}.txt" and output.read_bytes() == works.expected(0)
    assert receipt.sha256 == hashlib.sha256(works.expected(0)).hexdigest() and receipt.size == 65
    assert store.find_valid(task.key, ".txt") == store.read_manifest(task.key) == receipt and receipt.label == "part 0"


def test_store_is_initially_empty(store):
    assert store.find_valid(works.make_plan(1).tasks[0].key, ".txt") is None and not store.folder.exists()


@pytest.mark.parametrize("harm", ["flip", "shorten", "remove", "receipt", "empty receipt", "another's", "version 1"])
def test_damaged_outputs_are_invalid(store, harm):
    plan = works.make_plan(2)
    task, other = plan.tasks
    make_output(store, plan)
    output, receipt = store.output_path(task.key, ".txt"), store.manifest_path(task.key)
    if harm == "flip":
        raw = bytearray(output.read_bytes())
        raw[3] ^= 1
        output.write_bytes(raw)
    elif harm == "shorten":
        output.write_bytes(output.read_bytes()[:-1])
    elif harm == "remove":
        output.unlink()
    elif harm == "receipt":
        receipt.write_text(receipt.read_text()[:-20])
    elif harm == "empty receipt":
        receipt.write_text("")
    elif harm == "version 1":
        receipt.write_text(json.dumps(json.loads(receipt.read_text()) | {"format": 1}))
    else:
        shutil.copy(store.manifest_path(other.key), receipt)
    assert store.find_valid(task.key, ".txt") is None and store.find_valid(other.key, ".txt") is not None
    make_output(store, plan)
    assert store.find_valid(task.key, ".txt") is not None and output.read_bytes() == works.expected(0)


def test_output_may_be_a_folder(store):
    plan = works.folders(3)
    make_output(store, plan)
    (task,) = plan.tasks
    output = store.output_path(task.key, "/")
    assert [f.relative_to(output).as_posix() for f in list_files(output)] == ["a.txt", "below/b.txt"]
    (output / "below" / "b.txt").write_text("c\n")
    assert store.find_valid(task.key, "/") is None
    make_output(store, plan)
    assert (output / "below" / "b.txt").read_text() == "b\n" and store.find_valid(task.key, "/") is not None
    store.remove(task.key, "/")
    assert not output.exists() and list(store.iter_manifests()) == []


def test_imported_output_is_verified(store, tmp_path):
    imported = Store(tmp_path / "elsewhere")
    for plan in (works.make_plan(1), works.folders(3)):
        (output,) = make_output(imported, plan)
        (task,) = plan.tasks
        receipt = imported.read_manifest(task.key)
        with pytest.raises(NergError, match="was corrupted in transfer"):
            store.import_output(task, receipt, [("a" if task.suffix == "/" else "", b"something else")])
        assert store.find_valid(task.key, task.suffix) is None and not store.output_path(task.key, task.suffix).exists()
        store.import_output(task, receipt, read_contents(output.path))
        assert store.find_valid(task.key, task.suffix) == receipt


def test_full_disk_leaves_no_partial_output(store):
    """The size of files is limited to some hundred bytes, which a plan exceeds."""
    plan = works.make_plan(1)
    store.save_plan(plan)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))
    try:
        with pytest.raises(NergError, match="raise the limit"):
            next(LocalEngine().run(plan.shared, plan.tasks, store, print))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not [p for p in store.folder.glob("??/*") if p.is_file()]


def test_unwritable_store_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(NergError, match="parents is a file"):
        Store(tmp_path / "file" / "store")


def test_scratch_folder_is_removed(store):
    with store.make_scratch_folder() as folder:
        (folder / "rays.npz").write_text("12345")
        assert store.find_leftovers(3600) == [] and store.find_leftovers(-1) == [folder]
    assert not folder.exists()


# ---- Plans ----


def test_plan_is_saved_and_replaced_by_name(store, tmp_path):
    (tmp_path / "a").write_text("x")
    (store.folder / "b").parent.mkdir()
    (store.folder / "b").write_text("made by a part")
    plan = works.make_plan(2, (tmp_path / "a", store.folder / "b"))
    path = store.save_plan(plan)
    plans = read_plan(path)
    sha256 = hashlib.sha256(b"x").hexdigest()
    assert (plans.name, plans.keys) == ("p", {t.key: ".txt" for t in plan.tasks})
    assert plans.inputs == {str(tmp_path / "a"): sha256} and plans.common == {sha256}
    assert store.save_plan(works.make_plan(1)) == path
    store.save_plan(works.make_plan(3, what="a film"))
    assert [(p.name, len(p.keys)) for p in store.read_plans()] == [("a film", 3), ("p", 1)]


GOOD = {"format": 2, "what": "p", "inputs": {}, "common": [], "keys": {"a" * 64: ".png"}}


@pytest.mark.parametrize(
    "change",
    [
        {"format": 1},
        {"what": 3},
        {"keys": []},
        {"keys": {"a" * 64: 3}},
        {"inputs": {"a": None}},
        {"common": [3]},
        {"common": None},
        {"keys": {"../../etc": ".png"}},
        {"keys": {"a" * 64: "/../x"}},
    ],
)
def test_invalid_plan_is_refused(tmp_path, change):
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(GOOD))
    assert read_plan(path).name == "p"
    path.write_text(json.dumps({**GOOD, **change}))
    with pytest.raises(NergError, match=r"plan\.json.*start (its|the) job again"):
        read_plan(path)


# ---- Status ----


def test_status_of_interrupted_job(store):
    arriving = run_plan(works.make_plan(5), store, LocalEngine())
    next(arriving), next(arriving)
    arriving.close()
    account = read_status(store)
    (job,) = account.jobs
    assert (job.name, job.total, job.done, job.remaining, job.bytes) == ("p", 5, 2, 3, 130)
    assert account.stale == () and account.leftovers == () and account.bytes == 130 and job.seconds >= 0


def test_outputs_without_job_are_stale(store):
    (
        make_output(store, works.make_plan(4)),
        make_output(store, works.make_plan(2, what="another")),
        make_output(store, works.make_plan(1)),
    )
    account = read_status(store)
    assert sorted(r.label for r in account.stale) == ["part 2", "part 3"]
    assert account.stale_bytes == 130 == delete_stale(store, account)
    left = read_status(store)
    assert left.stale == () and [job.done for job in left.jobs] == [2, 1] and left.bytes == 130


def test_outputs_of_changed_files_are_stale(store, tmp_path):
    """A file of all parts, a file of a single part, and a missing file."""
    for name in "abc":
        (tmp_path / name).write_text(f"{name} before")
    make_output(store, works.make_plan(2, (tmp_path / "a",), what="all"))
    make_output(store, works.read_one(tmp_path / "b", tmp_path / "c"))
    for name in "ab":
        (tmp_path / name).write_text("after")
    (tmp_path / "c").unlink()
    account = read_status(store)
    both, each = account.jobs
    assert both.changed == (str(tmp_path / "a"),) and both.outdated == 2
    assert each.changed == (str(tmp_path / "b"),) and each.missing == (str(tmp_path / "c"),) and each.outdated == 1
    assert {r.label for r in account.stale} == {"part 0", "part 1", "of b"}
    delete_stale(store, account)
    assert [r.label for r in store.iter_manifests()] == ["of c"]


def test_bytes_in_another_file_are_not_outdated(store, tmp_path):
    for name in "ab":
        (tmp_path / name).write_text("alike")
    make_output(store, works.read_one(tmp_path / "a", tmp_path / "b"))
    (tmp_path / "a").write_text("other")
    account = read_status(store)
    assert account.jobs[0].changed == (str(tmp_path / "a"),) and account.jobs[0].outdated == 0 and account.stale == ()


def test_old_leftovers_are_removed(store):
    make_output(store, works.make_plan(2))
    hidden = next(store.folder.glob("??")) / ".abc.part.txt"
    hidden.write_text("half")
    folder = hidden.with_name(".abd.part")
    (folder / "below").mkdir(parents=True)
    (folder / "below" / "x").write_text("12345")
    unsigned = works.make_plan(2).tasks[1].key
    store.manifest_path(unsigned).unlink()
    assert read_status(store).leftovers == ()
    for path in (hidden, folder, store.output_path(unsigned, ".txt")):
        os.utime(path, (1, 1))
    account = read_status(store)
    assert len(account.leftovers) == 3 and account.leftover_bytes == 9 + 65 == delete_stale(store, account)
    assert not hidden.exists() and not folder.exists() and read_status(store).jobs[0].done == 1


def test_other_folder_is_refused(tmp_path):
    with pytest.raises(NergError, match="contains no parts of jobs"):
        read_status(Store(tmp_path))


def test_manifests_of_other_keys_are_ignored(store):
    make_output(store, works.make_plan(1))
    (receipt,) = store.iter_manifests()
    store.add_manifest(replace(receipt, key="f" * 64))
    assert store.find_valid("f" * 64, ".txt") is None and Path(store.manifest_path("f" * 64)).exists()
