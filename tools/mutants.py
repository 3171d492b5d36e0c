"""Small mistakes put into the source, one at a time: which of them the tests notice.

    make mutants                                      the fixed sample of 400, resumed where it stopped
    python -m tools.mutants --package nerg_mi/field   those of one package
    python -m tools.mutants --only FILE:LINE[:KIND]   every mutant of a line, in the sample or not
    python -m tools.mutants --survivors               read those that survived; nothing is run
    python -m tools.mutants --update docs/trust.md    put the table of all results on the page; nothing is run

A mutant is made in a copy of the repository, never in the working tree, and judged by the tests that execute its line:
those of the file of tests that mirrors its module first, then the others, the quickest first, up to a bound of recorded
seconds. It is killed where a test fails, hangs or crashes. Nothing is judged twice as long as its file and the files of
its tests stay as they are; what killed a mutant is tried first when it must be judged again.

The sample: the mutants of each package in the order of a digest of the seed and of what they change, as many as
its share of the lines. So it stays the same when lines move, and where code goes away only its mutants are replaced.

`mutants_equivalent.json` lists the mutants of the sample that cannot be told from the original, each with the reason.
They are counted apart, and the share is given with and without them.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import sys
from pathlib import Path

from tools import page
from tools.mirror import is_test_of
from tools.mutation.bench import BUILD, ROOT, Bench
from tools.mutation.reach import Reach, digest
from tools.mutation.sites import Mutant, compiles, find

SEED = "nerg"
QUOTAS = {
    "nerg_mi/maths": 10,
    "nerg_mi/field": 41,
    "nerg_mi/transport": 62,
    "nerg_mi/rays": 74,
    "nerg_mi/density": 25,
    "nerg_mi/training": 104,
    "nerg_mi/evaluation": 68,
    "plugins/nerg.py": 16,
}
"""Mutants of the sample, by package: 400 in proportion to the lines."""

RESULTS = BUILD / "results.json"
EQUIVALENT = ROOT / "tools" / "mutants_equivalent.json"
UNRUN = ("error", "none")
"""What pytest answers where tests cannot be collected, as where a mutant takes away what they are made of."""

_LONGEST = 600  # seconds
KILLED = ("failed", "hang", "crash", "uncollected")


def mutants_of(package: str, tree: Path) -> list[Mutant]:
    path = tree / package
    files = [path] if path.is_file() else sorted(path.rglob("*.py"))
    return [m for f in files for m in find(str(f.relative_to(tree)), f.read_text(encoding="utf-8"))]


def sample(package: str, tree: Path = ROOT) -> list[Mutant]:
    """The package's part of the sample in the sources of ``tree``, in the order of the lines."""
    candidates = mutants_of(package, tree)
    ranked = sorted(candidates, key=lambda m: hashlib.sha256(f"{SEED} {m.key}".encode()).digest())
    chosen = []
    for mutant in ranked:
        if len(chosen) == QUOTAS[package]:
            break
        if compiles(mutant, (tree / mutant.file).read_text(encoding="utf-8")):
            chosen.append(mutant)
    return sorted(chosen, key=lambda m: (m.file, m.start, m.kind))


# ------------------------------------------------------------------------
#  Judging
# ------------------------------------------------------------------------


def in_order(mutant: Mutant, tests: list[str], reach: Reach, first: str | None) -> list[str]:
    """The tests, nearest first: the last killer, the mirroring file, then the quickest."""

    def rank(test: str) -> tuple[bool, bool, float]:
        return test != first, not is_test_of(test, mutant.file), reach.tests[test]["seconds"]

    return sorted(tests, key=rank)


def batches(tests: list[str], seconds: dict[str, float], bound: float):
    """Ever longer groups of tests, until their seconds reach `bound`; at least one test."""
    spent, group, size = 0.0, [], 3.0
    for test in tests:
        if spent and spent + seconds[test] > bound:
            break
        group.append(test)
        spent += seconds[test]
        if sum(seconds[t] for t in group) >= size:
            yield group
            group, size = [], 3 * size
    if group:
        yield group


