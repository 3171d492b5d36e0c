"""Who is refused: other names, other sites, and whoever has no token."""

from __future__ import annotations

import pytest

from nerg_mi.viewer.server import CLIENTS, Guard, is_loopback, new_token

LOCAL = Guard("127.0.0.1")


def status(guard, path="/", port=8080, clients=0, **headers):
    found = guard.refusal(headers, path, port, clients)
    return 200 if found is None else found.status


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "LOCALHOST", "[::1]:8080", "localhost:9999"])
def test01_names_of_this_machine(host):
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
def test02_other_names_are_refused(host):
    assert status(LOCAL, Host=host) == 403
    assert status(LOCAL, Host=host, Upgrade="websocket") == 403


def test03_no_host_at_all_is_refused():
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
def test04_other_sites_are_refused(origin):
    assert status(LOCAL, Host="localhost:8080", Origin=origin, Upgrade="websocket") == 403


def test05_the_page_itself_is_let_in():
    assert status(LOCAL, host="localhost:8080", origin="http://localhost:8080", upgrade="websocket") == 200
    # Browsers write names in small letters, and whoever typed the address need not.
    assert status(LOCAL, host="LocalHost:8080", origin="http://localhost:8080", upgrade="websocket") == 200


def test06_a_token_is_asked_for_elsewhere():
    guard = Guard("0.0.0.0", "a-token")
    assert status(guard, Host="192.168.1.7:8080") == 403
    assert status(guard, "/?token=wrong", Host="192.168.1.7:8080") == 403
    assert status(guard, "/?token=", Host="192.168.1.7:8080") == 403
    assert status(guard, "/?token=a-token", Host="192.168.1.7:8080") == 200
    assert status(guard, Host="192.168.1.7:8080", Cookie="other=1; nerg_view_8080=a-token") == 200
    assert status(guard, Host="192.168.1.7:8080", Cookie="nerg_view_8080=wrong") == 403
    assert status(guard, Host="192.168.1.7:8080", Cookie="nerg_view_8081=a-token") == 403
    # Right as it is, it opens no door to another site, nor by a name that leads here.
    assert status(guard, "/?token=a-token", Host="192.168.1.7:8080", Origin="http://evil.example") == 403
    assert status(guard, "/?token=a-token", Host="evil.example") == 403
    assert status(Guard("0.0.0.0", "a-token", ("lab",)), "/?token=a-token", Host="lab:8080") == 200
    assert "a-token" not in repr(guard)


def test07_the_browser_keeps_the_token_and_stays_here():
    guard = Guard("0.0.0.0", "a-token")
    headers = guard.response_headers("/?token=a-token", "192.168.1.7:8080", 8080)
    assert headers["Set-Cookie"].startswith("nerg_view_8080=a-token; HttpOnly; SameSite=Strict")
    assert "ws://192.168.1.7:8080" in headers["Content-Security-Policy"]
    assert "Set-Cookie" not in guard.response_headers("/", "192.168.1.7:8080", 8080)
    assert "Set-Cookie" not in LOCAL.response_headers("/?token=x", "localhost", 8080)
    assert headers["Referrer-Policy"] == "no-referrer"


def test08_so_many_pages_and_no_more():
    open_one = dict(Host="localhost:8080", Upgrade="WebSocket")
    assert status(LOCAL, clients=CLIENTS - 1, **open_one) == 200
    assert status(LOCAL, clients=CLIENTS, **open_one) == 503
    assert status(LOCAL, clients=CLIENTS, Host="localhost:8080") == 200


def test09_loopback():
    assert all(map(is_loopback, ["127.0.0.1", "localhost", "::1", "127.1.2.3", "[::1]"]))
    assert not any(map(is_loopback, ["0.0.0.0", "::", "192.168.1.7", "example.org", "localhost.example.org"]))
    assert len({new_token() for _ in range(8)}) == 8 and len(new_token()) == 32
