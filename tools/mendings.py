"""Each mending undone, one at a time: whether the tests that look for its fault fail without it.

    make mendings                                        all of them
    python -m tools.mendings --only "One core"           those whose row begins so, or has these words in it
    python -m tools.mendings --update docs/trust.md      all of them, and their table on the page

`tools/mending/` lists what is held to, the changes of source that bring each fault back, and the tests that must then
fail. A change is made in a copy of the repository, never in the working tree. Each test runs without it, where it must
pass, and with it, where it must fail, hang or end the process; that it cannot be collected is no proof. Exit code 1
where one does otherwise.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from tools import page
from tools.mending import MENDINGS
from tools.mending.reversal import Mending, Reversal
from tools.mutation.bench import Bench

HEADING = "What is held to, and by which test"
COLUMNS = ["what is held to", "what is undone", "tests", "with it / without it"]

_LONGEST = 600
"""Seconds that a test may take as things are."""


@dataclass(frozen=True)
class Trial:
    """One ``test`` (node id) of one reversal: whether it ``passes`` as things are, and ``notices`` the reversal."""

    test: str
    passes: bool
    notices: bool


def passed(answer: dict) -> bool:
    """Whether a test ran and passed: one that is skipped for want of something proves nothing."""
    return answer["outcome"] == "passed" and answer["ran"] > 0


def noticed(answer: dict) -> bool:
    """Whether a test failed, hung or ended the process, and not only could not be collected."""
    return answer["outcome"] in ("hang", "crash") or (answer["outcome"] == "failed" and "::" in (answer["by"] or ""))


def why(log: Path) -> str:
    """The first line of what pytest says of a failure, from what the tests printed; empty where there is none."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    return next((line[1:].strip() for line in lines if line.startswith("E  ")), "")


def try_reversal(bench: Bench, reversal: Reversal, known: dict[str, dict]) -> list[Trial]:
    """Run the tests of ``reversal`` without it and with it. ``known``: answers without any reversal, which are added
    to."""
    for test in reversal.tests:
        if test not in known:
            known[test] = bench.run([test], _LONGEST)
    before = {change.file: bench.source(change.file) for change in reversal.changes}
    trials = []
    _write(bench, reversal.sources(bench.source))
    try:
        for test in reversal.tests:
            plain = known[test]
            answer = bench.run([test], 30 + 5 * plain["seconds"])
            trials.append(Trial(test, passed(plain), noticed(answer)))
            told = answer["outcome"] if passed(plain) else f"as things are {plain['outcome']}, {plain['ran']} ran"
            print(f"  {told:8} {plain['seconds']:6.1f} s {answer['seconds']:6.1f} s  {test}", flush=True)
            if why(bench.log):
                print(f"           {why(bench.log)[:110]}", flush=True)
    finally:
        _write(bench, before)
    return trials


def _write(bench: Bench, sources: dict[str, str]) -> None:
    for file, text in sources.items():
        bench.write(file, text)
    if any(Path(file).parent == Path("nerg_mi") for file in sources):
        # Importing the package loads some of these, and the worker has imported it before.
        bench.stop()


def row(mending: Mending, trials: list[Trial]) -> list[str]:
    """The row of the table: what the trials of the reversals of ``mending`` came to."""
    count = len(trials)
    share = lambda n: f"{n}" if n == count else f"{n} of {count}"
    passing, failing = sum(t.passes for t in trials), sum(t.notices for t in trials)
    return [
        mending.held,
        "; ".join(r.undone for r in mending.reversals),
        ", ".join(f"`{t}`" for t in mending.tests),
        f"{share(passing)} pass / {share(failing)} fail",
    ]


def run(mendings: list[Mending], bench: Bench) -> tuple[list[list[str]], list[str]]:
    """The rows of the table, and a sentence on each test that does not prove its mending."""
    rows, wrong, known = [], [], {}
    for k, mending in enumerate(mendings, 1):
        print(f"{k}/{len(mendings)} {mending.held}", flush=True)
        trials = []
        for reversal in mending.reversals:
            print(f" without it: {reversal.undone}", flush=True)
            found = try_reversal(bench, reversal, known)
            trials += found
            wrong += [
                f"{t.test} does not pass as things are, or is skipped; give it what it asks for first."
                for t in found
                if not t.passes
            ]
            wrong += [
                f'{t.test} does not notice "{reversal.undone}"; make it look for that.' for t in found if not t.notices
            ]
        rows.append(row(mending, trials))
    return rows, list(dict.fromkeys(wrong))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="WORDS", default="", help="only the rows with these words")
    parser.add_argument("--update", metavar="PAGE", help="put the table on this page")
    options = parser.parse_args(arguments)
    if options.only and options.update:
        parser.error("--only leaves rows out and --update writes the whole table; leave out one of the two")
    chosen = [m for m in MENDINGS if options.only.lower() in m.held.lower()]
    if not chosen:
        parser.error(f'no row has "{options.only}" in what is held to; see docs/trust.md for the rows')
    with Bench() as bench:
        rows, wrong = run(chosen, bench)
    page.update(options.update, HEADING, page.table(COLUMNS, rows))
    print(*wrong, sep="\n", file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
