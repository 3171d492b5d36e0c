"""The copy of the repository that mistakes are made in."""

from __future__ import annotations

import pytest

from tests.conftest import ROOT
from tools.mutation import bench


@pytest.mark.nightly
@pytest.mark.slow
def test_a_mistake_is_made_in_the_copy_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "BUILD", tmp_path)
    file = "nerg_mi/maths/elementary.py"
    before = (ROOT / file).read_text(encoding="utf-8")
    with bench.Bench() as copy:
        assert copy.source(file) == before and (copy.tree / "nerg_mi" / "plugins" / "nerg.py").is_file()
        copy.write(file, before.replace("def ", "def mistaken_", 1))
        assert copy.run(["tests/maths/test_elementary.py"], 120)["outcome"] == "failed"
        copy.write(file, before)
        assert copy.run(["tests/maths/test_elementary.py"], 120)["outcome"] == "passed"
        tree = copy.tree
    assert not tree.exists() and (ROOT / file).read_text(encoding="utf-8") == before
