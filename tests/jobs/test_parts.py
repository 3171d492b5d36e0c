"""From options to a store and a scheduler."""

from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.jobs.options.parts import PartOptions
from nerg_mi.jobs.parts import Parts
from nerg_mi.tasks.plan import Plan
from nerg_mi.tasks.processes import Processes
from tests.jobs.recorder import Recorder
from tests.tasks import works


def test_parts_are_asked_for_by_either_option():
    assert not PartOptions().in_parts
    assert PartOptions(store=Path("s")).in_parts and PartOptions(scheduler="local").in_parts


def test_the_store_is_beside_the_output_unless_it_is_named(tmp_path):
    beside = Parts(PartOptions(scheduler="local:2"), tmp_path / "walk.mp4", Recorder())
    assert beside.store.folder == tmp_path / "walk.tasks" and isinstance(beside.scheduler, Processes)
    named = Parts(PartOptions(store=tmp_path / "s"), tmp_path / "walk.mp4", Recorder())
    assert named.store.folder == tmp_path / "s"
    with pytest.raises(NergError, match="there is no scheduler"):
        Parts(PartOptions(scheduler="x"), tmp_path / "walk.mp4", Recorder())


def test_progress_of_a_share_of_the_job(tmp_path):
    told = Recorder()
    parts = Parts(PartOptions(store=tmp_path / "s"), tmp_path / "a", told)
    assert len(list(parts.run(Plan("p", works.tasks(2)), 0.0, 0.8))) == 2
    assert len(list(parts.run(Plan("q", works.tasks(4)), 0.8))) == 4
    assert [round(share, 2) for share, _ in told.steps] == [0.0, 0.4, 0.8, 0.9, 0.95, 1.0]
    texts = [text for _, text in told.steps]
    assert all(" left" not in text for text in texts[:3]) and texts[0] == "0 of 2 parts"
    assert texts[-1].startswith("4 of 4 parts") and texts[-1].endswith("0 s left")


def test_ctrl_c_says_where_the_parts_are(tmp_path):
    class Impatient(Recorder):
        def progress(self, share, text=""):
            raise KeyboardInterrupt

    parts = Parts(PartOptions(store=tmp_path / "s"), tmp_path / "a", Impatient())
    with pytest.raises(KeyboardInterrupt, match=r"kept in .*/s: the same command goes on"):
        list(parts.run(Plan("p", works.tasks(2))))
