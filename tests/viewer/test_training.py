"""The page of a radiance training: its pictures, panel and cost."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from types import SimpleNamespace

import drjit.llvm.ad as ns
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.maths.color import psnr
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.train import radiance as workflow
from nerg_mi.train.radiance import train_radiance
from nerg_mi.train.radiance_run import train_field
from nerg_mi.train.radiance_settings import RadianceSettings
from nerg_mi.viewer import training
from nerg_mi.viewer.points import PinholeView
from nerg_mi.viewer.training import MAX_FRACTION, TrainingPage, make_camera_view, open_training_page
from tests.recorder import Recorder
from tests.tiny import ball_pose, write_photos
from tests.train.radiance.ball import TINY, ball, ball_dataset, settings, trainer
from tests.viewer.browser import require
from tests.viewer.test_server import get_status

# ---- Cameras ----


def test01_rays_of_a_view_are_those_of_the_page():
    view = PinholeView.look_at([1.0, 2.0, 3.0], [-1.0, 0.5, 2.5], [0.1, 0.2, 1.0], 0.9, 1.6)
    made = make_camera_view(view, 48)
    assert made.shape == (30, 48) and np.allclose(made.camera.center, view.origin)
    rays = (pixel_directions(made.camera.intrinsics) @ made.camera.to_world[:3, :3].T).reshape(-1, 3)
    assert np.allclose(rays, view.ray_directions(48, 30, np.full((48 * 30, 2), 0.5)), atol=1e-12)
    assert training._get_fov(made.camera) == pytest.approx(0.9)


# ---- Pages without a server ----


class Gui:
    """A panel that records its contents."""

    def __init__(self):
        self.charts = []

    def add_markdown(self, content):
        return SimpleNamespace(content=content)

    def add_checkbox(self, label, value, hint=""):
        return SimpleNamespace(value=value, on_update=lambda function: function)

    def add_uplot(self, data, series, **options):
        self.charts.append(SimpleNamespace(data=data, series=series, options=options))
        return self.charts[-1]


class Server:
    """A server with visitors at given cameras, and without a network."""

    def __init__(self):
        self.gui, self.initial_camera, self.frustums = Gui(), SimpleNamespace(), []
        self.scene = SimpleNamespace(set_up_direction=lambda up: None, add_camera_frustum=self._add_frustum)
        self.pictures = []

    def _add_frustum(self, name, **values):
        self.frustums.append((name, values))
        return SimpleNamespace(visible=True)

    def get_port(self):
        return 1

    def get_clients(self):
        return {}

    def on_client_connect(self, function):
        self.connect = function

    def on_client_disconnect(self, function):
        self.disconnect = function

    def visit(self, number=0, position=(0.0, -2.0, 0.0), forward=(0.0, 1.0, 0.0)):
        """Connect a browser with a camera; returns it."""
        right, up = np.cross(forward, [0.0, 0, 1]), np.array([0.0, 0, 1])
        x, y, z, w = Rotation.from_matrix(np.stack([right, -up, forward], axis=1)).as_quat()
        camera = SimpleNamespace(
            position=np.array(position), wxyz=(w, x, y, z), fov=0.76, image_width=300, image_height=200
        )
        camera.on_update = lambda function: setattr(camera, "moved", function)
        shown = self.pictures
        scene = SimpleNamespace(set_background_image=lambda picture, **how: shown.append((number, picture)))
        client = SimpleNamespace(client_id=number, camera=camera, scene=scene)
        self.connect(client)
        return client


@pytest.fixture
def _eager(monkeypatch):
    """Update the page after each step, whatever that costs."""
    for name in ("MIN_INTERVAL", "REFRESH_INTERVAL", "_STATUS_INTERVAL", "_REST_SECONDS"):
        monkeypatch.setattr(training, name, 0.0)
    monkeypatch.setattr(training, "MAX_FRACTION", math.inf)


@pytest.mark.usefixtures("_eager")
def test02_a_visitor_sees_the_field():
    """The ball after 99 steps, from a camera without a photo."""
    data, server = ball_dataset(), Server()
    page = TrainingPage(server)
    t = trainer(data, steps=100)
    page.on_start(t, data)
    assert len(server.frustums) == len(data.train) + len(data.held_out)
    w, x, y, z = server.frustums[0][1]["wxyz"]
    # A frustum of the page has y down and z forward, a camera of the data set y up and z backwards.
    axes, camera = Rotation.from_quat([x, y, z, w]).as_matrix(), data.train[0].camera
    assert np.allclose(axes[:, 2], camera.axis) and np.allclose(axes[:, 1], -camera.to_world[:3, 1])
    while t.steps < 99:
        t.step()
    server.visit()
    page.on_step(t, [{"steps": 5, "seconds": 1.0, "psnr": 12.0, "psnr_train": 13.0}])
    ((number, picture),) = server.pictures
    assert number == 0 and picture.dtype == np.uint8 and abs(picture.shape[1] / picture.shape[0] - 1.5) < 0.03
    # The photo of the same camera, whose lens has a vertical field of view of 0.76.
    truth = ball(ball_pose(np.array([0.0, -2.0, 0.0]))).composite_over(0)
    height, width = picture.shape[:2]
    rows = np.linspace(0, height - 1, 24).round().astype(int)
    columns = (width / 2 + (np.linspace(0, height - 1, 24) - height / 2)).round().astype(int)
    assert psnr(picture[np.ix_(rows, columns)] / 255, truth) > 15
    assert "step 99" in page._status.content and "12.00 dB" in page._status.content
    (chart,) = server.gui.charts
    assert [list(column) for column in chart.data] == [[1.0], [12.0], [13.0]]


@pytest.mark.usefixtures("_eager")
def test03_an_outdated_picture_is_grey():
    data, server = ball_dataset(), Server()
    page, t = TrainingPage(server), trainer(data, steps=40)
    page.on_start(t, data)
    client = server.visit()
    t.step()
    page.on_step(t, [])
    assert len(server.pictures) == 1 and page.visitors[0].picture is not None
    page._update_view(page.visitors[0])
    assert len(server.pictures) == 1, "the camera has not moved"
    client.camera.position = np.array([0.3, -2.0, 0.0])
    page._update_view(page.visitors[0])
    grey = server.pictures[-1][1]
    assert len(server.pictures) == 2 and (grey[..., 0] == grey[..., 1]).all() and page.visitors[0].picture is None
    t.step()
    page.on_step(t, [])
    assert len(server.pictures) == 3 and page.visitors[0].picture is not None
    client.camera.position = np.full(3, np.nan)
    page._update_view(page.visitors[0])
    assert len(server.pictures) == 3 and np.isfinite(page.visitors[0].view.origin).all()
    server.disconnect(client)
    t.step()
    page.on_step(t, [])
    assert len(server.pictures) == 3


@pytest.mark.usefixtures("_eager")
def test04_visitors_take_turns():
    data, server = ball_dataset(), Server()
    page, t = TrainingPage(server), trainer(data, steps=40)
    page.on_start(t, data)
    for number in range(3):
        server.visit(number)
    for _ in range(6):
        t.step()
        page.on_step(t, [])
    assert [number for number, _ in server.pictures] == [0, 1, 2, 0, 1, 2]


def test05_the_page_takes_a_fraction_of_the_time():
    """Measured: with a visitor, updates take at most a tenth of the time between the first and the last."""
    data, server = ball_dataset(), Server()
    page, t = TrainingPage(server), trainer(data, steps=10**6)
    page.on_start(t, data)
    server.visit()
    t.step()
    t.render(make_camera_view(page.visitors[0].view, 64))  # Compiles its kernels
    t.start()
    while t.seconds < 5:
        t.step()
        page.on_step(t, [])
    assert server.pictures
    # The last update may have been just now.
    assert page.seconds <= MAX_FRACTION * (t.seconds + max(training.MIN_INTERVAL, page.seconds / MAX_FRACTION))


# ---- Trainings with a page ----


@pytest.mark.usefixtures("_eager", "one_thread")
def test06_weights_do_not_depend_on_the_page():
    data, server, weights = ball_dataset(), Server(), []
    page = TrainingPage(server)

    class Visited:
        def on_start(self, trainer, dataset):
            page.on_start(trainer, dataset)
            server.visit()

        def on_step(self, trainer, history):
            page.on_step(trainer, history)

    for observer in (None, Visited()):
        field, _ = train_field(data, TINY, settings(steps=12), ns, observer=observer)
        weights.append({name: value.numpy() for name, value in field.parameters().items()})
    assert len(server.pictures) == 11, "one a step, except the last"
    for name, value in weights[0].items():
        assert np.array_equal(value, weights[1][name]), name


@dataclass(frozen=True)
class CoarseSettings(RadianceSettings):
    """A density grid of 32 cells per edge instead of 128, whose extraction at the end of a training takes long."""

    resolution: int = 32


@pytest.fixture
def photos(tmp_path, monkeypatch):
    """A folder of posed photos; trainings have a coarse density grid."""
    monkeypatch.setattr(workflow, "RadianceSettings", CoarseSettings)
    return write_photos(tmp_path / "photos", 8)


OPTIONS = {"steps": 4, "holdout": 4, "view": True, "port": 0}


def test07_a_command_with_a_page(photos, tmp_path, monkeypatch):
    require("viser")
    recorder, statuses = Recorder(), []
    on_step = TrainingPage.on_step

    def observe(page, trainer, history):
        on_step(page, trainer, history)
        statuses.append(get_status(page.address))

    monkeypatch.setattr(TrainingPage, "on_step", observe)
    result = train_radiance(photos, **OPTIONS, output=tmp_path / "a.safetensors", progress=recorder)
    assert statuses == [200] * 4 and result.path.is_file()
    (opened,) = (text for text in recorder.messages if text.startswith("open http://127.0.0.1:"))
    with pytest.raises(ConnectionError):
        get_status(opened.split()[1])
    wrote = " ".join(text for text in recorder.messages if text.startswith("wrote"))
    for name in ("a.safetensors", "a.preview.png", "a.curves.csv", "a.curves.png"):
        assert str(tmp_path / name) in wrote and (tmp_path / name).is_file()


def test08_a_failing_page_does_not_end_the_training(photos, tmp_path, monkeypatch):
    require("viser")
    recorder = Recorder()

    def fail(page, trainer, history):
        raise RuntimeError("no page")

    monkeypatch.setattr(TrainingPage, "on_step", fail)
    result = train_radiance(photos, **OPTIONS, output=tmp_path / "a.safetensors", progress=recorder)
    assert result.provenance["steps"] == 4 and result.path.is_file()
    (warning,) = (text for text in recorder.warnings if "page" in text)
    assert "RuntimeError: no page" in warning and "training continues" in warning


def test09_missing_viser_and_a_used_port_are_refused_before_the_training(tmp_path, monkeypatch):
    require("viser")
    with open_training_page(0) as page:
        port = page.server.get_port()
        with pytest.raises(NergError, match="choose another with port"):
            train_radiance(tmp_path, **{**OPTIONS, "port": port})
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(NergError, match=r'pip install "nerg-mi\[viewer\]"'):
        train_radiance(tmp_path, **OPTIONS)


def test10_the_panel_is_supported_by_viser():
    """The calls of this page, with a real server."""
    require("viser")
    data = ball_dataset()
    with open_training_page(0) as page:
        t = trainer(data, steps=10**6)
        page.on_start(t, data)
        t.step()
        page.on_step(t, [{"steps": 1, "seconds": 0.5, "psnr": 10.0, "psnr_train": None}])
        page._next_update = -math.inf
        page.on_step(t, [{"steps": k, "seconds": 0.5 * k, "psnr": 10.0, "psnr_train": 11.0} for k in (1, 2)])
        assert [len(column) for column in page._chart.data] == [2, 2, 2]
        assert "step 1" in page._status.content
