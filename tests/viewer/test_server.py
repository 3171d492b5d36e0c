"""Access control of the viewer, its start and end, and the point levels of a browser."""

from __future__ import annotations

import http.client
import os
import signal
import socket
import sys
import threading
import time
from urllib.parse import urlsplit

import numpy as np
import pytest

from nerg_mi.cli import signatures
from nerg_mi.cli.signatures import make_command
from nerg_mi.cli.table import ROWS
from nerg_mi.errors import NergError
from nerg_mi.viewer.page import BrowserWindow
from nerg_mi.viewer.points import NUM_LEVELS
from nerg_mi.viewer.serve import view
from nerg_mi.viewer.server import MAX_CLIENTS, MAX_MESSAGE_BYTES, RequestGuard, is_loopback, make_token, start_server
from tests.recorder import Recorder
from tests.viewer import browser
from tests.viewer.browser import require

# ---- Access control ----

LOCAL = RequestGuard("127.0.0.1")


def status(guard, path="/", port=8080, clients=0, **headers):
    refusal = guard.check(headers, path, port, clients)
    return 200 if refusal is None else refusal.status


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "LOCALHOST", "[::1]:8080", "localhost:9999"])
def test01_own_host_names_are_accepted(host):
    assert status(LOCAL, Host=host) == 200


@pytest.mark.parametrize(
    "host",
    [
        "",
        "evil.example",
        "evil.example:8080",
        "localhost.evil.example",
        "127.0.0.1.evil.example:8080",
        "127.0.0.1@evil.example",
        "localhost/evil.example",
        "evil.example?localhost",
        "localhost, evil.example",
        "192.168.1.7:8080",
        "[::1",
    ],
)
def test02_other_host_names_are_refused(host):
    assert status(LOCAL, Host=host) == 403
    assert status(LOCAL, Host=host, Upgrade="websocket") == 403


def test03_missing_host_is_refused():
    assert status(LOCAL) == 403


@pytest.mark.parametrize(
    "origin",
    [
        "https://evil.example",
        "null",
        "",
        "http://localhost:8081",
        "http://127.0.0.1:8080",
        "http://localhost:8080.evil.example",
        "ftp://localhost:8080",
        "http://[",
    ],
)
def test04_other_origins_are_refused(origin):
    assert status(LOCAL, Host="localhost:8080", Origin=origin, Upgrade="websocket") == 403


def test05_own_origin_is_accepted():
    assert status(LOCAL, host="localhost:8080", origin="http://localhost:8080", upgrade="websocket") == 200
    # Browsers write host names in lower case; typed addresses can be upper case.
    assert status(LOCAL, host="LocalHost:8080", origin="http://localhost:8080", upgrade="websocket") == 200


def test06_token_is_required_on_other_addresses():
    guard = RequestGuard("0.0.0.0", "a-token")
    assert status(guard, Host="192.168.1.7:8080") == 403
    assert status(guard, "/?token=wrong", Host="192.168.1.7:8080") == 403
    assert status(guard, "/?token=", Host="192.168.1.7:8080") == 403
    assert status(guard, "/?token=a-token", Host="192.168.1.7:8080") == 200
    assert status(guard, Host="192.168.1.7:8080", Cookie="other=1; nerg_view_8080=a-token") == 200
    assert status(guard, Host="192.168.1.7:8080", Cookie="nerg_view_8080=wrong") == 403
    assert status(guard, Host="192.168.1.7:8080", Cookie="nerg_view_8081=a-token") == 403
    # A valid token does not allow other origins or host names.
    assert status(guard, "/?token=a-token", Host="192.168.1.7:8080", Origin="http://evil.example") == 403
    assert status(guard, "/?token=a-token", Host="evil.example") == 403
    assert status(RequestGuard("0.0.0.0", "a-token", ("lab",)), "/?token=a-token", Host="lab:8080") == 200
    assert "a-token" not in repr(guard)


def test07_response_sets_cookie_and_policy():
    guard = RequestGuard("0.0.0.0", "a-token")
    headers = guard.response_headers("/?token=a-token", "192.168.1.7:8080", 8080)
    assert headers["Set-Cookie"].startswith("nerg_view_8080=a-token; HttpOnly; SameSite=Strict")
    assert "ws://192.168.1.7:8080" in headers["Content-Security-Policy"]
    assert "Set-Cookie" not in guard.response_headers("/", "192.168.1.7:8080", 8080)
    assert "Set-Cookie" not in LOCAL.response_headers("/?token=x", "localhost", 8080)
    assert headers["Referrer-Policy"] == "no-referrer"


def test_only_pages_of_this_machine_contain_the_page_and_only_on_request():
    policy = lambda guard: guard.response_headers("/", "127.0.0.1:8080", 8080)["Content-Security-Policy"]
    assert policy(LOCAL).endswith("frame-ancestors 'none'")
    assert policy(RequestGuard("127.0.0.1", is_embeddable=True)).endswith(
        "frame-ancestors http://localhost:* http://127.0.0.1:*"
    )


