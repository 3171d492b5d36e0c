"""The page is told all that a session tells."""

from __future__ import annotations

import inspect

import pytest

from nerg_mi.viewer.listener import Listener
from nerg_mi.viewer.page import Page

TOLD = [name for name in vars(Listener) if name.startswith("on_")]


@pytest.mark.parametrize("name", TOLD)
def test_the_page_listens(name):
    assert inspect.signature(getattr(Page, name)) == inspect.signature(getattr(Listener, name))


def test_sessions_tell_of_nothing_else():
    import nerg_mi.viewer.session as session

    text = inspect.getsource(session)
    assert len(TOLD) >= 5 and all(f"listener.{name}" in text for name in TOLD)
