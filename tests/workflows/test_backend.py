"""Where a job computes."""

import drjit as dr
import pytest

from nerg_mi.errors import NergError
from nerg_mi.workflows.base import select_backend


def test_variant_and_threads(rgb):
    before = dr.thread_count()
    rgb.set_variant("llvm_ad_mono")
    try:
        assert select_backend("llvm_ad_rgb", 1).__name__ == "drjit.llvm.ad"
        assert rgb.variant() == "llvm_ad_rgb" and dr.thread_count() == 1
    finally:
        dr.set_thread_count(before)
    select_backend("llvm_ad_rgb")
    assert dr.thread_count() == before


@pytest.mark.parametrize("mode, said", [("llvm_rgb", "there is no variant"), ("scalar_rgb", "need a JIT variant")])
def test_what_no_field_can_be_computed_on(mode, said):
    with pytest.raises(NergError, match=said):
        select_backend(mode)
