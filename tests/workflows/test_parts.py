"""From options to a store and an engine, and what is said of a store."""

import shutil

import pytest

from nerg_mi.errors import NergError
from nerg_mi.tasks.engines import Local, Processes, run_plan
from nerg_mi.tasks.store import Store
from nerg_mi.workflows.film import make_picture
from nerg_mi.workflows.options import PartOptions
from nerg_mi.workflows.parts import Parts, PlannedScene, account_for_store, size
from nerg_mi.workflows.scene_commands import PictureOptions
from tests.tasks import works
from tests.workflows.recorder import Recorder


def test_the_store_is_beside_the_output_unless_it_is_named(tmp_path):
    beside = Parts(PartOptions(scheduler="local:2"), tmp_path / "walk.mp4", Recorder())
    assert beside.store.folder == tmp_path / "walk.tasks" and isinstance(beside.engine, Processes)
    named = Parts(PartOptions(store=tmp_path / "s"), tmp_path / "walk.mp4", Recorder())
    assert named.store.folder == tmp_path / "s"


def test_progress_of_a_share_of_the_job(tmp_path):
    told = Recorder()
    parts = Parts(PartOptions(store=tmp_path / "s"), tmp_path / "a", told)
    assert len(list(parts.run(works.plan(2), 0.0, 0.8))) == 2
    assert len(list(parts.run(works.some(*"abcd"), 0.8))) == 4
    assert [round(share, 2) for share, _ in told.steps] == [0.0, 0.4, 0.8, 0.8, 0.85, 0.9, 0.95, 1.0]
    texts = [text for _, text in told.steps]
    assert all(" left" not in text for text in texts[:3]) and texts[0] == "0 of 2 parts"
    assert texts[-1].startswith("4 of 4 parts") and texts[-1].endswith("0 s left")


def test_ctrl_c_says_where_the_parts_are(tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            raise KeyboardInterrupt

    parts = Parts(PartOptions(store=tmp_path / "s"), tmp_path / "a", Impatient())
    with pytest.raises(KeyboardInterrupt, match=r"kept in .*/s: the same command goes on"):
        list(parts.run(works.plan(2)))


def test_a_scene_that_reads_another_file_than_was_planned_is_refused(tmp_path):
    """As on a worker where a whole path leads to somebody else's file."""
    (tmp_path / "more.xml").write_text('<scene version="3.0.0"/>')
    scene = tmp_path / "scene.xml"
    scene.write_text(f'<scene version="3.0.0"><include filename="{tmp_path / "more.xml"}"/></scene>')
    planned = PlannedScene.of(scene)
    assert planned.checked() == scene and len(planned.files.all) == 2
    there = works.laid_out(planned, tmp_path / "worker")
    with pytest.raises(NergError, match="is not the file that the job was planned with"):
        make_picture(PictureOptions(), there, tmp_path / "a.png")
    scene.write_text('<scene version="3.0.0"><include filename="more.xml"/></scene>')
    there = works.laid_out(PlannedScene.of(scene), tmp_path / "relative")
    shutil.move(tmp_path / "more.xml", tmp_path / "gone.xml")
    assert there.checked().read_text() == scene.read_text() and there.checked() != scene


# ---- What is said of a store ----


def test_lines_and_removal(tmp_path):
    (tmp_path / "a").write_text("before")
    store = Store(tmp_path / "store")
    arriving = run_plan(works.plan(5, what="nerg render walk.mp4"), store, Local())
    next(arriving), next(arriving)
    arriving.close()
    list(run_plan(works.plan(2, (tmp_path / "a",), what="another"), store, Local()))
    (tmp_path / "a").write_text("after")
    told = Recorder()
    account = account_for_store(store.folder, reporter=told)
    lines = told.messages[0].splitlines()
    assert lines[2].startswith("| another | 2 | 2 | 0 | 130 bytes | 0 s | 2 |")
    assert lines[3].startswith("| nerg render walk.mp4 | 5 | 2 | 3 | 130 bytes |")
    assert told.messages[1] == f"changed since another: {tmp_path / 'a'}"
    assert told.messages[2].startswith("260 bytes in all; stale: 2 outputs, 130 bytes;")
    assert "--remove-stale" in told.messages[3] and len(account.stale) == 2
    told = Recorder()
    account_for_store(store.folder, True, told)
    assert told.messages[-1] == "Removed 130 bytes." and len(list(store.receipts())) == 2


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(NergError, match="there is no folder"):
        account_for_store(tmp_path / "none")


def test_sizes():
    counts = (0, 999, 1200, 34_000, 5_600_000, 7.8e9, 2e12)
    assert [size(n) for n in counts] == ["0 bytes", "999 bytes", "1.2 kB", "34 kB", "5.6 MB", "7.8 GB", "2.0 TB"]
