"""Which calls are recorded, and how they are drawn."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from xml.etree import ElementTree

import pytest

from tools.ray_path import Call, Recorder, draw, lane

OUTER = """
class Plugin:
    def sample(self):
        self._helper()
        inner.density()
        inner.density()
    def _helper(self):
        inner.Mlp()(1)
        inner.maths()
        [inner.late() for _ in range(2)]
"""
INNER = """
class Mlp:
    def __init__(self): self.x = 1
    def __call__(self, y): return _private(y)
def _private(y): return y
def density(): return Mlp().x
def maths(): return 1
def late(): return 2
"""


@pytest.fixture
def recorded(tmp_path):
    """Calls of a plugin that calls a field, both of them made up."""
    spaces = {}
    for module, text in (("nerg_mi.field.inner", INNER), ("nerg_mi.plugins.outer", OUTER)):
        spaces[module] = {"inner": SimpleNamespace(**spaces.get("nerg_mi.field.inner", {}))}
        exec(compile(text, str(tmp_path / f"{module}.py"), "exec"), spaces[module])
    recorder = Recorder()
    recorder.modules = {str(tmp_path / f"{module}.py"): module for module in spaces}
    plugin = spaces["nerg_mi.plugins.outer"]["Plugin"]()
    sys.setprofile(recorder)
    try:
        plugin.sample()
    finally:
        sys.setprofile(None)
    return recorder.calls


def test_first_calls_from_module_to_module(recorded):
    """In order; private names and repeated calls are left out, and calls by a private function are its module's."""
    assert [c.name for c in recorded] == ["Mlp", "maths", "late", "density"]
    assert {(c.source, c.target) for c in recorded} == {("nerg_mi.plugins.outer", "nerg_mi.field.inner")}
    assert {c.depth for c in recorded} == {0}


def test_a_module_belongs_to_the_deepest_column():
    assert lane("nerg_mi.transport.march.primal") == "transport.march"
    assert lane("nerg_mi.transport.place") == "transport"
    assert lane("nerg_mi.plugins.nerg") == "plugins"
    assert lane("nerg_mi.density.kde.view") == "density"


def test_each_call_has_a_line_and_an_arrow():
    calls = [
        Call("nerg_mi.plugins.nerg", "nerg_mi.transport.place", "Place.trace", 0),
        Call("nerg_mi.transport.place", "nerg_mi.density.kde.view", "look", 1),
        Call("nerg_mi.transport.march.primal", "nerg_mi.transport.march.rules", "rule", 2),
    ]
    root = ElementTree.fromstring(draw(calls))
    words = {e.text: e for e in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"Place.trace", "look", "rule", "density"} <= set(words)
    assert float(words["rule"].get("x")) > float(words["look"].get("x")) > float(words["Place.trace"].get("x"))
    # The last one stays within its column.
    assert len(list(root.iter("{http://www.w3.org/2000/svg}polygon"))) == 2
