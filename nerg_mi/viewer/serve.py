"""What the viewer serves, and for how long."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.workflows.base import SILENT, Reporter
from nerg_mi.workflows.scene_commands import ViewOptions
from nerg_mi.workflows.view import make_viewer_scene

from .controls import AreasPanel, Controls
from .flights import FlightPanel
from .page import Page
from .scene import ParticipantsPanel
from .server import RequestGuard, is_loopback, make_token, require_viser, start_server
from .session import Session


@dataclass(frozen=True)
class RunningViewer:
    """A running viewer: ``address`` to open, and its ``page``."""

    address: str
    page: Page


@contextmanager
def open_viewer(
    files: Sequence[str | Path], options: ViewOptions | None = None, reporter: Reporter = SILENT
) -> Iterator[RunningViewer]:
    """Serve ``files`` as a page for as long as the block lasts: what `workflows.view.place_to_view` takes.

    Bound to this machine alone by default; at another host the address has a token. Raises `NergError` for files that
    cannot be shown, for a port that is taken, and where the extra "viewer" is missing.
    """
    options = options or ViewOptions()
    require_viser()
    token = None if is_loopback(options.host) else make_token()
    guard = RequestGuard(options.host, token, options.hostnames)
    with tempfile.TemporaryDirectory() as folder:
        server = start_server(guard, options.port, "nerg view")
        page = Page(server)
        try:
            session = Session(lambda: make_viewer_scene(files, Path(folder), options, reporter), options, page)
            page.session = session
            session.start()
            page.open(session)
            Controls(page)
            FlightPanel(page)
            if session.tracks is not None:
                ParticipantsPanel(page, session.tracks)
            if session.scene.has_gaze:
                AreasPanel(page)
            host = "localhost" if options.host in ("0.0.0.0", "::") else options.host
            host = f"[{host}]" if ":" in host else host
            query = "" if token is None else f"?token={token}"
            yield RunningViewer(f"http://{host}:{server.get_port()}/{query}", page)
        finally:
            page.close()


def view_files(files: Sequence[str | Path], options: ViewOptions | None = None, reporter: Reporter = SILENT) -> None:
    """Serve ``files`` until Ctrl-C, which is the way to end it. Raises as `viewer`."""
    options = options or ViewOptions()
    if is_loopback(options.host):
        lower_priority()
    with open_viewer(files, options, reporter) as running:
        if not is_loopback(options.host):
            reporter.warn("whoever has the address sees the place, and moves its observer; it is not encrypted")
        reporter.message(f"open {running.address}")
        reporter.message("Ctrl-C ends the viewer")
        if options.open:
            import webbrowser

            webbrowser.open(running.address)
        try:
            _wait()
        except KeyboardInterrupt:
            reporter.message("the viewer has ended")


def lower_priority() -> None:
    """Let the browser, which draws on this machine as well, go before this thread and those that it begins, where the
    system knows of such a thing: without a graphics card a page would stand still while pictures are refined."""
    if hasattr(os, "nice"):
        os.nice(10)


def _wait() -> None:
    """Until Ctrl-C."""
    while True:
        threading.Event().wait(3600)