def test08_number_of_pages_is_limited():
    open_one = dict(Host="localhost:8080", Upgrade="WebSocket")
    assert status(LOCAL, clients=MAX_CLIENTS - 1, **open_one) == 200
    assert status(LOCAL, clients=MAX_CLIENTS, **open_one) == 503
    assert status(LOCAL, clients=MAX_CLIENTS, Host="localhost:8080") == 200


def test09_loopback():
    assert all(map(is_loopback, ["127.0.0.1", "localhost", "::1", "127.1.2.3", "[::1]"]))
    assert not any(map(is_loopback, ["0.0.0.0", "::", "192.168.1.7", "example.org", "localhost.example.org"]))
    assert len({make_token() for _ in range(8)}) == 8 and len(make_token()) == 32


# ---- Running server ----

OPEN = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


@pytest.fixture(scope="module")
def viser():
    return require("viser")


@pytest.fixture(scope="module")
def local(viser):
    server = start_server(RequestGuard("127.0.0.1"), 0, "test")
    yield server
    server.stop()


def ask(server, path="/", **headers):
    """Return status, headers and body of a GET request with exactly these headers."""
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    try:
        connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
        for name, value in headers.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        response = connection.getresponse()
        body = b"" if response.status == 101 else response.read()
        return response.status, dict(response.getheaders()), body
    finally:
        connection.close()


def open_websocket(server, **headers):
    headers.setdefault("Host", f"127.0.0.1:{server.get_port()}")
    return ask(server, "/", **headers, **{k.replace("-", "_"): v for k, v in OPEN.items()})[0]


def test10_page_is_served(local):
    status, headers, body = ask(local, Host=f"localhost:{local.get_port()}")
    assert status == 200 and b"<html" in body[:1000].lower()
    assert "connect-src 'self'" in headers["Content-Security-Policy"]


def test11_forged_headers_are_refused(local):
    port = local.get_port()
    assert ask(local, Host="evil.example")[0] == 403
    assert ask(local)[0] in (400, 403)
    assert ask(local, Host=f"localhost:{port}", Origin="http://evil.example")[0] == 403
    assert open_websocket(local) == 101
    assert open_websocket(local, Origin=f"http://127.0.0.1:{port}") == 101
    assert open_websocket(local, Origin="http://evil.example") == 403
    assert open_websocket(local, Origin="null") == 403
    assert open_websocket(local, Origin=f"http://localhost:{port}") == 403
    assert open_websocket(local, Host=f"evil.example:{port}", Origin=f"http://evil.example:{port}") == 403


@pytest.mark.parametrize(
    "lines",
    [
        ("Host: {own}", "Host: evil.example"),
        ("Host: evil.example", "Host: {own}"),
        ("Host: {own}", "Host: {own}"),
        ("Host: {own}", "host: evil.example"),
        ("Host: {own}", "Origin: http://{own}", "Origin: http://evil.example"),
        ("Host: {own}", "Origin: http://evil.example", "Origin: http://{own}"),
    ],
)
def test12_repeated_headers_are_refused(local, lines):
    port = local.get_port()
    lines = ["GET / HTTP/1.1", *(line.format(own=f"localhost:{port}") for line in lines), "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall("\r\n".join(lines).encode())
        assert connection.recv(4096).split()[1] in (b"403", b"400")


def test13_token_on_other_addresses(viser):
    server = start_server(RequestGuard("0.0.0.0", "secret"), 0, "test")
    try:
        host = f"127.0.0.1:{server.get_port()}"
        assert ask(server, Host=host)[0] == 403 and open_websocket(server) == 403
        status, headers, _ = ask(server, "/?token=secret", Host=host)
        assert status == 200
        cookie = headers["Set-Cookie"].partition(";")[0]
        assert ask(server, Host=host, Cookie=cookie)[0] == 200
        assert open_websocket(server, Cookie=cookie) == 101
        assert open_websocket(server, Cookie=cookie, Origin="http://evil.example") == 403
        assert open_websocket(server, Cookie=cookie[:-1]) == 403
    finally:
        server.stop()


def test14_message_size_is_limited(local, viser):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    address = f"ws://127.0.0.1:{local.get_port()}"
    with connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None, compression=None) as page:
        with pytest.raises(ConnectionClosed) as closed:
            page.send(bytes(MAX_MESSAGE_BYTES + 1))
            while True:
                page.recv(timeout=10)
        assert closed.value.rcvd is not None and closed.value.rcvd.code == 1009


def test15_share_url_is_disabled(local, monkeypatch):
    import viser._viser

    def tunnel(*args, **kwargs):
        raise AssertionError("a tunnel was asked for")

    monkeypatch.setattr(viser._viser, "ViserTunnel", tunnel)
    assert local.request_share_url() is None


def test16_used_port_is_reported(local):
    with pytest.raises(NergError, match="choose another with port"):
        start_server(RequestGuard("127.0.0.1"), local.get_port(), "test")


