"""`nerg worker`: what it hands on, and what it says."""

import os

import pytest

from nerg_mi.cli import main
from nerg_mi.tasks import engines
from nerg_mi.threads import VARIABLE


@pytest.fixture
def served(monkeypatch):
    given = []
    monkeypatch.setattr(engines, "serve_cluster", lambda *a: given.append((*a[:2], a[3], os.environ.get(VARIABLE))))
    monkeypatch.delenv(VARIABLE, raising=False)
    # What the command sets is taken back after the test.
    monkeypatch.setenv(VARIABLE, "")
    return given


def nerg(*words) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return end.value.code or 0


def test_what_is_handed_on(served, capsys):
    assert nerg("worker", "tcp://127.0.0.1:8786", "--threads", "3", "--wait", "5", "--name", "a") == 0
    assert served == [("tcp://127.0.0.1:8786", 5.0, "a", "3")] and capsys.readouterr().err == ""


def test_an_open_address_is_warned_of(served, capsys):
    assert nerg("worker", "tcp://192.0.2.1:8786") == 0
    assert "warning: nothing protects tcp://192.0.2.1:8786" in capsys.readouterr().err


def test_an_address_that_is_none(capsys):
    assert nerg("worker", "somewhere") == 1
    assert "is no address of a scheduler" in capsys.readouterr().err
