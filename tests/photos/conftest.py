"""Data sets for several test modules."""

import json

import pytest

from tests.photos.written_sets import OPENCV, instant_ngp


@pytest.fixture
def ring(tmp_path, rgb):
    """Folder of a set of nine photos in a ring, as instant-ngp writes it."""
    instant_ngp(tmp_path, rgb, OPENCV)
    return tmp_path


@pytest.fixture
def write(tmp_path):
    """`write(content, images)`: write a transforms file next to empty image files and return its path."""

    def make(content, images=("b.png", "a.png"), name="transforms.json"):
        for image in images:
            (tmp_path / image).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / image).write_bytes(b"")
        (tmp_path / name).write_text(json.dumps(content))
        return tmp_path / name

    return make
