"""The page's panel as a person uses it: folders, buttons and controls by what is written on them."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any


class Panel:
    """The panel in a browser, ``driver``; what it saves comes into ``folder``."""

    def __init__(self, driver: Any, folder: Path):
        self.driver, self.folder = driver, folder
        driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)})

    def open(self, title: str, inside: str) -> None:
        """Open the folder ``title``, if what is ``inside`` is not to be seen, and wait until it has unfolded."""
        if not self._seen(inside):
            self._click(self._one(f"//*[normalize-space(text())='{title}']"))
            end = time.monotonic() + 10
            while not self._seen(inside):
                assert time.monotonic() < end, f"{title} does not unfold"
                time.sleep(0.1)
            time.sleep(0.3)

    def _seen(self, text: str) -> bool:
        found = self.driver.find_elements("xpath", f"//*[self::button or self::label][normalize-space(.)='{text}']")
        return any(e.is_displayed() and e.size["height"] > 0 for e in found)

    def press(self, text: str) -> None:
        """Click the button that says ``text``."""
        self._click(self._one(f"//button[normalize-space(.)='{text}']"))

    def choose(self, label: str, option: str) -> None:
        """Pick ``option`` of a list."""
        from selenium.webdriver.common.keys import Keys

        found = self.input(label)
        self._click(found)
        time.sleep(0.2)
        self._click(self._one(f"//*[@role='option'][normalize-space(.)='{option}']"))
        # A list that is still open lies over what is above it.
        found.send_keys(Keys.ESCAPE)

    def tick(self, label: str) -> None:
        """Click a checkbox."""
        self._click(self.input(label))

    def write(self, label: str, text: str) -> None:
        """Replace the text of an input and leave it; of several, the first."""
        self._write(self.input(label), text)

    def slide(self, label: str, value: float) -> None:
        """Set a slider, by the number beside it."""
        found = self._one(f"//label[normalize-space(.)='{label}']")
        self._write(found.find_element("xpath", "./following::input[not(@type='hidden')][1]"), f"{value:g}")

    def _write(self, found: Any, text: str) -> None:
        from selenium.webdriver.common.keys import Keys

        self._to(found)
        found.click()
        found.send_keys(Keys.CONTROL, "a")
        found.send_keys(text, Keys.TAB)

    def input(self, label: str) -> Any:
        """The first input that stands by ``label``."""
        found = self._one(f"//label[normalize-space(.)='{label}']")
        named = self.driver.find_elements("id", found.get_attribute("for"))
        # Texts have a label that names nothing.
        return (named or found.find_elements("xpath", "./following::input"))[0]

    def texts(self) -> str:
        """All that the page says."""
        # Asking for what is laid out as text would keep the page from drawing.
        return self.driver.execute_script("return document.body.textContent")

    def saved(self, name: str, seconds: float = 20.0) -> bytes:
        """The bytes of the file ``name``, once it is there."""
        end = time.monotonic() + seconds
        path = self.folder / name
        while not path.is_file():
            assert time.monotonic() < end, f"{name} was not saved: {[p.name for p in self.folder.iterdir()]}"
            time.sleep(0.05)
        return path.read_bytes()

    def close_notes(self) -> None:
        """Close the notes in the corner, and wait until they are gone: they slide over the view."""
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
                # A slider shows its value above itself for a while.
                if time.monotonic() > end:
                    raise
                time.sleep(0.3)
