"""Kills, full disks and forbidden folders: whatever happens to a command, files that were whole stay whole.

    python -m tools.faults [--tries 100] [--only WORD] [--update docs/trust.md]

Commands run in a folder with an earlier result of each. Every second try is killed (SIGKILL) at a moment of its usual
run, spread from its begin to its end; the others are killed as soon as a file is being written. After each, every file
of the folder must be as it was, byte for byte, or another that its reader reads whole; and the next start, which
resumes where there is a state, must not fail. Then each command meets a disk without room, a folder that is not its
user's to write, a parent that is missing and one that is a file. Exit code 1 where a file is lost or a start fails.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from tools.child_commands import become_nobody, fill, kill_at, kill_while_writing, small_disk, start, wait
from tools.page import table, update
from tools.whole_files import contents, lost_files, part


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
# Commands
# ----------------------------------------------------------------------------


def prepare(folder: Path) -> None:
    """Inputs of the commands, in ``folder``."""
    import shutil

    import mitsuba as mi

    from nerg_mi.jobs.demo import store_scene
    from tools import tiny

    mi.set_variant("scalar_rgb")
    tiny.write_photos(folder / "photos")
    tiny.write_tracking(folder / "track.csv", 40_000)
    tiny.looks(2_000).save(folder / "rays.npz")
    for name in ("scene.xml", "store.safetensors", "shoppers.safetensors"):
        shutil.copy(store_scene().parent / name, folder / name)


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
    tally.left = sum(map(part, out.rglob("*")))
    _require_success(command, wait(start(begin(command, inputs, out), log)), log)
    assert all((out / name).is_file() for name in command.made), f"{command.name} has not made {command.made}"
    return tally


def _require_success(command: Command, code: int, log: Path) -> None:
    assert code == 0, f"nerg {command.name} ended with {code}: {log.read_text(errors='replace')[-600:]}"


def refused(command: Command, inputs: Path, output: Path, log: Path, said: str, before=lambda: None) -> str:
    """What is wrong with how ``command`` is refused at ``output``; empty where it ends with 1 and one sentence with
    ``said``."""
    code = wait(start(command.arguments(inputs, output), log, before))
    text = log.read_text(errors="replace")
    sentences = [line for line in text.splitlines() if line.startswith("nerg: ")]
    if code != 1 or len(sentences) != 1 or said not in text or "Traceback" in text:
        return f"nerg {command.name} ended with {code}: {text[-400:]}"
    return ""


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


def refusals(work: Path, inputs: Path, only: str) -> tuple[list[list[object]], list[str]]:
    """Rows of what is refused, and what was wrong with it."""
    chosen, log, rows, wrong = [c for c in COMMANDS if only in c.name], work / "log.txt", [], []

    def row(what: str, each) -> None:
        tally = Tally()
        for command in chosen:
            found = each(command)
            if found is None:
                continue
            bad, lost = found
            tally.tried += 1
            tally.lost += lost
            tally.started += not bad
            wrong.extend([f"{what}: {bad}"] if bad else [])
        rows.append([what, tally.tried, "-", tally.lost, f"{tally.started} of {tally.tried}", 0])
        print(" | ".join(map(str, rows[-1])), file=sys.stderr, flush=True)

    def source(command: Command, folder: Path) -> Path:
        """The output in ``folder``, with an earlier file in its place."""
        output = folder / command.output
        earlier = output / "study.md" if command.name == "study" else output
        earlier.parent.mkdir(parents=True, exist_ok=True)
        earlier.write_bytes((inputs / "rays.npz").read_bytes() if "place" in command.output else b"earlier\n")
        return output

    def full(command: Command):
        with small_disk(work / "disk") as disk:
            output = source(command, disk)
            fill(disk)
            before = contents(disk)
            bad = refused(command, inputs, output, log, "the disk is full")
            # What is small may still find room, and must be whole then.
            lost = lost_files(before, contents(disk))
            wrong.extend(lost)
            (disk / "filler").unlink()
            if not bad and wait(start(begin(command, inputs, disk), log)) != 0:
                bad = f"the next start of nerg {command.name} fails: {log.read_text()[-300:]}"
            return bad, len(lost)

    def forbidden(command: Command):
        folder = work / f"forbidden {command.output}"
        folder.mkdir()
        output = source(command, folder)
        before = contents(folder)
        folder.chmod(0o555)
        os.chmod(output, 0o555)
        bad = refused(command, inputs, output, log, "you may not write there", become_nobody)
        return bad, sum(contents(folder).get(p) != digest for p, digest in before.items())

    def missing(command: Command):
        if "place" in command.output:
            return None  # its input is where its output is
        output = work / "new" / command.output.partition(".")[0] / "below" / command.output
        code = wait(start(command.arguments(inputs, output), log))
        return (
            "" if code == 0 and output.exists() else f"nerg {command.name} ended with {code}: {log.read_text()[-300:]}",
            0,
        )

    def blocked(command: Command):
        if "place" in command.output:
            return None
        return refused(command, inputs, inputs / "track.csv" / command.output, log, "one of its parents is a file"), 0

    if os.geteuid() == 0:
        row("A disk without room", full)
        row("A folder that is another user's", forbidden)
    else:
        rows.append(
            ["A disk without room; another user's folder", 0, "-", "-", "skipped: root alone can make them", "-"]
        )
    row("A parent that is missing is made", missing)
    row("A parent that is a file", blocked)
    return rows, wrong


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
        more, wrong = refusals(work, inputs, options.only)
    print(*wrong, sep="\n", file=sys.stderr)
    update(options.update, "Faults", table(HEAD, [*rows, *more]))
    return int(bool(wrong) or any(row[3] not in (0, "-") for row in [*rows, *more]))


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
