"""Set up the checkout: a usable libLLVM, `.venv`, and an editable installation of the package.

    python3 tools/setup.py [EXTRA ...]

EXTRA are optional dependencies of pyproject.toml, such as `test`. A second run only does what is missing. Works on
Debian and Ubuntu with Python 3.10 or newer; on other Linux systems and macOS, libLLVM must be installed manually. Only
the standard library is used, because nothing else may be installed yet.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
STAMP = VENV / "nerg-setup.json"


class Stop(Exception):
    """Set-up cannot continue; the message is one sentence with the remedy."""


# ------------------------------------------------------------------------
#  libLLVM
# ------------------------------------------------------------------------


def find_newest_package(names: list[str], minimum: int) -> str | None:
    """Return the libLLVM package with the highest version from `minimum` up; None if there is none."""
    # Ubuntu 24.04 added "t64" to some names.
    candidates = [(int(match[1]), name) for name in names if (match := re.fullmatch(r"libllvm(\d+)(t64)?", name))]
    return max((entry for entry in candidates if entry[0] >= minimum), default=(0, None))[1]


def find_offered_package(minimum: int) -> str | None:
    """Return the newest libLLVM package from `minimum` up that apt offers; None if there is none."""
    answer = subprocess.run(["apt-cache", "pkgnames", "libllvm"], capture_output=True, text=True, check=True)
    return find_newest_package(answer.stdout.split(), minimum)


def get_root_command() -> list[str] | None:
    """Return the prefix that runs a command as root without a password; None if that is not allowed."""
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") and subprocess.run(["sudo", "-n", "true"], capture_output=True).returncode == 0:
        return ["sudo", "-n"]
    return None


def provide_llvm() -> None:
    """Ensure that there is a libLLVM for Dr.Jit, installing one with apt if necessary and allowed."""
    sys.path.insert(0, str(ROOT))
    from nerg_mi import llvm

    trouble = llvm.find_problem()
    if trouble is None or (llvm.PATH_VARIABLE not in os.environ and llvm.has_cuda()):
        return
    if llvm.PATH_VARIABLE in os.environ or not shutil.which("apt-get"):
        raise Stop(trouble)

    root = get_root_command()
    package = find_offered_package(llvm.MIN_VERSION)
    if package is None and root is not None:
        # A new machine may not have package lists yet.
        subprocess.run([*root, "apt-get", "update", "-qq"], check=True)
        package = find_offered_package(llvm.MIN_VERSION)
    if root is None:
        command = f"sudo apt-get install {package}" if package else "sudo apt-get update"
        raise Stop(
            f"LLVM {llvm.MIN_VERSION} or newer is missing, and its installation needs your password: run\n\n"
            f"    {command}\n\nand start this again."
        )
    if package is None:
        raise Stop(
            f"apt offers no libLLVM from version {llvm.MIN_VERSION} up: use a newer release of the system, "
            f"or set {llvm.PATH_VARIABLE} to such a libLLVM."
        )
    print(f"Installing {package} ...", flush=True)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    # A machine that has just started often updates itself in the background and locks the package database.
    waiting = ["-o", "DPkg::Lock::Timeout=600"]
    install = [*root, "apt-get", "install", "-y", "-qq", "--no-install-recommends", *waiting, package]
    if subprocess.run(install, env=environment).returncode != 0:
        # Lists of packages that are there, but older than the packages.
        subprocess.run([*root, "apt-get", "update", "-qq"], check=True)
        subprocess.run(install, env=environment, check=True)
    llvm.select_library()
    if llvm.find_problem() is not None:
        raise Stop(llvm.find_problem())


# ------------------------------------------------------------------------
#  Python
# ------------------------------------------------------------------------


def provide_venv() -> Path:
    """Ensure that there is a virtual environment with pip, and return its Python."""
    python = VENV / "bin" / "python"
    if python.exists() and subprocess.run([python, "-m", "pip", "--version"], capture_output=True).returncode == 0:
        return python
    if importlib.util.find_spec("ensurepip") is None or importlib.util.find_spec("venv") is None:
        raise Stop(
            "Python's venv module is missing: run\n\n    sudo apt-get install python3-venv\n\nand start this again."
        )
    print(f"Creating {VENV.name} ...", flush=True)
    subprocess.run([sys.executable, "-m", "venv", "--clear", VENV], check=True)
    return python


def provide_package(python: Path, extras: set[str]) -> None:
    """Ensure that the package is installed according to pyproject.toml, with at least these extras."""
    key = hashlib.sha256((ROOT / "pyproject.toml").read_bytes()).hexdigest()
    done = json.loads(STAMP.read_text()) if STAMP.exists() else {}
    if done.get("pyproject") == key and extras <= set(done["extras"]):
        return
    extras |= set(done.get("extras", ()))
    what = str(ROOT) + (f"[{','.join(sorted(extras))}]" if extras else "")
    print("Installing nerg_mi and its dependencies ...", flush=True)
    subprocess.run([python, "-m", "pip", "install", "-q", "--disable-pip-version-check", "-e", what], check=True)
    # Written last, so that an interrupted installation is repeated.
    STAMP.write_text(json.dumps({"pyproject": key, "extras": sorted(extras)}))


def main(extras: list[str]) -> int:
    try:
        if sys.version_info < (3, 10):  # noqa: UP036 (the user may not know the required version)
            version = sys.version.split()[0]
            raise Stop(
                f"Python 3.10 or newer is needed and this is {version}: use another one with make PYTHON=python3.12."
            )
        provide_llvm()
        provide_package(provide_venv(), set(extras))
    except Stop as stop:
        print(f"set-up: {stop}", file=sys.stderr)
        return 1
    except subprocess.CalledProcessError as error:
        # The command has printed its error.
        print(f"set-up: fix the reported error and run again: {' '.join(map(str, error.cmd))}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
