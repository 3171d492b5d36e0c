"""Optional requirements of the viewer tests: viser, selenium and a headless Chromium."""

from __future__ import annotations

import importlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

REQUIRED = os.environ.get("NERG_REQUIRE_BROWSER", "0") not in ("", "0")


def _missing(what: str):
    if REQUIRED:
        pytest.fail(f"NERG_REQUIRE_BROWSER is set, and {what}")
    pytest.skip(what)


def require(module: str):
    """Import a module; without it, the test is skipped, or fails if NERG_REQUIRE_BROWSER is set."""
    try:
        return importlib.import_module(module)
    except ImportError:
        extra = {"viser": "viewer", "selenium": "browser"}[module.partition(".")[0]]
        return _missing(f'{module} is not installed (pip install "nerg-mi[{extra}]")')


@contextmanager
def chromium(width: int = 1200, height: int = 760) -> Iterator:
    """Start a headless Chromium with a temporary profile and yield its driver."""
    require("selenium")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    binary = shutil.which("chromium") or shutil.which("google-chrome")
    driver_file = shutil.which("chromedriver")
    if binary is None or driver_file is None:
        _missing("chromium and chromedriver are not installed (apt install chromium chromium-driver)")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = binary or ""
        for argument in (
            "--headless=new",
            "--no-sandbox",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--lang=en-US",
            f"--window-size={width},{height}",
            f"--user-data-dir={profile}",
        ):
            options.add_argument(argument)
        options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
        environment = {**os.environ, "LANG": "en_US.UTF-8", "LANGUAGE": "en_US"}
        driver = webdriver.Chrome(options=options, service=Service(driver_file, env=environment))
        try:
            yield driver
        finally:
            driver.quit()
