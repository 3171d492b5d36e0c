"""Threads are changed between computations, never within one."""

import drjit as dr
import numpy as np

from nerg_mi.threads import set_thread_count, share


def test_what_is_queued_is_done_first(monkeypatch):
    order = []
    monkeypatch.setattr(dr, "sync_thread", lambda: order.append("waited"))
    monkeypatch.setattr(dr, "set_thread_count", order.append)
    monkeypatch.setattr(dr, "thread_count", lambda: 2)
    set_thread_count(3)
    set_thread_count(2)
    assert order == ["waited", 3]


def test_arrays_keep_their_values_however_often_it_changes(rgb):
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


def test_a_worker_gives_a_job_what_it_asks_for_and_has():
    assert (share(4, 2), share(2, 4), share(0, 3), share(3, 0)) == (2, 2, 3, 3) and share(0, 0) >= 1
