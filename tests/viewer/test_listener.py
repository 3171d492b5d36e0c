"""The page is told all that a session tells."""

from __future__ import annotations

import inspect

import pytest

from nerg_mi.viewer.page import Page
from nerg_mi.viewer.session import Listener

TOLD = [name for name in vars(Listener) if name.startswith("on_")]


@pytest.mark.parametrize("name", TOLD)
def test_the_page_listens(name):
    assert inspect.signature(getattr(Page, name)) == inspect.signature(getattr(Listener, name))
