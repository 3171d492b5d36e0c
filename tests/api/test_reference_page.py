"""docs/python-reference.md has every public name, and what of it is public is documented."""

from __future__ import annotations

import inspect
import re
from importlib import import_module

import pytest

import nerg_mi as nerg
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "python-reference.md").read_text(encoding="utf-8")
LISTED = re.findall(r"^\.\. auto(?:function|class|exception):: (\S+)", PAGE, re.M)


def named(path: str) -> object:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name) if module else getattr(nerg, path)


def test01_every_public_name_is_listed_once():
    assert sorted(path.rpartition(".")[2] for path in LISTED if named(path) in PUBLIC) == sorted(nerg.__all__)
    assert len(set(LISTED)) == len(LISTED)


PUBLIC = [getattr(nerg, name) for name in nerg.__all__]


@pytest.mark.parametrize("path", LISTED)
def test02_what_is_public_is_documented(path):
    value = named(path)
    assert inspect.getdoc(value), path
    if inspect.isclass(value):
        for name, member in vars(value).items():
            if not name.startswith("_") and (inspect.isroutine(member) or isinstance(member, (property, classmethod))):
                assert inspect.getdoc(member), f"{path}.{name} has no docstring"


def test03_what_functions_give_is_listed():
    """The classes of results, by the annotations of what returns them."""
    given = set()
    for function in filter(inspect.isfunction, PUBLIC):
        given |= set(re.findall(r"\b[A-Z]\w+", str(inspect.signature(function).return_annotation)))
    names = {path.rpartition(".")[2] for path in LISTED}
    assert given - names <= {"RadianceField", "AnyGazeField"}  # the networks themselves, within a TrainedField