def test17_unguarded_viser_is_refused(viser, monkeypatch):
    import contextlib

    import nerg_mi.viewer.server as module

    stopped = []
    monkeypatch.setattr(module, "_guard_websockets", lambda guard: contextlib.nullcontext([]))
    monkeypatch.setattr(viser.ViserServer, "stop", lambda self: stopped.append(self._websock_server.stop()))
    with pytest.raises(NergError, match="access control"):
        start_server(RequestGuard("127.0.0.1"), 0, "test")
    assert stopped


def test18_missing_viser_is_reported(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(NergError, match=r'pip install "nerg-mi\[viewer\]"'):
        start_server(RequestGuard("127.0.0.1"), 0, "test")


# ---- Viewer ----


@pytest.fixture
def _viser():
    require("viser")


def get_status(address: str) -> int:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
    connection.request("GET", f"/?{parts.query}")
    return connection.getresponse().status


@pytest.mark.usefixtures("_viser")
def test19_viewer_runs_within_the_block(room):
    with view([room], port=0) as running:
        assert get_status(running.address) == 200 and urlsplit(running.address).hostname == "127.0.0.1"
        address = running.address
    with pytest.raises(ConnectionError):
        get_status(address)


@pytest.mark.usefixtures("_viser")
def test20_other_host_has_a_token(room):
    with view([room], host="0.0.0.0", port=0) as running:
        assert get_status(running.address) == 200
        assert get_status(running.address.partition("?")[0]) == 403


@pytest.mark.usefixtures("_viser")
def test21_page_moves_the_observer(room):
    with view([room], port=0) as running:
        page, session = running.page, running.page.session
        page.place_observer(np.array([3.0, 0, 0.5]), np.eye(3))
        assert np.allclose(page._observer.position, [3, 0, 0.5]) and np.allclose(page._observer.wxyz, [1, 0, 0, 0])
        end = time.monotonic() + 60
        while session.finished_observer is None or not np.array_equal(session.finished_observer, session.observer):
            assert time.monotonic() < end
            time.sleep(0.05)
        assert page.problem == ""
        page.on_error(KeyError("x"))
        assert "bug in nerg_mi" in page.problem


@pytest.mark.usefixtures("_viser")
def test22_the_command_serves_until_ctrl_c(room, monkeypatch):
    class Interrupting(Recorder):
        def message(self, text):
            super().message(text)
            if text == "press Ctrl-C to stop":
                threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()

    recorder, command = Interrupting(), make_command(ROWS["view"])
    monkeypatch.setattr(signatures, "lower_priority", lambda: None)
    command.run(inputs=[room], options=command.options(port=0, mode="llvm_ad_rgb"), reporter=recorder)
    (address,) = [text.removeprefix("open ") for text in recorder.messages if text.startswith("open http://127.0.0.1:")]
    with pytest.raises(ConnectionError):
        get_status(address)


@pytest.mark.usefixtures("_viser")
def test23_missing_files_are_reported(tmp_path):
    with pytest.raises(NergError, match="no file"):
        view([tmp_path / "a.xml"], port=0)


# ---- Point levels ----


@pytest.mark.parametrize(
    ("seconds", "at_rest", "change"),
    [(0.2, False, 1), (0.2, True, 1), (0.03, True, 0), (0.017, True, -1), (0.017, False, 0)],
)
def test24_level_adapts_to_frame_times(seconds, at_rest, change):
    window = BrowserWindow(None, None)
    before = window.level
    for _ in range(20):
        window.record_frame(seconds)
    # With pauses of the mouse and a long absence.
    for pause in (0.4, 0.9, 60.0):
        window.record_frame(pause)
    assert window.choose_level(at_rest) == before + change


def test25_level_limits():
    window = BrowserWindow(None, None)
    window.record_frame(0.9)
    assert window.choose_level(True) == window.level
    for pace, end in ((0.5, NUM_LEVELS - 1), (0.01, 0)):
        window.frame_times[:] = [pace] * 20
        for _ in range(2 * NUM_LEVELS):
            window.level = window.choose_level(True)
        assert window.level == end


def test26_slow_frames_do_not_count_as_rest():
    window = BrowserWindow(None, None)
    assert window.rest_seconds == pytest.approx(0.12)
    for _ in range(10):
        window.record_frame(0.02)
    assert window.rest_seconds == pytest.approx(0.12)
    window.record_frame(0.9)
    assert window.rest_seconds == pytest.approx(0.12)
    for _ in range(8):
        window.record_frame(0.2)
    assert window.rest_seconds == pytest.approx(0.6)
    for _ in range(10):
        window.record_frame(0.9)
    assert window.rest_seconds == pytest.approx(0.8)


# ---- Missing requirements ----


def test27_missing_module_skips_or_fails(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.setattr(browser, "REQUIRED", False)
    with pytest.raises(pytest.skip.Exception, match=r"viser is not installed"):
        browser.require("viser")
    monkeypatch.setattr(browser, "REQUIRED", True)
    with pytest.raises(pytest.fail.Exception, match="NERG_REQUIRE_BROWSER"):
        browser.require("viser")
