"""The table of kinds."""

import dataclasses

import pytest

from nerg_mi.errors import NergError
from nerg_mi.workflows.draw import KINDS, find_kind


@pytest.mark.parametrize("name", KINDS)
def test_each_tells_what_it_is(name):
    kind = find_kind(name)
    assert kind.name == name and kind.summary.endswith(".") and kind.most >= 1
    assert kind.options() is not None and all(f.metadata["help"] for f in dataclasses.fields(kind.options))


def test_one_that_is_not_there():
    with pytest.raises(NergError, match='no figure "pie"; there are sphere, triptych'):
        find_kind("pie")
