"""Processes that are killed, and what they end with."""

from __future__ import annotations

import os
import time

import pytest

from tools import child_commands


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_kill_lands_and_an_end_is_seen():
    pid = os.fork()
    if pid == 0:
        time.sleep(60)
        os._exit(0)
    assert child_commands.kill_at(pid, 0.05) == -9
    pid = os.fork()
    if pid == 0:
        os._exit(3)
    assert child_commands.kill_at(pid, 30) == 3


def test_what_does_not_end_is_killed():
    pid = os.fork()
    if pid == 0:
        time.sleep(60)
        os._exit(0)
    with pytest.raises(TimeoutError, match="no end after 0 s"):
        child_commands.wait(pid, 0.05)
