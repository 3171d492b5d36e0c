"""Figures as files: read back by other libraries, whole in themselves, and equal for equal input."""

from __future__ import annotations

import base64
import io
import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Heat, gaze_figure, overlay
from nerg_mi.figures.style import Provenance, encode, rasterize, save

RNG = np.random.default_rng(3)
COLOR, GAZE = RNG.random((160, 200, 3)), RNG.random((160, 200))
MASK = np.ones((160, 200), bool)
ABOUT = Provenance("nerg render", {"scène.xml": "ab" * 32}, 5, {"spp": 2}, {"nerg_mi": "1"})
SVG = "{http://www.w3.org/2000/svg}"
LINK = "{http://www.w3.org/1999/xlink}href"


def figure():
    return gaze_figure(COLOR, GAZE, MASK, Heat(0.5))


def test_png_by_another_library(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    save(figure(), tmp_path / "a.png", ABOUT)
    with image.open(tmp_path / "a.png") as found:
        assert json.loads(found.text["Comment"]) == json.loads(ABOUT.json()) and found.text["Software"] == "nerg_mi 1"
        np.testing.assert_array_equal(np.asarray(found.convert("RGB")), rasterize(figure()))


def test_svg_is_whole_in_itself(tmp_path):
    save(figure(), tmp_path / "a.svg", ABOUT)
    root = ElementTree.parse(tmp_path / "a.svg").getroot()
    links = [v for e in root.iter() for k, v in e.attrib.items() if k in ("href", LINK, "src")]
    assert links and all(v.startswith(("data:image/png;base64,", "#")) for v in links)
    assert "url(http" not in (tmp_path / "a.svg").read_text()
    # Text stays text.
    texts = ["".join(e.itertext()) for e in root.iter(f"{SVG}text")]
    assert "Gaze" in texts and "gaze density [1/sr]" in texts and "0.5" in texts
    (said,) = [e.text for e in root.iter("{http://purl.org/dc/elements/1.1/}description")]
    assert json.loads(said) == json.loads(ABOUT.json())
    assert not list(root.iter("{http://purl.org/dc/elements/1.1/}date"))


def test_the_picture_in_an_svg_has_its_pixels(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")
    text = encode(figure(), ".svg").decode()
    parts = [base64.b64decode(p) for p in re.findall(r'base64,\s*([^"]+)"', text)]
    pictures = [np.asarray(image.open(io.BytesIO(p)).convert("RGB")) for p in parts]
    (found,) = [p for p in pictures if p.shape[:2] == (160, 200)]
    wanted = overlay(COLOR, GAZE, Heat(0.5), MASK)
    # Perhaps upside down, as matplotlib's transforms have it.
    assert min(np.abs(v / 255 - wanted).max() for v in (found, found[::-1])) < 0.01


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_equal_figures_are_equal_files(suffix):
    assert encode(figure(), suffix, ABOUT.text()) == encode(figure(), suffix, ABOUT.text())


def test_other_formats_are_refused(tmp_path):
    with pytest.raises(NergError, match=r"end in .png or .svg"):
        save(figure(), tmp_path / "a.jpg")
    assert not list(tmp_path.iterdir())


def test_notebooks_show_a_figure_by_itself():
    assert figure()._repr_png_().startswith(b"\x89PNG")
