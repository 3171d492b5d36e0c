"""A copy of the repository to make mistakes in, and the process that runs its tests."""

from __future__ import annotations

import compileall
import json
import os
import py_compile
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "mutants"
"""What is kept between runs: results, which test reaches which line, kernels. Not committed."""


class Bench:
    """A copy of the working tree in a temporary folder, with a worker in it. Use it in a `with`."""

    def __init__(self):
        self.tree = Path(tempfile.mkdtemp(prefix="mutants-")).resolve()
        listed = ["git", "-C", str(ROOT), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        for name in filter(None, subprocess.run(listed, capture_output=True, check=True).stdout.decode().split("\0")):
            source, target = ROOT / name, self.tree / name
            if source.is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)
        # pyproject.toml maps these two; the copy is not installed, so it holds them in place.
        for name in ("plugins", "scenes"):
            (self.tree / "nerg_mi" / name).symlink_to(Path("..") / name)
        # A mutant has the size and the second of its original: compiled files are told apart by contents.
        checked = py_compile.PycInvalidationMode.CHECKED_HASH
        for name in ("nerg_mi", "plugins", "scenes"):
            compileall.compile_dir(self.tree / name, quiet=2, invalidation_mode=checked)
        BUILD.mkdir(parents=True, exist_ok=True)
        self.log = BUILD / f"log-{os.getpid()}.txt"
        self.worker = None

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *error) -> None:
        self.stop()
        shutil.rmtree(self.tree, ignore_errors=True)
        self.log.unlink(missing_ok=True)

    def stop(self) -> None:
        """End the worker; the next run starts another, which imports what stands in the copy by then."""
        if self.worker is not None:
            self.worker.kill()
            self.worker.wait()
            self.worker = None

    def _start(self) -> None:
        environment = {
            **os.environ,
            "PYTHONPATH": str(self.tree),
            "DRJIT_CACHE_DIR": str(BUILD / "kernels"),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        environment.setdefault("NERG_DATA", str(ROOT.parent / "shared" / "data"))
        (BUILD / "kernels").mkdir(exist_ok=True)
        command = [sys.executable, str(Path(__file__).with_name("worker.py")), str(self.tree)]
        self.worker = subprocess.Popen(
            command, cwd=self.tree, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, tests: list[str], limit: float, record: Path | None = None) -> dict:
        """Run pytest on `tests` in a fresh process; the worker's answer."""
        if self.worker is None:
            self._start()
        request = {"tests": tests, "limit": limit, "log": str(self.log), "record": record and str(record)}
        print(json.dumps(request), file=self.worker.stdin, flush=True)
        line = self.worker.stdout.readline()
        if not line:
            raise SystemExit(f"the process that runs the tests has ended; its last words are in {self.log}")
        return json.loads(line)

    def source(self, file: str) -> str:
        return (self.tree / file).read_text(encoding="utf-8")

    def write(self, file: str, text: str) -> None:
        (self.tree / file).write_text(text, encoding="utf-8")
