"""The process that reads damaged files. It is started by `watch`, reads one JSON line per case, and writes one line
with the outcome.

An audit hook watches each case: nothing may be run, opened for writing, removed, or sent.
"""

from __future__ import annotations

import base64
import importlib
import json
import os
import resource
import shutil
import sys
import time
import warnings
from pathlib import Path

ROOM = 1 << 30
"""So much more memory may a case take, in bytes."""

SECONDS = 5.0
"""So much time of the processor, for a file; a command has four times as much."""

_FORBIDDEN = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "subprocess.Popen",
    "pty.spawn",
    "pickle.find_class",
    "shutil.",
    "os.remove",
    "os.rename",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.chmod",
    "os.chown",
    "os.truncate",
    "os.putenv",
    "os.kill",
    "socket.",
    "ctypes.dlopen",
    "code.__new__",
    "webbrowser.",
    "urllib.",
    "ftplib.",
    "smtplib.",
    "tempfile.",
)
# Modules that may be imported late, besides the standard library.
_LIBRARIES = frozenset(
    (
        "nerg_mi",
        "tests",
        "numpy",
        "scipy",
        "drjit",
        "mitsuba",
        "OpenEXR",
        "safetensors",
        "trimesh",
        "pyarrow",
        "matplotlib",
        "PIL",
        "av",
        "torch",
    )
)

# Bytecode of a function that returns None, in any version of Python.
_EMPTY = 32

watched = False
violations: list[str] = []


def audit(event: str, arguments: tuple) -> None:
    """Record and block operations that a reader must not perform."""
    if not watched:
        return
    bad = event.startswith(_FORBIDDEN)
    if event == "code.__new__":
        # Libraries compiled with Cython create an empty function for the traceback of each exception.
        code, name, *_ = arguments
        bad = not (str(name).startswith("av/") and len(code) <= _EMPTY)
    elif event == "open":
        _, mode, flags = arguments
        writes = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
        bad = (isinstance(mode, str) and any(c in mode for c in "wax+")) or (
            isinstance(flags, int) and bool(flags & writes)
        )
    elif event == "exec":
        name = getattr(arguments[0], "co_filename", "<unknown>")
        # Late imports also run code from files. Frozen modules belong to Python; dataclasses generate code that has no
        # file.
        bad = name.startswith("<") and not name.startswith("<frozen")
    elif event == "import":
        root = str(arguments[0]).partition(".")[0]
        bad = root not in _LIBRARIES and root not in sys.stdlib_module_names
    if bad:
        violations.append(f"{event} {str(arguments)[:200]}")
        raise RuntimeError(f"a damaged file led to {event}")


def _memory(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) << 10
    return 0


def _files(folder: Path) -> set:
    return {(str(p.relative_to(folder)), p.lstat().st_size) for p in folder.rglob("*")}


def attempt(reader, folder: Path) -> dict:
    """Read ``folder`` and return the outcome: result, refusal, or one of the breaches of the contract."""
    global watched  # noqa: PLW0603 (an audit hook cannot be removed, and checks this variable)
    from nerg_mi.errors import NergError

    violations.clear()
    before = _files(folder)
    Path("/proc/self/clear_refs").write_text("5")
    # A command may compute in other threads.
    clock = time.process_time if reader.is_command else time.thread_time
    memory, start, outcome, said = _memory("VmRSS"), clock(), "result", ""
    watched = not reader.is_command
    try:
        reader.read(folder)
    except NergError as error:
        outcome, said = "refusal", str(error)
    except BaseException as error:
        outcome, said = "other exception", f"{type(error).__name__}: {error}"
    finally:
        watched = False
    seconds, taken = clock() - start, _memory("VmHWM") - memory
    if violations:
        outcome, said = "executed", "; ".join(violations)
    elif not reader.is_command and _files(folder) != before:
        outcome, said = "left a file", str(_files(folder) ^ before)
    elif taken > ROOM or "needs more memory than is available" in said:
        outcome, said = "memory", f"{taken >> 20} MB; {said}"
    elif seconds > SECONDS * (24 if reader.is_command else 1):
        outcome, said = "slow", f"{seconds:.1f} s; {said}"
    elif outcome == "refusal" and not (said.isprintable() and 10 < len(said) < 1500):
        outcome = "no sentence"
    return {"outcome": outcome, "said": said[:600], "seconds": seconds, "memory": taken}


def place(file: Path, special: str, data: bytes) -> None:
    """Write ``data`` to ``file``, or create something that is not a regular file (see `watch.SPECIAL`)."""
    match special:
        case "":
            file.write_bytes(data)
        case "fifo":
            os.mkfifo(file)
        case "folder":
            file.mkdir()
        case "missing":
            file.symlink_to(file.with_name("no-such-file"))
        case "loop":
            file.symlink_to(file.name)
        case "sparse":
            with file.open("wb") as out:
                out.write(data)
                out.truncate(64 << 30)
        case device:
            file.symlink_to(device)


def main() -> None:
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    warnings.simplefilter("ignore")
    home, room, module, names = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4:]
    readers = {r.name: r for r in importlib.import_module(module).READERS}
    sys.addaudithook(audit)
    for name in names:
        shutil.copytree(home / name, room / name)
        # First with the valid input, to import all modules and to check the input.
        readers[name].read(room / name)
    limit = _memory("VmSize") + 2 * ROOM
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    print(json.dumps({"ready": True}), file=out)
    for line in sys.stdin:
        case = json.loads(line)
        folder = room / case["reader"]
        file = folder / case["target"]
        request = file.read_bytes()
        file.unlink()
        place(file, case["special"], base64.b64decode(case["data"]))
        report = attempt(readers[case["reader"]], folder)
        file.rmdir() if file.is_dir() and not file.is_symlink() else file.unlink()
        file.write_bytes(request)
        print(json.dumps(report), file=out)


if __name__ == "__main__":
    main()
