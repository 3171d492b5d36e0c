"""Images a second and latency of the viewer while the camera or the observer moves, without a browser.

    python benchmarks/viewer_frames.py SCENE.xml [--width 640] [--seconds 4] [--frame-width WIDTH] [--splats FILE]
    [--pictures FOLDER]

The page gets 60 changes a second. Each image is rendered, coloured and encoded as for a browser, but not sent. Rows are
the scene with the compiled copy of its radiance field, which is made next to the field if there is none; with Gaussian
splats in place of the field, by default about 200,000 that are made of it; and with the field itself. CPU time is that
of the process for each image. The latency of an image is the time from the change that it shows to its encoded form.
"Full resolution" is the time from the end of a movement to the first image of the full width. "PSNR" is that of drafts
of the usual size, at `NUM_COMPARED` moments of the movement, against images at rest.
"""

from __future__ import annotations

import argparse
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
import splats
from timing import median, save_result

import numpy as np

RATE = 60  # Changes a second
REACH = 0.3  # Amplitude of the movement, scene units
RESOLUTION = 222  # Lattice of the splats
NUM_COMPARED = 8


@dataclass
class Image:
    """An encoded image of a movement: when it was complete, its shape, pixels per ray, and seconds of its parts."""

    time: float
    shape: tuple[int, ...]
    pixels_per_ray: int
    waiting: float
    rendering: float
    encoding: float

    @property
    def latency(self) -> float:
        return self.waiting + self.rendering + self.encoding


class Client:
    """A browser that only records its images."""

    client_id = 1

    def __init__(self, pictures: Path | None) -> None:
        self.scene, self.images, self.pictures = self, list[Image](), pictures
        # When the displayed change was made, and when its image was begun.
        self.change = self.begin = 0.0
        self.pixels_per_ray = 1

    def atomic(self) -> Any:
        return threading.RLock()

    def set_background_image(self, image: np.ndarray | None, format: str = "", jpeg_quality: int = 90) -> None:
        from viser._image_encoding import cv2_imencode_with_fallback

        if image is None:
            return
        start = time.monotonic()
        data = cv2_imencode_with_fallback("jpeg", image, jpeg_quality, channel_ordering="rgb")
        end = time.monotonic()
        parts = self.begin - self.change, start - self.begin, end - start
        self.images.append(Image(end, image.shape[:2], self.pixels_per_ray, *parts))
        if self.pictures is not None and len(self.images) % 40 == 1:
            self.pictures.mkdir(parents=True, exist_ok=True)
            (self.pictures / f"{len(self.images):05}.jpg").write_bytes(data)


class Listener:
    """A listener that raises nothing and draws nothing."""

    def on_event(self) -> None:
        pass

    on_proxy = on_baked = on_shares = on_range = on_event

    def on_error(self, error: BaseException) -> None:
        raise error


