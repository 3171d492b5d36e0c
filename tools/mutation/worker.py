"""A process that has imported everything but the code under test, and forks a child for every run of tests.

    python worker.py TREE

runs in TREE, a copy of the repository, and answers each line of JSON on its input with one on its output. A request:
`tests` (pytest's arguments), `limit` (seconds), `log` (a file for what the tests print), `record` (a file to write
into which tests execute which lines, or null). An answer: `outcome` ("passed", "failed", "hang", "crash"), `by` (what
failed first), `ran` (how many tests were not skipped), `seconds`. A child in which a module of the project came from
another place than TREE ends the worker.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import resource
import signal
import sys
import time
from pathlib import Path

STRAY = 90
"""Exit status of a child that has tested another tree."""

_MEMORY = 12 << 30  # a mutant must not take the machine with it
_TICK = 0.05

_SHARED = (
    "drjit",
    "drjit.nn",
    "drjit.opt",
    "mitsuba",
    "pytest",
    "hypothesis",
    "hypothesis.extra.pytestplugin",
    "matplotlib.pyplot",
    "rich.console",
    "safetensors.numpy",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.spatial.transform",
    "scipy.special",
    "scipy.stats",
    "trimesh",
    "typer.testing",
)
"""What tests and the code under test import, and mutants do not change."""


class Watch:
    """pytest's plugin in a child: what failed first, how long each test took, and which test executes which lines."""

    def __init__(self, tree: Path, coverage):
        self.tree, self.coverage = tree, coverage
        self.first: str | None = None
        self.tests: dict[str, dict] = {}

    def pytest_runtest_setup(self, item):
        # What a fixture of a whole file executes serves all of its tests, so it is written down for the file.
        self._context(item.nodeid.split("::")[0])

    def pytest_runtest_call(self, item):
        self._context(item.nodeid)

    def pytest_runtest_teardown(self, item):
        self._context("")

    def _context(self, name: str) -> None:
        if self.coverage is not None:
            self.coverage.switch_context(name)

    def pytest_runtest_logreport(self, report):
        entry = self.tests.setdefault(report.nodeid, {"seconds": 0.0, "outcome": "passed"})
        entry["seconds"] = round(entry["seconds"] + report.duration, 3)
        if report.outcome != "passed":
            entry["outcome"] = report.outcome
        if report.failed and self.first is None:
            self.first = report.nodeid

    def pytest_collectreport(self, report):
        if report.failed and self.first is None:
            self.first = report.nodeid

    @property
    def ran(self) -> int:
        """How many tests were not skipped."""
        return sum(entry["outcome"] != "skipped" for entry in self.tests.values())

    def lines(self) -> dict[str, dict[str, list[int]]]:
        """Source file -> test (or file of tests) -> lines."""
        data = self.coverage.get_data()
        found: dict[str, dict[str, list[int]]] = {}
        for path in data.measured_files():
            by_line = data.contexts_by_lineno(path)
            entry = found.setdefault(str(Path(path).resolve().relative_to(self.tree)), {})
            for line, contexts in by_line.items():
                for context in filter(None, contexts):
                    entry.setdefault(context, []).append(line)
        return found


def stray_modules(tree: Path) -> list[str]:
    """Modules of the project that were not loaded from `tree`."""
    return [
        f"{name} ({module.__file__})"
        for name, module in list(sys.modules.items())
        if name.split(".")[0] == "nerg_mi"
        and getattr(module, "__file__", None)
        and not Path(module.__file__).resolve().is_relative_to(tree)
    ]


def run_tests(tree: Path, request: dict, answer: int) -> int:
    """In the child: run the tests, write the answer to the file descriptor `answer`, and give the exit status."""
    os.setsid()
    log = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(log, 1)
    os.dup2(log, 2)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    import pytest

    coverage = None
    if request.get("record"):
        from coverage import Coverage

        coverage = Coverage(data_file=None, config_file=False, include=[f"{tree}/nerg_mi/*", f"{tree}/plugins/*"])
        coverage.start()
    watch = Watch(tree, coverage)
    stop = [] if request.get("record") else ["-x"]
    quiet = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # of what is loaded already
    status = pytest.main(
        [*stop, *quiet, "-q", "-p", "no:cacheprovider", "--no-header", *request["tests"]], plugins=[watch]
    )
    if coverage is not None:
        coverage.stop()
        Path(request["record"]).write_text(json.dumps({"tests": watch.tests, "lines": watch.lines()}))
    stray = stray_modules(tree)
    if stray:
        print("not from the tree under test:", *stray, sep="\n")
        return STRAY
    os.write(answer, json.dumps({"status": int(status), "by": watch.first, "ran": watch.ran}).encode())
    return 0


def attend(child: int, limit: float) -> tuple[int | None, float]:
    """The child's exit status, None where it had to be killed, and the seconds it took.

    Seconds in which this process itself was suspended do not count.
    """
    spent, last = 0.0, time.monotonic()
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        now = time.monotonic()
        spent += min(now - last, 4 * _TICK)
        last = now
        if done:
            return os.waitstatus_to_exitcode(status), spent
        if spent > limit:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None, spent
        time.sleep(_TICK)


def serve(tree: Path, requests, answers) -> None:
    for line in requests:
        request = json.loads(line)
        receive, send = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(receive)
            code = 1
            try:
                code = run_tests(tree, request, send)
            finally:
                sys.stdout.flush()
                os._exit(code)
        os.close(send)
        status, seconds = attend(child, request["limit"])
        with os.fdopen(receive, "rb") as pipe:
            text = pipe.read()
        try:
            os.killpg(child, signal.SIGKILL)  # what a test has started and left behind
        except ProcessLookupError:
            pass
        if status == STRAY:
            raise SystemExit(f"tests ran on another tree: see {request['log']}")
        if status is None:
            answer = {"outcome": "hang", "by": None, "ran": 0}
        elif status != 0 or not text:
            answer = {"outcome": "crash", "by": None, "ran": 0}
        else:
            told = json.loads(text)
            # A file that cannot be imported any more leaves pytest without the test that it was told to run.
            outcome = {0: "passed", 1: "failed", 2: "failed", 5: "none"}.get(
                told["status"], "failed" if told["by"] else "error"
            )
            answer = {"outcome": outcome, "by": told["by"], "ran": told["ran"]}
        print(json.dumps({**answer, "seconds": round(seconds, 2)}), file=answers, flush=True)


def main(tree: Path) -> None:
    os.chdir(tree)
    # Loaded once for all children. No variant of Mitsuba is chosen: that would load the code under test, and threads.
    importlib.import_module("nerg_mi")  # chooses the libLLVM, so it comes first
    for name in _SHARED:
        if importlib.util.find_spec(name.split(".")[0]) is not None:
            importlib.import_module(name)

    answers = os.fdopen(os.dup(1), "w")
    serve(tree, sys.stdin, answers)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
