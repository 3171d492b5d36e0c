"""Interruptions and the number of threads."""

from __future__ import annotations

import signal

import drjit as dr
import numpy as np
import pytest

from nerg_mi.interruption import Interruption
from nerg_mi.threads import limit_threads, set_thread_count

from .plugins import fields

# ---- Interruptions ----


def test_first_interrupt_is_recorded_and_second_raised():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), Interruption() as stop:
        stop.check()
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        stop.check()
    assert signal.getsignal(signal.SIGINT) is before


def test_foreign_signal_handler_is_kept(monkeypatch):
    """A handler that Python did not install cannot be restored."""
    set_handlers = []
    monkeypatch.setattr(signal, "getsignal", lambda which: None)
    monkeypatch.setattr(signal, "signal", lambda *args: set_handlers.append(args))
    with Interruption() as stop:
        stop.check()
    assert not set_handlers


def test_ignored_interrupt_stays_ignored():
    """As for a background command of a script."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interruption() as stop:
            signal.raise_signal(signal.SIGINT)
            stop.check()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def scene(rgb, tmp_path):
    fields.radiance(tmp_path / "f.safetensors")
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    return rgb.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "nerg", "field": {"type": "nerf", "filename": str(tmp_path / "f.safetensors")}},
            "sensor": {
                "type": "perspective",
                "film": film,
                "to_world": rgb.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
            },
        }
    )


def test_interrupt_works_after_rendering(rgb, scene):
    for _ in range(2):
        rgb.render(scene, spp=1)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with Interruption() as stop:
        rgb.render(scene, spp=1)
        signal.raise_signal(signal.SIGINT)
        assert stop.is_requested


def test_interrupt_during_rendering_is_raised(rgb, scene, monkeypatch):
    integrator = scene.integrator()
    sample = type(integrator).sample

    def interrupted(self, *args):
        signal.raise_signal(signal.SIGINT)
        return sample(self, *args)

    with monkeypatch.context() as change:
        change.setattr(type(integrator), "sample", interrupted)
        # `mi.render` wraps exceptions of an integrator.
        with pytest.raises(RuntimeError) as raised:
            rgb.render(scene, spp=1)
    error = raised.value
    while error.__cause__ is not None:
        error = error.__cause__
    assert isinstance(error, KeyboardInterrupt)
    rgb.render(scene, spp=1)


# ---- Number of threads ----


def test_pending_work_finishes_before_thread_change(monkeypatch):
    order = []
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: order.append("waited"))
    monkeypatch.setattr(dr, "set_thread_count", order.append)
    monkeypatch.setattr(dr, "thread_count", lambda: 2)
    set_thread_count(3)
    set_thread_count(2)
    assert order == ["waited", 3]


def test_arrays_survive_thread_changes(rgb):
    before = dr.thread_count()
    try:
        for count in (2, 1, 3, before) * 5:
            x = dr.arange(rgb.Float, 1 << 20) * 2 + count
            dr.schedule(x)
            dr.eval()
            set_thread_count(count)
            assert dr.thread_count() == count
            np.testing.assert_array_equal(x.numpy()[[0, 5, -1]], np.float32([count, 10 + count, 2**21 - 2 + count]))
    finally:
        set_thread_count(before)


def test_pending_scatters_survive_thread_changes(rgb):
    before = dr.thread_count()
    try:
        for count in (1, 3) * 3:
            index = dr.arange(rgb.UInt32, 1 << 18) % 60
            x = dr.zeros(rgb.Float, 240)
            set_thread_count(1)
            dr.scatter_add(x, dr.llvm.ad.Array4f(1, 2, 3, 4), index)
            set_thread_count(count)
            expected = np.bincount(np.arange(1 << 18) % 60)[:, None] * [1, 2, 3, 4]
            np.testing.assert_array_equal(x.numpy().reshape(60, 4), expected)
    finally:
        set_thread_count(before)


def test_worker_limits_threads_to_available():
    assert (limit_threads(4, 2), limit_threads(2, 4), limit_threads(0, 3), limit_threads(3, 0)) == (
        2,
        2,
        3,
        3,
    ) and limit_threads(0, 0) >= 1
