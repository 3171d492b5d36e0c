"""Command lines with pairs of options and unusual values; each must end with a result or one sentence.

Most values pass the check of their own option, because options interact only after these checks. For the fuzzer, a
command line is a JSON file of its words. Inputs are those of `tests.cli.outputs`, which are small enough that a command
takes about a second.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import re
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from typer.core import TyperOption

from nerg_mi.ranges import COORDINATES, TIMES
from nerg_mi.train.gaze_recipes import load_recipes
from tests.cli import outputs
from tests.fuzz.watch import Case, Reader

SKIPPED = {"demo", "study", "eval folds", "export torch-ngp", "refine"}
SKIPPED |= set() if outputs.HAS_TORCH else set(outputs.OF_TORCH)
"""Commands that take many seconds at any setting, or have no options."""

FIXED = set("-o --output --mode --variant --store --scheduler --help --threads".split())
"""Options that are not varied: outputs, variants, and where work is done."""

_WORK = "steps minutes spp resamples resolution ensemble width height texture-size max-angle max-edge cone scale fps"
_WORK += " views viewpoints num-rays num-views num-frames repeats folds rays gaze analyses"
WORK = {"--" + name for name in _WORK.split()}
"""Options whose value is an amount of work: any in their range may be meant in earnest, and take hours. A line with one
is interrupted after `PATIENCE` seconds of the processor, and must end then; others must be done within `LIMIT`."""

PATIENCE, LIMIT = 4.0, 120.0

_FILES = dict(field="field.safetensors", gaze="gaze.safetensors", scene="ball.xml", surface="room.ply", rays="rays.npz")
_FILES |= dict(areas="areas.json", pairs="pairs.csv", frames="frames.csv", photos="photos", views="photos")
_FILES |= dict(align="align.json", align_views="align.json", test="rays.npz")
"""Parameter of a command -> an input of the kind that it reads."""
_WRITTEN = {("import", "gaze"), ("export volume", "color"), ("eval radiance", "json_file")}

_REFUSED = {
    int: "-1 -2147483648 9223372036854775808 1e3 0.5 nan".split(),
    float: "-1 -0.0 1e-320 1e38 1e308 nan inf 1e400 x".split(),
    str: "|a|nan,0,0|1e30,0,0|1e308,0,0|1,2|0:1|,|--|:|a:b:c|no such word".split("|"),
    Path: ["{i}/" + name for name in ("rays.npz", "day.csv", "room.ply", "a.exr", "photos", "no-such", "")],
}
"""Type of an option -> values of which most are refused."""

_TEXTS = dict(
    defaults=("level=0.5", "spp=1"),
    observers=("0,0,1.6", "1,1,1.6"),
    person=("a", "b"),
    persons=("a", "b"),
    photo=("0", "3.png"),
    recipe=load_recipes(),
    salience=("spectral-residual",),
    source=("field", "rays"),
    windows=("w=0,1",),
    without_persons=("a", "b"),
)
"""Parameter of a command -> values that its help does not enumerate."""
_POINTS = ("0.5,1.2,1.6", f"{COORDINATES.low},0,{COORDINATES.high}", "1e-7,0,0", "-2,-2,-2", "0,0,1")
_SPANS = ("0,2", "0,0", f"{TIMES.low},{TIMES.high}", "1.5,1.5000001")
_BOXES = {"x0,x1": "-2,2,-2,2,-1,3", "x0,y0": "-2,-2,-1,2,2,3"}
# Forms in which help texts list choices: "data, grid or blue", "all (one clock), or person", "both: ...; pos: ...".
_WORD = r"[A-Za-z][\w-]*(?: \([^)]*\))?"
_ROW = re.compile(rf"\b{_WORD}(?:, {_WORD})*,? or {_WORD}|\b{_WORD}(?:, {_WORD}){{2,}}")
_ENTRY = re.compile(r"(?<!\S)([a-z]+): ")
_NO_NUMBER = re.compile(r"(?<![\w.\-/])[-+]?(?:nan|inf|infinity)(?![\w\-])", re.IGNORECASE)


@functools.lru_cache
def _inputs() -> Path:
    """Create the inputs of all commands, once per process."""
    import mitsuba as mi

    import nerg_mi.cli

    mi.set_variant("llvm_ad_rgb")
    folder = outputs.make_inputs(Path(tempfile.mkdtemp(prefix="nerg-commands-")))
    for line in outputs.list_trainings(folder):
        with contextlib.suppress(SystemExit):
            nerg_mi.cli.main(line)
    (folder / "align.json").write_text(json.dumps(np.eye(4).tolist()))
    return folder


def _reader(name: str, case: outputs.Case) -> Reader:
    words = [*case.name.split(), *case.line.split("'")[0].split()]

    def make(folder: Path) -> None:
        shutil.copytree(_inputs(), folder, dirs_exist_ok=True)
        (folder / "line.json").write_text(json.dumps(words))

    def read(folder: Path) -> None:
        line = json.loads((folder / "line.json").read_text())
        run(folder, line, is_work=not WORK.isdisjoint(line[len(words) :]))

    return Reader(name, make, {"line.json": ()}, read, is_command=True)


def run(folder: Path, words: list[str], is_work: bool = False) -> None:
    """Run the command line ``words`` on the inputs in ``folder``. ``is_work``: whether a long run was requested.

    Raises `NergError` with the message if the command refuses, and ``RuntimeError`` if it ends with an internal error,
    takes too long, or has no result.
    """
    import nerg_mi.cli
    from nerg_mi.cli.ending import INTERNAL_ERROR, INTERRUPTED
    from nerg_mi.errors import NergError

    output, printed, said = Path(tempfile.mkdtemp(prefix="nerg-out-")), io.StringIO(), io.StringIO()
    # The signal is ignored in background jobs of a shell.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    ended: list[bool] = []
    signal.signal(signal.SIGPROF, lambda *_: None if ended else signal.raise_signal(signal.SIGINT))
    signal.setitimer(signal.ITIMER_PROF, PATIENCE if is_work else LIMIT)
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
            nerg_mi.cli.main([word.replace("{i}", str(folder)).replace("{o}", str(output)) for word in words])
    except SystemExit as end:
        # The command has just finished, and needs no Ctrl-C.
        ended.append(True)
        last = " ".join(said.getvalue().split())[-900:]
        if end.code == INTERNAL_ERROR or "Traceback" in said.getvalue():
            raise RuntimeError(last) from None
        if end.code == INTERRUPTED and not is_work:
            raise RuntimeError(f"not done in {LIMIT:g} s of the processor: {last}") from None
        if end.code and end.code != INTERRUPTED:
            raise NergError(last) from None
        if not end.code:
            check_outputs(output, printed.getvalue())
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        shutil.rmtree(output)


def check_outputs(folder: Path, printed: str) -> None:
    """Raise ``RuntimeError`` if a successful command printed or wrote nothing, or wrote NaN in place of a number."""
    import mitsuba as mi
    from safetensors.numpy import load_file

    from nerg_mi.tracking.rays import Rays

    files = [path for path in folder.rglob("*") if path.is_file()]
    wrong = [path.name for path in files if not path.stat().st_size]
    for path in set(files) - {folder / name for name in wrong}:
        arrays = []
        if path.suffix == ".safetensors":
            arrays = list(load_file(path).values())
        elif path.suffix in (".exr", ".png"):
            arrays = [np.array(mi.Bitmap(str(path)))]
        elif path.suffix == ".npz":
            arrays = [Rays.load(path).origin]
        elif path.suffix in (".csv", ".json", ".md", ".xml", ".svg") and _NO_NUMBER.search(path.read_text()):
            wrong.append(path.name)
        if arrays and not (sum(a.size for a in arrays) and all(np.isfinite(a.astype(float)).all() for a in arrays)):
            wrong.append(path.name)
    if wrong or not files or _NO_NUMBER.search(printed):
        raise RuntimeError(f"done, but there is no number in {wrong or len(files)} of its files: {printed[-400:]}")


def draw_cases(readers: list[Reader], inputs: Path, count: int, start: int = 0) -> Iterator[Case]:
    """Draw ``count`` command lines, equally many for each command, each with two or three additional options."""
    for k, reader in enumerate(readers):
        words = json.loads((inputs / reader.name / "line.json").read_text())
        rng = np.random.default_rng([start, k])
        command, options = reader.name.rpartition(" ")[0], _options(words)
        for _ in range(count * (k + 1) // len(readers) - count * k // len(readers)):
            extra: list[str] = []
            for option in rng.choice(len(options), min(len(options), int(rng.integers(2, 4))), replace=False):
                extra += _draw_options(options[option], command, rng)
            yield Case(reader.name, "line.json", json.dumps([*words, *extra]).encode())


@functools.lru_cache
def _commands() -> dict[str, Any]:
    """Return the parser of each command, by its words."""
    from tools.command_pages import iter_commands

    return {path.removeprefix("nerg "): command for path, command, _ in iter_commands()}


def _options(words: list[str]) -> list[TyperOption]:
    """Return the options of the command that the line ``words`` calls."""
    command = _commands().get(" ".join(words[:2])) or _commands()[words[0]]
    return [p for p in command.params if isinstance(p, TyperOption) and FIXED.isdisjoint(p.opts)]


def _draw_options(option: TyperOption, command: str, rng: np.random.Generator) -> list[str]:
    """Draw ``option`` with a value, as words of a command line."""
    if option.is_flag:
        return [str(rng.choice([*option.opts, *option.secondary_opts]))]
    kind = option.type_descriptor.annotation
    if (command, option.name) in _WRITTEN:
        values = ["{o}/" + option.name + (".vol" if option.name == "color" else "")]
    elif rng.random() < 0.1:
        values = _REFUSED.get(kind, _REFUSED[str])
    else:
        values = _allowed(option)
    return [option.opts[0], *(str(rng.choice(values)) for _ in range(max(option.nargs, 1)))]


def _allowed(option: TyperOption) -> list[str]:
    """Return values in the range of ``option``: its ends, values next to them, and usual values; or its choices."""
    kind = option.type_descriptor.annotation
    if kind is Path:
        return ["{i}/" + _FILES.get(option.name, "rays.npz")]
    if kind in (int, float):
        limits = option.type_descriptor.parameter_info
        low, high = kind(limits.min), kind(limits.max)
        next_to = (low + 1, high - 1) if kind is int else np.nextafter((low, high), (high, low)).tolist()
        usual = [v for v in (option.default, 0, 0.1, 0.5, 1, 2, 3, 8, 16) if v is not None and low <= v <= high]
        return [str(v) for v in (*usual, *usual, low, *next_to, high) if kind(v) == v]
    parameter = re.sub(r"\[.*?\]", "", option.help or "")
    if "A,B" in parameter:
        return [*_SPANS]
    if coordinates := re.search(r"\b[a-z]\d?(?:,[a-z]\d?){2,}", parameter):
        return [_BOXES.get(coordinates[0][:5], "")] if coordinates[0].count(",") > 2 else [*_POINTS]
    rows = ", ".join(_ROW.findall(re.sub(r" \([^)]*\)", "", parameter)))
    entries = _ENTRY.findall(parameter)
    words = re.split(r",? or |, ", rows) if rows and len(entries) < 2 else entries
    return [*_TEXTS.get(option.name, words or ("a",)), *([option.default] if option.default else [])]


def _all() -> list[Reader]:
    cases = [case for case in outputs.CASES if case.name not in SKIPPED and "'" not in case.line]
    return [_reader(f"{case.name} {k}", case) for k, case in enumerate(cases)]


READERS = _all()
