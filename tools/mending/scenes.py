"""Mendings of scenes, rendering and evaluation."""

from __future__ import annotations

from .reversal import held, undo

MENDINGS = (
    held(
        "Threads change between computations, never within one",
        undo(
            "the number changes while kernels are queued",
            ["tests/test_threads.py::test_what_is_queued_is_done_first"],
            ("nerg_mi/threads.py", "    dr.sync_thread()\n", ""),
        ),
    ),
)
