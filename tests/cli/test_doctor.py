"""`nerg doctor` on this machine, and on one whose libLLVM is unusable."""

import os
import subprocess
import sys

from nerg_mi import diagnosis, llvm


def doctor(**environment):
    return subprocess.run(
        [sys.executable, "-c", "import sys; sys.argv[1:] = ['doctor']\nfrom nerg_mi.cli import main; main()"],
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
