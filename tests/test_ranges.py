"""Ranges of all numeric options, properties of plugins, and error messages."""

from __future__ import annotations

import importlib
import math
import pkgutil
import re
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest
import typer
from typer.core import TyperOption

import nerg_mi as nerg
import nerg_mi.aoi
import nerg_mi.cli
import nerg_mi.tracking.readers
import nerg_mi.train
from nerg_mi import errors, properties
from nerg_mi.cli.building import build_command
from nerg_mi.cli.declarations import Command
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.evaluation.metrics import FieldRenderer
from nerg_mi.figures import settings as figure_settings
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths import vmf
from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.ranges import (
    KAPPAS,
    MAX_COORDINATE,
    RANGE,
    Range,
    ValidatedDataclass,
    check_number,
    parse_kappa,
    range_field,
)
from nerg_mi.surfaces import settings as bake_settings
from nerg_mi.tracking.readers.registry import collect_shared_options
from nerg_mi.train import gaze_settings, radiance_settings
from nerg_mi.train.gaze_settings import ProbeSettings
from tools.command_pages import iter_commands


def _modules():
    for package in (nerg_mi.aoi, nerg_mi.train, nerg_mi.cli, nerg_mi.tracking.readers):
        yield package
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            yield importlib.import_module(module.name)
    yield from (gaze_settings, radiance_settings, bake_settings, figure_settings)


KINDS = list(
    dict.fromkeys(
        kind
        for module in _modules()
        for kind in vars(module).values()
        if isinstance(kind, type)
        and is_dataclass(kind)
        and (issubclass(kind, ValidatedDataclass) or any(RANGE in f.metadata for f in fields(kind)))
    )
)
LEFT_OUT = {"output", "salt"}
"""Fields that are not command-line options, or have another name there."""
# Options that other options require.
PREREQUISITES: dict[str, dict[str, Any]] = {"GazeSettings": {"steps": 1}, "RadianceSettings": {"steps": 1}}
STRANGE = (
    *(math.nan, math.inf, -math.inf, 1e308, -1e308, 10**400, -(10**400), 10**5000, 2**31, 2**32, 1e38, -0.0, 5e-324),
    *(float(np.finfo(np.float32).max), True, "1", None),
)


def _numbers(kind):
    return [f for f in fields(kind) if re.search(r"\b(int|float)\b", str(f.type))]


def _fault(kind, field, value) -> str | None:
    """Return the error message for ``value`` of ``field``, ignoring errors about combinations of options."""
    values = {**PREREQUISITES.get(kind.__name__, {}), field.name: value}
    if "tuple" in str(field.type):
        values[field.name] = (value,) * (3 if "..." in str(field.type) else str(field.type).count(",") + 1)
    if field.name == "minutes" and "Settings" in kind.__name__:
        values.pop("steps")
    try:
        kind(**values)
    except NergError as error:
        return str(error) if "must be a" in str(error) or "must lie in" in str(error) else None
    return None


def test_all_option_classes_are_collected():
    names = {kind.__name__ for kind in KINDS}
    assert {"BakeSampling", "TableOptions", "TickOption", "ProbeSettings", "GazeSettings"} <= names


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: f"{k.__module__}.{k.__name__}")
def test_numbers_are_refused_outside_their_range(kind):
    assert not _numbers(kind) or issubclass(kind, ValidatedDataclass)
    for field in _numbers(kind):
        within = field.metadata[RANGE]
        assert isinstance(within, Range), f"{field.name} has no range"
        is_integer = re.search(r"\bint\b", str(field.type))
        for end, beyond in ((within.low, -1), (within.high, 1)):
            ends = (int(end), int(end) + beyond) if is_integer else (end, math.nextafter(end, beyond * math.inf))
            assert _fault(kind, field, ends[0]) is None
            assert "must lie in" in (_fault(kind, field, ends[1]) or "")
        for value in STRANGE:
            number = type(value) is int or (type(value) is float and not is_integer)
            none = value is None and "None" in str(field.type) and "tuple" not in str(field.type)
            said = _fault(kind, field, value)
            # A concentration may be text, because it may be an angle.
            text = within is KAPPAS and value == "1"
            assert (said is None) == (none or text or (number and within.low <= value <= within.high)), field.name
            name = field.name
            assert said is None or (name in said and len(said) < 200)


@pytest.mark.parametrize(
    "kind", [k for k in KINDS if all("more" in f.metadata for f in fields(k))], ids=lambda k: k.__name__
)
def test_command_line_refuses_the_same_values(kind):
    made: list[Any] = []
    left_out = tuple({f.name for f in fields(kind)} & LEFT_OUT)
    take = lambda options, reporter: made.append(options)
    run = build_command(Command("take", take, "", "", kind, left_out, {}))
    for field in _numbers(kind):
        flag = (field.metadata["names"] or ["--" + field.name.replace("_", "-")])[-1]
        for value in ("nan", "1e400", "1" + 400 * "0"):
            text = ",".join([value] * 3) if field.metadata["parse"] else value
            with pytest.raises((NergError, typer.BadParameter)):
                run.main([f"{flag}={text}"], standalone_mode=False)
    assert not made