def judge(bench: Bench, reach: Reach, mutant: Mutant, bound: float, first: str | None) -> dict:
    """Run the tests on one mutant; the entry for the results."""
    source = bench.source(mutant.file)
    tests = in_order(mutant, reach.of(mutant), reach, first)
    seconds = {t: max(reach.tests[t]["seconds"], 0.01) for t in tests}
    entry = {"outcome": "unreached", "by": None, "seconds": 0.0, "tests": 0, "source": digest(source)}
    used: list[str] = []
    bench.write(mutant.file, mutant.apply(source))
    try:
        for group in batches(tests, seconds, bound):
            # Files one after the other: each sets its own things up.
            group.sort(key=lambda t: (t != first, t.split("::")[0]))
            used += group
            answer = bench.run(group, 45 + 10 * sum(seconds[t] for t in group))
            entry["seconds"] = round(entry["seconds"] + answer["seconds"], 2)
            entry.update(outcome=answer["outcome"], by=answer["by"])
            if answer["outcome"] in UNRUN:
                _blame(bench, mutant, source, group)
                entry.update(outcome="uncollected", by=None)
            if entry["outcome"] in KILLED:
                break
    finally:
        bench.write(mutant.file, source)
    entry["tests"] = len(used)
    entry["left"] = len(tests) - len(used)
    entry["files"] = reach.files([entry["by"]] if entry["by"] in reach.tests else tests)
    return entry


def _blame(bench: Bench, mutant: Mutant, source: str, tests: list[str]) -> None:
    """Make sure that it is the mutant for which pytest cannot run ``tests``: without it they run. Raises
    ``SystemExit`` where they do not."""
    bench.write(mutant.file, source)
    if bench.run(tests, _LONGEST)["outcome"] in UNRUN:
        raise SystemExit(f"pytest could not run the tests of {mutant.place}: see {bench.log}")


def is_known(entry: dict | None, mutant: Mutant, reach: Reach, bound: float) -> bool:
    """Whether the entry still holds: same source, same tests, and a survivor had as much time."""
    if entry is None or entry["source"] != digest(reach.bench.source(mutant.file)):
        return False
    if entry["outcome"] in KILLED:
        return all(reach.records.get(f, {}).get("stamp") == stamp for f, stamp in entry["files"].items())
    return entry["files"] == reach.files(reach.of(mutant)) and entry.get("bound", 0) >= bound


