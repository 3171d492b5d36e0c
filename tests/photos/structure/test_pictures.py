"""Copies of pictures, and which of them share a camera."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from nerg_mi.photos.structure import Picture, cameras_of, encoded, shrunk, small_name, small_size


def test_the_longer_side_is_bounded():
    assert small_size((1080, 1920), 960) == (540, 960)
    assert small_size((640, 480), 960) == (640, 480) and small_size((5000, 2), 960) == (960, 1)
    assert small_name(7) == "000007.png"


def test_small_copies_are_averages():
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:, ::2] = 200
    small = np.asarray(Image.open(io.BytesIO(shrunk(Image.fromarray(pixels), (15, 10)))))
    assert small.shape == (10, 15, 3) and abs(small.astype(int) - 100).max() <= 12
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(shrunk(Image.fromarray(pixels), (60, 40))))), pixels)


@pytest.mark.parametrize("suffix, kind", [(".png", "PNG"), (".JPG", "JPEG"), (".jpeg", "JPEG")])
def test_files_are_of_their_names_kind(suffix, kind):
    image = Image.fromarray(np.full((8, 9), 77, np.uint8))
    opened = Image.open(io.BytesIO(encoded(image, suffix)))
    assert opened.format == kind and opened.mode == "RGB" and opened.size == (9, 8)


def test_pictures_of_one_size_share_a_camera():
    upright, across = ((3, 4), (3, 4)), ((4, 3), (4, 3))
    sizes = [upright, across, upright, upright]
    pictures = [Picture(str(k), *size) for k, size in enumerate(sizes)]
    assert cameras_of(pictures) == [0, 1, 0, 0] and cameras_of(pictures, share=False) == [0, 1, 2, 3]
    made = [Picture(str(k), *upright, made_by=("maker", focal)) for k, focal in enumerate(["4.2", "4.2", "9"])]
    assert cameras_of(made) == [0, 0, 1]
