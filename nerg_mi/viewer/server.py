"""The server of the viewer: its sockets, and the guard that refuses other origins."""

from __future__ import annotations

import contextlib
import hmac
import io
import ipaddress
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from nerg_mi.errors import NergError, format_error

# ---- Guard ----
#
# Who may talk to the viewer: checks of every HTTP request and of every websocket before it opens.
#
# A page of another site, open in the same browser, can send requests to this machine (cross-site websockets), and by a
# name that it resolves anew even as if they were to itself (DNS rebinding). What it cannot choose are the headers
# `Host` and `Origin`: the former must be a name of this server, the latter, where there is one, this very server.
# Whoever can reach an address other than the loopback's needs a token as well.

LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Names by which a browser on this machine reaches it."""

MESSAGE_BYTES = 16 << 20
"""A message of a browser may have so many bytes: a screenshot of a large window."""

CLIENTS = 32
"""So many pages may be open at once."""

_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob: {sockets}; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches what is bound to ``host``."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def new_token() -> str:
    """192 random bits as text that may stand in an address."""
    return secrets.token_urlsafe(24)


@dataclass(frozen=True)
class Refusal:
    """``status`` of HTTP, and why, for people."""

    status: int
    reason: str


@dataclass(frozen=True)
class Guard:
    """``host`` that the server is bound to; ``token`` that requests must bring, or None; ``names``: more names by which
    it is reached."""

    host: str
    token: str | None = field(default=None, repr=False)
    names: tuple[str, ...] = ()

    def refusal(self, headers: Mapping[str, str], path: str, port: int, clients: int = 0) -> Refusal | None:
        """Why a request is refused, or None. ``headers``: one value each, of names in any case; ``path`` with its
        query;
        ``port`` of the server; ``clients`` that have a websocket already."""
        given = {name.lower(): value for name, value in headers.items()}
        asked, origin = given.get("host", ""), given.get("origin")
        if not self._is_own(asked):
            return Refusal(403, "The header Host is no name of this server.")
        if origin is not None and not self._same(origin, asked):
            return Refusal(403, "The header Origin is that of another site.")
        if self.token is not None and not self._has_token(given.get("cookie", ""), path, port):
            return Refusal(403, "The token is missing or wrong: open the address that nerg view printed.")
        if given.get("upgrade", "").lower() == "websocket" and clients >= CLIENTS:
            return Refusal(503, f"There are {CLIENTS} pages open already: close one.")
        return None

    def response_headers(self, path: str, asked: str, port: int) -> dict[str, str]:
        """What is added to an answer: the browser itself keeps the page from reaching any other machine, and brings the
        token of ``path`` again from now on. ``asked``: the header Host."""
        found = {
            "Content-Security-Policy": _POLICY.format(sockets=f"ws://{asked} wss://{asked}"),
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
        }
        if self.token is not None and self._in_query(path):
            found["Set-Cookie"] = f"{_cookie_name(port)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return found

    def _is_own(self, asked: str) -> bool:
        """Whether the header Host is one of ours; the port may be another one, of a tunnel."""
        try:
            name = urlsplit(f"//{asked}").hostname
        except ValueError:
            return False
        if not name or set(asked) & set("/?#@\\ "):
            return False
        own = {*LOOPBACK, self.host.strip("[]").lower(), *(n.lower() for n in self.names)}
        if name.lower() in own:
            return True
        # Bound to all addresses, it is reached by any of them; a name could lead anywhere, an address cannot.
        return not is_loopback(self.host) and _is_address(name)

    @staticmethod
    def _same(origin: str, asked: str) -> bool:
        """Whether an Origin is the server of the header Host."""
        try:
            parts = urlsplit(origin)
            return parts.scheme in ("http", "https") and parts.netloc.lower() == asked.lower()
        except ValueError:
            return False

    def _has_token(self, cookies: str, path: str, port: int) -> bool:
        if self._in_query(path):
            return True
        try:
            found = SimpleCookie(cookies).get(_cookie_name(port))
        except CookieError:
            return False
        return found is not None and self._right(found.value)

    def _in_query(self, path: str) -> bool:
        try:
            given = parse_qs(urlsplit(path).query, max_num_fields=16).get("token", [])
        except ValueError:
            return False
        return any(map(self._right, given))

    def _right(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), (self.token or "").encode())


def _cookie_name(port: int) -> str:
    # Cookies are shared between the ports of a machine.
    return f"nerg_view_{port}"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


# ---- Server ----
#
# viser's server behind a `Guard`: bound where it is told, with capped messages, and no link to share.
#
# viser takes no checks of its own, so that the websockets' `serve` that it calls is wrapped while it starts; where that
# call is not made as expected, nothing is served at all.

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
                f"port {port} of {host} cannot be used ({format_error(error).rstrip('.')}); choose another with --port"
            ) from error
