"""Images a second of the viewer while the camera or the observer moves, without a browser.

    python benchmarks/viewer_frames.py SCENE.xml [--width 640] [--seconds 4]

The page gets 60 changes a second. Each image is rendered, coloured and encoded as for a browser, but not sent. The rows
are the scene's own radiance field and its compiled copy, which is made next to the field if there is none. "Full
resolution" is the time from the end of a movement to the first image of the full width.
"""

from __future__ import annotations

import argparse
import io
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

RATE = 60  # Changes a second
REACH = 0.3  # Amplitude of the movement, scene units


class Client:
    """A browser that only records the sizes and times of its images."""

    client_id = 1

    def __init__(self) -> None:
        self.scene, self.images = self, list[tuple[float, tuple[int, int]]]()

    def atomic(self) -> Any:
        return threading.RLock()

    def set_background_image(self, image: np.ndarray | None, format: str = "", jpeg_quality: int = 90) -> None:
        from PIL import Image

        if image is not None:
            Image.fromarray(image).save(io.BytesIO(), "JPEG", quality=jpeg_quality)
            self.images.append((time.monotonic(), image.shape[:2]))


class Listener:
    """A listener that raises nothing and draws nothing."""

    def on_event(self) -> None:
        pass

    on_proxy = on_baked = on_shares = on_range = on_event

    def on_error(self, error: BaseException) -> None:
        raise error


def measure(scene: Path, width: int, seconds: float, compile: bool) -> list[list[str]]:
    """Rows of the table: a moving camera, and a moving observer."""
    from nerg_mi.viewer.page import REST_SECONDS, BrowserWindow, Page
    from nerg_mi.viewer.points import PinholeView
    from nerg_mi.viewer.session import Session, SessionSettings
    from nerg_mi.viewer.source import open_viewer_inputs

    settings = SessionSettings(width=width, compile=compile)
    session = Session(lambda: open_viewer_inputs(scene), settings, Listener())
    session.start()
    try:
        while compile and session.compiled is None:
            time.sleep(0.1)
        session.worker.wait_idle(600)
        page, client = Page(None), Client()
        page.session = session
        home = replace(session.home_view, aspect=16 / 9)
        window = page.windows[1] = BrowserWindow(client, None, view=home)
        page._start_refinement(window)
        session.worker.wait_idle(600)
        rows, eye = [], session.observer
        for moving in ("camera", "observer"):
            client.images.clear()
            start = time.monotonic()
            while (t := time.monotonic() - start) < seconds:
                offset = REACH * np.sin(t) * np.cross(home.forward, home.up)
                if moving == "camera":
                    with page._lock:
                        window.view = PinholeView.look_at(
                            home.origin + offset, home.origin + home.forward, home.up, home.fov, home.aspect
                        )
                        page._hide_picture(window, time.monotonic())
                else:
                    session.place_observer(eye + offset)
                    page._on_observer_moved(False)
                time.sleep(1 / RATE)
            images = list(client.images)
            client.images.clear()
            end = time.monotonic()
            time.sleep(REST_SECONDS)
            window.is_handled = True
            page._start_refinement(window)
            while not (full := [t for t, (_, w) in client.images if w == width]):
                time.sleep(0.005)
            session.worker.wait_idle(600)
            sizes = Counter(f"{w} x {h}" for _, (h, w) in images)
            name = sizes.most_common(1)[0][0] if sizes else "points"
            row = ["compiled" if compile else "field", moving, name]
            rows.append([*row, f"{len(images) / seconds:.1f}", f"{full[0] - end:.2f}"])
        return rows
    finally:
        session.stop()


def main(argv=None) -> None:
    from nerg_mi.cli.declarations import select_backend
    from timing import save_result

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--width", type=int, default=640, help="width of the full resolution, pixels (default: 640)")
    parser.add_argument("--seconds", type=float, default=4, help="length of a movement (default: 4)")
    args = parser.parse_args(argv)
    select_backend("llvm_ad_rgb")
    rows = []
    for compile in (True, False):
        rows += measure(args.scene, args.width, args.seconds, compile)
    save_result("viewer", ("density", "moving", "usual size", "images a second", "full resolution, s"), rows)


if __name__ == "__main__":
    main()
