"""The API takes the variant that is set, and sets one only where there is none."""

import subprocess
import sys

import pytest

from nerg_mi.api.scene import active_mitsuba, array_module
from nerg_mi.errors import NergError


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test01_one_is_set_where_there_is_none():
    code = "import nerg_mi as nerg, mitsuba as mi; nerg.Scene; print(mi.variant()); "
    code += "from nerg_mi.api.scene import active_mitsuba; print(active_mitsuba().variant())"
    before, after = run(code).split()
    assert before == "None" and after in ("cuda_ad_rgb", "llvm_ad_rgb")


def test02_one_that_is_set_stays(mono):
    assert active_mitsuba() is mono and mono.variant() == "llvm_ad_mono"
    assert array_module().__name__ == "drjit.llvm.ad"
    assert mono.variant() == "llvm_ad_mono"


def test03_scalar_variants_are_refused(rgb):
    rgb.set_variant("scalar_rgb")
    with pytest.raises(NergError, match='"scalar_rgb".*mi.set_variant'):
        active_mitsuba()
