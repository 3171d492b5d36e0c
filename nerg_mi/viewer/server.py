"""The web server of the viewer and its access control."""

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

from nerg_mi.errors import NergError, format_error, parameter

# ---- Access control ----
#
# Every HTTP request is checked, and every websocket before it opens. A page of another site in the same browser can
# send requests to this machine (cross-site websocket hijacking), even under its own name (DNS rebinding). It cannot
# choose the headers `Host` and `Origin`: `Host` must be a name of this server, and `Origin`, if present, must be this
# server. On addresses other than loopback, a token is required as well.

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
"""Names by which a browser on this machine can address it."""

MAX_MESSAGE_BYTES = 16 << 20
"""Maximum size of a message from a browser; a screenshot of a large window fits."""

MAX_CLIENTS = 32
"""Maximum number of open pages."""

_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob: {sockets}; "
    "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors {ancestors}"
)
_NO_ANCESTORS, _LOCAL_ANCESTORS = "'none'", "http://localhost:* http://127.0.0.1:*"


def is_loopback(host: str) -> bool:
    """Whether a server bound to ``host`` is reachable only from this machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def make_token() -> str:
    """Return 192 random bits as URL-safe text."""
    return secrets.token_urlsafe(24)


@dataclass(frozen=True)
class Refusal:
    """The refusal of a request: HTTP ``status`` and ``reason``."""

    status: int
    reason: str


@dataclass(frozen=True)
class RequestGuard:
    """Decides which requests the server accepts.

    Parameters
    ----------
    host : str
        Address that the server is bound to.
    token : str or None
        Token that requests must contain.
    host_names : tuple of str
        Additional names by which the server is addressed.
    is_embeddable : bool
        Whether pages of this machine, such as a notebook, may contain the page.
    """

    host: str
    token: str | None = field(default=None, repr=False)
    host_names: tuple[str, ...] = ()
    is_embeddable: bool = False

    def check(self, headers: Mapping[str, str], path: str, port: int, num_clients: int = 0) -> Refusal | None:
        """Check a request.

        Parameters
        ----------
        headers : mapping of str to str
            Headers, with names in any case.
        path : str
            Path with query.
        port : int
            Port of the server.
        num_clients : int
            Number of open websockets.

        Returns
        -------
        Refusal or None
            Why the request is refused; None if it is accepted.
        """
        values = {name.lower(): value for name, value in headers.items()}
        host_header, origin = values.get("host", ""), values.get("origin")
        if not self._is_own_host(host_header):
            return Refusal(403, "The Host header does not name this server.")
        if origin is not None and not self._is_same_origin(origin, host_header):
            return Refusal(403, "The Origin header names another site.")
        if self.token is not None and not self._has_token(values.get("cookie", ""), path, port):
            return Refusal(403, "The token is missing or wrong. Open the address that nerg view printed.")
        if values.get("upgrade", "").lower() == "websocket" and num_clients >= MAX_CLIENTS:
            return Refusal(503, f"The maximum of {MAX_CLIENTS} open pages is reached. Close one of them.")
        return None

    def response_headers(self, path: str, host_header: str, port: int) -> dict[str, str]:
        """Return headers to add to a response to ``path``.

        They stop the page from contacting other machines and the browser from caching, and set the token as a cookie if
        the query of ``path`` contains it. ``host_header`` is the Host header of the request.
        """
        ancestors = _LOCAL_ANCESTORS if self.is_embeddable else _NO_ANCESTORS
        headers = {
            "Content-Security-Policy": _POLICY.format(
                sockets=f"ws://{host_header} wss://{host_header}", ancestors=ancestors
            ),
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cache-Control": "no-store",
        }
        if self.token is not None and self._has_token_in_query(path):
            headers["Set-Cookie"] = f"{_cookie_name(port)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        return headers

    def _is_own_host(self, host_header: str) -> bool:
        """Whether a Host header names this server; the port can differ, for example behind a tunnel."""
        try:
            name = urlsplit(f"//{host_header}").hostname
        except ValueError:
            return False
        if not name or set(host_header) & set("/?#@\\ "):
            return False
        own_names = {*LOOPBACK_NAMES, self.host.strip("[]").lower(), *(n.lower() for n in self.host_names)}
        if name.lower() in own_names:
            return True
        # A server bound to all addresses accepts any address, but no unknown name, because of DNS rebinding.
        return not is_loopback(self.host) and _is_address(name)

    @staticmethod
    def _is_same_origin(origin: str, host_header: str) -> bool:
        """Whether an Origin header names the server of the Host header."""
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
    # Cookies are shared between all ports of a machine.
    return f"nerg_view_{port}"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


# ---- Server ----
#
# viser has no hook for access control, so the function `serve` of websockets is wrapped while viser starts. If viser
# does not call it, the server is not started at all.

_START_LOCK = threading.Lock()


def require_viser() -> Any:
    """Import viser. Raises `NergError` if it is not installed."""
    try:
        import viser
    except ImportError as error:
        raise NergError('the viewer needs viser, which is not installed: pip install "nerg-mi[viewer]"') from error
    return viser


def start_server(guard: RequestGuard, port: int, label: str) -> Any:
    """Start a `viser.ViserServer` with access control.

    Parameters
    ----------
    guard : RequestGuard
        Decides which requests are accepted; its host is the address to bind.
    port : int
        Port; 0 chooses a free one.
    label : str
        Title of the page.

    Returns
    -------
    viser.ViserServer
        The running server.

    Raises
    ------
    NergError
        The port is in use, or this version of viser does not support access control.
    """
    viser = require_viser()
    _check_port(guard.host, port)

    class Server(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> None:
            """Disabled: the page must not be published on another server."""

    with _guard_websockets(guard) as calls, contextlib.redirect_stdout(io.StringIO()):
        server = Server(host=guard.host, port=port, label=label, verbose=False)
    if not calls:
        stop_server(server)
        raise NergError(
            "this version of viser does not support the viewer's access control; "
            'reinstall it with: pip install "nerg-mi[viewer]"'
        )
    # Both link to external sites.
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    return server


def stop_server(server: Any) -> None:
    """Stop a server of `start_server` without viser's output."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


@contextlib.contextmanager
def _guard_websockets(guard: RequestGuard) -> Iterator[list[bool]]:
    """Wrap `websockets.asyncio.server.serve` within the block; the list is filled when it is called."""
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
    """A websocket handler that counts the open connections."""

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
    """Return the response to a request before a websocket opens: a refusal, viser's own, or None to open it."""
    port = int(connection.local_address[1])
    headers: dict[str, str] = {}
    for name, value in request.headers.raw_items():
        # Repeated headers are joined, so that they match nothing.
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
    """Raise `NergError` if ``port`` cannot be bound; viser would silently use another one."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            raise NergError(
                f"port {port} of {host} cannot be used ({format_error(error).rstrip('.')}); choose another with "
                f"{parameter('port')}"
            ) from error
