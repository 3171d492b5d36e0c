"""The reporter of jobs that were given none."""

from nerg_mi.workflows.base import SILENT


def test_it_says_nothing(capsys):
    SILENT.message("a")
    SILENT.warn("b")
    SILENT.progress(0.5, "c")
    assert capsys.readouterr() == ("", "")
