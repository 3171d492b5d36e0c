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

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
"""Names by which a browser on this machine reaches it."""

MAX_MESSAGE_BYTES = 16 << 20
"""A message of a browser may have so many bytes: a screenshot of a large window."""

MAX_CLIENTS = 32
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


def make_token() -> str:
    """192 random bits as text that may stand in an address."""
    return secrets.token_urlsafe(24)


@dataclass(frozen=True)
class Refusal:
    """``status`` of HTTP, and why, for people."""

    status: int
    reason: str


@dataclass(frozen=True)
class RequestGuard:
    """``host`` that the server is bound to; ``token`` that requests must bring, or None; ``names``: more names by which
    it is reached."""

    host: str
    token: str | None = field(default=None, repr=False)
    host_names: tuple[str, ...] = ()

    def check(self, headers: Mapping[str, str], path: str, port: int, num_clients: int = 0) -> Refusal | None:
        """Why a request is refused, or None. ``headers``: one value each, of names in any case; ``path`` with its
        query;
        ``port`` of the server; ``clients`` that have a websocket already."""
        values = {name.lower(): value for name, value in headers.items()}
        host_header, origin = values.get("host", ""), values.get("origin")
        if not self._is_own_host(host_header):
            return Refusal(403, "The header Host is no name of this server.")
        if origin is not None and not self._is_same_origin(origin, host_header):
            return Refusal(403, "The header Origin is that of another site.")
        if self.token is not None and not self._has_token(values.get("cookie", ""), path, port):
            return Refusal(403, "The token is missing or wrong: open the address that nerg view printed.")
        if values.get("upgrade", "").lower() == "websocket" and num_clients >= MAX_CLIENTS:
            return Refusal(503, f"There are {MAX_CLIENTS} pages open already: close one.")
        return None

    def response_headers(self, path: str, host_header: str, port: int) -> dict[str, str]:
        """What is added to an answer: the browser itself keeps the page from reaching any other machine, and brings the
        token of ``path`` again from now on. ``asked``: the header Host."""
        headers = {
            "Content-Security-Policy": _POLICY.format(sockets=f"ws://{host_header} wss://{host_header}"),
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
        }
        if self.token is not None and self._has_token_in_query(path):
            headers["Set-Cookie"] = f"{_cookie_name(port)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return headers

    def _is_own_host(self, host_header: str) -> bool:
        """Whether the header Host is one of ours; the port may be another one, of a tunnel."""
        try:
            name = urlsplit(f"//{host_header}").hostname
        except ValueError:
            return False
        if not name or set(host_header) & set("/?#@\\ "):
            return False
        own_names = {*LOOPBACK_NAMES, self.host.strip("[]").lower(), *(n.lower() for n in self.host_names)}
        if name.lower() in own_names:
            return True
        # Bound to all addresses, it is reached by any of them; a name could lead anywhere, an address cannot.
        return not is_loopback(self.host) and _is_address(name)

    @staticmethod
    def _is_same_origin(origin: str, host_header: str) -> bool:
        """Whether an Origin is the server of the header Host."""
        try:
            parts = urlsplit(origin)
            return parts.scheme in ("http", "https") and parts.netloc.lower() == host_header.lower()
        except ValueError:
            return False

    def _has_token(self, cookies: str, path: str, port: int) -> bool:
        if self._has_token_in_query(path):
            return True
        try:
            cookie = SimpleCookie(cookies).get(_cookie_name(port))
        except CookieError:
            return False
        return cookie is not None and self._is_token(cookie.value)

    def _has_token_in_query(self, path: str) -> bool:
        try:
            tokens = parse_qs(urlsplit(path).query, max_num_fields=16).get("token", [])
        except ValueError:
            return False
        return any(map(self._is_token, tokens))

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), (self.token or "").encode())


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

_START_LOCK = threading.Lock()


def require_viser() -> Any:
    """The module `viser`. Raises `NergError` where the extra is not installed."""
    try:
        import viser
    except ImportError as error:
        raise NergError('the viewer needs viser, which is not installed: pip install "nerg-mi[viewer]"') from error
    return viser


def start_server(guard: RequestGuard, port: int, label: str) -> Any:
    """A running `viser.ViserServer` on ``guard``'s host and ``port`` (0: any that is free).

    Raises `NergError` for a port that is taken, and for a viser that cannot be guarded.
    """
    viser = require_viser()
    _check_port(guard.host, port)

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Nothing leaves this machine, whatever a page asks for."""

    with _guard_websockets(guard) as calls, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=guard.host, port=port, label=label, verbose=False)
    if not calls:
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
def _guard_websockets(guard: RequestGuard) -> Iterator[list[bool]]:
    """A block in which `websockets.asyncio.server.serve` checks what it serves; the list is filled when that is
    called."""
    from websockets.asyncio import server as websockets_server

    calls: list[bool] = []
    with _START_LOCK:
        serve = websockets_server.serve

        def serve_guarded(handler: Any, host: Any, port: Any, **options: Any) -> Any:
            calls.append(True)
            counting = _CountingHandler(handler)
            options["process_request"] = partial(_process_request, guard, counting, options.get("process_request"))
            options["max_size"] = MAX_MESSAGE_BYTES
            return serve(counting, host, port, **options)

        websockets_server.serve = serve_guarded
        try:
            yield calls
        finally:
            websockets_server.serve = serve


class _CountingHandler:
    """A handler of websockets that knows how many are open."""

    def __init__(self, handler: Callable[[Any], Any]):
        self._handler, self.num_open = handler, 0

    async def __call__(self, connection: Any) -> None:
        self.num_open += 1
        try:
            await self._handler(connection)
        finally:
            self.num_open -= 1


def _process_request(
    guard: RequestGuard, counting: _CountingHandler, next_handler: Any, connection: Any, request: Any
) -> Any:
    """The response to a request before any websocket opens: a refusal, viser's own, or None to open one."""
    port = int(connection.local_address[1])
    headers: dict[str, str] = {}
    for name, value in request.headers.raw_items():
        # Two of a kind agree with nobody.
        headers[name.lower()] = f"{headers[name.lower()]}, {value}" if name.lower() in headers else value
    refusal = guard.check(headers, request.path, port, counting.num_open)
    if refusal is not None:
        return connection.respond(HTTPStatus(refusal.status), refusal.reason + "\n")
    response = None if next_handler is None else next_handler(connection, request)
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