def test_help_shows_ranges():
    """Includes options that a command declares itself; options of readers are checked by the readers."""
    of_readers = {option.name for option in collect_shared_options()}
    options = [p for _, command, _ in iter_commands() for p in command.params if isinstance(p, TyperOption)]
    numbers = [p for p in options if p.type_descriptor.annotation in (int, float) and p.name not in of_readers]
    limits = {(p.name, (i := p.type_descriptor.parameter_info).min, i.max) for p in numbers}
    assert len(limits) > 50 and [limit for limit in limits if None in limit] == []


def test_a_concentration_may_be_an_angle():
    assert parse_kappa("200", "--kappa") == 200
    # The standard deviation of a kernel of concentration 200, measured.
    mu = np.tile([0.0, 0.0, 1.0], (20_000, 1))
    spread = np.degrees(vmf.sample(mu, 200.0, np.random.default_rng(0))[:, :2].std())
    assert parse_kappa(f"{spread:.3f}deg", "--kappa") == pytest.approx(200, rel=0.03)
    assert ProbeSettings(kappa="4deg").kappa == pytest.approx(205.2, abs=0.1)
    for wrong in ("4 degrees", "0deg", "", "deg"):
        with pytest.raises(NergError, match="kappa.*4deg"):
            ProbeSettings(kappa=wrong)
    with pytest.raises(NergError, match="kappa"):
        ProbeSettings(kappa="-1")


def test_each_of_several_numbers_is_checked():
    from dataclasses import dataclass

    @dataclass(frozen=True)
    class Some(ValidatedDataclass):
        sizes: tuple[int, ...] = range_field((1, 2), Range(1, 9))

    assert Some(sizes=(1, 9)).sizes == (1, 9)
    for wrong in ((1, 10), (1, 2.5), 3, "12"):
        with pytest.raises(NergError, match="^sizes must"):
            Some(sizes=wrong)


def test_numpy_numbers_are_accepted():
    check_number(np.float32(2), Range(0, MAX_COORDINATE), "x")
    check_number(np.int64(2), Range(0, MAX_COORDINATE), "x", is_integer=True)
    for is_integer in (False, True):
        with pytest.raises(NergError, match="x must be a .*timedelta64"):
            check_number(np.timedelta64(2, "ms"), Range(0, MAX_COORDINATE), "x", is_integer=is_integer)


# ---- Properties of plugins ----


ANY = Range(-1e9, 1e9)


@pytest.mark.parametrize(
    "read, value, expected",
    [
        (lambda p: properties.read_number(p, "x", 1.5, ANY), {}, 1.5),
        (lambda p: properties.read_number(p, "x", 1.5, Range(0, 9)), {"x": 2}, 2.0),
        (lambda p: properties.read_integer(p, "x", 4, Range(1, 9)), {"x": 9.0}, 9),
        (lambda p: properties.read_boolean(p, "x", True), {"x": False}, False),
        (lambda p: properties.read_choice(p, "x", "a", ("a", "b")), {"x": "b"}, "b"),
        (lambda p: properties.read_string(p, "x"), {"x": "name"}, "name"),
        (lambda p: properties.read_string(p, "x", "other"), {}, "other"),
        (lambda p: properties.read_color(p, "x", 0.25), {}, [0.25, 0.25, 0.25]),
        (lambda p: properties.read_color(p, "x", 0.0), {"x": [0.1, 2.0, 0.0]}, [0.1, 2.0, 0.0]),
    ],
)
def test_valid_property_values(read, value, expected):
    assert read(value) == expected and type(read(value)) is type(expected)


def test_color_of_a_texture(rgb):
    texture = rgb.load_dict({"type": "rgb", "value": [0.1, 0.2, 0.4]})
    assert properties.read_color({"x": texture}, "x", 0.0) == pytest.approx([0.1, 0.2, 0.4])


