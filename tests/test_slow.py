"""The list of slow tests names tests that are there."""

import ast

from tests.conftest import ROOT, listed_as_slow


def test_every_slow_test_is_there():
    listed = listed_as_slow()
    assert len(listed) > 20
    functions = {}
    for entry in sorted(listed):
        path, _, name = entry.partition("::")
        if path not in functions:
            tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
            functions[path] = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        assert name in functions[path], f"tests/slow.txt names {entry}, which is gone; take it out, or give its new name"


def test_they_are_marked(request):
    slow = listed_as_slow()
    for item in request.session.items:
        if item.nodeid.partition("[")[0] in slow:
            assert item.get_closest_marker("slow") is not None
