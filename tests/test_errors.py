"""Errors in one sentence, and which of them a user can mend."""

from __future__ import annotations

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi import errors
from nerg_mi.errors import NergError
from nerg_mi.evaluation.ablation import frame_timer
from nerg_mi.evaluation.metrics import Renderer
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.photos.cameras import Camera, Intrinsics
from nerg_mi.train.geometry import place_of_scene, place_of_volume

TRACE = """While loading "a.xml" (line 3): could not instantiate plugin of type "nerg":
Traceback (most recent call last):
  File "nerg.py", line 7, in __init__
    raise {error}
{error}: "step" must lie in 0 .. 1, got 2
"""


def caught(code) -> BaseException:
    try:
        code()
    except BaseException as error:
        return error
    raise AssertionError("nothing was raised")


@pytest.mark.parametrize(
    "error, mendable",
    [
        (NergError("a"), True),
        (errors.MissingFile("a"), True),
        (caught(lambda: open("/nowhere/at/all")), True),
        (caught(lambda: __import__("a_module_that_is_not_there")), True),
        (caught(lambda: __import__("nerg_mi.not_there")), False),
        (MemoryError(), True),
        (OSError("a function's own"), False),
        (ValueError("wrong"), False),
        (TypeError("wrong"), False),
        (KeyboardInterrupt(), False),
    ],
)
def test_what_can_be_mended(error, mendable):
    assert errors.expected(error) is mendable


def test_values_that_were_chosen_are_the_users_to_mend():
    with pytest.raises(NergError, match=r"^a box needs a size; give other values by --aabb$"):
        with errors.chosen("--aabb"):
            raise ValueError("a box needs a size.")
    with pytest.raises(NergError, match="^as it is$"):
        with errors.chosen("--aabb"):
            raise NergError("as it is")
    with pytest.raises(TypeError):
        with errors.chosen("--aabb"):
            raise TypeError


def test_what_mitsuba_wraps_is_said_with_its_place():
    with pytest.raises(NergError) as said:
        with errors.mitsuba_says():
            raise RuntimeError(TRACE.format(error="nerg_mi.errors.NergError"))
    words = str(said.value)
    assert words.startswith('While loading "a.xml" (line 3)') and words.endswith('"step" must lie in 0 .. 1, got 2')
    assert "Traceback" not in words and "\n" not in words and "NergError" not in words


def test_what_mitsuba_quotes_may_be_no_text():
    with pytest.raises(NergError, match="is damaged"), errors.mitsuba_says():
        b"\xfe".decode()


def test_a_mistake_in_a_plugin_is_none_of_the_scene():
    with pytest.raises(RuntimeError) as said:
        with errors.mitsuba_says():
            raise RuntimeError(TRACE.format(error="TypeError"))
    assert not isinstance(said.value, NergError)


def _mesh(folder):
    (folder / "file.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return lambda: place_of_scene(folder / "file.obj")


def _volume(folder):
    write_volume(folder / "file.vol", np.ones((2, 2, 2), np.float32), (0, 0, 0), (1, 1, 1))
    return lambda: place_of_volume(folder / "file.vol")


def _timer(folder):
    render = frame_timer(_volume(folder)(), np.zeros((1, 3)), folder)
    return lambda: render(folder / "file.safetensors")


def _camera_of_photo(folder):
    renderer = Renderer.__new__(Renderer)
    renderer.spp = 1
    return lambda: renderer(Camera(Intrinsics(4, 3, 5.0, 5.0, 2.0, 1.5), np.eye(4)))


def _camera_of_scene(folder):
    scene = nerg.make_scene(shapes={"type": "cube"})
    return lambda: scene.sensor(nerg.Camera((0, -3, 0), (0, 0, 0)))


@pytest.mark.parametrize(
    "prepare, names_file",
    [
        (_mesh, True),
        (_volume, True),
        (_timer, True),
        (lambda folder: lambda: Renderer(folder / "file.safetensors"), True),
        (_camera_of_photo, False),
        (_camera_of_scene, False),
        (lambda folder: lambda: nerg.make_scene(shapes={"type": "cube"}), False),
        (lambda folder: lambda: nerg.make_scene(shapes={"type": "scene", "box": {"type": "cube"}}), False),
    ],
)
def test_what_mitsuba_refuses_of_a_file_or_camera_is_the_users(rgb, tmp_path, monkeypatch, prepare, names_file):
    def refuse(*_, **__):
        raise RuntimeError("[plugin.cpp:7] it has no sides")

    load = prepare(tmp_path)
    monkeypatch.setattr(rgb, "load_dict", refuse)
    with pytest.raises(NergError, match="it has no sides$") as said:
        load()
    assert (str(tmp_path / "file.") in str(said.value)) is names_file


@pytest.mark.parametrize("load", [_timer, lambda folder: lambda: Renderer(folder / "file.safetensors")])
@pytest.mark.parametrize("content", [None, b"", b"\x08\0\0\0\0\0\0\0{}      "], ids=["missing", "empty", "other"])
def test_checkpoints_that_cannot_be_rendered_are_named(rgb, tmp_path, load, content):
    if content is not None:
        (tmp_path / "file.safetensors").write_bytes(content)
    with pytest.raises(NergError, match=r"file\.safetensors"):
        load(tmp_path)()


@pytest.mark.parametrize(
    "error, words",
    [
        (caught(lambda: open("/nowhere/a.txt")), 'there is no file "/nowhere/a.txt"'),
        (PermissionError(13, "Permission denied", "a.txt"), '"a.txt": permission denied'),
        (OSError(28, "No space left on device"), "no space left on device"),
        (MemoryError(), "there is not enough memory; ask for less, or close other programs"),
        (RuntimeError("[film.cpp:12] two\nlines"), "two lines"),
        (KeyError(), "KeyError"),
    ],
)
def test_one_line(error, words):
    assert errors.sentence(error) == words


def test_text_of_a_file_is_cut_and_made_printable():
    assert errors.plain("a\x1b[2Jb\n") == "a?[2Jb?"
    assert errors.plain("x" * 400, 10) == "x" * 10 + "..." and errors.plain("x" * 10, 10) == "x" * 10
