"""Shared fixtures of the plugin tests: small fields in files."""

import pytest

from . import fields


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with `field.safetensors` and `gaze.safetensors`."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("fields")
    fields.radiance(folder / "field.safetensors")
    fields.gaze(folder / "gaze.safetensors")
    return folder