def load() -> dict[str, dict]:
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def keep(key: str, entry: dict) -> None:
    """Add one entry to the results on the disk, where another run may have added its own since."""
    with open(RESULTS.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        known = load()
        before = known.get(key, {})
        if before.get("outcome") in KILLED and entry["outcome"] not in KILLED and before["source"] == entry["source"]:
            return  # by other tests than these
        draft = RESULTS.with_suffix(".part")
        draft.write_text(json.dumps({**known, key: entry}, indent=1))
        draft.replace(RESULTS)


# ------------------------------------------------------------------------
#  Reporting
# ------------------------------------------------------------------------


def equivalents() -> dict[str, str]:
    """Key of a mutant -> why nothing can tell it from the original."""
    return json.loads(EQUIVALENT.read_text(encoding="utf-8")) if EQUIVALENT.exists() else {}


def summary(results: dict[str, dict]) -> str:
    same, rows, sums = equivalents(), [], [0, 0, 0, 0]
    for package in QUOTAS:
        entries = [(m.key, results.get(m.key)) for m in sample(package)]
        judged = [(key, e) for key, e in entries if e is not None]
        killed = sum(e["outcome"] in KILLED for _, e in judged)
        alike = sum(e["outcome"] not in KILLED and key in same for key, e in judged)
        row = [len(judged), killed, len(judged) - killed - alike, alike]
        sums = [a + b for a, b in zip(sums, row)]
        rows.append([f"`{package}`", *row, _share(row), _share(row, apart=True)])
    rows.append(["all", *sums, _share(sums), _share(sums, apart=True)])
    head = ["package", "mutants", "killed", "survived", "equivalent", "killed of all", "killed of those that differ"]
    return page.table(head, rows)


def _share(row: list[int], apart: bool = False) -> str:
    count = row[0] - (row[3] if apart else 0)
    return f"{100 * row[1] / count:.1f} %" if count else ""


def describe(mutant: Mutant) -> str:
    before, after = " ".join(mutant.before.split()), " ".join(mutant.after.split())
    return f"{mutant.place} in {mutant.function}\n    - {before}\n    + {after}"


def show_survivors(results: dict[str, dict], packages: list[str]) -> None:
    same = equivalents()
    for package in packages:
        for mutant in sample(package):
            entry = results.get(mutant.key)
            if entry is None or entry["outcome"] in KILLED:
                continue
            print(describe(mutant))
            print(f"    {entry['outcome']}: {entry['tests']} tests passed, {entry.get('left', 0)} left")
            if mutant.key in same:
                print(f"    equivalent: {same[mutant.key]}")
            else:
                print(f"    {mutant.key}")
            print()


# ------------------------------------------------------------------------
#  Command
# ------------------------------------------------------------------------


def chosen_by(place: str, tree: Path) -> list[Mutant]:
    """The mutants that FILE:LINE or FILE:LINE:KIND names."""
    file, line, *kind = place.split(":")
    source = (tree / file).read_text(encoding="utf-8")
    found = [m for m in find(file, source) if m.line == int(line) and (not kind or m.kind == kind[0])]
    return [m for m in found if compiles(m, source)]


def run(packages: list[str], results: dict[str, dict], arguments) -> None:
    with Bench() as bench:
        reach = Reach(bench, tuple(arguments.tests or ["tests/"]))
        if arguments.only:
            mutants = [m for place in arguments.only for m in chosen_by(place, bench.tree)]
        else:
            mutants = [m for p in packages for m in sample(p, bench.tree)]
        todo = [m for m in mutants if arguments.again or not is_known(results.get(m.key), m, reach, arguments.bound)]
        if arguments.survived:
            todo = [m for m in todo if (results.get(m.key) or {}).get("outcome") not in KILLED]
        print(f"{len(mutants)} mutants, {len(todo)} of them to be judged", flush=True)
        for k, mutant in enumerate(todo, 1):
            before = results.get(mutant.key) or {}
            first = before.get("by") if before.get("by") in reach.of(mutant) else None
            entry = judge(bench, reach, mutant, arguments.bound, first)
            results[mutant.key] = {**entry, "bound": arguments.bound}
            keep(mutant.key, results[mutant.key])
            outcome = "survived" if entry["outcome"] not in KILLED else entry["outcome"]
            print(
                f"{k}/{len(todo)} {outcome:8} {entry['seconds']:6.1f} s  {mutant.place}  {entry['by'] or ''}",
                flush=True,
            )
            if arguments.only:
                print(describe(mutant), flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--package", action="append", choices=list(QUOTAS), metavar="FOLDER", help="only this part of the sample"
    )
    parser.add_argument("--only", action="append", metavar="FILE:LINE[:KIND]", help="every mutant of this line")
    parser.add_argument("--survivors", action="store_true", help="print the survivors of the sample, run nothing")
    parser.add_argument("--update", metavar="PAGE", help="put the table on this page, run nothing")
    parser.add_argument(
        "--survived", action="store_true", help="judge only what was not killed when it was last judged"
    )
    parser.add_argument("--again", action="store_true", help="judge also what is known")
    parser.add_argument(
        "--tests", action="append", metavar="PREFIX", help="judge by the files of tests that begin so (default: all)"
    )
    parser.add_argument("--bound", type=float, default=45.0, help="seconds of tests at most for a mutant (default: 45)")
    arguments = parser.parse_args()
    packages = arguments.package or list(QUOTAS)
    results = load()
    if arguments.survivors:
        show_survivors(results, packages)
        return 0
    if arguments.update is None:
        run(packages, results, arguments)
    if not arguments.only:
        page.update(arguments.update, "Mutants", summary(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
