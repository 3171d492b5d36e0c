"""Kill tests: a killed command never leaves a damaged file.

    python -m tools.faults [--tries 100] [--only WORD]

Commands run in a folder with an earlier result of each. Every second try is killed (SIGKILL) at a time spread evenly
over its usual run; the others are killed as soon as a file is being written. Afterwards every file of the folder must
be unchanged, byte for byte, or a new file that its reader can read completely; and the next start, which resumes if
there is a state, must succeed. The exit code is 1 if a file is lost or a start fails.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from tools.results import save
from tools.with_defaults import find_defaults


@dataclass(frozen=True)
class Command:
    """A command under test.

    ``line`` are the arguments of `nerg`, with OUT for the output and IN for the folder of inputs; ``output`` is the
    name of the output, ``made`` lists the files that it writes, ``weight`` is its relative number of tries, and
    ``state`` is the file from which --resume continues. ``defaults`` are those of parameters without an option.
    """

    name: str
    line: str
    output: str
    outputs: tuple[str, ...]
    weight: int
    state: str = ""
    defaults: Mapping[str, Any] = field(default_factory=dict)

    def arguments(self, inputs: Path, output: Path) -> list[str]:
        return [w.replace("IN", str(inputs)).replace("OUT", str(output)) for w in self.line.split()]


_GAZE = "--environment none --radius 0.5 --min-rays 8"
COMMANDS = (
    Command(
        "train radiance",
        "train radiance IN/photos -o OUT --steps 25 --holdout 0",
        "field.safetensors",
        ("field.safetensors",),
        6,
        "field.run",
        {"save_every": 0.5},
    ),
    Command(
        "train gaze",
        f"train gaze IN/rays.npz -o OUT --steps 200 {_GAZE}",
        "gaze.safetensors",
        ("gaze.safetensors",),
        14,
        "gaze.run",
        {"save_every": 0.02, "validation_zones": 0, "probes": 16, "directions": 64},
    ),
    Command(
        "rays import",
        "rays import IN/track.csv -o OUT --map origin=x,y,z~direction=dx,dy,dz~t=t~person=person",
        "imported.npz",
        ("imported.npz",),
        18,
    ),
    Command("rays filter, in place", "rays filter OUT -o OUT --min-confidence 0.1", "place.npz", ("place.npz",), 22),
    Command("export mesh", "export mesh IN/store.safetensors -o OUT --resolution 48", "mesh.ply", ("mesh.ply",), 8),
    Command(
        "export points", "export points IN/store.safetensors -o OUT --resolution 48", "points.ply", ("points.ply",), 8
    ),
    Command(
        "export volume", "export volume IN/store.safetensors -o OUT --resolution 48", "density.vol", ("density.vol",), 8
    ),
    Command(
        "render",
        "render IN/scene.xml -o OUT --spp 1 -m llvm_ad_rgb -D width=96 -D height=64",
        "scene.exr",
        ("scene.exr",),
        10,
    ),
    Command(
        "study",
        "study sphere -o OUT --quick --width 24 --height 16 -m llvm_ad_rgb --only coarse",
        "study",
        ("study/study.csv", "study/study.md", "study/study.json"),
        6,
    ),
)


@dataclass
class Tally:
    """Results of the tries of a command.

    ``hit`` of the ``tried`` kills hit it while it ran; ``lost`` counts missing or damaged files, ``restarted``
    successful restarts, ``left`` hidden files of killed writers.
    """

    tried: int = 0
    hit: int = 0
    lost: int = 0
    restarted: int = 0
    left: int = 0


# ----------------------------------------------------------------------------
# Processes that are killed
# ----------------------------------------------------------------------------

_LIMIT = 900.0


def start_process(arguments: list[str], log: Path) -> int:
    """Start `nerg` with ``arguments`` in a new process; returns its id.

    The process is forked from this one, which has the modules loaded but not used.
    """
    pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        with open(log, "wb") as out, open(os.devnull, "rb") as null:
            for target, stream in ((0, null), (1, out), (2, out)):
                os.dup2(stream.fileno(), target)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        from nerg_mi import cli

        # Spaces in column maps are written as "~".
        cli.main([a.replace("~", " ") for a in arguments])
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def wait_for(pid: int, limit: float = _LIMIT) -> int:
    """Return the exit code of the process ``pid``, negative for the signal that ended it; it is killed after ``limit``
    seconds.
    """
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    raise TimeoutError(f"the process did not end within {limit:.0f} s")


def kill_at(pid: int, seconds: float) -> int:
    """Kill ``pid`` after ``seconds`` unless it has ended; returns its exit code."""
    with contextlib.suppress(TimeoutError):
        return wait_for(pid, seconds)
    return -signal.SIGKILL


def kill_while_writing(pid: int, folder: Path, turn: random.Random, skip: int) -> int:
    """Kill ``pid`` during a later write, after ``skip`` writes, or a few milliseconds after it; returns its exit
    code."""
    files_before, seen = set(filter(is_partial, folder.rglob("*"))), 0
    end = time.monotonic() + _LIMIT
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        new = set(filter(is_partial, folder.rglob("*"))) - files_before
        files_before |= new
        seen += len(new)
        if seen > skip:
            return kill_at(pid, turn.choice((0, 0.001, 0.003, 0.01)))
        time.sleep(0.0005)
    return kill_at(pid, 0)


# ----------------------------------------------------------------------------
# Complete files
# ----------------------------------------------------------------------------


def hash_files(*folders: Path) -> dict[Path, str]:
    """Return the SHA-256 of every file in ``folders``, without the hidden files and locks of killed writers."""
    is_output = lambda path: path.is_file() and not is_partial(path) and path.suffix != ".lock"
    paths = (p for folder in folders for p in folder.rglob("*") if is_output(p))
    return {p: hashlib.sha256(p.read_bytes()).hexdigest() for p in paths}


def is_partial(path: Path) -> bool:
    """Return whether ``path`` is a file that is being written."""
    return path.name.startswith(".") and ".part" in path.name


def read_whole(path: Path) -> None:
    """Read ``path`` completely with the reader of its kind; raises any exception if it is damaged."""
    data = path.read_bytes()
    if path.suffix in (".safetensors", ".run"):
        from safetensors.numpy import load

        assert load(data)
    elif path.suffix == ".npz":
        from nerg_mi.tracking.rays import Rays

        assert len(Rays.load(path))
    elif path.suffix == ".ply":
        import trimesh

        assert len(trimesh.load(path, process=False).vertices)
    elif path.suffix == ".vol":
        x, y, z, channels = struct.unpack("<4i", data[8:24])
        assert data[:3] == b"VOL" and len(data) == 48 + 4 * x * y * z * channels
    elif path.suffix == ".exr":
        import OpenEXR

        with OpenEXR.File(str(path)) as picture:
            assert all(c.pixels is not None for c in picture.channels().values())
    elif path.suffix == ".json":
        json.loads(data)
    elif path.suffix == ".png":
        import matplotlib.image

        assert matplotlib.image.imread(path).size
    else:
        assert data.endswith(b"\n"), "its last line is cut off"


def find_lost_files(before: dict[Path, str], after: dict[Path, str]) -> list[str]:
    """List files that are missing, or changed and damaged, with the problem."""
    problems = [f"{path} is missing" for path in before if path not in after and path.suffix != ".run"]
    for path, digest in after.items():
        if before.get(path) == digest:
            continue
        try:
            read_whole(path)
        except Exception as error:  # readers raise different exceptions for damaged files
            problems.append(f"{path} is damaged: {type(error).__name__}: {error}")
    return problems


# ----------------------------------------------------------------------------
# Commands
# ----------------------------------------------------------------------------


def write_inputs(folder: Path) -> None:
    """Write the inputs of the commands into ``folder``."""
    import shutil

    import mitsuba as mi
    from nerg_mi.scenes.store import SCENE_FILE

    from tests import tiny

    mi.set_variant("scalar_rgb")
    tiny.write_photos(folder / "photos")
    tiny.write_tracking(folder / "track.csv", 40_000)
    tiny.simulate_gaze(2_000).save(folder / "rays.npz")
    for name in ("scene.xml", "store.safetensors", "shoppers.safetensors"):
        shutil.copy(SCENE_FILE.parent / name, folder / name)


def make_arguments(command: Command, inputs: Path, out: Path) -> list[str]:
    """Return the arguments of the next start, with --resume if there is a state."""
    resume = ["--resume"] if command.state and (out / command.state).is_file() else []
    return command.arguments(inputs, out / command.output) + resume


def try_kills(command: Command, inputs: Path, out: Path, tries: int, seed: int = 0) -> Tally:
    """Kill ``command`` ``tries`` times, and then let it finish; raises `AssertionError` if a start fails."""
    tally, turn, log = Tally(), random.Random(seed), out.parent / "log.txt"
    if "place" in command.output:
        (out / command.output).write_bytes((inputs / "rays.npz").read_bytes())
    find_defaults(command.line.split()).update(command.defaults)
    since = time.monotonic()
    _require_success(command, wait_for(start_process(make_arguments(command, inputs, out), log)), log)
    usual = time.monotonic() - since
    for k in range(tries):
        before = hash_files(inputs, out)
        pid = start_process(make_arguments(command, inputs, out), log)
        code = (
            kill_at(pid, usual * (k + 0.5) / tries)
            if k % 2
            else kill_while_writing(pid, out, turn, turn.randrange(4) if command.state else 0)
        )
        tally.tried += 1
        tally.hit += code == -signal.SIGKILL
        if code != -signal.SIGKILL:
            _require_success(command, code, log)
        tally.restarted += 1
        lost = find_lost_files(before, hash_files(inputs, out))
        tally.lost += len(lost)
        for line in lost:
            print(f"{command.name}: {line}", file=sys.stderr)
    tally.left = sum(map(is_partial, out.rglob("*")))
    _require_success(command, wait_for(start_process(make_arguments(command, inputs, out), log)), log)
    assert all((out / name).is_file() for name in command.outputs), f"{command.name} did not write {command.outputs}"
    return tally


def _require_success(command: Command, code: int, log: Path) -> None:
    assert code == 0, f"nerg {command.name} ended with {code}: {log.read_text(errors='replace')[-600:]}"


# ----------------------------------------------------------------------------
# The table
# ----------------------------------------------------------------------------

HEADER = ("Command", "Tries", "Killed while running", "Files lost", "Successful restarts", "Partial files left")


def run_kills(work: Path, inputs: Path, tries: int, only: str) -> list[list[object]]:
    """Return the rows of the kill tests, one per command, and their sum."""
    selected = [c for c in COMMANDS if only in c.name]
    total, rows, tallies = sum(c.weight for c in COMMANDS), [], []
    for k, command in enumerate(selected):
        out = work / f"out{k}" / "results"
        out.mkdir(parents=True)
        count = max(1, round(tries * command.weight / total))
        tally = try_kills(command, inputs, out, count, k)
        tallies.append(tally)
        rows.append(_make_row(f"SIGKILL: `nerg {command.name}`", tally))
        print(" | ".join(map(str, rows[-1])), file=sys.stderr, flush=True)
    every = Tally(*(sum(getattr(t, n) for t in tallies) for n in ("tried", "hit", "lost", "restarted", "left")))
    return [*rows, _make_row("SIGKILL, all", every)]


def _make_row(what: str, t: Tally) -> list[object]:
    return [what, t.tried, t.hit, t.lost, f"{t.restarted} of {t.tried}", t.left]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--tries", type=int, default=100, help="total number of kills")
    parser.add_argument("--only", default="", help="only commands with this word in their name")
    options = parser.parse_args(arguments)
    # Loaded here, so that child processes have it; it must not be used in this process.
    import matplotlib  # noqa: F401

    with tempfile.TemporaryDirectory(prefix="nerg-faults-") as made:
        work, inputs = Path(made), Path(made) / "inputs"
        work.chmod(0o755)
        _write_inputs_in_process(inputs)
        rows = run_kills(work, inputs, options.tries, options.only)
    save("faults", HEADER, rows)
    return int(any(row[3] for row in rows))


def _write_inputs_in_process(inputs: Path) -> None:
    """Run `write_inputs` in its own process, because it initialises Mitsuba."""
    inputs.mkdir()
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            write_inputs(inputs)
            code = 0
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            os._exit(code)
    assert wait_for(pid) == 0, "the inputs could not be created"


if __name__ == "__main__":
    sys.exit(main())
