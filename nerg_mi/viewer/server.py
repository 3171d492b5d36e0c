"""viser's server behind a `Guard`: bound where it is told, with capped messages, and no link to share.

viser takes no checks of its own, so that the websockets' `serve` that it calls is wrapped while it starts; where that
call is not made as expected, nothing is served at all.
"""

from __future__ import annotations

import contextlib
import io
import socket
import threading
from collections.abc import Callable, Iterator
from functools import partial
from http import HTTPStatus
from typing import Any

from nerg_mi.errors import NergError, sentence

from .guard import MESSAGE_BYTES, Guard

_STARTING = threading.Lock()


def require_viser() -> Any:
    """The module `viser`. Raises `NergError` where the extra is not installed."""
    try:
        import viser
    except ImportError as error:
        raise NergError('the viewer needs viser, which is not installed: pip install "nerg-mi[viewer]"') from error
    return viser


def start_server(guard: Guard, port: int, label: str) -> Any:
    """A running `viser.ViserServer` on ``guard``'s host and ``port`` (0: any that is free).

    Raises `NergError` for a port that is taken, and for a viser that cannot be guarded.
    """
    viser = require_viser()
    _check_port(guard.host, port)

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Nothing leaves this machine, whatever a page asks for."""

    with _guarding(guard) as used, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=guard.host, port=port, label=label, verbose=False)
    if not used:
        stop_server(server)
        raise NergError('this viser cannot be guarded: pip install "nerg-mi[viewer]" again for one that can')
    # Both lead to a page on other people's machines.
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    return server


def stop_server(server: Any) -> None:
    """End a server that `start_server` gave, without a word of viser's."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _guarding(guard: Guard) -> Iterator[list[bool]]:
    """A block in which `websockets.asyncio.server.serve` checks what it serves; the list is filled when that is
    called."""
    from websockets.asyncio import server as websockets_server

    used: list[bool] = []
    with _STARTING:
        serve = websockets_server.serve

        def guarded(handler: Any, host: Any, port: Any, **options: Any) -> Any:
            used.append(True)
            counted = _Counted(handler)
            options["process_request"] = partial(_process, guard, counted, options.get("process_request"))
            options["max_size"] = MESSAGE_BYTES
            return serve(counted, host, port, **options)

        websockets_server.serve = guarded
        try:
            yield used
        finally:
            websockets_server.serve = serve


class _Counted:
    """A handler of websockets that knows how many are open."""

    def __init__(self, handler: Callable[[Any], Any]):
        self._handler, self.open = handler, 0

    async def __call__(self, connection: Any) -> None:
        self.open += 1
        try:
            await self._handler(connection)
        finally:
            self.open -= 1


def _process(guard: Guard, counted: _Counted, answer: Any, connection: Any, request: Any) -> Any:
    """The response to a request before any websocket opens: a refusal, viser's own, or None to open one."""
    port = int(connection.local_address[1])
    headers: dict[str, str] = {}
    for name, value in request.headers.raw_items():
        # Two of a kind agree with nobody.
        headers[name.lower()] = f"{headers[name.lower()]}, {value}" if name.lower() in headers else value
    refusal = guard.refusal(headers, request.path, port, counted.open)
    if refusal is not None:
        return connection.respond(HTTPStatus(refusal.status), refusal.reason + "\n")
    response = None if answer is None else answer(connection, request)
    if response is not None:
        for name, value in guard.response_headers(request.path, headers.get("host", ""), port).items():
            response.headers[name] = value
    return response


def _check_port(host: str, port: int) -> None:
    """Raise `NergError` where ``port`` cannot be bound: viser would take another one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            raise NergError(
                f"port {port} of {host} cannot be used ({sentence(error).rstrip('.')}); choose another with --port"
            ) from error
