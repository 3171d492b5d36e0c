"""A compiled copy of the scene's radiance field for the viewer, made by another process and kept next to it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerg_mi.environment.radiance import RadianceField
from nerg_mi.environment.scene_loading import get_array_module
from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.fields import decode_radiance, encode_radiance

_PROGRAM = "from nerg_mi.viewer.compilation import compile_stream; compile_stream()"


def find_compiled_file(field: Path) -> Path | None:
    """Return the file of the compiled copy of ``field``, next to it; None if nothing can be written there, or another
    file has its name."""
    beside = field.with_name(f"{field.stem}.compiled.safetensors")
    is_other = beside.exists() and _read_origin(beside) is None
    return None if is_other or not os.access(field.parent, os.W_OK) else beside


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


def compile_stream(**options: Any) -> None:
    """Compile the radiance field whose checkpoint is on standard input, as ``nerg compile`` does with ``options``, and
    write the result to standard output."""
    import nerg_mi  # the function above this package

    # What Mitsuba and others print goes to standard error.
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    network, metadata = decode_radiance(sys.stdin.buffer.read(), get_array_module())
    field = RadianceField(network, metadata["provenance"], origin=metadata.get("refined_from"), half=metadata["half"])
    compiled = nerg_mi.compile_field(field, **options)
    with output:
        output.write(encode_radiance(compiled.network, dict(compiled.provenance), compiled.half, compiled.origin))


class BackgroundCompilation:
    """A process that compiles a radiance field, as ``nerg compile`` does by default.

    Parameters
    ----------
    field : bytes
        Checkpoint of the field.
    name : str
        Name of the field in messages.
    on_done : callable
        Called with the checkpoint of the compiled field on a thread of its own.
    on_error : callable
        Called with a `NergError` if the process fails.
    """

    def __init__(
        self, field: bytes, name: str, on_done: Callable[[bytes], Any], on_error: Callable[[BaseException], Any]
    ):
        self._name, self._on_done, self._on_error = name, on_done, on_error
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
        # In its own session, so that Ctrl-C ends the viewer, which then ends the process.
        self._process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        self._is_stopped = False
        self._thread = threading.Thread(target=self._wait, args=(field,), name="nerg-view-compile", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the process if it is still running; no callback is called afterwards."""
        self._is_stopped = True
        self._process.terminate()
        self._thread.join()

    def _wait(self, field: bytes) -> None:
        compiled, text = self._process.communicate(field)
        if self._is_stopped:
            return
        if self._process.returncode == 0:
            try:
                self._on_done(compiled)
            except NergError as error:
                self._on_error(error)
            return
        lines = text.decode(errors="replace").strip().splitlines()
        reason = sanitize(lines[-1], 200) if lines else f"exit code {self._process.returncode}"
        self._on_error(NergError(f"{self._name} is shown uncompiled, since its compilation failed: {reason}"))
