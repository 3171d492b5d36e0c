"""Damage what every reader reads, many times, and count what comes of it.

    python -m tools.fuzz [--kind damage] [--cases 20000] [--start 1] [--only NAME] [--keep]
        [--update docs/explanation/robustness.md]

Each reader gets as many cases, the same for the same ``--start``. ``--kind damage``: bytes and structure, drawn by
hypothesis (tests/fuzz/mutations.py); ``semantic``: files that contradict themselves, and FIFOs, devices and links in
their place (tests/fuzz/semantic.py); ``commands``: pairs of options on command lines (tests/fuzz/commands.py).
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
from tests.fuzz import cases, commands, readers, semantic
from tests.fuzz.watch import BREACHES, CORPUS, kept, run_cases
from tools.page import table, update_table

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
KINDS = {
    "damage": (readers, cases.draw_cases),
    "semantic": (readers, semantic.draw_cases),
    "commands": (commands, commands.draw_cases),
}
"""Kind of cases -> the module of the readers that are tried, and what draws the cases."""

_GROUPS = (("other exception", "no sentence"), ("crash", "hang"), ("executed", "left a file"), ("slow", "memory"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kind", choices=KINDS, default="damage")
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
    module, draw_cases = KINDS[given.kind]
    tried = [r for r in module.READERS if given.only is None or given.only in r.name]
    outcomes, slowest, most, broken = defaultdict(Counter), Counter(), Counter(), 0
    interrupted = False
    with tempfile.TemporaryDirectory() as folder:
        inputs = cases.make_inputs(tried, Path(folder))
        drawn = draw_cases(tried, inputs, given.cases, given.start)
        try:
            for case, report in run_cases(drawn, inputs, [r.name for r in tried], module.__name__):
                name = case.reader
                outcomes[name][report.outcome] += 1
                slowest[name] = max(slowest[name], report.seconds)
                most[name] = max(most[name], report.memory)
                if report.outcome in BREACHES:
                    broken += 1
                    print(f"{kept(case)}: {report.outcome}: {report.said}", file=sys.stderr, flush=True)
                    if given.keep and not case.special:
                        (CORPUS / kept(case)).write_bytes(case.data)
        except KeyboardInterrupt:
            # What was tried until then is shown; a page must not take it for the whole.
            interrupted = True
    rows = [_row(r.name, outcomes[r.name], slowest[r.name], most[r.name]) for r in tried if outcomes[r.name]]
    rows.append(_row("all", sum(outcomes.values(), Counter()), max(slowest.values()), max(most.values())))
    update_table(None if interrupted else given.update, "Readers", table(HEAD, rows))
    if interrupted:
        return 130
    return 1 if broken else 0


def _row(name: str, count: Counter, seconds: float, memory: int) -> list:
    groups = [sum(count[o] for o in group) for group in _GROUPS]
    return [name, sum(count.values()), count["result"], count["refusal"], *groups, f"{seconds:.2f}", memory >> 20]


if __name__ == "__main__":
    sys.exit(main())
