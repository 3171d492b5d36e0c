"""`nerg doctor` on this machine, and on one whose libLLVM is unusable."""

import os
import subprocess
import sys
from pathlib import Path

from nerg_mi import diagnosis, llvm


def doctor(**environment):
    return subprocess.run(
        [sys.executable, "-c", "import sys; sys.argv[1:] = ['doctor']\nfrom nerg_command import main; main()"],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )


def test01_this_machine():
    done = doctor()
    assert done.returncode == 0, done.stdout + done.stderr
    for word in ("libLLVM", "CUDA", "llvm_ad_rgb", "threads", *diagnosis.EXTRAS, "ready to render"):
        assert word in done.stdout


def test02_unusable_llvm(tmp_path):
    bad = tmp_path / "libLLVM-15.so.1"
    bad.touch()
    done = doctor(**{llvm.VARIABLE: str(bad)})
    assert "Traceback" not in done.stderr
    assert f"LLVM 15 ({bad}) cannot run the kernels of Dr.Jit" in done.stdout
    assert "llvm_ad_rgb" not in done.stdout
    if not llvm.has_cuda():
        assert done.returncode == 1 and "nothing can be rendered" in done.stdout


def test03_a_dying_backend_is_reported(monkeypatch):
    monkeypatch.setattr(
        diagnosis, "_TRIAL", "import os, sys; print('LLVM ERROR: no', file=sys.stderr, flush=True); os.abort()"
    )
    assert diagnosis.try_backend("llvm") == {"variants": [], "failed": {"llvm": "LLVM ERROR: no"}}


def test04_extras_by_their_names(monkeypatch):
    """The names are those of distributions, as pyproject.toml has them: that of scikit-image is not that of its
    module."""
    project = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    assert all(f'["{name}>=' in project for name in diagnosis.EXTRAS)
