"""Command lines with pairs of options and values that one seldom tries together; each must end with a result or one
sentence.

To the fuzzer a line is a file of JSON (its words). Inputs are those of `tests.cli.outputs`, so small that a command
takes about a second.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args, get_origin

import numpy as np
from typer.core import TyperOption

from tests.cli import outputs
from tests.fuzz.describe import Reader
from tests.fuzz.watch import Case

SKIPPED = {"demo", "study", "ablate", "eval folds", "export torch-ngp"}
"""Commands that take many seconds at any setting, or have no options."""

KEPT_OPTIONS = set("-o --output --mode --variant --store --scheduler --help --threads --hosts --workers".split())
"""Options that are not varied: outputs, variants, and where work is done."""

# What is often allowed comes more than once, so that options meet beyond the checks of each.
_FLOATS = [*4 * "0.1 0.5 1 2 10".split(), *"0 -0.0 -1 1e-30 1e-3 1e6 1e30 1e38 1e308 nan inf 1e400".split()]
# Sizes that a user may ask for in earnest would take minutes; what is beyond them all must be refused.
_INTEGERS = [*4 * "1 2 3 8 16".split(), *"-1 0 5 -2147483648 9223372036854775808 1e3".split()]
_TEXTS = "|a|0,0,0|1,2,3|nan,0,0|1e30,0,0|1e308,0,0|-1,-1,-1|1,2|0.5|x=1|0:1|,|0,1,0,1,0,1|--|:|a:b:c".split("|")
_FILES = ("rays.npz", "room.ply", "ball.xml", "areas.json", "gaze.safetensors", "day.csv", "photos", "no-such", "a.exr")


@functools.lru_cache
def _inputs() -> Path:
    """The inputs of all commands, made once in this process."""
    import mitsuba as mi

    import nerg_mi.cli

    mi.set_variant("llvm_ad_rgb")
    folder = outputs.make_inputs(Path(tempfile.mkdtemp(prefix="nerg-commands-")))
    line = (
        f"train gaze {folder}/rays.npz -o {folder}/gaze.safetensors --geometry hits --radius 0.5 --probes 8 --steps 2"
    )
    with contextlib.suppress(SystemExit):
        nerg_mi.cli.main([*line.split(), *"--directions 64 --zones 0 --min-rays 8 --test-zones 1".split()])
    return folder


def _reader(name: str, case: outputs.Case) -> Reader:
    def make(folder: Path) -> None:
        shutil.copytree(_inputs(), folder, dirs_exist_ok=True)
        (folder / "line.json").write_text(json.dumps([*case.name.split(), *case.line.split("'")[0].split()]))

    def read(folder: Path) -> None:
        run(folder, json.loads((folder / "line.json").read_text()))

    return Reader(name, make, {"line.json": ()}, read, is_command=True)


def run(folder: Path, words: list[str]) -> None:
    """Run the command line ``words`` on the inputs in ``folder``.

    Raises `NergError` with its sentence where it refuses, ``RuntimeError`` where it ends with an internal error.
    """
    import nerg_mi.cli
    from nerg_mi.errors import NergError

    output, said = tempfile.mkdtemp(prefix="nerg-out-"), io.StringIO()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
            nerg_mi.cli.main([word.replace("{i}", str(folder)).replace("{o}", output) for word in words])
    except SystemExit as end:
        last = " ".join(said.getvalue().split())[-900:]
        if end.code == 70:
            raise RuntimeError(last) from None
        if end.code:
            raise NergError(last) from None
    finally:
        shutil.rmtree(output)


def draw_cases(readers: list[Reader], inputs: Path, count: int, start: int = 0) -> Iterator[Case]:
    """``count`` lines, as many for each command, each with one to three options more."""
    for k, reader in enumerate(readers):
        words = json.loads((inputs / reader.name / "line.json").read_text())
        rng = np.random.default_rng([start, k])
        options = _options(words)
        for _ in range(count * (k + 1) // len(readers) - count * k // len(readers)):
            more: list[str] = []
            for option in rng.choice(len(options), min(len(options), int(rng.integers(1, 4))), replace=False):
                more += _drawn(options[option], rng)
            yield Case(reader.name, "line.json", json.dumps([*words, *more]).encode())


def _options(words: list[str]) -> list[TyperOption]:
    """The options of the command that the line ``words`` calls."""
    import typer

    from nerg_mi.cli import build_app

    command = typer.main.get_command(build_app(words[0]))
    for word in words:
        command = getattr(command, "commands", {}).get(word, command)
    return [p for p in command.params if isinstance(p, TyperOption) and KEPT_OPTIONS.isdisjoint(p.opts)]


def _drawn(option: TyperOption, rng: np.random.Generator) -> list[str]:
    """``option`` with a value, as words of a command line."""
    if option.is_flag:
        return [str(rng.choice([*option.opts, *option.secondary_opts]))]
    kind = option.type_descriptor.annotation
    choices = get_args(kind) if get_origin(kind) is Literal else ()
    if choices and rng.random() < 0.8:
        values = choices
    elif kind is Path:
        values = ["{i}/" + name for name in _FILES]
    else:
        values = {int: _INTEGERS, float: _FLOATS}.get(kind, _TEXTS)
    return [option.opts[0], *(str(rng.choice(values)) for _ in range(max(option.nargs, 1)))]


def _all() -> list[Reader]:
    cases = [case for case in outputs.CASES if case.name not in SKIPPED and "'" not in case.line]
    return [_reader(f"{case.name} {k}", case) for k, case in enumerate(cases)]


READERS = _all()
