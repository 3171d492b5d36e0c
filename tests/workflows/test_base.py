"""Tests of `nerg_mi.workflows.base`."""

from nerg_mi.workflows.base import SILENT, versions

# ---- The reporter of jobs that were given none ----


def test_it_says_nothing(capsys):
    SILENT.message("a")
    SILENT.warn("b")
    SILENT.progress(0.5, "c")
    assert capsys.readouterr() == ("", "")


# ---- What a report says about the programs that made it ----


def test_versions_of_what_has_a_part():
    found = versions("llvm_ad_rgb")
    assert set(found) == {"nerg_mi", "mitsuba", "drjit", "numpy", "python", "libLLVM"} and all(found.values())
    assert "libLLVM" not in versions("scalar_rgb")
