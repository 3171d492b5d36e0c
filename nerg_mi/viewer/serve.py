"""Start and stop the viewer."""

from __future__ import annotations

import atexit
import os
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.api.calls import Progress, report_progress
from nerg_mi.api.gaze import list_inputs
from nerg_mi.api.objects import as_file, build_options
from nerg_mi.files.html import element
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.workflows.scene_commands import ViewOptions
from nerg_mi.workflows.view import make_viewer_scene

from .controls import AreasPanel, Controls
from .page import Page
from .scene import ParticipantsPanel
from .server import RequestGuard, is_loopback, make_token, require_viser, start_server
from .session import Session


@dataclass(frozen=True)
class RunningViewer:
    """A running viewer.

    Parameters
    ----------
    address : str
        URL to open in a browser.
    page : Page
        Its page.
    is_embeddable : bool
        Whether pages of this machine, such as a notebook, may contain the page.
    """

    address: str
    page: Page
    is_embeddable: bool


@contextmanager
def open_viewer(
    files: Sequence[str | Path],
    options: ViewOptions | None = None,
    reporter: Reporter = SILENT,
    is_embeddable: bool = False,
) -> Iterator[RunningViewer]:
    """Serve ``files`` as a page for the duration of the block.

    Parameters
    ----------
    files : sequence of str or Path
        Files that `nerg_mi.workflows.view` can display.
    options : ViewOptions, optional
        Options of ``nerg view``. By default the server accepts connections from this machine only; with another host
        the address contains a token.
    reporter : Reporter
        Receives progress and messages.
    is_embeddable : bool
        Whether pages of this machine, such as a notebook, may contain the page. Only without a token, whose cookie a
        browser would not send from within another page.

    Yields
    ------
    RunningViewer
        The address and the page.

    Raises
    ------
    NergError
        The files cannot be displayed, the port is in use, or viser is not installed.
    """
    options = options or ViewOptions()
    require_viser()
    token = None if is_loopback(options.host) else make_token()
    guard = RequestGuard(options.host, token, options.hostnames, is_embeddable and token is None)
    with tempfile.TemporaryDirectory() as folder:
        server = start_server(guard, options.port, "nerg view")
        page = Page(server)
        try:
            session = Session(lambda: make_viewer_scene(files, Path(folder), options, reporter), options, page)
            page.session = session
            session.start()
            page.open(session)
            Controls(page)
            if session.tracks is not None:
                ParticipantsPanel(page, session.tracks)
            if session.scene.has_gaze:
                AreasPanel(page)
            host = "localhost" if options.host in ("0.0.0.0", "::") else options.host
            host = f"[{host}]" if ":" in host else host
            query = "" if token is None else f"?token={token}"
            yield RunningViewer(f"http://{host}:{server.get_port()}/{query}", page, guard.is_embeddable)
        finally:
            page.close()


class Viewer:
    """A viewer in the background, of `view`: it serves its page until `close`, or the end of the process.

    Attributes
    ----------
    address : str
        URL to open in a browser.
    """

    HEIGHT = 600
    """Height of the viewer in a notebook in CSS pixels."""

    def __init__(self, running: AbstractContextManager[RunningViewer]) -> None:
        self._running = running
        opened = running.__enter__()
        self.address, self._is_embeddable = opened.address, opened.is_embeddable
        atexit.register(self.close)

    def close(self) -> None:
        """Stop serving the page."""
        atexit.unregister(self.close)
        running, self._running = self._running, None
        if running is not None:
            running.__exit__(None, None, None)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Viewer: {'closed' if self._running is None else self.address}>"

    def _repr_html_(self) -> str:
        link = element("a", f"Viewer at {self.address}", href=self.address, target="_blank", rel="noopener")
        if self._running is None or not self._is_embeddable:
            return link
        style = f"width: 100%; height: {self.HEIGHT}px; border: 0"
        return element("div", link, element("iframe", src=self.address, style=style))


def view(inputs: object, *, options: ViewOptions | None = None, progress: Progress = None, **overrides: Any) -> Viewer:
    """Show a scene with its gaze in the browser, with a movable observer.

    The page is served in the background, to this machine only unless ``host`` is set.

    Parameters
    ----------
    inputs : object or sequence of these
        A scene, or an environment, a gaze field and recordings, in memory or as files, in any order.
    options : ViewOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.ViewOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``port=0`` or ``observer=(4.4, 2.8, 1.6)``.

    Returns
    -------
    Viewer
        The viewer: its ``address`` and its method ``close``. A notebook of this machine contains its page, and other
        notebooks a link to it.

    Raises
    ------
    NergError
        The inputs cannot be shown, the port is in use, or viser is not installed.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> with nerg.view(files("nerg_mi.scenes.store") / "scene.xml", port=0) as viewer:
    ...     viewer.address.startswith("http://127.0.0.1:")
    True
    """
    with report_progress(progress) as reporter:
        resolved = build_options(ViewOptions, "view", options, overrides)
        paths = [as_file(item, "inputs") for item in list_inputs(inputs)]
        return Viewer(open_viewer(paths, resolved, reporter, is_embeddable=True))


def view_files(files: Sequence[str | Path], options: ViewOptions | None = None, reporter: Reporter = SILENT) -> None:
    """Serve ``files`` until Ctrl-C. Arguments and errors as for `open_viewer`."""
    options = options or ViewOptions()
    if is_loopback(options.host):
        lower_priority()
    with open_viewer(files, options, reporter) as running:
        if not is_loopback(options.host):
            reporter.warn(
                "anyone who has the address can see the scene and move the observer; the connection is not encrypted"
            )
        reporter.message(f"open {running.address}")
        reporter.message("press Ctrl-C to stop the viewer")
        if options.open:
            import webbrowser

            webbrowser.open(running.address)
        try:
            _wait()
        except KeyboardInterrupt:
            reporter.message("the viewer has stopped")


def lower_priority() -> None:
    """Lower the priority of this thread and its children, where the operating system supports it.

    The browser also draws on this machine; without a graphics card, it would freeze while pictures are refined.
    """
    if hasattr(os, "nice"):
        os.nice(10)


def _wait() -> None:
    """Block until Ctrl-C."""
    while True:
        threading.Event().wait(3600)
