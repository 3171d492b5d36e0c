"""What works on this machine: variants, libLLVM, CUDA, threads, extras; each trouble with its remedy.

Backends are tried in processes of their own, since a bad one may end its process. Nothing here imports Mitsuba.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import subprocess
import sys
from dataclasses import dataclass, field

from . import __version__, llvm
from .errors import format_error

EXTRAS = {
    "torch": 'checkpoints of torch-ngp, fields as torch modules: pip install "nerg-mi[torch]"',
    "scikit-image": 'meshes of radiance fields: pip install "nerg-mi[mesh]"',
    "xatlas": 'textures of baked gaze: pip install "nerg-mi[bake]"',
    "pyarrow": 'ray tables in Parquet: pip install "nerg-mi[parquet]"',
    "pycolmap": 'poses of photos: pip install "nerg-mi[poses]"',
    "c3d": 'C3D files of motion capture: pip install "nerg-mi[mocap]"',
}
"""Optional distributions, each with what it is for and how to get it."""

MIN_CUDA_VERSION = (12, 8)
"""CUDA version of the oldest NVIDIA driver (R570) on which drjit.nn works."""

# dr.maximum is the operation on which libLLVM 15 and 16 abort; the rest of a kernel tells nothing more.
_TRIAL = """
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
    """One line of the report. `trouble` says what is wrong and what to do; empty where all is well."""

    topic: str
    text: str
    problem: str = ""


@dataclass
class Diagnosis:
    """All findings, and whether the machine can render at all (`usable`: some compiled variant works)."""

    findings: list[Finding] = field(default_factory=list)
    is_usable: bool = False

    def __str__(self) -> str:
        wide = max(len(f.topic) for f in self.findings)
        lines = []
        for f in self.findings:
            lines.append(f"{f.topic:<{wide}}  {f.text}".rstrip())
            if f.problem:
                lines.append(f"{'':<{wide}}  -> {f.problem}")
        return "\n".join(lines)


def try_backend(backend: str) -> dict:
    """Run a small kernel in every variant of `backend` ("scalar", "llvm" or "cuda"), in a process of its own.

    Gives `variants` (those that worked), `failed` (message of each that did not), and where one worked `threads` and
    the `version` of the backend. A process that died gives no variants and, as `failed[backend]`, its last words.
    """
    trial = subprocess.run([sys.executable, "-c", _TRIAL, backend], capture_output=True, text=True)
    if trial.returncode == 0:
        return json.loads(trial.stdout.splitlines()[-1])
    words = (trial.stderr.strip() or f"its process ended with code {trial.returncode}").splitlines()[-1]
    return {"variants": [], "failed": {backend: words}}


def run_diagnosis() -> Diagnosis:
    """Try everything and report it; takes a few seconds."""
    diagnosis = Diagnosis()
    add = diagnosis.findings.append
    core = (f"{name} {_version(name) or 'not installed'}" for name in ("mitsuba", "drjit"))
    add(Finding("versions", ", ".join((f"nerg {__version__}", f"Python {platform.python_version()}", *core))))

    library, trouble = llvm.find_current(), llvm.find_problem()
    add(Finding("libLLVM", str(library) if library else "none", trouble or ""))
    # Mitsuba itself may be what is broken, so the variants without a backend come first.
    results = {"scalar": try_backend("scalar")}
    results["llvm"] = try_backend("llvm") if trouble is None else {"variants": [], "failed": {}}
    driver = llvm.has_cuda()
    results["cuda"] = try_backend("cuda") if driver else {"variants": [], "failed": {}}

    cuda = results["cuda"]
    if not driver:
        add(Finding("CUDA", "no NVIDIA driver (not needed: the llvm variants run on the CPU)"))
    elif not cuda["variants"]:
        said = next(iter(cuda["failed"].values()), "no reason was given")
        add(Finding("CUDA", "does not work", f"install an NVIDIA driver R570 or newer; Dr.Jit said: {_one_line(said)}"))
    else:
        old = tuple(cuda["version"]) < MIN_CUDA_VERSION
        said = "neural fields need an NVIDIA driver R570 or newer: update it." if old else ""
        add(Finding("CUDA", ".".join(map(str, cuda["version"])), said))

    for backend, result in results.items():
        text, said = " ".join(result["variants"]) or "none", ""
        if result["failed"] and (backend != "cuda" or result["variants"]):
            name, words = next(iter(result["failed"].items()))
            said = f"{name} failed ({_one_line(words)}); reinstall with: pip install --force-reinstall mitsuba"
        add(Finding(f"{backend} variants", text, said))

    threads = results["llvm"].get("threads")
    if threads:
        add(Finding("threads", str(threads)))
    for name, purpose in EXTRAS.items():
        add(Finding(name, _version(name) or f"not installed ({purpose})"))

    diagnosis.is_usable = any(not v.startswith("scalar") for result in results.values() for v in result["variants"])
    if not diagnosis.is_usable:
        said = "mend libLLVM or CUDA as said above."
        add(Finding("verdict", "nothing can be rendered: no llvm and no cuda variant works", said))
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
