"""Fixtures of the viewer tests: the demo store, and a simple room with gaze fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

import nerg_mi as nerg
from nerg_mi.cli import demo
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.geometry import Box
from nerg_mi.viewer.session import Session, SessionSettings
from nerg_mi.viewer.source import open_viewer_inputs

# ---- A simple room with an analytic solution ----

ROOM = """<scene version="3.0.0">
    <integrator type="nerg" id="integrator">
        <integrator type="direct"/>
        <sensor name="observer" type="perspective">
            <transform name="to_world"><lookat origin="0, 0, 0.5" target="1, 0, 0.5" up="0, 0, 1"/></transform>
        </sensor>
        <string name="aovs" value="depth"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="-2, 0, 1" target="2, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="48"/><integer name="height" value="32"/><rfilter type="box"/>
        </film>
    </sensor>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="3"/></transform>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world"><scale value="0.5"/><translate x="1.5" z="0.5"/></transform>
    </shape>
    <emitter type="constant"/>
</scene>
"""


def write_gaze_fields(folder: Path) -> list[Path]:
    """Write two untrained gaze fields to ``folder``, of the variants emit_capture and emit, and return the files."""
    files, rng = [], np.random.default_rng(3)
    grid = HashGridConfig(levels=2, log2_rows=10, base=2, finest=4)
    for variant in ("emit_capture", "emit"):
        config = LogGazeConfig(grid=grid, width=16, prior=8, variant=variant)
        field = LogGazeField.random(
            config, Box((-3, -3, -1), (3, 3, 2)), namespace("llvm"), 1, rng.normal(size=(8, 16))
        )
        # Random tables, so that the fields differ also in the factor that they share.
        table = field.grid.table
        field.set_parameters({"grid.table": type(table)(rng.normal(size=len(table)).astype(np.float32))})
        files.append(folder / f"{variant}.safetensors")
        save_gaze(field, files[-1], {})
    return files


# ---- Fixtures ----


@pytest.fixture
def room(rgb, tmp_path):
    """File of a scene with a floor at z = 0, a box from x = 1 to x = 2, and constant light."""
    path = tmp_path / "room.xml"
    path.write_text(ROOM)
    return path


@pytest.fixture
def room_scene(room):
    return nerg.Scene.load(room)


@pytest.fixture
def gaze_fields(rgb, tmp_path):
    """Files of two untrained gaze fields in the room, of the variants emit_capture and emit."""
    return write_gaze_fields(tmp_path)


@pytest.fixture
def store(rgb):
    """File of the demo store's scene with its trained fields."""
    path = SCENE_FILE
    if not all((path.parent / name).is_file() for name in demo.CHECKPOINTS.values()):
        pytest.skip("the store's fields are not here: python -m nerg_mi.scenes.store.make")
    return path


# ---- Sessions ----


class CountingListener:
    """A listener that counts events."""

    def __init__(self):
        self.proxies = self.baked = self.shares = 0
        self.errors = []
        self.on_error, self.on_range = self.errors.append, lambda: None

    def on_proxy(self):
        self.proxies += 1

    def on_baked(self):
        self.baked += 1

    def on_shares(self):
        self.shares += 1


@pytest.fixture
def make_session():
    made = []

    def make(path, *other_files, **options) -> Session:
        settings = SessionSettings(**{"compile": False, **options})
        load = lambda: open_viewer_inputs([path, *other_files], observer=settings.observer)
        session = Session(load, settings, CountingListener())
        made.append(session)
        session.start()
        return session

    yield make
    for session in made:
        session.stop()
