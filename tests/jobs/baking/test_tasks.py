"""Parts of a bake as tasks, run where nothing lies but what was sent."""

import shutil

from nerg_mi.jobs.baking import tasks
from nerg_mi.jobs.baking.chunks import BakeScene
from nerg_mi.jobs.baking.summing import sums_in_one_go
from nerg_mi.surfaces.sources import GazeSettings
from nerg_mi.tasks.inputs import Checksums
from nerg_mi.tasks.making import make_output
from nerg_mi.tasks.run import Output
from nerg_mi.tasks.store import Store
from tests.jobs.baking.test_summing import GAZE, ROOM, crowd, equal, parts
from tests.jobs.recorder import Recorder
from tests.surfaces.meshes import box


def sent(task, folder):
    """The inputs of ``task``, copied below ``folder`` under their names."""
    paths = {file.name: folder / file.name for file in task.inputs}
    for file in task.inputs:
        paths[file.name].parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file.path, paths[file.name])
    return paths


def test_files_that_were_sent_serve_as_those_that_lie_there(tmp_path, rgb):
    """A worker has what it was sent in a folder of its own, under the names of the inputs."""
    scene = BakeScene(ROOM, (box((1, 1, 0), (2, 2, 1)),), GAZE, of_gaze=GazeSettings(angle=0.5, directions=1024))
    own = parts(tmp_path / "store")
    (task,) = tasks.tasks_of(scene, crowd(1), "llvm_ad_rgb", own)
    paths = sent(task, tmp_path / "sent")
    there = Store(tmp_path / "there")
    receipt = make_output(task, paths, there, Checksums())
    (whole,) = sums_in_one_go(scene, [crowd(1)], Recorder())
    found = tasks.read_sums(Output(there.output(task.key, ".npy"), receipt.notes), len(ROOM.faces))
    assert equal([found], [whole]) and task.label == "observers 1 to 1"
