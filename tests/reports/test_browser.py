"""A report in a real browser: nothing is wrong on its console, the 3D scene is drawn and follows the mouse, and no
request is made.

Needs chromium, chromedriver and selenium; with NERG_REQUIRE_BROWSER=1 their absence is a failure.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import time

import pytest

from nerg_mi.reports.sections import render_page
from tests.reports.made import HOSTILE, full_run, minimal_run

REQUIRED = os.environ.get("NERG_REQUIRE_BROWSER", "0") not in ("", "0")


def missing(reason: str) -> None:
    """Skip, or fail if a browser is required."""
    if REQUIRED:
        pytest.fail(f"NERG_REQUIRE_BROWSER is set, and {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless Chromium that records every request."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        missing("there is no chromium with its chromedriver")
    try:
        from selenium import webdriver
    except ImportError:
        missing("selenium is not installed: pip install selenium")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for word in ("headless=new", "no-sandbox", "use-angle=swiftshader", "enable-unsafe-swiftshader", "disable-quic"):
        options.add_argument(f"--{word}")
    options.add_argument("--disable-background-networking")
    options.add_argument("--window-size=1000,900")
    options.add_argument(f"--user-data-dir={tmp_path_factory.mktemp('profile')}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = webdriver.ChromeService(driver, env={**os.environ, "LANG": "en_US.UTF-8"})
    with webdriver.Chrome(options, service) as started:
        started.set_page_load_timeout(120)
        yield started


def opened(browser, tmp_path, run):
    """The page of ``run`` in the browser, from disk; gives its console and the addresses that were asked for."""
    path = tmp_path / "report.html"
    path.write_text(render_page(run), encoding="utf-8")
    browser.get("about:blank")
    browser.get_log("performance")
    browser.get(path.as_uri())
    return path


def requests(browser) -> list[str]:
    """Return all requested addresses except those of the browser's own pages."""
    events = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    requested = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
    return [url for url in requested if not url.startswith(("data:", "chrome:", "about:"))]


def canvas_png(browser) -> bytes:
    data = browser.execute_script("return document.querySelector('#stage canvas').toDataURL('image/png')")
    return base64.b64decode(data.split(",")[1])


def pixels(browser) -> tuple[int, int]:
    """Number of colours in the canvas, and of pixels that are not its background."""
    return tuple(
        browser.execute_script(
            """const c = document.querySelector('#stage canvas'), copy = document.createElement('canvas');
            copy.width = c.width; copy.height = c.height;
            const context = copy.getContext('2d'); context.drawImage(c, 0, 0);
            const d = context.getImageData(0, 0, c.width, c.height).data, colors = new Set(); let drawn = 0;
            for (let k = 0; k < d.length; k += 4) {
              colors.add(d[k] << 16 | d[k + 1] << 8 | d[k + 2]);
              if (Math.abs(d[k] - 245) + Math.abs(d[k + 1] - 245) + Math.abs(d[k + 2] - 242) > 12) drawn++;
            }
            return [colors.size, drawn];"""
        )
    )


@pytest.mark.parametrize("name", ["shelf", HOSTILE], ids=["plain", "hostile"])
def test_page_renders_offline(browser, tmp_path, name):
    path = opened(browser, tmp_path, full_run(name))
    assert browser.execute_script("return document.querySelector('#stage').className") == "live"
    assert browser.execute_script("return document.querySelector('#stage canvas').dataset.drawn") == "true"
    colors, drawn = pixels(browser)
    assert colors > 50 and drawn > 5000
    assert [e for e in browser.get_log("browser") if e["level"] in ("SEVERE", "WARNING")] == []
    assert requests(browser) == [path.as_uri()]
    assert browser.execute_script("return document.querySelectorAll('img[onerror]').length") == 0


def test_3d_view_is_interactive(browser, tmp_path):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    opened(browser, tmp_path, full_run())
    stage = browser.find_element(By.ID, "stage")
    canvas = stage.find_element(By.TAG_NAME, "canvas")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    seen = [canvas_png(browser)]

    def changed(act) -> bool:
        act()
        end = time.monotonic() + 20
        while canvas_png(browser) == seen[-1] and time.monotonic() < end:
            time.sleep(0.05)
        # Wait until the view stops changing.
        while canvas_png(browser) != (last := canvas_png(browser)):
            pass
        seen.append(last)
        return seen[-1] != seen[-2]

    drag = lambda: ActionChains(browser).drag_and_drop_by_offset(canvas, 120, 40).perform()
    assert changed(drag)
    assert changed(lambda: ActionChains(browser).scroll_from_origin(origin(canvas), 0, -300).perform())
    options = stage.find_elements(By.TAG_NAME, "option")
    assert [o.text for o in options] == ["mean of all 2 observers", "observer 1", "observer 2"]
    # An open list would cover the page.
    choose = lambda k: browser.execute_script(
        "const s = document.querySelector('#stage select'); s.value = arguments[0]; s.dispatchEvent(new "
        "Event('input'))",
        k,
    )
    assert changed(lambda: choose(2)) and "1/sr" in stage.find_element(By.TAG_NAME, "output").text
    for switch in stage.find_elements(By.CSS_SELECTOR, "input[type=checkbox]"):
        assert changed(switch.click), switch.get_attribute("name")
        assert changed(switch.click)
    assert changed(lambda: choose(0))
    assert changed(stage.find_element(By.TAG_NAME, "button").click) and seen[-1] == seen[0]


def origin(canvas):
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    return ScrollOrigin.from_element(canvas)


def test_fallback_image_without_scripts_and_in_print(browser, tmp_path):
    opened(browser, tmp_path, full_run())
    shown = "return getComputedStyle(document.querySelector(arguments[0])).display"
    assert browser.execute_script(shown, "#stage .still") == "none"
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    assert browser.execute_script(shown, "#stage") == "none"
    # The gaze section, which is printed, contains the image.
    assert browser.execute_script(shown, "#gaze img") != "none"
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        opened(browser, tmp_path, full_run())
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
    assert browser.execute_script(shown, "#stage canvas") == "none"
    assert browser.execute_script(shown, "#stage .still") != "none"


def test_page_fits_a_narrow_screen(browser, tmp_path):
    size = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        opened(browser, tmp_path, full_run())
        assert browser.execute_script("return document.documentElement.scrollWidth") <= 390
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_bare_report_renders(browser, tmp_path):
    opened(browser, tmp_path, minimal_run())
    assert [e for e in browser.get_log("browser") if e["level"] in ("SEVERE", "WARNING")] == []
    assert browser.execute_script("return document.querySelector('h1').textContent") == "Gaze"
