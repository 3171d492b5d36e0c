"""The panel's part for flights: what is refused is said, and a video is sent to the page that asked."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from nerg_mi.viewer.flights import Flying
from nerg_mi.viewer.points import View
from nerg_mi.viewer.serve import viewer
from nerg_mi.workflows.view import ViewOptions
from tests.viewer.browser import require


class Client:
    def __init__(self):
        self.notes, self.files = [], {}

    def add_notification(self, title, body, **more):
        self.notes.append(body)

    def send_file_download(self, name, data, **more):
        self.files[name] = data


def test01_a_video_is_sent(room):
    require("viser")
    pytest.importorskip("av")
    client = Client()
    with viewer([room], ViewOptions(port=0, width=32, spp=1)) as running:
        part = Flying(running.page)
        part._begin(SimpleNamespace(client=client))
        assert "two views" in client.notes[-1] and part._film is None
        home = running.page.session.home
        part._kept = [home, View.of(home.origin + 0.3, home.origin + home.ahead, home.up, home.fov, home.aspect)]
        part._seconds.value, part._fps.value = 0.2, 10
        part._begin(SimpleNamespace(client=client))
        assert running.page.session.worker.wait_idle(120)
        assert running.page.problem == "" and part._film is None and not part._cancel.visible
    assert client.files["flight.mp4"][4:8] == b"ftyp"
