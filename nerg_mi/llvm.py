"""Selection of the libLLVM that Dr.Jit loads, and a check that its kernels can run on it.

Dr.Jit accepts LLVM 15 and newer, but its kernels use `llvm.maximum`, which LLVM 15 and 16 cannot compile on x86: they
terminate the process without a Python exception. Dr.Jit searches for the library once, when it is imported, and uses
the first result of the system's default search. This module therefore selects a library before that import, and raises
an error for an unusable one.

This module does not import drjit, mitsuba or NumPy.
"""

from __future__ import annotations

import ctypes
import glob
import os
import re
import sys
from typing import NamedTuple

from nerg_mi.errors import UnusableLLVM

MIN_VERSION = 17
"""Oldest major version of LLVM whose code generator supports all operations that Dr.Jit emits."""

PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
"""Environment variable with the path of the library for Dr.Jit. A value set by the user is never replaced."""

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
    """A libLLVM.

    Attributes
    ----------
    path
        Path of the file; "" if Dr.Jit selected the library itself.
    version
        Version numbers, starting with the major version.
    """

    path: str
    version: tuple[int, ...]

    @property
    def is_usable(self) -> bool:
        return self.version[0] >= MIN_VERSION

    def __str__(self) -> str:
        number = ".".join(map(str, self.version))
        return f"LLVM {number} ({self.path})" if self.path else f"LLVM {number}"


def suggest_fix() -> str:
    """Return how to install a usable library on this machine, as the end of a sentence."""
    best = next(iter(find_installed()), None)
    if PATH_VARIABLE in os.environ and best is not None and best.is_usable:
        return f"unset {PATH_VARIABLE}, since {best} is installed"
    if sys.platform == "darwin":
        return f'"brew install llvm", or set {PATH_VARIABLE} to a libLLVM.dylib of version {MIN_VERSION} or newer'
    if sys.platform == "win32":
        return f"install LLVM {MIN_VERSION} or newer, or set {PATH_VARIABLE} to its LLVM-C.dll"
    return f'"sudo apt install libllvm19" (any from {MIN_VERSION} up), or set {PATH_VARIABLE} to such a libLLVM'


def find_version(path: str) -> tuple[int, ...] | None:
    """Return the version of the libLLVM at ``path``, or None if the file is not a libLLVM.

    Distributions include the version in the file name. Only if it is missing, the library is loaded and queried in a
    separate process: a second LLVM in this process could provide the symbols that Dr.Jit resolves.
    """
    for name in (os.path.realpath(path), path):
        match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+(?:\.\d+)*)", os.path.basename(name))
        if match:
            return tuple(int(part) for part in match[1].split("."))
    if not os.path.isfile(path):
        return None
    import subprocess

    process = subprocess.run([sys.executable, "-c", _VERSION_PROBE, path], capture_output=True, text=True)
    if (
        process.returncode != 0
    ):  # not a library, built for another machine, or older than LLVM 16, which lacks this function
        return None
    return tuple(map(int, process.stdout.split()))


def find_installed() -> list[Library]:
    """Return each libLLVM in the usual library folders, newest first, without duplicates.

    LLVM 19, 21, 22 and 23 compile the kernels of frames and of trainings equally fast.
    """
    folders = [*_FOLDERS.get(sys.platform, ()), os.path.join(sys.prefix, "lib")]
    suffix = "*.dylib" if sys.platform == "darwin" else "*.so*"
    libraries: dict[str, Library] = {}
    for folder in folders:
        for path in sorted(glob.glob(os.path.join(folder, "libLLVM" + suffix))):
            real = os.path.realpath(path)
            if real in libraries or not os.path.isfile(real):
                continue
            version = find_version(real)
            if version is not None:
                libraries[real] = Library(path, version)
    return sorted(libraries.values(), key=lambda one: one.version, reverse=True)


def has_cuda() -> bool:
    """Return whether an NVIDIA driver is installed. Does not initialise CUDA."""
    names = {"win32": ["nvcuda.dll"], "darwin": []}.get(sys.platform, ["libcuda.so.1", "libcuda.so"])
    for name in filter(None, [os.environ.get("DRJIT_LIBCUDA_PATH"), *names]):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def select_library() -> None:
    """Set the environment so that Dr.Jit loads the newest libLLVM, if it is usable.

    Does nothing if the user has set the variable or Dr.Jit is already loaded.
    """
    if PATH_VARIABLE in os.environ or "drjit" in sys.modules:
        return
    best = next(iter(find_installed()), None)
    if best is not None and best.is_usable:
        os.environ[PATH_VARIABLE] = best.path


def _find_loaded() -> Library | None:
    """Return the libLLVM of a loaded Dr.Jit; None if drjit is not loaded or has found no suitable library."""
    detail = getattr(sys.modules.get("drjit"), "detail", None)
    get_version = getattr(detail, "llvm_version", None)
    version = get_version() if get_version else (-1,)
    return Library(os.environ.get(PATH_VARIABLE, ""), tuple(version)) if version[0] > 0 else None


def find_current() -> Library | None:
    """Return the libLLVM that Dr.Jit has loaded or will load; None if there is none."""
    loaded = _find_loaded()
    if loaded is not None:
        return loaded
    user_path = os.environ.get(PATH_VARIABLE)
    if user_path is not None:
        version = find_version(user_path) if os.path.isfile(user_path) else None
        return Library(user_path, version) if version else None
    return next(iter(find_installed()), None)


def find_problem() -> str | None:
    """Return what is wrong with the libLLVM of Dr.Jit, as one sentence with the remedy; None if it is usable."""
    library = find_current()
    if library is not None and not library.is_usable:
        return f"{library} cannot run the kernels of Dr.Jit, which need LLVM {MIN_VERSION} or newer: {suggest_fix()}."
    if library is not None:
        return None
    user_path = os.environ.get(PATH_VARIABLE)
    if user_path is not None and not os.path.isfile(user_path):
        return (
            f'{PATH_VARIABLE} names "{user_path}", which is not a file, and LLVM {MIN_VERSION} or newer is needed: '
            f"{suggest_fix()}."
        )
    if user_path is not None:
        return f'{PATH_VARIABLE} names "{user_path}", which is not a usable libLLVM: {suggest_fix()}.'
    return f"No libLLVM was found, and the llvm variants need version {MIN_VERSION} or newer: {suggest_fix()}."


def require_usable(variant: str | None = None) -> None:
    """Raise `UnusableLLVM` (an ImportError) if rendering would abort the process or could not work.

    Parameters
    ----------
    variant
        Mitsuba variant that is about to be used. Only an ``llvm_*`` variant can fail, and then any problem with libLLVM
        is an error. With None, a machine without libLLVM passes, because features without kernels work there. A machine
        with an NVIDIA driver passes too, because its cuda variants do not need LLVM. A library that the user has
        selected must be usable in all cases.
    """
    if variant is not None and not variant.startswith("llvm"):
        return
    problem = find_problem()
    if problem is None:
        return
    if variant is None and PATH_VARIABLE not in os.environ and (find_current() is None or has_cuda()):
        return
    raise UnusableLLVM(problem)
