"""A flight as a video, made on the render thread in turns with everything else.

The job behind ``nerg render --frames`` does it, which knows nothing of turns: it runs in a thread of its own, which
goes on only while the render thread waits for it, so that Dr.Jit is used by one of them at a time.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from nerg_mi.figures.overlay import OVERLAYS
from nerg_mi.jobs.options.pictures import PictureOptions
from nerg_mi.jobs.pictures import render_file

from .copied_scene import Shown
from .layers import Layer, Scale
from .view import View

_EVEN = 2


def even(view: View, width: int) -> tuple[View, int]:
    """``view`` and ``width`` with as many pixels in each row and column as a video has: even numbers of them."""
    wide = max(width // _EVEN * _EVEN, 16)
    high = max(round(wide / view.aspect / _EVEN) * _EVEN, 16)
    return replace(view, aspect=wide / high), wide


def film_options(layer: Layer, scale: Scale, frames: Path, fps: float, mode: str) -> PictureOptions:
    """How `render_file` draws the frames of the file ``frames`` as ``layer`` shows them, with the ends and colours of
    ``scale``."""
    if layer.quantity not in OVERLAYS:
        return PictureOptions(frames=frames, fps=fps, mode=mode)
    scaled = OVERLAYS[layer.quantity].scaled
    return PictureOptions(
        frames=frames,
        fps=fps,
        mode=mode,
        overlay=layer.quantity,
        top=scale.high if scaled else None,
        cmap=scale.colors if layer.kind == "heat" else None,
    )


class Film:
    """A video that is being made of the scene file ``scene``: ``steps`` is what the `Worker` runs.

    ``on_progress(share, text)`` is told how far it is; ``on_end(error)`` of its end, with what went wrong, or None;
    after `cancel` it is `KeyboardInterrupt`, and no file is left.
    """

    def __init__(
        self,
        scene: Path,
        output: Path,
        options: PictureOptions,
        on_progress: Callable[[float, str], None],
        on_end: Callable[[BaseException | None], None],
    ):
        self._given = scene, output, options
        self._on_progress, self._on_end = on_progress, on_end
        self._go, self._paused = threading.Semaphore(0), threading.Semaphore(0)
        self._over = self._cancelled = False
        self._error: BaseException | None = None

    def cancel(self) -> None:
        """Make no further frame."""
        self._cancelled = True

    def steps(self) -> Iterator[None]:
        """Each makes a strip of a picture."""
        threading.Thread(target=self._run, name="nerg-view-film", daemon=True).start()
        try:
            while not self._over:
                self._go.release()
                self._paused.acquire()
                yield None
        finally:
            # Whoever drops the steps ends the job, too: nothing else would let its thread go on.
            while not self._over:
                self._cancelled = True
                self._go.release()
                self._paused.acquire()
            self._on_end(self._error)

    def _run(self) -> None:
        self._go.acquire()
        try:
            render_file(*self._given, self)
        except BaseException as error:
            self._error = error
        self._over = True
        self._paused.release()

    # The job's reporter

    def progress(self, share: float, text: str = "") -> None:
        """Let the others have their turn."""
        self._on_progress(share, text)
        self._paused.release()
        self._go.acquire()
        if self._cancelled:
            raise KeyboardInterrupt

    def message(self, text: str) -> None:
        """What is written is the page's to say."""

    def warn(self, text: str) -> None:
        """As any other progress."""
        self._on_progress(0.0, text)


def shown_of_flight(views: list[View], width: int, **others: Any) -> tuple[list[View], Shown]:
    """The ``views`` of a flight with even sides, and what their scene file is made of: the first of them, and what
    `Shown` has besides."""
    made = [even(view, width) for view in views]
    first, wide = made[0]
    return [replace(view, aspect=first.aspect, fov=first.fov) for view, _ in made], Shown(first, width=wide, **others)
