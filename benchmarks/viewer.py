"""The viewer in a headless Chromium: prints the table of docs/viewer.md, and makes its picture.

    python -m benchmarks.viewer [--screenshot docs/images/viewer.png] [--threads 2]

Chromium draws without a graphics card here, on the same processors that render: frames a second are those of software,
and a floor of what a browser with a card shows. What a card does not take over is the page's own work, whose processor
time a frame is told beside: below 16.7 ms it leaves room for 60 frames a second.
"""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path

from nerg_mi.files.tables import markdown_table
from nerg_mi.jobs import demo
from nerg_mi.jobs.options.view import ViewOptions
from nerg_mi.viewer.controls import look
from nerg_mi.viewer.serving import viewer, yield_to_browser

import numpy as np
from tests.viewer.browser import chromium
from tests.viewer.test_in_chromium import drag, on_screen, until

MOVING = """
const done = arguments[0], canvas = [...document.querySelectorAll('canvas')].find(c => c.width > 0);
const start = performance.now(); let count = 0, longest = 0, last = start;
function pointer(kind, x) {
    const on = kind == 'pointerdown' ? canvas : document;
    const mouse = {pointerId: 1, pointerType: 'mouse', button: 0, buttons: 1, isPrimary: true};
    on.dispatchEvent(new PointerEvent(kind, {bubbles: true, clientX: x, clientY: 500, ...mouse}));
}
function frame(now) {
    count += 1; longest = Math.max(longest, now - last); last = now;
    pointer('pointermove', 400 + 60 * Math.sin(count / 10));
    if (now - start < 4000) requestAnimationFrame(frame);
    else { pointer('pointerup', 400); window.found = [count, 1000 * count / (now - start), longest]; }
}
pointer('pointerdown', 400); requestAnimationFrame(frame); done(true);
"""


