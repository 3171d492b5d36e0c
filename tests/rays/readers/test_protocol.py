"""What every reader keeps to, of those that are registered."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers import registry
from nerg_mi.rays.readers.base import Frame
from tests.rays.readers.examples import EXAMPLES


@pytest.mark.parametrize("name", registry.reader_names())
def test_what_they_say_of_themselves(name):
    reader = registry.reader_named(name)
    assert reader.name == name and all(
        isinstance(text, str) and text.strip() for text in (reader.files, reader.world, reader.checked_on)
    )
    assert isinstance(reader.frame([], reader.Options()), Frame)


READABLE = [name for name in registry.reader_names() if name != "c3d" or find_spec("c3d")]


@pytest.mark.parametrize("name", READABLE)
@pytest.mark.parametrize("skip_bad_lines", [False, True])
def test_what_all_readers_keep(tmp_path, name, skip_bad_lines):
    """Of the example of each: rays in the frame that is declared, with an account of all rows."""
    example, reader = EXAMPLES[name], registry.reader_named(name)
    given, options = example.make(tmp_path), registry.make_options(name, example.options_in(tmp_path))
    begun = []
    rays = registry.read_rays(name, given, options, skip_bad_lines=skip_bad_lines, on_source=begun.append)
    about = rays.metadata
    assert (
        len(rays) > 0
        and about["preset"] == name
        and about["rows_read"] == len(rays) + sum(d["count"] for d in about["dropped"])
    )
    assert about["source_frame"] == reader.frame([given], options).to_dict()
    assert np.allclose(about["transform"], reader.frame([given], options).to_rays())
    assert [s["file"] for s in about["sources"]] == begun and len(begun) == len(example.files)
    # Heads are where heads are: the frame was not taken for another.
    assert 0.9 < np.median(rays.origin[:, 2]) < 2.0 or name in ("pupil", "table")
    rays.save(tmp_path / "rays.npz")
    assert Rays.load(tmp_path / "rays.npz").metadata == about
    # The same by name and by object, and of several files at once where there is one a recording.
    again = registry.read_rays(reader, [given], options)
    assert np.array_equal(again.origin, rays.origin) and np.array_equal(again.direction, rays.direction)


@pytest.mark.parametrize("name", READABLE)
def test_a_file_that_is_none_of_theirs(tmp_path, name):
    example = EXAMPLES[name]
    given = example.make(tmp_path)
    given.write_text("this is a letter\nand no table\n")
    with pytest.raises(NergError, match=given.name.split(".")[0]):
        registry.read_rays(name, given, registry.make_options(name, example.options_in(tmp_path)))
