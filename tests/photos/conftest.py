"""Data sets that several files of tests read."""

import json

import pytest

from tests.photos.written_sets import OPENCV, instant_ngp


@pytest.fixture
def ring(tmp_path, rgb):
    """The folder of a set of nine photos in a ring, as instant-ngp writes it."""
    instant_ngp(tmp_path, rgb, OPENCV)
    return tmp_path


@pytest.fixture
def write(tmp_path):
    """`write(content, images)`: a transforms file beside empty files of the names given; its path."""

    def make(content, images=("b.png", "a.png"), name="transforms.json"):
        for image in images:
            (tmp_path / image).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / image).write_bytes(b"")
        (tmp_path / name).write_text(json.dumps(content))
        return tmp_path / name

    return make