SMALL = (500, 300)
"""Sides of a window in which there is little to draw."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--screenshot", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--width", type=int, default=480)
    given = parser.parse_args()
    regions = demo.store_scene().parent / "regions.json"
    rows = []
    with chromium(1100, 760) as driver:
        # As the command does, which the browser does not belong to.
        yield_to_browser()
        begun = time.perf_counter()
        with viewer([demo.store_scene()], ViewOptions(port=0, width=given.width, regions=regions)) as running:
            from nerg_mi.threads import set_thread_count

            running.page.session.worker.call(lambda: set_thread_count(given.threads)).result()
            rows.append(("command to address (kernels compiled before)", f"{time.perf_counter() - begun:.1f} s"))
            rows += measure(running, driver, given.screenshot)
            driver.get("about:blank")
            rows += without_browser(running.page.session)
    print(markdown_table(("what", "figure"), rows, right=("figure",)))


def measure(running, driver, screenshot: Path | None) -> list[tuple[str, str]]:
    """Rows of the table."""
    page, session = running.page, running.page.session
    start = time.perf_counter()
    driver.get(running.address)
    window = until(lambda: next(iter(page.windows.values()), None))
    until(lambda: window.cloud is not None)
    rows = [("page asked for to points in the browser", f"{time.perf_counter() - start:.1f} s")]
    until(lambda: window.last is not None)
    rows.append(("to a first picture of the integrator", f"{time.perf_counter() - start:.1f} s"))
    whole = lambda: window.picture and window.last is not None and window.last[0].whole
    until(whole, 120)
    until(lambda: session.worker.idle, 120)

    page.place_observer(np.array([5.6, 3.6, 1.6]), np.eye(3))
    until(whole, 120)
    until(lambda: session.worker.idle, 120)

    def move() -> tuple[float, float, float, float]:
        """Frames a second, the longest time between two, and milliseconds of the page's thread and of scripts a frame,
        while the camera moves."""
        driver.execute_script("window.found = null")
        before = page_work(driver)
        driver.execute_async_script(MOVING)
        count, fps, longest = until(lambda: driver.execute_script("return window.found"), 120)
        after = page_work(driver)
        until(whole, 120)
        until(lambda: session.worker.idle, 120)
        return fps, longest, *(1000 * (after[k] - before[k]) / count for k in ("ThreadTime", "ScriptDuration"))

    # Twice, since the page is given as many points as it drew quickly the first time.
    move()
    fps, longest, *_ = move()
    points = len(window.cloud.points)
    rows.append((f"frames a second while the camera moves, {points:,} points (no graphics card)", f"{fps:.0f}"))
    rows.append(("longest time between two of them", f"{longest:.0f} ms"))
    # So small that drawing in software holds few frames up: what a frame costs the page itself is told by many.
    size = driver.get_window_size()
    driver.set_window_size(*SMALL)
    until(lambda: whole() and session.worker.idle, 120)
    move()
    fps, _, thread, scripts = move()
    rows.append((f"frames a second in a window of {SMALL[0]} x {SMALL[1]}", f"{fps:.0f}"))
    rows.append(("of these, processor time of the page's thread a frame", f"{thread:.1f} ms"))
    rows.append(("of it scripts", f"{scripts:.1f} ms"))
    driver.set_window_size(size["width"], size["height"])
    until(whole, 120)
    until(lambda: session.worker.idle, 120)

    home = session.home
    look(window.client, home.origin, home.origin + 3 * home.ahead, session.place.up)
    until(lambda: np.allclose(window.view.origin, home.origin, atol=1e-3) and whole(), 120)
    waits = {"points": [], "coarse": [], "full": [], "whole": [], "shares": []}
    for k in range(5):
        page.place_observer(np.array([5.6, 3.6, 1.6]), np.eye(3))
        until(whole, 120)
        until(lambda: session.worker.idle, 120)
        at = session.observer.copy()
        first = on_screen(driver, window.view, at + np.array([0.3, 0, 0]))
        # The browser may not have drawn the gizmo where it stands now.
        for _ in range(5):
            drag(driver, first, (first[0] + 60 + 10 * k, first[1] + 20))
            end = time.perf_counter()
            while np.array_equal(session.observer, at) and time.perf_counter() - end < 3:
                time.sleep(0.005)
            if not np.array_equal(session.observer, at):
                break
        seconds = lambda end=end: time.perf_counter() - end
        pending = {
            "points": lambda: session.baked_for is not None and np.array_equal(session.baked_for, session.observer),
            "coarse": lambda: window.picture,
            "full": lambda: window.picture and window.last[0].share == 1,
            "whole": whole,
            "shares": session.follow_shares,
        }
        while pending:
            for name in [name for name, there in pending.items() if there()]:
                waits[name].append(seconds())
                del pending[name]
            time.sleep(0.01)
    session.worker.wait_idle(120)
    words = {
        "points": "drag's end to its gaze on all points",
        "coarse": "drag's end to a picture, a quarter as wide",
        "full": "drag's end to a picture of full size, one sample a pixel",
        "whole": f"drag's end to the refined picture, {session.spp} samples a pixel",
        "shares": f"drag's end to the shares of {len(session.regions)} areas",
    }
    size = "{1} x {0}".format(*window.last[1].shape[:2])
    for name, text in words.items():
        low, middle, high = np.percentile(waits[name], [0, 50, 100])
        rows.append((f"{text}{f' ({size})' if name == 'full' else ''}", f"{middle:.1f} s ({low:.1f} to {high:.1f})"))
    if screenshot is not None:
        save(driver, screenshot)
    return rows


def page_work(driver) -> dict[str, float]:
    """Seconds of processor time that the page's main thread has taken, by what for. Where there is no graphics card,
    drawing is done by another process, and is not among them."""
    driver.execute_cdp_cmd("Performance.enable", {"timeDomain": "threadTicks"})
    return {entry["name"]: entry["value"] for entry in driver.execute_cdp_cmd("Performance.getMetrics", {})["metrics"]}


def without_browser(session) -> list[tuple[str, str]]:
    """The same waits where nobody draws on these processors: what remains where the browser has a graphics card."""
    waits: dict[str, list[float]] = {"points": [], "coarse": [], "full": [], "whole": [], "shares": []}
    for k in range(6):
        until(lambda: session.worker.idle, 120)
        start = time.perf_counter()
        at = np.array([5.6 + 0.1 * k, 3.6, 1.6])
        session.place_observer(at)
        found: dict[str, float] = {}

        def deliver(picture, colors, start=start, found=found) -> None:
            name = "whole" if picture.whole else {4: "coarse", 1: "full"}.get(picture.share)
            found.setdefault(name, time.perf_counter() - start)

        session.picture("measured", session.home, deliver, session.options.width, session.spp)
        pending = {
            "points": lambda at=at: session.baked_for is not None and np.array_equal(session.baked_for, at),
            "shares": session.follow_shares,
        }
        session.follow_observer()
        while pending or "whole" not in found:
            for name in [name for name, there in pending.items() if there()]:
                found[name] = time.perf_counter() - start
                del pending[name]
            time.sleep(0.005)
        # The first compiles what the pages did not need.
        if k:
            for name, values in waits.items():
                values.append(found[name])
    words = {"points": "gaze on all points", "coarse": "a picture, a quarter as wide", "full": "one of full size"}
    words |= {"whole": "the refined picture", "shares": "the shares"}
    return [
        (f"without a browser: observer moved to {words[name]}", "{1:.1f} s ({0:.1f} to {2:.1f})".format(*spread))
        for name, spread in ((name, np.percentile(values, [0, 50, 100])) for name, values in waits.items())
    ]


def save(driver, path: Path) -> None:
    """What the browser shows, as a small PNG of 160 colours."""
    from PIL import Image
    from selenium.webdriver.common.by import By

    for button in driver.find_elements(By.CSS_SELECTOR, ".mantine-Notification-closeButton"):
        button.click()
    time.sleep(1.5)
    picture = Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(160, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
