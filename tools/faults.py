"""Kills: whatever happens to a command, files that were whole stay whole.

    python -m tools.faults [--tries 100] [--only WORD] [--update docs/explanation/robustness.md]

Commands run in a folder with an earlier result of each. Every second try is killed (SIGKILL) at a moment of its usual
run, spread from its begin to its end; the others are killed as soon as a file is being written. After each, every file
of the folder must be as it was, byte for byte, or another that its reader reads whole; and the next start, which
resumes where there is a state, must not fail. Exit code 1 where a file is lost or a start fails.
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
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from tools.page import table, update_table


@dataclass(frozen=True)
class Command:
    """``line``: of `nerg`, in which OUT stands for the output and IN for the folder of inputs; ``output``: its name;
    ``made``: the files that it makes; ``weight``: of the tries; ``state``: the file from which --resume goes on."""

    name: str
    line: str
    output: str
    made: tuple[str, ...]
    weight: int
    state: str = ""

    def arguments(self, inputs: Path, output: Path) -> list[str]:
        return [w.replace("IN", str(inputs)).replace("OUT", str(output)) for w in self.line.split()]


_GAZE = "--geometry none --zones 0 --radius 0.5 --probes 16 --min-rays 8 --directions 64"
COMMANDS = (
    Command(
        "train radiance",
        "train radiance IN/photos -o OUT --steps 25 --save-every 0.5 --holdout 0",
        "field.safetensors",
        ("field.safetensors",),
        6,
        "field.run",
    ),
    Command(
        "train gaze",
        f"train gaze IN/rays.npz -o OUT --steps 200 --save-every 0.02 {_GAZE}",
        "gaze.safetensors",
        ("gaze.safetensors",),
        14,
        "gaze.run",
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
    """What became of the tries of a command: of ``tried``, ``landed`` met it while it ran; ``lost``: files that were
    neither the old ones nor whole; ``started``: starts that did not fail; ``left``: hidden files of killed writers."""

    tried: int = 0
    landed: int = 0
    lost: int = 0
    started: int = 0
    left: int = 0


# ----------------------------------------------------------------------------
# Processes that are killed
# ----------------------------------------------------------------------------

_LIMIT = 900.0


def start(arguments: list[str], log: Path) -> int:
    """Begin `nerg` with ``arguments`` in a process of its own; returns its id.

    It is forked from this one, which has the modules loaded and has not begun anything with them.
    """
    pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        with open(log, "wb") as out, open(os.devnull, "rb") as nothing:
            for target, stream in ((0, nothing), (1, out), (2, out)):
                os.dup2(stream.fileno(), target)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        from nerg_mi import cli

        # A column map has spaces in it.
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


def wait(pid: int, limit: float = _LIMIT) -> int:
    """Exit code of the process ``pid``, negative for the signal that ended it; it is killed after ``limit`` seconds."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    raise TimeoutError(f"no end after {limit:.0f} s")


def kill_at(pid: int, seconds: float) -> int:
    """Kill ``pid`` after ``seconds`` unless it has ended; its exit code."""
    with contextlib.suppress(TimeoutError):
        return wait(pid, seconds)
    return -signal.SIGKILL


def kill_while_writing(pid: int, folder: Path, turn: random.Random, skip: int) -> int:
    """Kill ``pid`` within the ``skip``-th write after this, or a few milliseconds later; its exit code."""
    there, seen = set(filter(is_partial, folder.rglob("*"))), 0
    end = time.monotonic() + _LIMIT
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        new = set(filter(is_partial, folder.rglob("*"))) - there
        there |= new
        seen += len(new)
        if seen > skip:
            return kill_at(pid, turn.choice((0, 0.001, 0.003, 0.01)))
        time.sleep(0.0005)
    return kill_at(pid, 0)


# ----------------------------------------------------------------------------
# Files that are whole
# ----------------------------------------------------------------------------


def contents(*folders: Path) -> dict[Path, str]:
    """SHA-256 of every file in ``folders``, without the hidden ones that a killed writer leaves."""
    found = (p for folder in folders for p in folder.rglob("*") if p.is_file() and not is_partial(p))
    return {p: hashlib.sha256(p.read_bytes()).hexdigest() for p in found}


def is_partial(path: Path) -> bool:
    """Whether ``path`` is a file that was being written."""
    return path.name.startswith(".") and ".part" in path.name


def read_whole(path: Path) -> None:
    """Read ``path`` to its end by the reader of its kind; raises whatever that raises where it is not whole."""
    data = path.read_bytes()
    if path.suffix in (".safetensors", ".run"):
        from safetensors.numpy import load

        assert load(data)
    elif path.suffix == ".npz":
        from nerg_mi.rays.rays import Rays

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


def lost_files(before: dict[Path, str], after: dict[Path, str]) -> list[str]:
    """Files that are gone, or neither as they were nor whole, each with what is wrong."""
    found = [f"{path} is gone" for path in before if path not in after and path.suffix != ".run"]
    for path, digest in after.items():
        if before.get(path) == digest:
            continue
        try:
            read_whole(path)
        except Exception as error:  # whatever a reader says of what is not whole
            found.append(f"{path} is not whole: {type(error).__name__}: {error}")
    return found


