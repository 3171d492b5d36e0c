"""Checks of the installation for `nerg doctor`: variants, libLLVM, CUDA, threads and extras, each with a fix.

Each backend is tested in its own process because a broken backend may terminate the process. This module does not
import Mitsuba.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import subprocess
import sys
from dataclasses import dataclass, field

from nerg_mi.errors import format_error
from nerg_mi.memory import MITSUBA_MEGABYTES, NUMPY_MEGABYTES, find_free_address_space

from . import __version__, llvm
from .progress import Progress

EXTRAS = {
    "torch": 'for torch-ngp checkpoints and fields as torch modules: pip install "nerg-mi[torch]"',
    "scikit-image": 'for meshes of radiance fields: pip install "nerg-mi[mesh]"',
    "xatlas": 'for textures of baked gaze: pip install "nerg-mi[bake]"',
    "pyarrow": 'for gaze samples in Parquet tables: pip install "nerg-mi[parquet]"',
    "pycolmap": 'for camera poses of photos: pip install "nerg-mi[poses]"',
    "c3d": 'for C3D motion-capture files: pip install "nerg-mi[mocap]"',
}
"""Optional distributions, each with its purpose and the command that installs it."""

TESTED_MITSUBA = "3.9."
"""How the versions of Mitsuba begin with which the tests were run."""

MIN_CUDA_VERSION = (12, 8)
"""CUDA version of the oldest NVIDIA driver (R570) on which drjit.nn works."""


# The kernel uses dr.maximum because libLLVM 15 and 16 abort on it.
_TEST_SCRIPT = """
import json, sys
import drjit as dr, mitsuba as mi
backend, found = sys.argv[1], {"variants": [], "failed": {}}
for variant in mi.variants():
    if not variant.startswith(backend):
        continue
    try:
        mi.set_variant(variant)
        assert dr.sum(dr.maximum(mi.Float(-1 if backend == "scalar" else [-1, 3]), 0)) in (0, 3)
        found["variants"].append(variant)
    except Exception as error:
        found["failed"][variant] = str(error)
if found["variants"]:
    found["threads"] = dr.thread_count()
    if backend == "llvm":
        found["version"] = dr.detail.llvm_version()
    if backend == "cuda":
        found["version"] = dr.detail.cuda_version()
print("\\n" + json.dumps(found))
"""


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes
    ----------
    topic
        What was checked.
    text
        The result of the check.
    problem
        What is wrong and how to fix it; empty if the check passed.
    """

    topic: str
    text: str
    problem: str = ""


@dataclass
class Diagnosis:
    """All findings. ``is_usable`` is true if at least one compiled variant works, so that the machine can render."""

    findings: list[Finding] = field(default_factory=list)
    is_usable: bool = False

    def to_text(self) -> str:
        """Return one line for each finding, and one for each problem."""
        width = max(len(f.topic) for f in self.findings)
        lines = []
        for f in self.findings:
            lines.append(f"{f.topic:<{width}}  {f.text}".rstrip())
            if f.problem:
                lines.append(f"{'':<{width}}  -> {f.problem}")
        return "\n".join(lines)


def try_backend(backend: str) -> dict:
    """Run a small kernel in each variant of ``backend`` ("scalar", "llvm" or "cuda") in a separate process.

    Returns
    -------
    dict
        ``variants`` (names of the variants that work) and ``failed`` (error message of each variant that does not). If
        a variant works, also ``threads`` and the ``version`` of the backend. If the process dies, ``variants`` is empty
        and ``failed[backend]`` is the last line of its error output.
    """
    process = subprocess.run([sys.executable, "-c", _TEST_SCRIPT, backend], capture_output=True, text=True)
    if process.returncode == 0:
        return json.loads(process.stdout.splitlines()[-1])
    last_line = (process.stderr.strip() or f"its process exited with code {process.returncode}").splitlines()[-1]
    return {"variants": [], "failed": {backend: last_line}}


def run_diagnosis(progress: Progress = None) -> Diagnosis:
    """Check the installation and suggest fixes.

    The exit code is 0 if a compiled variant of Mitsuba works, else 1.
    """
    diagnosis = Diagnosis()
    add = diagnosis.findings.append
    core = (f"{name} {_version(name) or 'not installed'}" for name in ("mitsuba", "drjit"))
    versions, problem = ", ".join((f"nerg {__version__}", f"Python {platform.python_version()}", *core)), ""
    if not (_version("mitsuba") or TESTED_MITSUBA).startswith(TESTED_MITSUBA):
        problem = f'tested with mitsuba {TESTED_MITSUBA}* only; if it fails: pip install "mitsuba=={TESTED_MITSUBA}*"'
    add(Finding("versions", versions, problem))

    library, llvm_problem = llvm.find_current(), llvm.find_problem()
    add(Finding("libLLVM", str(library) if library else "none", llvm_problem or ""))
    # The scalar variants need no backend. They are tested first because Mitsuba itself may be broken.
    results = {"scalar": try_backend("scalar")}
    results["llvm"] = try_backend("llvm") if llvm_problem is None else {"variants": [], "failed": {}}
    has_driver = llvm.has_cuda()
    results["cuda"] = try_backend("cuda") if has_driver else {"variants": [], "failed": {}}

    cuda = results["cuda"]
    if not has_driver:
        add(Finding("CUDA", "no NVIDIA driver found (optional: the llvm variants run on the CPU)"))
    elif not cuda["variants"]:
        problem = next(iter(cuda["failed"].values()), "no error message")
        add(
            Finding(
                "CUDA", "does not work", f"install NVIDIA driver R570 or newer; Dr.Jit reports: {_one_line(problem)}"
            )
        )
    else:
        is_outdated = tuple(cuda["version"]) < MIN_CUDA_VERSION
        problem = "neural fields need NVIDIA driver R570 or newer: update the driver." if is_outdated else ""
        add(Finding("CUDA", ".".join(map(str, cuda["version"])), problem))

    for backend, result in results.items():
        text, problem = " ".join(result["variants"]) or "none", ""
        if result["failed"] and (backend != "cuda" or result["variants"]):
            name, message = next(iter(result["failed"].items()))
            problem = f"{name} failed ({_one_line(message)}); reinstall with: pip install --force-reinstall mitsuba"
        add(Finding(f"{backend} variants", text, problem))

    free = find_free_address_space()
    needed = NUMPY_MEGABYTES + MITSUBA_MEGABYTES
    has_memory = free is None or free >= needed
    if free is not None:
        problem = "" if has_memory else f'rendering needs about {needed} MB: raise the limit with "ulimit -v".'
        add(Finding("memory limit", f"{free} MB", problem))

    threads = results["llvm"].get("threads")
    if threads:
        add(Finding("threads", str(threads)))
    for name, purpose in EXTRAS.items():
        add(Finding(name, _version(name) or f"not installed ({purpose})"))

    diagnosis.is_usable = has_memory and any(
        not v.startswith("scalar") for result in results.values() for v in result["variants"]
    )
    if not has_memory:
        add(Finding("verdict", "cannot render: the memory limit of this process is too low", "raise it."))
    elif not diagnosis.is_usable:
        problem = "fix libLLVM or CUDA as described above."
        add(Finding("verdict", "cannot render: no llvm or cuda variant works", problem))
    else:
        add(Finding("verdict", "ready to render"))
    return diagnosis


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _one_line(text: str) -> str:
    return format_error(RuntimeError(text))
