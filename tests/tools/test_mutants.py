"""The sample of mutants, and the order in which tests judge one."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from tools import mutants
from tools.mutation import sites


def test_the_sample_is_of_the_size_that_it_says():
    for package, count in mutants.QUOTAS.items():
        chosen = mutants.sample(package)
        assert len({m.key for m in chosen}) == len(chosen) == count
    assert sum(mutants.QUOTAS.values()) == 400


def test_what_is_listed_as_equivalent_is_a_mutant_with_a_reason():
    """Of the source as it stands: an entry whose code has moved or changed says nothing any more."""
    listed = mutants.equivalents()
    files = {key.split(" :: ")[0] for key in listed}
    there = {m.key for f in files for m in sites.find(f, (mutants.ROOT / f).read_text(encoding="utf-8"))}
    assert set(listed) <= there and all(len(reason) > 20 for reason in listed.values())


def test_nearest_tests_judge_first():
    """What killed it last, then the file that mirrors its module, then the quickest."""
    (mutant,) = (m for m in sites.find("nerg_mi/field/mlp.py", "x = 1 < 2\n") if m.kind == "comparison")
    seconds = {
        "tests/a.py::slow": 9.0,
        "tests/a.py::quick": 0.1,
        "tests/field/test_mlp.py::near": 5.0,
        "tests/field/test_mlp_wide.py::near_too": 6.0,
        "tests/b.py::killer": 30.0,
    }
    reach = SimpleNamespace(tests={name: {"seconds": s} for name, s in seconds.items()})
    assert mutants.in_order(mutant, list(seconds), reach, "tests/b.py::killer") == [
        "tests/b.py::killer",
        "tests/field/test_mlp.py::near",
        "tests/field/test_mlp_wide.py::near_too",
        "tests/a.py::quick",
        "tests/a.py::slow",
    ]


def test_groups_of_tests_grow_up_to_the_bound():
    seconds = dict.fromkeys("abcdefgh", 2.0)
    assert list(mutants.batches(list("abcdefgh"), seconds, 13.0)) == [["a", "b"], ["c", "d", "e", "f"]]
    assert list(mutants.batches(["a"], {"a": 100.0}, 1.0)) == [["a"]]


class Told:
    """In the place of a bench: its tests end as they are told to, with a mutant and without."""

    def __init__(self, mutated: str, plain: str):
        self.log, self.source_of, self.now = "log", "x = 1\n", "x = 1\n"
        self.outcomes = {True: mutated, False: plain}

    def source(self, file):
        return self.source_of

    def write(self, file, text):
        self.now = text

    def run(self, tests, limit):
        return {"outcome": self.outcomes[self.now != self.source_of], "by": None, "seconds": 0.1}


def judged(bench):
    mutant = SimpleNamespace(file="a.py", place="a.py:1", apply=lambda source: "x = 2\n")
    seconds = {f"t.py::{name}": {"seconds": 2.0} for name in "abcd"}
    reach = SimpleNamespace(of=lambda m: list(seconds), tests=seconds, files=lambda tests: {})
    return mutants.judge(bench, reach, mutant, 45.0, None)["outcome"]


def test_a_mutant_for_which_tests_cannot_be_collected_is_killed():
    bench = Told("error", "passed")
    assert judged(bench) == "uncollected" and "uncollected" in mutants.KILLED and bench.now == bench.source_of


def test_tests_that_cannot_be_collected_without_a_mutant_judge_none():
    with pytest.raises(SystemExit, match="a.py:1"):
        judged(Told("none", "none"))
