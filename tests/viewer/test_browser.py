"""What is missing skips a test, or fails it where that was asked for."""

from __future__ import annotations

import sys

import pytest

from tests.viewer import browser


def test01_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr(browser, "REQUIRED", False)
    with pytest.raises(pytest.skip.Exception, match=r"viser is not installed"):
        browser.require("viser")
    monkeypatch.setattr(browser, "REQUIRED", True)
    with pytest.raises(pytest.fail.Exception, match="NERG_REQUIRE_BROWSER"):
        browser.require("viser")
