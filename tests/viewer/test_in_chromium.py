"""The page in a real browser."""

from __future__ import annotations

import json
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest

from nerg_mi.viewer.layers import get_layer
from nerg_mi.viewer.points import PinholeView
from nerg_mi.viewer.serve import view
from tests.viewer.browser import chromium, require

# A browser that renders in software needs most of two cores: nightly, where nothing else is emulated.
pytestmark = [pytest.mark.slow, pytest.mark.nightly]


def until(what, seconds=60.0):
    """Wait until ``what()`` is true and return its value."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = what()
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError("it did not come about in time")


def read_pixels(driver):
    """Return the contents of the browser window (height, width, 3), float."""
    import mitsuba as mi

    stream = mi.MemoryStream()
    data = driver.get_screenshot_as_png()
    stream.write(data)
    stream.seek(0)
    return np.array(mi.Bitmap(stream))[..., :3].astype(float)


def to_screen(driver, view: PinholeView, point) -> tuple[int, int]:
    """Return the position of ``point`` in the window, in pixels."""
    away = np.asarray(point, float) - view.origin
    depth, rise = away @ view.forward, np.tan(view.fov / 2)
    right = np.cross(view.forward, view.up)
    x = 0.5 + away @ right / (depth * rise * view.aspect) / 2
    y = 0.5 - away @ view.up / (depth * rise) / 2
    width, height = driver.execute_script("return [window.innerWidth, window.innerHeight]")
    return round(x * width), round(y * height)


def drag(driver, start, end):
    """Drag the mouse from pixel ``start`` to pixel ``end``."""
    from selenium.webdriver.common.actions.action_builder import ActionBuilder
    from selenium.webdriver.common.actions.mouse_button import MouseButton

    steps = ActionBuilder(driver, duration=60)
    steps.pointer_action.move_to_location(*start).pause(0.3).pointer_down(button=MouseButton.LEFT)
    for share in np.linspace(0, 1, 9)[1:]:
        x, y = (round(a + share * (b - a)) for a, b in zip(start, end))
        steps.pointer_action.move_to_location(x, y)
    steps.pointer_action.pause(0.1).pointer_up(button=MouseButton.LEFT)
    steps.perform()


@pytest.fixture(scope="module")
def running():
    from nerg_mi.scenes.store import SCENE_FILE

    from nerg_mi.cli import demo
    from nerg_mi.environment.scene_loading import activate_variant

    require("viser")
    activate_variant("llvm_ad_rgb")
    path = SCENE_FILE
    if not all((path.parent / name).is_file() for name in demo.CHECKPOINTS.values()):
        pytest.skip("the store's fields are not here: python -m nerg_mi.scenes.store.make")
    with view([path], port=0, width=160, spp=1, compile=False) as viewer:
        yield viewer


@pytest.fixture(scope="module")
def driver(running):
    with chromium() as browser:
        browser.get(running.address)
        yield browser


def window_of(running):
    return until(lambda: list(running.page.windows.values()))[-1]


def reload(running, driver):
    """Load the page again, which puts the camera back to its first pose, and return the new window."""
    old = window_of(running)
    driver.refresh()
    window = until(lambda: next((w for w in running.page.windows.values() if w is not old), None))
    wait_for_picture(running, window)
    return window


def wait_for_picture(running, window):
    """Wait until the final picture is displayed and return it."""
    until(lambda: window.shows_picture and window.last_picture is not None and window.last_picture[0].is_final)
    until(lambda: running.page.session.worker.is_idle)
    time.sleep(0.7)
    return window.last_picture


def wait_for_canvas(driver):
    """Wait until the canvas is drawn and return the left half of it, without the panel and the note on software
    rendering."""
    return until(lambda: (image := read_pixels(driver))[250:600, :800].std() > 20 and [image])[0]


def test01_page_loads_and_refines(running, driver):
    window = window_of(running)
    until(lambda: window.cloud is not None)
    wait_for_picture(running, window)
    shown = wait_for_canvas(driver)
    assert running.page.problem == ""
    # The window displays the rendered picture: compare mean colours of cells.
    colors = window.last_picture[1].astype(float)
    height, width = shown.shape[:2]
    rows, columns = np.linspace(0, 1, 24)[14:22], np.linspace(0, 1, 24)[1:14]
    expected = np.array([[colors[int(r * colors.shape[0]), int(c * colors.shape[1])] for c in columns] for r in rows])
    seen = np.array([[shown[int(r * height), int(c * width)] for c in columns] for r in rows])
    assert np.corrcoef(expected.ravel(), seen.ravel())[0, 1] > 0.8


def test02_dragging_the_observer_changes_the_picture(running, driver):
    session, window = running.page.session, reload(running, driver)
    running.page.place_observer(np.array([5.6, 3.6, 1.6]), np.eye(3))
    wait_for_picture(running, window)
    before, numbers, at = read_pixels(driver), window.last_picture[0].values["gaze"].copy(), session.observer.copy()
    start = to_screen(driver, window.view, at + np.array([0.3, 0, 0]))
    drag(driver, start, (start[0] + 90, start[1] + 30))
    until(lambda: not np.array_equal(session.observer, at), 10)
    assert np.abs(session.observer - at)[1:].max() < 1e-3 and abs(session.observer[0] - at[0]) > 0.05, "along its arrow"
    wait_for_picture(running, window)
    assert np.abs(read_pixels(driver) - before)[250:600, :800].mean() > 1
    gaze = window.last_picture[0].values["gaze"]
    assert np.abs(gaze - numbers).max() > 0.05 * numbers.max()
    assert session.finished_observer is not None and np.array_equal(session.finished_observer, session.observer)
    assert np.allclose(running.page._observer.position, session.observer)


def test03_mouse_moves_the_camera(running, driver):
    window = window_of(running)
    wait_for_picture(running, window)
    before, at = read_pixels(driver), window.view
    drag(driver, (500, 450), (650, 470))
    until(lambda: not np.allclose(window.view.origin, at.origin), 10)
    wait_for_picture(running, window)
    assert np.abs(read_pixels(driver) - before)[250:600, :800].mean() > 3


def test04_browsers_share_the_observer_but_not_the_camera(running, driver):
    first = window_of(running)
    with chromium(700, 500) as other:
        other.get(running.address)
        second = until(lambda: next((w for w in running.page.windows.values() if w is not first), None))
        wait_for_picture(running, second)
        assert len(running.page.windows) == 2
        view = first.view
        drag(other, (60, 200), (150, 210))
        until(
            lambda: second.view.origin is not None and not np.allclose(second.view.origin, view.origin, atol=0.05), 10
        )
        assert first.view is view
        running.page.place_observer(np.array([4.4, 2.8, 1.6]))
        for window in (first, second):
            wait_for_picture(running, window)
        assert not np.array_equal(first.last_picture[1], second.last_picture[1])
    until(lambda: len(running.page.windows) == 1, 20)


def test05_reload_keeps_the_state(running, driver):
    running.page.place_observer(np.array([6.2, 3.0, 1.6]))
    reload(running, driver)
    assert np.allclose(running.page.session.observer, [6.2, 3.0, 1.6])
    wait_for_canvas(driver)
    assert running.page.problem == ""


def test05b_stale_contents_are_grey(running, driver):
    """While the render thread is busy, the gaze of the previous observer position is grey."""
    # Whatever other tests have moved or shown
    session, window = running.page.session, reload(running, driver)

    def show(title):
        session.set_display(layer=get_layer(title))
        running.page.redraw_points()
        running.page.restart_pictures()
        for callback in running.page.scale_callbacks:
            callback()

    show("gaze")
    running.page.place_observer(np.array([4.0, 2.4, 1.6]))
    wait_for_picture(running, window)
    until(lambda: not session.stale_points_reason and not session.are_shares_stale, 120)
    colorful = lambda: np.ptp(read_pixels(driver)[250:600, :800], axis=-1).mean()
    text = lambda: driver.find_element("tag name", "body").text
    fresh, go = colorful(), threading.Event()
    assert "Grey:" not in text() and "utdated" not in text()

    def wait():
        go.wait(60)
        yield

    def held(change, words):
        go.clear()
        session.worker.submit("people", 0, wait())
        until(lambda: session.running_tasks == ["recordings"])
        change()
        until(lambda: words in text() and colorful() < 0.5 * fresh)
        assert "Observer view (grey: outdated)" in text() and "Computing: picture" in text()
        go.set()
        wait_for_picture(running, window)
        until(lambda: "Grey:" not in text() and "utdated" not in text())

    held(lambda: running.page.place_observer(np.array([4.4, 2.8, 1.6])), "Grey: gaze of a previous observer position")

    held(lambda: show("depth"), "Grey: the points do not show depth")
    show("gaze")
    wait_for_picture(running, window)


def test05c_camera_and_observer_leave_solids(running, driver):
    """Both the camera and a dragged observer."""
    session, window = running.page.session, window_of(running)
    wait_for_picture(running, window)
    shelf = np.array([5.4, 3.6, 0.8])
    window.client.camera.position = tuple(shelf)
    # A slow browser sends its old camera once more.
    until(lambda: window.message and np.linalg.norm(window.view.origin - shelf) > 0.2, 60)
    wait_for_picture(running, window)
    until(lambda: "inside a solid" in window.status.content)
    # The next drag starts from the position that was set.
    running.page.place_observer(session.observer + (0, 0, 0.5))
    before = session.observer.copy()
    running.page._observer.position = tuple(shelf)
    running.page._on_drag("end")
    assert np.allclose(session.observer, shelf)
    until(lambda: not np.allclose(session.observer, shelf), 30)
    wait_for_picture(running, window)
    away = session.observer - before
    assert np.linalg.norm(np.cross(away, shelf - before)) < 1e-3 and 0 < np.linalg.norm(away)
    assert np.allclose(running.page._observer.position, session.observer) and running.page.problem == ""


def test05d_invalid_positions_are_refused(running, driver, monkeypatch):
    """As a forged page could send them."""
    page, session = running.page, running.page.session
    before = session.observer.copy()
    for position, turn in (((np.nan, 0, 1), (1, 0, 0, 0)), ((4, 3, 1), (0, 0, 0, 0)), ((4, 3, 1), (np.nan, 0, 0, 1))):
        sent = SimpleNamespace(position=position, wxyz=turn)
        with monkeypatch.context() as patched:
            patched.setattr(page, "_observer", sent)
            page._on_drag("end")
        assert np.array_equal(session.observer, before) and page.problem
        # The gizmo returns to the observer.
        assert np.allclose(sent.position, before) and np.isfinite(sent.wxyz).all()
    page.place_observer(before)
    assert page.problem == ""


def test06_no_request_leaves_the_machine(running, driver):
    address, urls = urlsplit(running.address).netloc, []
    for entry in driver.get_log("performance"):
        event = json.loads(entry["message"])["message"]
        params = event["params"]
        # Ignore the initial page of the browser.
        if event["method"] == "Network.requestWillBeSent" and urlsplit(params["documentURL"]).netloc == address:
            urls.append(params["request"]["url"])
        if event["method"] == "Network.webSocketCreated":
            urls.append(params["url"])
    assert any(urlsplit(url).netloc == address for url in urls)
    external = [url for url in urls if urlsplit(url.removeprefix("blob:")).netloc != address]
    assert all(url.startswith("data:") for url in external), external
    assert not [e for e in driver.get_log("browser") if e["level"] == "SEVERE"]


def test07_page_cannot_reach_other_hosts(running, driver):
    said = driver.execute_async_script(
        "const done = arguments[0];"
        "document.addEventListener('securitypolicyviolation', e => done(e.violatedDirective));"
        "fetch('http://127.0.0.2:8099/').then(() => done('let through'), e => setTimeout(() => done('failed'), 3000));"
    )
    assert said == "connect-src"
    # Reading the log empties it: another test, in any order, finds only errors of the viewer.
    errors = [e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"]
    assert errors and all("127.0.0.2:8099" in message for message in errors), errors


def test08_no_thread_or_port_is_left(rgb, room):
    import threading

    require("viser")
    before = threading.active_count()
    with view([room], port=0) as viewer:
        port = urlsplit(viewer.address).port
    until(lambda: threading.active_count() <= before, 10)
    import socket

    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0


@contextmanager
def serve_page(text: str):
    """Serve one page of this machine, as a notebook does, and yield its address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(text.encode())

        def log_message(self, *args):
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}/"
        server.shutdown()


def test_a_notebook_contains_the_viewer_of_python(running, monkeypatch):
    monkeypatch.setattr("nerg_mi.viewer.serve.is_notebook", lambda: True)
    from nerg_mi.scenes.store import SCENE_FILE

    import nerg_mi as nerg

    has_canvas = lambda browser: browser.execute_script("return document.querySelectorAll('canvas').length") > 0
    with nerg.view(SCENE_FILE, port=0, width=160, compile=False) as viewer, chromium() as browser:
        with serve_page(viewer._repr_html_()) as address:
            browser.get(address)
            browser.switch_to.frame(browser.find_element("tag name", "iframe"))
            until(lambda: has_canvas(browser))
        # The page of the command refuses to be shown within another one.
        with serve_page(f'<iframe src="{running.address}"></iframe>') as address:
            browser.get(address)
            browser.switch_to.frame(browser.find_element("tag name", "iframe"))
            time.sleep(2)
            assert not has_canvas(browser)
    assert "iframe" not in viewer._repr_html_()
