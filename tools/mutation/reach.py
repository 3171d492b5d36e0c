"""Which tests execute a line: recorded once for each file of tests, and again where that file has changed.

The record keeps the sources that it was made with; a line of today's source is sought where it stood then, so that a
change elsewhere in a file costs no new record.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import os
from pathlib import Path

from .bench import BUILD, Bench
from .sites import Mutant

_FOLDER = BUILD / "reach"
_LONGEST = 1800  # seconds for one file of tests


def digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def test_files(tree: Path) -> list[str]:
    return sorted(str(p.relative_to(tree)) for p in (tree / "tests").rglob("test_*.py") if "fuzz" not in p.parts)


class Reach:
    """`tests`: outcome and seconds of each test without any mistake; `of(mutant)`: which of them reach it."""

    def __init__(self, bench: Bench, prefixes: tuple[str, ...] = ("tests/",)):
        self.bench, self.records = bench, {}
        self._moves: dict[tuple[str, str], dict[int, int]] = {}
        for file in (f for f in test_files(bench.tree) if f.startswith(prefixes)):
            path = _FOLDER / (file.replace("/", "-") + ".json")
            stamp = digest(bench.source(file))
            if not path.exists() or json.loads(path.read_text())["stamp"] != stamp:
                self._record(bench, file, path, stamp)
            self.records[file] = json.loads(path.read_text())
        self.tests = {name: entry for r in self.records.values() for name, entry in r["tests"].items()}

    def _record(self, bench: Bench, file: str, path: Path, stamp: str) -> None:
        (_FOLDER / "sources").mkdir(parents=True, exist_ok=True)
        raw = BUILD / f"record-{os.getpid()}.json"
        raw.unlink(missing_ok=True)
        answer = bench.run([file], _LONGEST, raw)
        if not raw.exists():
            raise SystemExit(f"{file} did not come to its end ({answer['outcome']}): see {bench.log}")
        record = json.loads(raw.read_text())
        raw.unlink()
        record["stamp"], record["sources"] = stamp, {}
        for source in record["lines"]:
            text = bench.source(source)
            record["sources"][source] = digest(text)
            (_FOLDER / "sources" / digest(text)).write_text(text, encoding="utf-8")
        path.write_text(json.dumps(record))
        bad = [name for name, entry in record["tests"].items() if entry["outcome"] == "failed"]
        print(f"recorded {file}: {len(record['tests'])} tests, {answer['seconds']:.0f} s", flush=True)
        for name in bad:
            print(f"  fails without any mistake, and judges none: {name}", flush=True)

    def of(self, mutant: Mutant) -> list[str]:
        """The tests that reach the mutant's lines; of what runs at import alone, those that reach its file."""
        source = mutant.file.replace("nerg_mi/plugins", "plugins")
        if not mutant.called:
            # Whichever test came first has run it, when it imported the file.
            return self._reaching(source, None)
        lines = range(mutant.line, mutant.last + 1)
        exact = self._reaching(source, set(lines))
        return exact or self._reaching(source, {mutant.statement}) or self._reaching(source, None)

    def _reaching(self, source: str, lines: set[int] | None) -> list[str]:
        found = set()
        for record in self.records.values():
            if source not in record["lines"]:
                continue
            then = self._moved(source, record["sources"][source])
            wanted = None if lines is None else {then[k] for k in lines if k in then}
            for context, executed in record["lines"][source].items():
                if wanted is None or not wanted.isdisjoint(executed):
                    found.update([context] if "::" in context else record["tests"])
        return sorted(t for t in found if self.tests.get(t, {}).get("outcome") == "passed")

    def files(self, tests: list[str]) -> dict[str, str]:
        """The files of these tests, with the digests of their contents."""
        return {file: self.records[file]["stamp"] for file in sorted({t.split("::")[0] for t in tests})}

    def _moved(self, source: str, stamp: str) -> dict[int, int]:
        """Line of today's source -> its line in the source that was recorded."""
        if (source, stamp) not in self._moves:
            now = self.bench.source(source).splitlines()
            then = (_FOLDER / "sources" / stamp).read_text(encoding="utf-8").splitlines()
            blocks = difflib.SequenceMatcher(None, now, then, autojunk=False).get_matching_blocks()
            self._moves[source, stamp] = {b.a + k + 1: b.b + k + 1 for b in blocks for k in range(b.size)}
        return self._moves[source, stamp]
