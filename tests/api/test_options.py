"""Options of jobs one by one."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from nerg_mi.api.options import options_of
from nerg_mi.errors import NergError


@dataclass(frozen=True, kw_only=True)
class Options:
    """Of a job."""

    steps: int = 5
    folder: Path | None = None
    seed: int = 0
    mode: str | None = None


def test01_changes_are_on_top_of_what_is_given(rgb):
    assert options_of(Options, "job", None, {}) == Options(mode="llvm_ad_rgb")
    assert options_of(Options, "job", Options(steps=9, seed=2), {"seed": 3}) == Options(
        steps=9, seed=3, mode="llvm_ad_rgb"
    )


def test02_the_variant_in_use_is_kept(mono):
    assert options_of(Options, "job", Options(mode="llvm_ad_rgb"), {}).mode == "llvm_ad_mono"


def test04_files_may_be_named_by_strings(rgb):
    assert options_of(Options, "job", None, {"folder": "here"}).folder == Path("here")


def test03_unknown_options_are_told(rgb):
    with pytest.raises(NergError, match='job has no option "step"; did you mean "steps"?'):
        options_of(Options, "job", None, {"step": 3})
    with pytest.raises(NergError, match="job works in the variant that is set; call mi.set_variant"):
        options_of(Options, "job", None, {"mode": "scalar_rgb"})
    with pytest.raises(NergError, match='job has no option "xyz"; it has steps, folder, seed'):
        options_of(Options, "job", None, {"xyz": 1})
