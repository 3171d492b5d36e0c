"""Source archive and wheel of the checkout, compared with it file by file."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_string
from pathlib import Path

from tools.imports import FOLDERS, ROOT

EXTRAS = ("parquet", "mesh")
"""Extras that the tests of a row run with. torch is none of them: its oldest version is a download of gigabytes."""
_LIMIT = 1800


class Failure(Exception):
    """A row that does not work; the message says at what."""


def run(command: list, cwd: Path | str = "/", *, env: dict | None = None, code: int = 0) -> str:
    """Standard output and error of ``command``, which has to end with ``code``; raises `Failure` with its last
    lines."""
    words = [str(c) for c in command]
    shown = " ".join(Path(w).name if w.startswith("/") else w for w in words)[:160]
    try:
        done = subprocess.run(
            words,
            cwd=cwd,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=_LIMIT,
        )
    except subprocess.TimeoutExpired:
        raise Failure(f"{shown}: no end after {_LIMIT} s") from None
    if done.returncode != code:
        last = " / ".join(done.stdout.strip().splitlines()[-25:])
        raise Failure(f"{shown}: exit code {done.returncode}: {last}")
    return done.stdout


def tracked_files() -> list[str]:
    """Paths of the checkout's files, those that are not committed yet included, without what git ignores."""
    listed = ["git", "-C", ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    return [p for p in run(listed).split("\0") if p and (ROOT / p).is_file()]


def build(work: Path) -> tuple[Path, Path]:
    """Source archive and wheel, made from a copy of the checkout that holds nothing else; raises `Failure`."""
    tracked, copy, out = tracked_files(), work / "checkout", work / "dist"
    for path in tracked:
        (copy / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / path, copy / path)
    run([sys.executable, "-m", "venv", work / "build"])
    python = work / "build" / "bin" / "python"
    run([python, "-m", "pip", "install", "-q", "build"])
    # Without a choice the wheel is built from the source archive, as it is for whoever has only that.
    run([python, "-m", "build", "--outdir", out, copy])
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    with tarfile.open(sdist) as archive:
        lost = missing_from_sdist(tracked, archive.getnames())
        # Pythons of before 2023 have no filter.
        safe = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
        archive.extractall(work / "unpacked", **safe)
    lost += missing_from_wheel(tracked, zipfile.ZipFile(wheel).namelist())
    if lost:
        raise Failure(f"the packages lack {len(lost)} files of the checkout: {', '.join(lost[:8])}")
    return sdist, wheel


def metadata_of(wheel: Path) -> str:
    """The text METADATA of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        return archive.read(name).decode()


def floors(metadata: str) -> list[str]:
    """pip constraints that hold every requirement of a wheel's METADATA to its lowest version, those of `EXTRAS`
    included."""
    pinned = []
    for requirement in message_from_string(metadata).get_all("Requires-Dist", []):
        name, _, marker = (part.strip() for part in requirement.partition(";"))
        extra = re.search(r"extra == .(\w+).", marker)
        if extra is not None and extra[1] not in EXTRAS:
            continue
        floor = re.match(r"([\w.-]+).*?(?:>=\s*([\w.]+)|==\s*([\w.]+)\.\*)", name)
        if floor is not None:
            pinned.append(f"{floor[1]}=={floor[2] or floor[3] + '.0'}")
    return pinned


def missing_from_wheel(tracked: list[str], names: list[str]) -> list[str]:
    """Files of the checkout (``tracked``) that are to be installed and are not among the ``names`` in the wheel."""
    there = set(names)
    wanted = ((path, path.split("/", 1)) for path in tracked if "/" in path)
    return [path for path, (top, rest) in wanted if top in FOLDERS and f"{FOLDERS[top]}/{rest}" not in there]


def missing_from_sdist(tracked: list[str], names: list[str]) -> list[str]:
    """Files of the checkout (``tracked``) that the source archive lacks, except those that only git and its server
    use."""
    there = {name.split("/", 1)[1] for name in names if "/" in name}
    return [path for path in tracked if not path.startswith(".") and path not in there]