@pytest.mark.parametrize(
    "read, value, words",
    [
        (lambda p: properties.read_number(p, "x", 1, Range(0, 2)), 3, "0 .. 2, got 3"),
        (lambda p: properties.read_number(p, "x", 1, ANY), math.nan, "nan"),
        (lambda p: properties.read_number(p, "x", 1, ANY), True, "must be a number"),
        (lambda p: properties.read_number(p, "x", 1, ANY), "1", "must be a number, got '1'"),
        (lambda p: properties.read_integer(p, "x", 1, Range(0, 9)), 2.5, "whole number"),
        (lambda p: properties.read_boolean(p, "x", True), 1, "true or false"),
        (lambda p: properties.read_choice(p, "x", "a", ("a", "b")), "c", "one of a, b, got 'c'"),
        (lambda p: properties.read_string(p, "x"), None, "a string, got nothing"),
        (lambda p: properties.read_color(p, "x", 0), [1, 2], "must be one"),
        (lambda p: properties.read_color(p, "x", 0), [1, -2, 0], "negative"),
        (lambda p: properties.read_color(p, "x", 0), "red", "an rgb colour, got 'red'"),
    ],
)
def test_invalid_property_is_reported(read, value, words):
    with pytest.raises(NergError) as said:
        read({"x": value})
    assert '"x"' in str(said.value) and words in str(said.value)


def test_field_from_file_or_memory(rgb):
    import drjit.llvm.ad as ns

    class Field:
        def __init__(self, array):
            self.array = array

        def parameters(self):
            return {"table": self.array}

    load = lambda path, ns: (path, {"about": ns})
    field, metadata, filename = properties.load_network({"filename": "here.safetensors"}, None, load, ns)
    assert field == filename and filename.endswith("here.safetensors") and metadata == {"about": ns}
    mine = Field(ns.TensorXf([1.0]))
    assert properties.load_network({}, mine, load, ns) == (mine, {}, "")
    with pytest.raises(NergError, match='"filename"'):
        properties.load_network({}, None, load, ns)
    # Arrays of another backend.
    with pytest.raises(NergError, match='"llvm_ad_rgb"'):
        properties.load_network({}, Field([1.0]), load, ns)


def test_files_are_resolved_in_scene_folders(rgb, tmp_path):
    (tmp_path / "here.ply").touch()
    path = rgb.file_resolver()
    rgb.set_file_resolver(type(path)(path))
    try:
        rgb.file_resolver().append(rgb.filesystem.path(str(tmp_path)))
        assert properties.resolve_scene_file("here.ply") == str(tmp_path / "here.ply")
        assert properties.resolve_scene_file("there.ply") == "there.ply"
    finally:
        rgb.set_file_resolver(path)


def test_transform_is_matrix_or_identity(rgb):
    place = rgb.ScalarTransform4f().translate([1, 2, 3]).scale(2)
    assert np.allclose(properties.read_transform({"to_world": place}, "to_world"), np.array(place.matrix))
    assert np.array_equal(properties.read_transform({}, "to_world"), np.eye(4))
    with pytest.raises(NergError, match='"to_world".*3'):
        properties.read_transform({"to_world": 3}, "to_world")


# ---- Error messages ----


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
def test_user_errors(error, mendable):
    assert errors.is_user_error(error) is mendable


def test_errors_of_chosen_options_are_user_errors():
    with pytest.raises(NergError, match=r"^a box needs a size; give other values by aabb$"):
        with errors.blame_options("aabb"):
            raise ValueError("a box needs a size.")
    with pytest.raises(NergError, match="^as it is$"):
        with errors.blame_options("aabb"):
            raise NergError("as it is")
    with pytest.raises(TypeError):
        with errors.blame_options("aabb"):
            raise TypeError


def test_wrapped_mitsuba_errors_name_the_location():
    with pytest.raises(NergError) as said:
        with errors.translate_mitsuba_errors():
            raise RuntimeError(TRACE.format(error="nerg_mi.errors.NergError"))
    words = str(said.value)
    assert words.startswith('While loading "a.xml" (line 3)') and words.endswith('"step" must lie in 0 .. 1, got 2')
    assert "Traceback" not in words and "\n" not in words and "NergError" not in words


def test_quoted_data_need_not_be_text():
    with pytest.raises(NergError, match="is damaged"), errors.translate_mitsuba_errors():
        b"\xfe".decode()


def test_plugin_bug_is_not_a_user_error():
    with pytest.raises(RuntimeError) as said:
        with errors.translate_mitsuba_errors():
            raise RuntimeError(TRACE.format(error="TypeError"))
    assert not isinstance(said.value, NergError)