# ----------------------------------------------------------------------------
# Commands
# ----------------------------------------------------------------------------


def prepare(folder: Path) -> None:
    """Inputs of the commands, in ``folder``."""
    import shutil

    import mitsuba as mi

    from nerg_mi.workflows.demo import find_store_scene
    from tests import tiny

    mi.set_variant("scalar_rgb")
    tiny.write_photos(folder / "photos")
    tiny.write_tracking(folder / "track.csv", 40_000)
    tiny.simulate_gaze(2_000).save(folder / "rays.npz")
    for name in ("scene.xml", "store.safetensors", "shoppers.safetensors"):
        shutil.copy(find_store_scene().parent / name, folder / name)


def begin(command: Command, inputs: Path, out: Path) -> list[str]:
    """Arguments of the next start: with --resume where there is a state to go on from."""
    resume = ["--resume"] if command.state and (out / command.state).is_file() else []
    return command.arguments(inputs, out / command.output) + resume


def try_kills(command: Command, inputs: Path, out: Path, tries: int, seed: int = 0) -> Tally:
    """Kill ``command`` ``tries`` times, and let it come to its end after that; raises `AssertionError` for a failing
    start."""
    tally, turn, log = Tally(), random.Random(seed), out.parent / "log.txt"
    if "place" in command.output:
        (out / command.output).write_bytes((inputs / "rays.npz").read_bytes())
    since = time.monotonic()
    _require_success(command, wait(start(begin(command, inputs, out), log)), log)
    usual = time.monotonic() - since
    for k in range(tries):
        before = contents(inputs, out)
        pid = start(begin(command, inputs, out), log)
        code = (
            kill_at(pid, usual * (k + 0.5) / tries)
            if k % 2
            else kill_while_writing(pid, out, turn, turn.randrange(4) if command.state else 0)
        )
        tally.tried += 1
        tally.landed += code == -signal.SIGKILL
        if code != -signal.SIGKILL:
            _require_success(command, code, log)
        tally.started += 1
        lost = lost_files(before, contents(inputs, out))
        tally.lost += len(lost)
        for line in lost:
            print(f"{command.name}: {line}", file=sys.stderr)
    tally.left = sum(map(is_partial, out.rglob("*")))
    _require_success(command, wait(start(begin(command, inputs, out), log)), log)
    assert all((out / name).is_file() for name in command.made), f"{command.name} has not made {command.made}"
    return tally


def _require_success(command: Command, code: int, log: Path) -> None:
    assert code == 0, f"nerg {command.name} ended with {code}: {log.read_text(errors='replace')[-600:]}"


# ----------------------------------------------------------------------------
# The table
# ----------------------------------------------------------------------------

HEAD = ("What", "Times tried", "While running", "Files lost", "Next start works", "Hidden parts left")


def kills(work: Path, inputs: Path, tries: int, only: str) -> list[list[object]]:
    """Rows of the kills, a command each and their sum."""
    chosen = [c for c in COMMANDS if only in c.name]
    total, rows, tallies = sum(c.weight for c in COMMANDS), [], []
    for k, command in enumerate(chosen):
        out = work / f"out{k}" / "results"
        out.mkdir(parents=True)
        count = max(1, round(tries * command.weight / total))
        tally = try_kills(command, inputs, out, count, k)
        tallies.append(tally)
        rows.append(_row(f"SIGKILL: `nerg {command.name}`", tally))
        print(" | ".join(map(str, rows[-1])), file=sys.stderr, flush=True)
    every = Tally(*(sum(getattr(t, n) for t in tallies) for n in ("tried", "landed", "lost", "started", "left")))
    return [*rows, _row("SIGKILL, all", every)]


def _row(what: str, t: Tally) -> list[object]:
    return [what, t.tried, t.landed, t.lost, f"{t.started} of {t.tried}", t.left]


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--tries", type=int, default=100, help="kills altogether")
    parser.add_argument("--only", default="", help="commands with this word in their name")
    parser.add_argument("--update", type=Path, help="page whose table is exchanged")
    options = parser.parse_args(arguments)
    # Children have what is loaded here; nothing may be begun with it.
    import matplotlib  # noqa: F401

    with tempfile.TemporaryDirectory(prefix="nerg-faults-") as made:
        work, inputs = Path(made), Path(made) / "inputs"
        work.chmod(0o755)
        _prepare_apart(inputs)
        rows = kills(work, inputs, options.tries, options.only)
    update_table(options.update, "Faults", table(HEAD, rows))
    return int(any(row[3] for row in rows))


def _prepare_apart(inputs: Path) -> None:
    """`prepare` in a process of its own, since it begins something with Mitsuba."""
    inputs.mkdir()
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            prepare(inputs)
            code = 0
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            os._exit(code)
    assert wait(pid) == 0, "the inputs could not be made"


if __name__ == "__main__":
    sys.exit(main())
