"""A viewer from files to an address."""

from __future__ import annotations

import http.client
import time
from urllib.parse import urlsplit

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.viewer import serve
from nerg_mi.viewer.serve import view_files, viewer
from nerg_mi.workflows.scene_commands import ViewOptions
from tests.viewer.browser import require
from tests.workflows.recorder import Recorder


@pytest.fixture(autouse=True)
def _viser():
    require("viser")


def status(address: str) -> int:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=10)
    connection.request("GET", f"/?{parts.query}")
    return connection.getresponse().status


def test01_an_address_that_answers_for_as_long_as_the_block(room):
    with viewer([room], ViewOptions(port=0)) as running:
        assert status(running.address) == 200 and urlsplit(running.address).hostname == "127.0.0.1"
        address = running.address
    with pytest.raises(ConnectionError):
        status(address)


def test02_elsewhere_there_is_a_token(room):
    with viewer([room], ViewOptions(host="0.0.0.0", port=0)) as running:
        assert status(running.address) == 200
        assert status(running.address.partition("?")[0]) == 403


def test03_a_moved_observer_is_seen_by_all(room):
    with viewer([room], ViewOptions(port=0)) as running:
        page, session = running.page, running.page.session
        page.place_observer(np.array([3.0, 0, 0.5]), np.eye(3))
        assert np.allclose(page._observer.position, [3, 0, 0.5]) and np.allclose(page._observer.wxyz, [1, 0, 0, 0])
        end = time.monotonic() + 60
        while session.baked_for is None or not np.array_equal(session.baked_for, session.observer):
            assert time.monotonic() < end
            time.sleep(0.05)
        assert page.problem == ""
        page.on_error(KeyError("x"))
        assert "mistake in the program" in page.problem


def test04_until_ctrl_c(room, monkeypatch):
    told = Recorder()

    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr(serve, "_wait", interrupted)
    view_files([room], ViewOptions(port=0), told)
    assert any(text.startswith("open http://127.0.0.1:") for text in told.messages)
    assert told.messages[-1] == "the viewer has ended"


def test05_files_that_are_not_there(tmp_path):
    with pytest.raises(NergError, match="no file"):
        with viewer([tmp_path / "a.xml"], ViewOptions(port=0)):
            pass
