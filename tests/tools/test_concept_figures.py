"""The pictures of docs/concepts.md can be made again, and stand on the page."""

from __future__ import annotations

import struct

import pytest

from tests.conftest import ROOT


@pytest.mark.nightly
@pytest.mark.slow
def test_they_are_drawn_and_stand_on_the_page(rgb, tmp_path):
    from tools.concept_figures import draw

    page = (ROOT / "docs" / "concepts.md").read_text(encoding="utf-8")
    for path in draw(tmp_path, width=24, spp=1):
        assert f"](images/{path.name})" in page, path.name
        stored = ROOT / "docs" / "images" / path.name
        # The size of a figure does not depend on the pixels of its panels.
        assert size(path) == size(stored), path.name
        assert stored.stat().st_size < 300_000


def size(path):
    """Width and height, as the header of a PNG file has them."""
    return struct.unpack(">2I", path.read_bytes()[16:24])
