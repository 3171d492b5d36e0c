"""The panel in a real browser, operated by its labels."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.viewer.serve import view
from tests.viewer.browser import chromium, require
from tests.viewer.conftest import ROOM, write_gaze_fields
from tests.viewer.test_in_chromium import drag, until

# ---- Driver of the panel ----


class Panel:
    """The panel in the browser of ``driver``; downloads are saved to ``folder``."""

    def __init__(self, driver: Any, folder: Path):
        self.driver, self.folder = driver, folder
        driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)})

    def open(self, title: str, inside: str) -> None:
        """Open the folder ``title`` unless the control ``inside`` is visible, and wait until it is."""
        if not self._seen(inside):
            self._click(self._one(f"//*[normalize-space(text())='{title}']"))
            end = time.monotonic() + 60
            while not self._seen(inside):
                assert time.monotonic() < end, f"{title} does not unfold"
                time.sleep(0.1)
            time.sleep(0.3)

    def _seen(self, text: str) -> bool:
        elements = self.driver.find_elements("xpath", f"//*[self::button or self::label][normalize-space(.)='{text}']")
        return any(e.is_displayed() and e.size["height"] > 0 for e in elements)

    def press(self, text: str) -> None:
        """Click the button labelled ``text``."""
        self._click(self._one(f"//button[normalize-space(.)='{text}']"))

    def choose(self, label: str, option: str) -> None:
        """Select ``option`` in a list."""
        from selenium.webdriver.common.keys import Keys

        element = self.input(label)
        self._click(element)
        time.sleep(0.2)
        self._click(self._one(f"//*[@role='option'][normalize-space(.)='{option}']"))
        # An open list would cover other controls.
        element.send_keys(Keys.ESCAPE)

    def tick(self, label: str) -> None:
        """Click a checkbox."""
        self._click(self.input(label))

    def write(self, label: str, text: str) -> None:
        """Replace the text of an input, the first of several, and leave it."""
        self._write(self.input(label), text)

    def slide(self, label: str, value: float) -> None:
        """Set a slider with its number input."""
        element = self._one(f"//label[normalize-space(.)='{label}']")
        self._write(element.find_element("xpath", "./following::input[not(@type='hidden')][1]"), f"{value:g}")

    def _write(self, element: Any, text: str) -> None:
        from selenium.webdriver.common.keys import Keys

        self._to(element)
        element.click()
        element.send_keys(Keys.CONTROL, "a")
        element.send_keys(text, Keys.TAB)

    def input(self, label: str) -> Any:
        """Return the first input labelled ``label``."""
        element = self._one(f"//label[normalize-space(.)='{label}']")
        named = self.driver.find_elements("id", element.get_attribute("for"))
        # Labels of text inputs refer to no element.
        return (named or element.find_elements("xpath", "./following::input"))[0]

    def texts(self) -> str:
        """Return all text of the page."""
        # Reading the rendered text instead would block drawing.
        return self.driver.execute_script("return document.body.textContent")

    def saved(self, name: str, seconds: float = 20.0) -> bytes:
        """Wait for the download ``name`` and return its bytes."""
        end = time.monotonic() + seconds
        path = self.folder / name
        while not path.is_file():
            assert time.monotonic() < end, f"{name} was not saved: {[p.name for p in self.folder.iterdir()]}"
            time.sleep(0.05)
        return path.read_bytes()

    def close_notes(self) -> None:
        """Close the notifications and wait until they have disappeared, because they cover the view."""
        end = time.monotonic() + 20
        while self.driver.find_elements("css selector", ".mantine-Notification-root"):
            assert time.monotonic() < end, "the notes do not close"
            self.driver.execute_script(
                "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
            )
            time.sleep(0.1)

    def _one(self, where: str) -> Any:
        seen = [e for e in self.driver.find_elements("xpath", where) if e.is_displayed()]
        assert seen, f"nothing is shown at {where}"
        return seen[0]

    def _to(self, element: Any) -> None:
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
        time.sleep(0.1)

    def _click(self, element: Any) -> None:
        from selenium.common.exceptions import ElementClickInterceptedException

        self._to(element)
        end = time.monotonic() + 10
        while True:
            try:
                return element.click()
            except ElementClickInterceptedException:
                # A slider displays its value above itself for a while.
                if time.monotonic() > end:
                    raise
                time.sleep(0.3)


# ---- Tests ----

pytestmark = pytest.mark.slow


def make_rays() -> nerg.Rays:
    """Ada, of the cohort young, walks along x for four seconds; Bob stands still."""
    t = np.tile(np.arange(0, 4, 0.1), 2)
    person = np.repeat([0, 1], 40)
    origin = np.stack([np.where(person == 0, 4 + 0.5 * t, 5), np.full(80, 3.0), np.full(80, 1.6)], axis=1)
    ahead = np.tile([0.0, 1, 0], (80, 1))
    return nerg.Rays(t, person, ("Ada", "Bob"), origin, ahead, np.ones(80), cohort=person, cohorts=("young", "old"))


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    from nerg_mi.scenes.store import SCENE_FILE

    from nerg_mi.cli import demo
    from nerg_mi.environment.scene_loading import activate_variant

    require("viser")
    activate_variant("llvm_ad_rgb")
    path = SCENE_FILE
    if not all((path.parent / name).is_file() for name in demo.CHECKPOINTS.values()):
        pytest.skip("the store's fields are not here: python -m nerg_mi.scenes.store.make")
    rays = tmp_path_factory.mktemp("rays") / "rays.npz"
    make_rays().save(rays)
    with view([path, rays], port=0, width=48, spp=1, compile=False) as viewer:
        yield viewer


@pytest.fixture(scope="module")
def panel(running, tmp_path_factory):
    with chromium(900, 700) as driver:
        driver.get(running.address)
        window = until(lambda: next(iter(running.page.windows.values()), None))
        until(lambda: window.shows_picture)
        result = Panel(driver, tmp_path_factory.mktemp("saved"))
        result.close_notes()
        yield result


def window_of(running):
    return next(iter(running.page.windows.values()))


def test01_layer_and_color_scale(running, panel):
    session, window = running.page.session, window_of(running)
    panel.choose("Layer", "depth")
    until(lambda: session.display.layer.title == "depth")
    until(lambda: window.shows_picture and "depth" in window.last_picture[0].values and session._ranges.get("depth"))
    # The colour scale has the range of the picture.
    until(lambda: f"{session.scale().high:.3g}" in panel.texts() and "units" in panel.texts())
    panel.choose("Layer", "gaze")
    until(lambda: session.display.layer.title == "gaze")
    panel.tick("Automatic range")
    until(lambda: session.display.limits is not None)
    # A range in 1/sr does not apply to metres.
    panel.choose("Layer", "depth")
    until(lambda: session.display.layer.title == "depth" and session.display.limits is None)
    panel.choose("Colours", "magma")
    until(lambda: session.scale().colors == "magma")
    panel.choose("Colours", "default")
    until(lambda: session.scale().colors == "viridis_r")
    panel.choose("Layer", "gaze")
    panel.slide("Fall-off", 0.5)
    until(lambda: abs(session.falloff - 0.5) < 0.1)


def test02_observer_and_camera(running, panel):
    session, window = running.page.session, window_of(running)
    panel.press("Move observer to camera")
    until(lambda: np.allclose(session.observer, window.view.origin))
    # The panel is updated with a delay, which would overwrite earlier input.
    until(lambda: np.isclose(float(panel.input("Position").get_attribute("value")), session.observer[0], atol=2e-3))
    panel.write("Position", "5.2")
    until(lambda: np.isclose(session.observer[0], 5.2))
    panel.press("Move camera to observer")
    until(lambda: np.allclose(window.view.origin, session.observer, atol=1e-3))


def test03_view_from_above_and_saved_files(running, panel):
    session, window = running.page.session, window_of(running)
    panel.open("Camera", "View from above")
    panel.press("View from above")
    until(lambda: window.view.forward @ session.source.up < -0.95)
    assert session.ceiling is not None and window.view.origin[2] > session.ceiling
    until(lambda: window.shows_picture)
    panel.press("Save picture (PNG)")
    data = panel.saved("view.png")
    assert data.startswith(b"\x89PNG") and int.from_bytes(data[16:20], "big") in (12, 24, 48)
    comment = data[data.index(b"tEXtComment\0") + 12 :]
    metadata = json.JSONDecoder().raw_decode(comment.decode("latin-1"))[0]
    assert metadata["what"] == "nerg view" and metadata["settings"]["layer"] == "gaze"
    assert "scene.xml" in metadata["inputs"] and "shoppers.safetensors" in metadata["inputs"]
    panel.press("Save scene (XML)")
    root = ElementTree.fromstring(panel.saved("view.xml"))
    eye = next(d for d in root.iter("default") if d.get("name") == "view_observer")
    assert np.allclose([float(v) for v in eye.get("value").split(",")], session.observer, atol=1e-5)
    panel.tick("Hide the ceiling")
    panel.press("Initial view")
    until(lambda: np.allclose(window.view.origin, session.home_view.origin, atol=1e-3) and session.ceiling is None)


def test05_observer_follows_a_participant(running, panel):
    session = running.page.session
    panel.open("Participants", "Observer follows")
    panel.choose("Observer follows", "Ada")
    until(lambda: np.allclose(session.observer, [4, 3, 1.6], atol=0.01))
    panel.slide("Time (s)", 2.0)
    until(lambda: np.allclose(session.observer, [5, 3, 1.6], atol=0.2) and session.observer[0] > 4.5)


def test06_area_is_drawn_and_saved(running, panel):
    session = running.page.session
    until(lambda: session.proxy is not None)
    panel.open("Areas of interest", "Draw box in view")
    panel.write("Name", "coolers")
    panel.press("Draw box in view")
    until(lambda: "Draw a rectangle around an object" in panel.texts())
    panel.close_notes()
    drag(panel.driver, (220, 300), (420, 440))
    region = until(lambda: next(iter(session.regions), None))
    panel.press("Save areas (JSON)")
    saved = json.loads(panel.saved("areas.json"))["regions"]
    assert [r["name"] for r in saved] == ["coolers"] and np.allclose(saved[0]["min"], region.lower)
    until(lambda: session.shares.get("coolers") is not None)
    panel.press("Remove area")
    until(lambda: not session.regions)
    assert running.page.problem == ""
    assert not [e for e in panel.driver.get_log("browser") if e["level"] == "SEVERE"]


def test07_gaze_field_can_be_switched(running, tmp_path):
    """One of two gaze fields lacks a factor: the list of layers and the pictures change."""
    (tmp_path / "room.xml").write_text(ROOM)
    with view([tmp_path / "room.xml", *write_gaze_fields(tmp_path)], port=0, width=48, spp=1, compile=False) as viewer:
        session = viewer.page.session
        with chromium(900, 700) as driver:
            driver.get(viewer.address)
            window = until(lambda: next(iter(viewer.page.windows.values()), None))
            until(lambda: window.shows_picture)
            panel = Panel(driver, tmp_path)
            panel.close_notes()
            panel.choose("Layer", "attention that the observer gives")
            until(lambda: session.display.layer.title == "attention that the observer gives")
            panel.choose("Gaze field", "emit")
            until(lambda: session.gaze_name == "emit" and session.display.layer.title == "gaze")
            until(lambda: window.shows_picture and "gaze" in window.last_picture[0].values)
            until(lambda: panel.input("Layer").get_attribute("value") == "gaze")
            one = window.last_picture[1]
            panel.choose("Gaze field", "emit_capture")
            until(lambda: session.gaze_name == "emit_capture")
            until(
                lambda: (
                    window.shows_picture
                    and window.last_picture[0].is_final
                    and not np.array_equal(window.last_picture[1], one)
                )
            )
