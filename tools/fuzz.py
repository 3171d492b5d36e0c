"""Damage what every reader reads, many times, and count what comes of it.

    python -m tools.fuzz [--cases 20000] [--start 1] [--only NAME] [--keep] [--update docs/trust.md]

Each reader gets as many cases, drawn by hypothesis (see tests/fuzz/mutations.py) and the same for the same ``--start``.
A child process reads them under a limit of memory, with an audit hook that sees whatever is run or written. Printed is
a table; whatever breaks the contract (a result, or one sentence; in 5 s and 1 GB; nothing run, nothing left behind) is
listed below it, and with ``--keep`` put into tests/fuzz/corpus, which the tests replay. Exit code 1 if anything broke
it.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from tests.fuzz.cases import draw_cases, make_inputs
from tests.fuzz.keeping import CORPUS, kept
from tests.fuzz.readers import READERS
from tests.fuzz.watch import BREACHES, run_cases
from tools.page import table, update

HEAD = (
    "reader",
    "cases",
    "results",
    "refusals in one sentence",
    "other exceptions",
    "crashes, hangs",
    "run, left behind",
    "over 5 s or 1 GB",
    "slowest, s",
    "most memory, MB",
)
_GROUPS = (("other exception", "no sentence"), ("crash", "hang"), ("executed", "left a file"), ("slow", "memory"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument(
        "--start", type=int, default=1, help="another number draws other cases; the tests draw those of 0"
    )
    parser.add_argument("--only", help="readers whose name holds this")
    parser.add_argument("--keep", action="store_true", help="put what breaks the contract into tests/fuzz/corpus")
    parser.add_argument("--update", type=Path, help="page whose table below the heading Readers is exchanged")
    given = parser.parse_args()

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    readers = [r for r in READERS if given.only is None or given.only in r.name]
    outcomes, slowest, most, broken = defaultdict(Counter), Counter(), Counter(), []
    interrupted = False
    with tempfile.TemporaryDirectory() as folder:
        inputs = make_inputs(readers, Path(folder))
        cases = draw_cases(readers, inputs, given.cases, given.start)
        try:
            for case, report in run_cases(cases, inputs, [r.name for r in readers]):
                name = case.reader
                outcomes[name][report.outcome] += 1
                slowest[name] = max(slowest[name], report.seconds)
                most[name] = max(most[name], report.memory)
                if report.outcome in BREACHES:
                    broken.append((case, report))
                    if given.keep:
                        (CORPUS / kept(case)).write_bytes(case.data)
        except KeyboardInterrupt:
            # What was tried until then is shown; a page must not take it for the whole.
            interrupted = True
    rows = [_row(r.name, outcomes[r.name], slowest[r.name], most[r.name]) for r in readers if outcomes[r.name]]
    rows.append(_row("all", sum(outcomes.values(), Counter()), max(slowest.values()), max(most.values())))
    update(None if interrupted else given.update, "Readers", table(HEAD, rows))
    for case, report in broken:
        print(f"{kept(case)}: {report.outcome}: {report.said}", file=sys.stderr)
    if interrupted:
        return 130
    return 1 if broken else 0


def _row(name: str, count: Counter, seconds: float, memory: int) -> list:
    groups = [sum(count[o] for o in group) for group in _GROUPS]
    return [name, sum(count.values()), count["result"], count["refusal"], *groups, f"{seconds:.2f}", memory >> 20]


if __name__ == "__main__":
    sys.exit(main())
