"""Parts of a bake of splats as tasks, run where nothing lies but what was sent, and by two processes."""

import pytest

from nerg_mi.formats.splats.ply import write_ply_splats
from nerg_mi.jobs.baking import chunks, splat_tasks, tasks
from nerg_mi.jobs.baking.splat_chunks import SplatScene, splat_chunk
from nerg_mi.jobs.baking.summing import sums_in_one_go, sums_in_parts
from nerg_mi.surfaces.sources import RaySettings
from nerg_mi.tasks.inputs import Checksums
from nerg_mi.tasks.making import make_output
from nerg_mi.tasks.run import Output
from nerg_mi.tasks.store import Store
from tests.conftest import ROOT
from tests.jobs.baking.test_summing import crowd, equal, made, parts
from tests.jobs.baking.test_tasks import sent
from tests.jobs.recorder import Recorder
from tests.plugins import fields
from tests.surfaces.test_splat_rays import falling
from tests.surfaces.walls import wall


@pytest.fixture
def scene(tmp_path, rgb, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(chunks, "RAYS", 200)
    splat_tasks._last.clear()
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    fields.gaze(tmp_path / "gaze.safetensors")
    return SplatScene(
        tmp_path / "wall.ply", len(plain), tmp_path / "gaze.safetensors", of_rays=RaySettings(cone=0.03, bundle=4)
    )


@pytest.mark.nightly
def test01_two_processes_give_the_sums_of_one_and_what_is_kept_is_not_made_again(scene, tmp_path):
    groups = [falling(500, 0.5), crowd(2)]
    whole = sums_in_one_go(scene, groups, Recorder(), splat_chunk)
    own = parts(tmp_path / "store", scheduler="local:2")
    assert equal(sums_in_parts(scene, groups, own, "a bake", splat_tasks.splat_tasks_of), whole)
    told = Recorder()
    sums_in_parts(scene, [falling(600, 0.5)], parts(tmp_path / "store", told), "a bake", splat_tasks.splat_tasks_of)
    assert made(told) == 3
    sums_in_parts(scene, groups, parts(tmp_path / "store", told := Recorder()), "a bake", splat_tasks.splat_tasks_of)
    assert made(told) == 0


def test02_files_that_were_sent_serve_as_those_that_lie_there(scene, tmp_path):
    (task,) = splat_tasks.splat_tasks_of(scene, falling(100), "llvm_ad_rgb", parts(tmp_path / "store"))
    paths = sent(task, tmp_path / "sent")
    there = Store(tmp_path / "there")
    receipt = make_output(task, paths, there, Checksums())
    found = tasks.read_sums(Output(there.output(task.key, ".npy"), receipt.notes), 2 * scene.count)
    assert equal([found], sums_in_one_go(scene, [falling(100)], Recorder(), splat_chunk))
    assert task.label == "rays 1 to 100"
