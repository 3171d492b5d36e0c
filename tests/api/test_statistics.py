"""Statistics from a notebook: the example of its docstring, and its options."""

from __future__ import annotations

import doctest

import pytest

from nerg_mi.api import workflows
from nerg_mi.errors import NergError


def test01_the_example(tmp_path):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    found = doctest.testmod(workflows, extraglobs={"folder": tmp_path})
    assert found.attempted > 4 and not found.failed


def test02_an_option_that_there_is_not():
    with pytest.raises(NergError, match='no option "area"'):
        workflows.stats("a.npz", area="x")
