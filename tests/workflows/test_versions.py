"""What a report says about the programs that made it."""

from nerg_mi.workflows.base import versions


def test_versions_of_what_has_a_part():
    found = versions("llvm_ad_rgb")
    assert set(found) == {"nerg_mi", "mitsuba", "drjit", "numpy", "python", "libLLVM"} and all(found.values())
    assert "libLLVM" not in versions("scalar_rgb")
