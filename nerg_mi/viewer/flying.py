"""The part of the panel for a camera's flight: views that are kept, and their frames or their video."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, expected, sentence
from nerg_mi.files.atomic import write_text
from nerg_mi.files.video import check_video

from . import layers
from .controls import tell
from .copied_scene import ceiling_of, check_copied, copied
from .filming import Film, film_options, shown_of_flight
from .flights import flight, frames_csv
from .page import Page
from .session import URGENCY
from .view import View

TITLE = "Flight"


class Flying:
    """A folder of a `Page`'s panel. One video is made at a time, whoever asked for it."""

    def __init__(self, page: Page):
        self.page, self.session = page, page.session
        self._kept: list[View] = []
        self._film: Film | None = None
        gui = page.server.gui
        with gui.add_folder(TITLE, expand_by_default=False):
            keep = gui.add_button("Keep this view")
            forget = gui.add_button("Forget the views")
            self._seconds = gui.add_number("Seconds", 6.0, min=0.1, max=3600.0, step=0.5)
            self._fps = gui.add_number("Frames a second", 25.0, min=1.0, max=120.0, step=1.0)
            frames = gui.add_button("Save the frames (CSV)")
            self._make = gui.add_button("Make a video (MP4)")
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._said = gui.add_markdown("", visible=False)
            self._cancel = gui.add_button("Cancel the video", visible=False)
        keep.on_click(self._keep)
        frames.on_click(self._save_frames)
        self._make.on_click(self._begin)
        forget.on_click(lambda event: self._kept.clear())

        @self._cancel.on_click
        def _(event: Any) -> None:
            if self._film is not None:
                self._film.cancel()

    def _keep(self, event: Any) -> None:
        self._kept.append(View.of_page(event.client.camera))
        count = len(self._kept)
        tell(event, TITLE, "One view is kept." if count == 1 else f"{count} views are kept.")

    def _save_frames(self, event: Any) -> None:
        try:
            text = frames_csv(flight(self._kept, self._seconds.value, self._fps.value))
        except NergError as error:
            tell(event, TITLE, sentence(error))
            return
        event.client.send_file_download("view.frames.csv", text.encode(), save_immediately=True)
        tell(event, TITLE, "nerg render view.xml -o flight.mp4 --frames view.frames.csv renders it.")

    def _begin(self, event: Any) -> None:
        """Make a video, and send it to the page that asked."""
        session, client, shade = self.session, event.client, self.session.shade
        if self._film is not None:
            tell(client, TITLE, "A video is being made already; cancel it, or wait for it.")
            return
        folder = tempfile.TemporaryDirectory()
        try:
            check_video(self._fps.value)
            check_copied(session)
            asked = tuple(name for name in layers.quantities(shade.layer) if name != "color")
            views, shown = shown_of_flight(
                flight(self._kept, self._seconds.value, self._fps.value),
                session.options.width,
                observer=session.observer,
                aovs=asked,
                spp=session.spp,
                falloff=session.falloff,
                ceiling=ceiling_of(session),
            )
            scene, frames, video = (Path(folder.name, name) for name in ("view.xml", "view.frames.csv", "flight.mp4"))
            write_text(scene, copied(session.scene_file, shown))
            write_text(frames, frames_csv(views))
        except (NergError, ImportError) as error:
            folder.cleanup()
            tell(client, TITLE, sentence(error))
            return

        def end(error: BaseException | None) -> None:
            try:
                if error is None:
                    client.send_file_download("flight.mp4", video.read_bytes(), save_immediately=True)
                elif isinstance(error, KeyboardInterrupt):
                    tell(client, TITLE, "The video was cancelled.")
                elif expected(error):
                    tell(client, TITLE, sentence(error))
                else:
                    self.page.on_error(error)
            finally:
                folder.cleanup()
                self._film = None
                self._show(False)

        options = film_options(shade.layer, session.scale(), frames, self._fps.value, session.mode)
        self._film = Film(scene, video, options, self._progress, end)
        self._show(True)
        self._progress(0.0, "the video waits for its turn")
        session.worker.submit("film", URGENCY, self._film.steps())

    def _progress(self, share: float, text: str) -> None:
        self._bar.value = 100 * share
        self._said.content = text

    def _show(self, making: bool) -> None:
        for handle in (self._bar, self._said, self._cancel):
            handle.visible = making
        self._make.disabled = making
