"""What is read of imports from syntax trees."""

from __future__ import annotations

import pytest

from tools.imports import assemble, circles, imports_of, modules, room


@pytest.mark.parametrize(
    "text, when, target, names",
    [
        ("from nerg_mi.field import mlp", "load", "nerg_mi.field.mlp", ()),
        ("from . import mlp as m", "load", "nerg_mi.field.mlp", ()),
        ("from .mlp import Mlp, _width", "load", "nerg_mi.field.mlp", ("Mlp", "_width")),
        ("import nerg_mi.field.mlp", "load", "nerg_mi.field.mlp", ()),
        ("def f():\n    if True:\n        from .mlp import Mlp", "call", "nerg_mi.field.mlp", ("Mlp",)),
        (
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .mlp import Mlp",
            "types",
            "nerg_mi.field.mlp",
            ("Mlp",),
        ),
    ],
)
def test_what_an_import_statement_says(tmp_path, text, when, target, names):
    path = tmp_path / "a.py"
    path.write_text(text)
    known = {"nerg_mi": path, "nerg_mi.field": path, "nerg_mi.field.mlp": path}
    (found,) = imports_of("nerg_mi.field.a", path, known)
    assert (found.when, found.target, found.names, found.source) == (when, target, names, "nerg_mi.field.a")


def test_circles_are_found():
    assert circles({("a", "b"), ("b", "c"), ("c", "a"), ("c", "d"), ("e", "e")}) == [["a", "b", "c"], ["e"]]
    assert circles({("a", "b"), ("a", "c"), ("b", "d"), ("c", "d")}) == []


def test_modules_are_named_as_they_are_installed():
    known = modules()
    assert known["nerg_mi.plugins.nerg"].parts[-2:] == ("plugins", "nerg.py")
    assert known["nerg_mi.scenes.store.twin"].parts[-3:] == ("scenes", "store", "twin.py")
    assert known["nerg_mi.field"].name == "__init__.py"
    assert room("nerg_mi.field.gaze.product") == "field" and room("nerg_mi.errors") == "errors"


def test_an_assembled_package_is_whole(tmp_path):
    made = {path.relative_to(tmp_path).as_posix() for path in assemble(tmp_path).rglob("*.py")}
    assert {"nerg_mi/__init__.py", "nerg_mi/plugins/nerg.py", "nerg_mi/scenes/store/__init__.py"} <= made
    assert len(made) == len(modules())
