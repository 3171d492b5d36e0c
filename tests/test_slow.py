"""The list of slow tests is of the tests that are there."""

import ast

from tests.conftest import ROOT, listed_as_slow


def test_the_list_is_up_to_date():
    listed, gone, functions = listed_as_slow(), [], {}
    for entry in sorted(listed):
        path, _, name = entry.partition("::")
        if path not in functions:
            file = ROOT / path
            tree = ast.parse(file.read_text(encoding="utf-8") if file.is_file() else "")
            functions[path] = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        if name not in functions[path]:
            gone.append(entry)
    # A test that got another name is at worst run by make check.
    assert len(listed) > 20 and len(gone) <= len(listed) / 10, (
        f"tests/slow.txt is out of date; it names {', '.join(gone)}"
    )


def test_they_are_marked(request):
    slow = listed_as_slow()
    for item in request.session.items:
        if item.nodeid.partition("[")[0] in slow:
            assert item.get_closest_marker("slow") is not None