def _mesh(folder):
    (folder / "file.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return lambda: Environment.open(folder / "file.obj")


def _volume(folder):
    write_volume(folder / "file.vol", np.ones((2, 2, 2), np.float32), (0, 0, 0), (1, 1, 1))
    return lambda: Environment.open(folder / "file.vol")


def _camera_of_photo(folder):
    renderer = FieldRenderer.__new__(FieldRenderer)
    renderer.spp = 1
    return lambda: renderer(PosedCamera(Intrinsics(4, 3, 5.0, 5.0, 2.0, 1.5), np.eye(4)))


def _camera_of_scene(folder):
    scene = nerg.make_scene(shapes={"type": "cube"})
    return lambda: scene.resolve_sensor(nerg.Camera((0, -3, 0), (0, 0, 0)))


@pytest.mark.parametrize(
    "prepare, names_file",
    [
        (_mesh, True),
        (_volume, True),
        (lambda folder: lambda: FieldRenderer(folder / "file.safetensors"), True),
        (_camera_of_photo, False),
        (_camera_of_scene, False),
        (lambda folder: lambda: nerg.make_scene(shapes={"type": "cube"}), False),
        (lambda folder: lambda: nerg.make_scene(shapes={"type": "scene", "box": {"type": "cube"}}), False),
    ],
)
def test_refused_files_and_cameras_are_user_errors(rgb, tmp_path, monkeypatch, prepare, names_file):
    def refuse(*_, **__):
        raise RuntimeError("[plugin.cpp:7] it has no sides")

    load = prepare(tmp_path)
    monkeypatch.setattr(rgb, "load_dict", refuse)
    with pytest.raises(NergError, match="it has no sides$") as said:
        load()
    assert (str(tmp_path / "file.") in str(said.value)) is names_file


@pytest.mark.parametrize("content", [None, b"", b"\x08\0\0\0\0\0\0\0{}      "], ids=["missing", "empty", "other"])
def test_unrenderable_checkpoints_are_reported(rgb, tmp_path, content):
    if content is not None:
        (tmp_path / "file.safetensors").write_bytes(content)
    with pytest.raises(NergError, match=r"file\.safetensors"):
        FieldRenderer(tmp_path / "file.safetensors")


@pytest.mark.parametrize(
    "error, words",
    [
        (caught(lambda: open("/nowhere/a.txt")), 'there is no file "/nowhere/a.txt"'),
        (PermissionError(13, "Permission denied", "a.txt"), '"a.txt": permission denied'),
        (OSError(28, "No space left on device"), "no space left on device"),
        (MemoryError(), "not enough memory"),
        (RuntimeError("[film.cpp:12] two\nlines"), "two lines"),
        (KeyError(), "KeyError"),
    ],
)
def test_errors_are_one_line(error, words):
    assert words in errors.format_error(error)


def test_quoted_text_is_sanitized():
    assert errors.sanitize("a\x1b[2Jb\n") == "a?[2Jb?"
    assert errors.sanitize("x" * 400, 10) == "x" * 10 + "..." and errors.sanitize("x" * 10, 10) == "x" * 10


@pytest.mark.parametrize("value", [3, math.nan, b"x", {"a": 1}, [1, 2], True, object()])
def test_texts_of_options_are_texts(value):
    tried = 0
    for kind in KINDS:
        for field in fields(kind):
            is_text = field.type in ("str", "str | None", "tuple[str, ...]") and issubclass(kind, ValidatedDataclass)
            if is_text and not any(f.default is f.default_factory for f in fields(kind) if f.init):
                tried += 1
                with pytest.raises(NergError, match=field.name.partition("_")[0]):
                    kind(**{field.name: value})
    assert tried > 30


@pytest.mark.parametrize(
    "arguments, said",
    [
        ({"persons": "ann"}, "persons must be texts, got 'ann'; pass a list"),
        ({"cohorts": 3}, "cohorts must be texts, got 3"),
        ({"box": 3.5}, "box must be numbers, got 3.5; pass a list"),
    ],
)
def test_sequences_of_functions_are_sequences(arguments, said):
    rays = nerg.Rays.from_arrays([[1, 2, 1.6]] * 2, [[1, 0, 0]] * 2, times=[0, 1], participants=["ann", "bob"])
    with pytest.raises(NergError, match=said):
        nerg.filter_rays(rays, **arguments)


@pytest.mark.parametrize("value", [[1, 2], 3, "eye=1", {1: "a"}, {"eye": None}, {"eye": (1, 2, 3)}], ids=repr)
def test_mappings_of_functions_map_texts(value):
    said = "defaults must map names to values, got .*; pass a dict"
    with pytest.raises(NergError, match=said):
        nerg.study("slab", defaults=value)
    with pytest.raises(NergError, match=said):
        nerg.export_scene([], "a.usdc", defaults=value)
    with pytest.raises(NergError, match="defaults are those of a scene file"):
        nerg.study("slab", defaults={"eye": 4})


def test_texts_of_functions_are_texts():
    rays = nerg.Rays.from_arrays([[1, 2, 1.6]] * 2, [[1, 0, 0]] * 2, times=[0, 1])
    for arguments in ({"up": (0, 0, 1)}, {"up": "z", "shift": (1, 2, 3)}):
        with pytest.raises(NergError, match=f"{list(arguments)[-1]} must be text, got .*; pass a string"):
            nerg.align(rays, **arguments)


def test_unknown_keywords_name_the_function():
    with pytest.raises(TypeError, match=r"^filter_rays\(\) got an unexpected keyword argument 'begin'"):
        nerg.filter_rays("a.npz", begin=1)
