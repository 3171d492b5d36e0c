"""Structure from motion, as seen from outside: starts the process of `worker`, listens, and reads what it found."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.capture.upright import Up
from nerg_mi.errors import NergError, plain
from nerg_mi.files.atomic import write_text

from .pairs import chosen_pairs
from .pictures import Picture, cameras_of

LENSES = {"auto": None, "radial": "SIMPLE_RADIAL", "opencv": "OPENCV"}
"""Names of lenses -> COLMAP's model that is refined; auto: by how many pictures a camera has."""


@dataclass(frozen=True)
class Settings:
    """``lens``: one of `LENSES`; ``matching``: as `chosen_pairs` has it; ``share``: pictures share cameras; ``orient``:
    turn the model so that up is +z; ``threads``: None for all."""

    lens: str = "auto"
    matching: str = "auto"
    share: bool = True
    orient: bool = True
    seed: int = 0
    threads: int | None = None


@dataclass(frozen=True)
class Reconstruction:
    """``parts``: names of the pictures of each model that was found, of which the first, the largest, is the one that
    was kept; ``error``: its mean reprojection error in pixels of the small pictures; ``points``: how many it has;
    ``up``: None where it was not asked for; ``lenses``: its cameras (JSON); ``to_world``: (N, 4, 4) OpenGL poses, in
    the order of the first part; ``surface``, ``colors``: points (M, 3) that three pictures see, and their colours
    (M, 3), uint8."""

    parts: list[list[str]]
    error: float
    points: int
    up: Up | None
    lenses: list[dict]
    to_world: np.ndarray
    surface: np.ndarray
    colors: np.ndarray


def check_installed() -> None:
    """Raise ``ImportError``, with the remedy, where pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise ImportError('poses of photos need pycolmap, which is not installed: pip install "nerg-mi[poses]"')


def reconstruct(
    pictures: list[Picture], work: Path, settings: Settings, progress: Callable[[str, int, int], None]
) -> Reconstruction | None:
    """Find the poses of ``pictures``, whose small copies lie in ``work``/small; None where no three fit together.

    The model is written to ``work``/sparse/0. ``progress(stage, done, of)``: stages are features, matching, mapping.
    Raises `NergError` where COLMAP ends otherwise than by itself, ``ImportError`` where it is not installed.
    """
    check_installed()
    if settings.lens not in LENSES:
        raise NergError(f'lens must be {", ".join(LENSES)}, got "{settings.lens}"')
    chosen_pairs(0, settings.matching)
    write_text(work / "job.json", json.dumps(_job(pictures, settings)))
    _run(work, settings.threads, progress)
    with np.load(work / "result.npz", allow_pickle=False) as found:
        result, arrays = json.loads(str(found["result"])), {k: found[k] for k in found.files if k != "result"}
    if not result["parts"]:
        return None
    up = result.get("up")
    return Reconstruction(
        [[pictures[k].name for k in sorted(part)] for part in result["parts"]],
        result["error"],
        result["points"],
        None if up is None else Up(np.array(up["direction"]), up["roll"], up["plane"], up["between"]),
        result["lenses"],
        arrays["to_world"],
        arrays["points"],
        arrays["colors"],
    )


def _job(pictures: list[Picture], settings: Settings) -> dict[str, Any]:
    numbers = cameras_of(pictures, settings.share)
    cameras = []
    for number in range(max(numbers) + 1):
        own = [p for p, n in zip(pictures, numbers) if n == number]
        focal = [p.focal * p.small[0] / p.size[0] for p in own if p.focal is not None]
        cameras.append(
            {
                "size": own[0].size,
                "small": own[0].small,
                "focal": float(np.median(focal)) if focal else None,
                "pictures": len(own),
            }
        )
    return {
        "pictures": [{"name": p.name, "camera": n} for p, n in zip(pictures, numbers)],
        "cameras": cameras,
        "lens": LENSES[settings.lens],
        "matching": settings.matching,
        "orient": settings.orient,
        "seed": settings.seed,
        "threads": settings.threads or -1,
    }


def _run(work: Path, threads: int | None, progress: Callable[[str, int, int], None]) -> None:
    """Run the process to its end; it ends with this block at the latest."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    if threads:
        environment |= {name: str(threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    command = [sys.executable, "-m", "nerg_mi.capture.structure.worker", str(work)]
    with tempfile.TemporaryFile() as words:
        # In a session of its own: Ctrl-C is for this process, which then ends the other.
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=words,
            env=environment,
            start_new_session=True,
        )
        try:
            assert process.stdout is not None
            for line in process.stdout:
                progress(*json.loads(line))
            code = process.wait()
        finally:
            process.kill()
            process.wait()
        if code:
            words.seek(0)
            raise NergError(_ended(code, words.read().decode("utf-8", "replace"), work))


def _ended(code: int, words: str, work: Path) -> str:
    """Why the process ended with ``code``, as far as it is known."""
    if shutil.disk_usage(work).free < 1 << 20:
        return f'COLMAP ended early, since the disk of "{work.parent.parent}" is full; free some space'
    if code == -signal.SIGKILL:
        return "COLMAP was ended from outside, probably for want of memory; give a smaller --size or fewer pictures"
    lines = [line for line in words.splitlines() if line.strip()]
    # A trace follows the sentence where a library aborts, and precedes it where Python raises.
    said = next((line for line in lines if "Check failed" in line or "] " in line[:80]), lines[-1] if lines else "")
    return (
        f"COLMAP ended early, with code {code} ({plain(said, 200)}); try again with --threads 1, or with other photos"
    )