def measure(name: str, load: Callable[[], Any], args: argparse.Namespace) -> list[list[str]]:
    """Rows of the table for the environment ``name``: a moving camera, and a moving observer."""
    from nerg_mi.viewer.page import REST_SECONDS, BrowserWindow, Page
    from nerg_mi.viewer.points import FRAME_SIZES, PinholeView
    from nerg_mi.viewer.session import Session, SessionSettings

    width, seconds, pictures, compile = args.width, args.seconds, args.pictures, name == "compiled"
    session = Session(load, SessionSettings(width=width, spp=1, compile=compile), Listener())
    session.start()
    try:
        while compile and session.compiled is None:
            time.sleep(0.1)
        session.worker.wait_idle(600)
        page, client = Page(None), Client(None)
        page.session = session
        home = replace(session.home_view, aspect=16 / 9)
        window = page.windows[1] = BrowserWindow(client, None, view=home)
        changes, make_frame = {id(home): 0.0}, session._make_frame
        last = 0.0

        def record_frame(view: PinholeView, lattice: Any, *args: Any, **options: Any) -> Any:
            client.begin, client.pixels_per_ray = time.monotonic(), lattice.pixels_per_ray
            client.change = changes.get(id(view), client.begin) if moving == "camera" else last
            return make_frame(view, lattice, *args, **options)

        session._make_frame = record_frame
        if args.frame_width:
            session.choose_lattice = lambda view: view.make_lattice(args.frame_width)
        rows, eye, views, moving = [], session.observer, [home], "camera"

        def move(t: float) -> PinholeView:
            """Move the observer, or return the view of a moving camera."""
            offset = REACH * np.sin(t) * np.cross(home.forward, home.up)
            if moving == "observer":
                session.place_observer(eye + offset)
                return home
            target = home.origin + home.forward
            views.append(PinholeView.look_at(home.origin + offset, target, home.up, home.fov, home.aspect))
            return views[-1]

        def warm_up() -> None:
            """Compile kernels, and record what the images replay."""
            sizes = [(args.frame_width, 1)] if args.frame_width else FRAME_SIZES
            for k in range(4 * len(sizes)):
                columns, pixels_per_ray = sizes[k // 4]
                make_frame(move(0.01 * k), home.make_lattice(min(columns, width), pixels_per_ray))

        def compare(columns: int, pixels_per_ray: int) -> float:
            """Mean PSNR of drafts."""
            ratios = []
            for k in range(NUM_COMPARED):
                view = move(k)
                draft = make_frame(view, view.make_lattice(columns, pixels_per_ray))[1]
                error = draft.astype(float) - make_frame(view, view.make_lattice(columns), is_draft=False)[1]
                ratios.append(20 * np.log10(255 / max(np.sqrt(np.mean(error**2)), 1e-3)))
            return float(np.mean(ratios))

        for moving in ("camera", "observer"):
            page._start_refinement(window)
            session.worker.wait_idle(600)
            session.worker.call(warm_up).result()
            client.images.clear()
            client.pictures = None if pictures is None else pictures / f"{name} {moving}".replace(" ", "-")
            start, used = time.monotonic(), time.process_time()
            while (t := time.monotonic() - start) < seconds:
                last = time.monotonic()
                with page._lock:
                    window.view = move(t)
                    if moving == "camera":
                        changes[id(window.view)] = last
                        page._hide_picture(window, last)
                    else:
                        page._on_observer_moved(False)
                time.sleep(1 / RATE)
            end, used = time.monotonic(), time.process_time() - used
            images = [image for image in client.images if image.time <= end]
            client.images.clear()
            time.sleep(REST_SECONDS)
            window.is_handled = True
            page._start_refinement(window)
            while not (full := [image.time for image in client.images if image.shape[1] == width]):
                time.sleep(0.005)
            session.worker.wait_idle(600)
            row, psnr = [name, moving, "points", f"{len(images) / seconds:.1f}"], ""
            if images:
                sizes = Counter((image.shape, image.pixels_per_ray) for image in images)
                ((lines, columns), pixels_per_ray), _ = sizes.most_common(1)[0]
                row[2] = f"{columns} x {lines}" + (f", {pixels_per_ray} pixels a ray" if pixels_per_ray > 1 else "")
                psnr = f"{session.worker.call(partial(compare, columns, pixels_per_ray)).result():.1f}"
                latency, *parts = (
                    [1e3 * getattr(image, part) for image in images]
                    for part in ("latency", "waiting", "rendering", "encoding")
                )
                row += [f"{1e3 * used / len(images):.0f}", f"{median(latency):.0f} ({np.quantile(latency, 0.95):.0f})"]
                row += [f"{median(part):.1f}" for part in parts]
            rows.append([*row, *[""] * (9 - len(row)), f"{full[0] - end:.2f}", psnr])
        return rows
    finally:
        session.stop()


def main(argv=None) -> None:
    from nerg_mi.cli.declarations import select_backend

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--width", type=int, default=640, help="width of the full resolution, pixels (default: 640)")
    parser.add_argument("--seconds", type=float, default=4, help="length of a movement (default: 4)")
    parser.add_argument(
        "--frame-width",
        type=int,
        default=0,
        help="width of images of a movement, with a ray for each pixel (default: that which is fast enough)",
    )
    parser.add_argument("--splats", type=Path, help="splats of the environment (default: made of the demo store)")
    parser.add_argument("--pictures", type=Path, help="folder for every 40th image (default: none)")
    parser.add_argument(
        "--only", default="compiled,splats,field", help="environments, separated by commas (default: all)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("out/benchmarks/viewer"), help="folder for files (default: %(default)s)"
    )
    args = parser.parse_args(argv)
    select_backend("llvm_ad_rgb")
    import nerg_mi as nerg
    from nerg_mi.scenes.store import SCENE_FILE
    from nerg_mi.viewer.source import open_viewer_inputs

    def load_splats() -> Any:
        files = {"field": args.splats.resolve(), "gaze": SCENE_FILE.with_name("shoppers.safetensors").resolve()}
        return open_viewer_inputs(nerg.Scene.load(splats.splat_scene(args.out), **files))

    loaders = {"compiled": partial(open_viewer_inputs, args.scene), "splats": load_splats}
    requested = args.only.split(",")
    if "splats" in requested and args.splats is None:
        args.splats = args.out / "store.ply"
        if not args.splats.is_file():
            splats.make(args.splats, RESOLUTION)
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in requested:
        load = loaders.get(name, loaders["compiled"])
        rows += measure(name, load, args)
    parts = ("waiting", "rendering", "encoding")
    columns = ("environment", "moving", "usual size", "images a second", "CPU time, ms", "latency (95 %), ms")
    save_result("viewer", (*columns, *(f"{part}, ms" for part in parts), "full resolution, s", "PSNR, dB"), rows)


if __name__ == "__main__":
    main()
