"""Start and stop the viewer."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from typing import Annotated

from nerg_mi.aoi.areas import AnyAreas, Areas
from nerg_mi.environment.scene_loading import activate_mitsuba, activate_variant
from nerg_mi.files.html import element
from nerg_mi.files.values import FilePath
from nerg_mi.formats.alignments import AnySimilarity
from nerg_mi.progress import Progress, is_notebook, open_reporter
from nerg_mi.ranges import COORDINATES, SPP, Range, check_ranges

from .controls import AreasPanel, Controls
from .page import Page
from .scene import ParticipantsPanel
from .server import RequestGuard, is_loopback, make_token, require_viser, start_server
from .session import Session, SessionSettings
from .source import ViewerInputs, open_viewer_inputs


class Viewer:
    """A viewer in the background, of `view`: it serves its page until `close`, or the end of the process.

    Attributes
    ----------
    address : str
        URL to open in a browser.
    page : Page
        Its page.
    """

    HEIGHT = 600
    """Height of the viewer in a notebook in CSS pixels."""

    def __init__(self, address: str, page: Page, is_embeddable: bool, resources: ExitStack) -> None:
        self.address, self.page = address, page
        self._is_embeddable, self._resources, self._is_closed = is_embeddable, resources, False
        atexit.register(self.close)

    def close(self) -> None:
        """Stop serving the page."""
        atexit.unregister(self.close)
        self._is_closed = True
        self._resources.close()

    def wait(self) -> None:
        """Serve the page until Ctrl-C."""
        try:
            while True:
                threading.Event().wait(3600)
        except KeyboardInterrupt:
            self.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Viewer: {'closed' if self._is_closed else self.address}>"

    def _repr_html_(self) -> str:
        link = element("a", f"Viewer at {self.address}", href=self.address, target="_blank", rel="noopener")
        if self._is_closed or not self._is_embeddable:
            return link
        style = f"width: 100%; height: {self.HEIGHT}px; border: 0"
        return element("div", link, element("iframe", src=self.address, style=style))


@check_ranges
def view(
    inputs: object | Sequence[object | FilePath],
    *,
    observer: Annotated[Sequence[float], COORDINATES] | None = None,
    up: Annotated[Sequence[float], COORDINATES] | None = None,
    areas: FilePath | AnyAreas | None = None,
    align: AnySimilarity | FilePath | None = None,
    width: Annotated[int, Range(16, 8192)] = 720,
    spp: Annotated[int, Range(0, SPP.high)] = 0,
    compile: bool = True,
    host: str = "127.0.0.1",
    port: Annotated[int, Range(0, 65535)] = 8080,
    hostnames: Sequence[str] = (),
    progress: Progress = None,
) -> Viewer:
    """Show a scene with its gaze in the browser, with a movable observer.

    The page is served in the background, to this machine only, and loads nothing from other servers. With another host,
    its address contains a token.

    Parameters
    ----------
    inputs : object, path or sequence of these
        A scene (.xml), or a radiance field, splats, mesh or .vol, a gaze field and rays, in any order; or their folder.
    observer : sequence of float, optional
        Initial position of the observer's eye, x,y,z. Default: as in the scene file.
    up : sequence of float, optional
        Up direction of the scene, x,y,z. Default: as its files state, else 0,0,1.
    areas : Areas, path or mapping, optional
        JSON file of areas of interest (AOIs): boxes with names.
    align : Alignment, Similarity, array_like or path, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.
        Default: the alignment of the gaze field.
    width : int
        Width of a refined image in pixels.
    spp : int
        Samples per pixel; 0: as in the scene file.
    compile : bool
        Compile the radiance field in the background, for faster pictures, and keep the result next to it as
        NAME.compiled.safetensors for the next time.
    host : str
        Address to serve at. With an address other than the loopback address, the page needs a token.
    port : int
        Port to serve at; 0: any free port.
    hostnames : sequence of str
        Further host name under which the page may be requested.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

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
    require_viser()
    token = None if is_loopback(host) else make_token()
    # A browser would not send the cookie of a token from within another page.
    guard = RequestGuard(host, token, tuple(hostnames), is_notebook() and token is None)
    shown = Areas(()) if areas is None else Areas.open(areas)
    settings = SessionSettings(width, spp, observer, shown, compile)
    variant = activate_mitsuba().variant()
    with open_reporter(progress) as reporter, ExitStack() as resources:

        def load() -> ViewerInputs:
            # On the render thread.
            activate_variant(variant)
            return open_viewer_inputs(inputs, observer=observer, up=up, align=align, reporter=reporter)

        server = start_server(guard, port, "nerg view")
        page = Page(server)
        resources.callback(page.close)
        session = page.session = Session(load, settings, page)
        session.start()
        page.open(session)
        Controls(page)
        if session.tracks is not None:
            ParticipantsPanel(page, session.tracks)
        if session.scene.has_gaze:
            AreasPanel(page)
        name = "localhost" if host in ("0.0.0.0", "::") else host
        name = f"[{name}]" if ":" in name else name
        address = f"http://{name}:{server.get_port()}/{'' if token is None else f'?token={token}'}"
        if token is not None:
            reporter.warn(
                "anyone who has the address can see the scene and move the observer; the connection is not encrypted"
            )
        reporter.message(f"open {address}")
        return Viewer(address, page, guard.is_embeddable, resources.pop_all())
