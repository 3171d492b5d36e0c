"""A compiled copy of the scene's radiance field for the viewer, made by another process and kept next to it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.checkpoint import read_metadata

_PROGRAM = "import sys, nerg_mi; nerg_mi.compile_field(sys.argv[1]).save(sys.argv[2])"


def find_compiled_file(field: Path, folder: Path) -> Path:
    """Return the file of the compiled copy of ``field``.

    It is next to the field, or in ``folder`` if nothing can be written there or another file has its name.
    """
    beside = field.with_name(f"{field.stem}.compiled.safetensors")
    is_other = beside.exists() and _read_origin(beside) is None
    return folder / beside.name if is_other or not os.access(field.parent, os.W_OK) else beside


def is_compiled(field: Path) -> bool:
    """Whether the checkpoint ``field`` has voxels."""
    return "voxels" in read_metadata(field)


def is_current(compiled: Path, field: Path) -> bool:
    """Whether the file ``compiled`` exists and was compiled from ``field`` as it is now."""
    origin = _read_origin(compiled) if compiled.exists() else None
    return origin is not None and origin == (read_metadata(field).get("refined_from") or file_sha256(field))


def _read_origin(path: Path) -> str | None:
    """Return the checksum of the field from which ``path`` was compiled; None if it is no compiled field."""
    try:
        metadata = read_metadata(path)
    except NergError:
        # A file of another kind, or a damaged one: it is not used and not replaced.
        return None
    return metadata.get("refined_from") if "voxels" in metadata else None


class BackgroundCompilation:
    """A process that compiles ``field`` to ``output``, as ``nerg compile`` does by default.

    Parameters
    ----------
    field, output : Path
        Radiance field, and the file to write.
    on_done : callable
        Called with ``output`` on a thread of its own when the file is complete.
    on_error : callable
        Called with a `NergError` if the process fails.
    """

    def __init__(
        self, field: Path, output: Path, on_done: Callable[[Path], Any], on_error: Callable[[BaseException], Any]
    ):
        self._field, self._output, self._on_done, self._on_error = field, output, on_done, on_error
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        # In its own session, so that Ctrl-C ends the viewer, which then ends the process.
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, str(field), str(output)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,
            text=True,
        )
        self._is_stopped = False
        self._thread = threading.Thread(target=self._wait, name="nerg-view-compile", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the process if it is still running; no callback is called afterwards."""
        self._is_stopped = True
        self._process.terminate()
        self._thread.join()

    def _wait(self) -> None:
        _, text = self._process.communicate()
        if self._is_stopped:
            return
        if self._process.returncode == 0:
            self._on_done(self._output)
            return
        lines = text.strip().splitlines()
        reason = sanitize(lines[-1], 200) if lines else f"exit code {self._process.returncode}"
        self._on_error(NergError(f'"{self._field}" is shown uncompiled, since "nerg compile" failed: {reason}'))
