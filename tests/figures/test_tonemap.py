"""Linear radiance as bytes."""

import numpy as np

from nerg_mi.figures.overlay import srgb, to_bytes, write_png


def test01_srgb_against_known_values():
    # IEC 61966-2-1: the knee, middle grey, white
    assert np.allclose(srgb([0, 0.0031308, 0.214041, 0.5, 1]), [0, 0.04045, 0.5, 0.735357, 1], atol=1e-5)


def test02_out_of_range_is_clipped():
    assert np.array_equal(to_bytes(srgb([-1.0, 7.0, np.nan, np.inf])), [0, 255, 0, 255])


def test03_png_has_the_pixels_and_the_text(rgb, tmp_path):
    picture = np.random.default_rng(0).random((5, 7, 3))
    write_png(tmp_path / "a.png", picture, {"Comment": "seed 3"})
    assert np.array_equal(np.array(rgb.Bitmap(str(tmp_path / "a.png"))), to_bytes(picture))
    assert b"seed 3" in (tmp_path / "a.png").read_bytes()
