"""Which libLLVM Dr.Jit will load, and whether its kernels can run on it.

Dr.Jit accepts LLVM 15 and newer, but its kernels use `llvm.maximum`, which LLVM 15 and 16 cannot translate on x86: they
end the whole process, without a Python exception. Dr.Jit looks for a library once, when it is imported, and takes what
the machine's default search yields. So the choice is made here before that, and a bad one is refused with a sentence.

Nothing here imports drjit, mitsuba or NumPy.
"""

from __future__ import annotations

import ctypes
import glob
import os
import re
import sys
from typing import NamedTuple

from .errors import UnusableLLVM

MIN_VERSION = 17
"""Oldest major version of LLVM whose code generator knows every operation that Dr.Jit emits."""

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable that names the library to Dr.Jit; a value set by the user is never replaced."""

_FOLDERS = {
    "linux": (
        "/usr/lib/*-linux-gnu",
        "/usr/lib/llvm-*/lib",
        "/usr/lib64",
        "/usr/lib",
        "/usr/lib64/llvm*/lib*",
        "/usr/lib/wsl/lib",
        "/usr/local/lib",
        "/usr/local/llvm*/lib",
    ),
    "darwin": (
        "/opt/homebrew/opt/llvm*/lib",
        "/usr/local/opt/llvm*/lib",
        "/opt/local/libexec/llvm-*/lib",
        "/usr/local/lib",
    ),
}

_VERSION_PROBE = """
import ctypes, sys
numbers = [ctypes.c_uint() for _ in range(3)]
ctypes.CDLL(sys.argv[1]).LLVMGetVersion(*map(ctypes.byref, numbers))
print(*(n.value for n in numbers))
"""


class Library(NamedTuple):
    """A libLLVM: `path` as found ("" if Dr.Jit chose it by itself), `version` a tuple starting with the major
    number."""

    path: str
    version: tuple[int, ...]

    @property
    def is_usable(self) -> bool:
        return self.version[0] >= MIN_VERSION

    def __str__(self) -> str:
        number = ".".join(map(str, self.version))
        return f"LLVM {number} ({self.path})" if self.path else f"LLVM {number}"


def suggest_fix() -> str:
    """How to get a usable library on this machine: the end of a sentence."""
    best = next(iter(find_installed()), None)
    if PATH_VARIABLE in os.environ and best is not None and best.is_usable:
        return f"unset {PATH_VARIABLE}, since {best} is installed"
    if sys.platform == "darwin":
        return f'"brew install llvm", or set {PATH_VARIABLE} to a libLLVM.dylib of version {MIN_VERSION} or newer'
    if sys.platform == "win32":
        return f"install LLVM {MIN_VERSION} or newer, or set {PATH_VARIABLE} to its LLVM-C.dll"
    return f'"sudo apt install libllvm19" (any from {MIN_VERSION} up), or set {PATH_VARIABLE} to such a libLLVM'


def find_version(path: str) -> tuple[int, ...] | None:
    """Version of the libLLVM at `path`, or None if it is none.

    Distributions write it into the file's name. Only where they do not, the library is asked, in a process of its own:
    a second LLVM in this one could be the one whose symbols Dr.Jit then finds.
    """
    for name in (os.path.realpath(path), path):
        match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+(?:\.\d+)*)", os.path.basename(name))
        if match:
            return tuple(int(part) for part in match[1].split("."))
    if not os.path.isfile(path):
        return None
    import subprocess

    answer = subprocess.run([sys.executable, "-c", _VERSION_PROBE, path], capture_output=True, text=True)
    if answer.returncode != 0:  # not a library, of another machine, or older than LLVM 16, which has no such function
        return None
    return tuple(map(int, answer.stdout.split()))


def find_installed() -> list[Library]:
    """Every libLLVM in the places where systems keep them, newest first, each file once."""
    folders = [*_FOLDERS.get(sys.platform, ()), os.path.join(sys.prefix, "lib")]
    suffix = "*.dylib" if sys.platform == "darwin" else "*.so*"
    found: dict[str, Library] = {}
    for folder in folders:
        for path in sorted(glob.glob(os.path.join(folder, "libLLVM" + suffix))):
            real = os.path.realpath(path)
            if real in found or not os.path.isfile(real):
                continue
            version = find_version(real)
            if version is not None:
                found[real] = Library(path, version)
    return sorted(found.values(), key=lambda library: library.version, reverse=True)


def has_cuda() -> bool:
    """Whether an NVIDIA driver is installed. Nothing is initialised."""
    names = {"win32": ["nvcuda.dll"], "darwin": []}.get(sys.platform, ["libcuda.so.1", "libcuda.so"])
    for name in filter(None, [os.environ.get("DRJIT_LIBCUDA_PATH"), *names]):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def select_library() -> None:
    """Point Dr.Jit to the newest usable libLLVM, unless the user has named one or Dr.Jit is loaded already."""
    if PATH_VARIABLE in os.environ or "drjit" in sys.modules:
        return
    best = next(iter(find_installed()), None)
    if best is not None and best.is_usable:
        os.environ[PATH_VARIABLE] = best.path


def _loaded() -> Library | None:
    """The libLLVM inside a Dr.Jit that is loaded already; None if drjit is not loaded or found none it accepts."""
    detail = getattr(sys.modules.get("drjit"), "max_edge", None)
    ask = getattr(detail, "llvm_version", None)
    version = ask() if ask else (-1,)
    return Library(os.environ.get(PATH_VARIABLE, ""), tuple(version)) if version[0] > 0 else None


def find_current() -> Library | None:
    """The libLLVM that Dr.Jit has loaded or will load; None if there is none."""
    loaded = _loaded()
    if loaded is not None:
        return loaded
    named = os.environ.get(PATH_VARIABLE)
    if named is not None:
        version = find_version(named) if os.path.isfile(named) else None
        return Library(named, version) if version else None
    return next(iter(find_installed()), None)


def find_problem() -> str | None:
    """What is wrong with the libLLVM that Dr.Jit has or will have, as one sentence with the remedy; None if nothing."""
    library = find_current()
    if library is not None and not library.is_usable:
        return f"{library} cannot run the kernels of Dr.Jit, which need LLVM {MIN_VERSION} or newer: {suggest_fix()}."
    if library is not None:
        return None
    named = os.environ.get(PATH_VARIABLE)
    if named is not None and not os.path.isfile(named):
        return f'{PATH_VARIABLE} names "{named}", which is no file, and LLVM {MIN_VERSION} or newer is needed: {suggest_fix()}.'
    if named is not None:
        return f'{PATH_VARIABLE} names "{named}", which is no libLLVM that can be used: {suggest_fix()}.'
    return f"No libLLVM was found, and the llvm variants need version {MIN_VERSION} or newer: {suggest_fix()}."


def require_usable(variant: str | None = None) -> None:
    """Raise `UnusableLLVM` (an ImportError) where going on would abort the process or could not work.

    Without a `variant`, a machine without any libLLVM passes (what needs no kernels works there), and so does one with
    an NVIDIA driver, whose cuda variants do not need LLVM; a library that the user named must be usable everywhere.
    With a `variant`, only an `llvm_*` one is refused, and then whatever is wrong counts.
    """
    if variant is not None and not variant.startswith("llvm"):
        return
    trouble = find_problem()
    if trouble is None:
        return
    if variant is None and PATH_VARIABLE not in os.environ and (find_current() is None or has_cuda()):
        return
    raise UnusableLLVM(trouble)
