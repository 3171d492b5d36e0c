"""`nerg view`: what it says of a wrong line, and that options come through."""

from __future__ import annotations

from dataclasses import replace

import pytest

import nerg_mi.cli


def nerg(*arguments):
    with pytest.raises(SystemExit) as end:
        nerg_mi.cli.main(list(map(str, arguments)))
    return end.value.code or 0


def test01_options_come_through(monkeypatch, tmp_path):
    from nerg_mi.viewer import serve
    from nerg_mi.workflows.base import COMMANDS

    given = []
    view = lambda files, options, reporter: given.append((files, options))
    monkeypatch.setitem(COMMANDS, "view", replace(COMMANDS["view"], run=view))
    assert COMMANDS["view"].options is serve.ViewOptions
    line = ["view", "a.xml", "b.npz", "--port", 0, "--observer=1,2,3", "--host", "::1", "--name", "lab", "--width", 320]
    assert nerg(*line) == 0
    ((files, options),) = given
    assert [f.name for f in files] == ["a.xml", "b.npz"] and options.observer == (1, 2, 3)
    assert (options.host, options.port, options.names, options.width) == ("::1", 0, ("lab",), 320)


def test02_without_the_extra_it_is_a_sentence(monkeypatch, capsys):
    import sys

    monkeypatch.setitem(sys.modules, "viser", None)
    assert nerg("view", "a.xml") == 1
    assert 'pip install "nerg-mi[viewer]"' in " ".join(capsys.readouterr().err.split())
