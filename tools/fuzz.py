"""Fuzz every reader with damaged files and count the outcomes.

    python -m tools.fuzz [--kind damage] [--cases 20000] [--start 1] [--only NAME] [--keep]

Each reader gets the same number of cases, which depend only on ``--start``. ``--kind damage``: bytes and structure,
drawn by hypothesis (tests/fuzz/mutations.py); ``semantic``: inconsistent files, and FIFOs, devices and links in place
of files (tests/fuzz/semantic.py); ``commands``: pairs of options on command lines (tests/fuzz/commands.py). A child
process reads them under a memory limit, with an audit hook that records everything that is executed or written. The
contract is a result or a one-sentence error within 5 s and 1 GB, without executing anything or leaving files behind.
Violations are listed below the printed table and, with ``--keep``, stored in tests/fuzz/corpus, which the tests replay.
The exit code is 1 if there are violations.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from tests.fuzz import cases, commands, readers, semantic
from tests.fuzz.watch import BREACHES, CORPUS, corpus_name, run_cases
from tools.results import save

HEADER = (
    "reader",
    "cases",
    "results",
    "one-sentence errors",
    "other exceptions",
    "crashes, hangs",
    "executed, left files",
    "over 5 s or 1 GB",
    "maximum time, s",
    "maximum memory, MB",
)
KINDS = {
    "damage": (readers, cases.draw_cases),
    "semantic": (readers, semantic.draw_cases),
    "commands": (commands, commands.draw_cases),
}
"""Kind of cases -> the module with the tested readers, and the function that draws the cases."""

_GROUPS = (("other exception", "no sentence"), ("crash", "hang"), ("executed", "left a file"), ("slow", "memory"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kind", choices=KINDS, default="damage")
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--start", type=int, default=1, help="seed of the cases (default: 1); the tests use 0")
    parser.add_argument("--only", help="only readers whose name contains this")
    parser.add_argument("--keep", action="store_true", help="store violations in tests/fuzz/corpus")
    options = parser.parse_args()

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    module, draw_cases = KINDS[options.kind]
    readers_tested = [r for r in module.READERS if options.only is None or options.only in r.name]
    outcomes, max_seconds, max_memory, broken = defaultdict(Counter), Counter(), Counter(), 0
    interrupted = False
    with tempfile.TemporaryDirectory() as folder:
        inputs = cases.make_inputs(readers_tested, Path(folder))
        drawn = draw_cases(readers_tested, inputs, options.cases, options.start)
        try:
            for case, report in run_cases(drawn, inputs, [r.name for r in readers_tested], module.__name__):
                name = case.reader
                outcomes[name][report.outcome] += 1
                max_seconds[name] = max(max_seconds[name], report.seconds)
                max_memory[name] = max(max_memory[name], report.memory)
                if report.outcome in BREACHES:
                    broken += 1
                    print(f"{corpus_name(case)}: {report.outcome}: {report.said}", file=sys.stderr, flush=True)
                    if options.keep and not case.special:
                        (CORPUS / corpus_name(case)).write_bytes(case.data)
        except KeyboardInterrupt:
            # Show the readers tested so far.
            interrupted = True
    rows = [
        _make_row(r.name, outcomes[r.name], max_seconds[r.name], max_memory[r.name])
        for r in readers_tested
        if outcomes[r.name]
    ]
    rows.append(
        _make_row("all", sum(outcomes.values(), Counter()), max(max_seconds.values()), max(max_memory.values()))
    )
    save(f"fuzz-{options.kind}", HEADER, rows, str(options.start))
    if interrupted:
        return 130
    return 1 if broken else 0


def _make_row(name: str, count: Counter, seconds: float, memory: int) -> list:
    groups = [sum(count[o] for o in group) for group in _GROUPS]
    return [name, sum(count.values()), count["result"], count["refusal"], *groups, f"{seconds:.2f}", memory >> 20]


if __name__ == "__main__":
    sys.exit(main())
