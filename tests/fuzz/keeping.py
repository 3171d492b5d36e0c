"""The corpus: cases that once broke the contract, and some made by hand, which the tests replay."""

from __future__ import annotations

import hashlib
from pathlib import Path

from tests.fuzz.describe import Reader
from tests.fuzz.watch import Case

CORPUS = Path(__file__).with_name("corpus")


def kept(case: Case) -> str:
    """Name of the file in the corpus that holds ``case``; of one without data, what stands in its place."""
    return f"{_prefix(case.reader, case.target)}-{case.special or hashlib.sha256(case.data).hexdigest()[:12]}"


def _prefix(reader: str, target: str) -> str:
    return f"{reader}-{target}".replace("/", "_").replace(" ", "_")


def corpus(readers: list[Reader]) -> list[Case]:
    """All cases that are kept. Raises `KeyError` for a file of a reader that there is not."""
    known = {_prefix(r.name, t): (r.name, t) for r in readers for t in r.targets}
    return [Case(*known[p.name.rsplit("-", 1)[0]], p.read_bytes()) for p in sorted(CORPUS.iterdir())]
