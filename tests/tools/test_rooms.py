"""The picture of the rooms says what the sources say."""

from __future__ import annotations

import pytest

from tests.conftest import ROOT
from tools import rooms
from tools.imports import modules


def test_every_room_is_drawn():
    folders = {path.parent.name for path in (ROOT / "nerg_mi").glob("*/__init__.py")}
    assert set(rooms.layers()) == folders | {"plugins", "scenes", rooms.MODULES}


def test_every_room_says_what_it_is():
    for name in rooms.layers():
        assert 5 < len(rooms.purpose(name)) <= 115 and rooms.purpose(name).endswith("."), name
    assert {"march", "media", "observer"} <= set(rooms.inner("transport"))


def test_imports_run_down():
    order, pairs = rooms.layers(), rooms.arrows()
    assert pairs["transport", "field"] == pairs["plugins", "transport"] == "load" and len(pairs) > 40
    assert [(a, b) for a, b in pairs if order.index(b) <= order.index(a)] == []


def test_scripts_are_scripts():
    for name in rooms.SCRIPTS:
        assert '__name__ == "__main__"' in modules()[name].read_text(encoding="utf-8")


@pytest.mark.nightly
def test_a_dot_for_each_pair():
    drawn = rooms.draw()
    assert drawn.count("<circle") == len(rooms.arrows()) + 2
    assert all(f">{name}</text>" in drawn for name in rooms.layers())
