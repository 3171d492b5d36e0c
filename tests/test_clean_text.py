"""Names that contain terminal escapes, reversed order or surrogates, in everything that leaves the package."""

import io
import sys
import warnings
from xml.etree import ElementTree

import matplotlib.figure
import numpy as np
import pytest

from nerg_mi import cli
from nerg_mi.errors import MissingFile, NergError, clean_text
from nerg_mi.figures.style import encode
from nerg_mi.progress import LOG_INTERVAL, TerminalReporter, WarningReporter
from nerg_mi.tracking.quality import QualityReport, summarise
from nerg_mi.tracking.rays import Rays

NAME = "Zo\u00eb\x1b[2J\x1b]0;title\x07\u202egnp\x9b31m"
BAD = "\x1b\x07\u202e\x9b"


def is_clean(text):
    return "Zo\u00eb" in text and not set(text) & set(BAD)


def test_letters_lines_and_joiners_remain():
    for text in ("Jörg, 田中\n\tβ ≤ 1 €", "क्\u200dष", "\u00a0"):
        assert clean_text(text) == text
    assert clean_text("a\x1bb\ud800c\u2066d") == "a?b?c?d"


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_messages_warnings_and_progress(monkeypatch, stream):
    out, error = stream(), stream()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", error)
    with TerminalReporter() as reporter:
        reporter.message(f"read {NAME}")
        reporter.warn(NAME)
        reporter.progress(0.3, NAME)
        assert is_clean(reporter.line())
        reporter._printed -= 2 * LOG_INTERVAL
        reporter.log_when_due()
        reporter.message(f"wrote {NAME}")
    for text in (out.getvalue(), error.getvalue()):
        assert "Zo\u00eb" in text and "[2J\x07" not in text and "\x1b[2J" not in text and "\x1b]0" not in text


def test_python_warnings_and_errors():
    with warnings.catch_warnings(record=True) as caught, WarningReporter() as reporter:
        warnings.simplefilter("always")
        reporter.warn(NAME)
    assert is_clean(str(caught[0].message))
    assert is_clean(str(NergError(NAME))) and is_clean(str(MissingFile(NAME)))


def test_errors_of_commands(capsys):
    with pytest.raises(SystemExit):
        cli.main(["render", f"{NAME}.xml", "-o", "picture.png"])
    assert is_clean(capsys.readouterr().err)


def test_figures():
    figure = matplotlib.figure.Figure()
    figure.subplots().set_title(NAME)
    image = encode(figure, ".svg")
    ElementTree.fromstring(image)
    assert "Zo\u00eb" in image.decode() and not set(image.decode()) & set(BAD)


def test_tables_contain_no_styles(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    rays = Rays(np.arange(3.0), np.zeros(3, int), (NAME,), np.zeros((3, 3)), np.tile([1.0, 0, 0], (3, 1)), np.ones(3))
    text = str(QualityReport(rays, NAME, summarise(rays)))
    assert "\x1b" not in text and is_clean(text)
