"""Damaged files: every reader gives a result or one sentence, in time and memory, and nothing is run or left behind.

The cases are the same in every run; ``make fuzz`` tries twenty times as many.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.fuzz import commands, semantic
from tests.fuzz.cases import draw_cases, make_inputs
from tests.fuzz.readers import ALL, READERS
from tests.fuzz.watch import BREACHES, Case, corpus, kept, run_cases

CASES = 750


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return make_inputs(READERS, tmp_path_factory.mktemp("fuzz") / "inputs")


def breaches(cases: list[Case], inputs: Path) -> list[str]:
    names, out = [r.name for r in READERS], []
    for case, report in run_cases(cases, inputs, names):
        if report.outcome in BREACHES:
            out.append(f"{kept(case)}: {report.outcome}: {report.said}")
    return out


@pytest.mark.slow
def test_damaged_files_give_a_result_or_one_sentence(inputs):
    cases = list(draw_cases(READERS, inputs, CASES))
    assert len(cases) > 0.95 * CASES and {c.reader for c in cases} == {r.name for r in READERS}
    assert breaches(cases, inputs) == []


def test_cases_that_once_failed(inputs):
    """``tools/fuzz.py --keep`` puts them into the corpus. Each file was also one of 64 GB once."""
    cases = [c for c in corpus(ALL) if c.reader in {r.name for r in READERS}]
    heads = [(r.name, target, (inputs / r.name / target).read_bytes()) for r in READERS for target in r.targets]
    large = [Case(name, target, start, "sparse") for name, target, data in heads for start in (b"", data)]
    assert len(cases) > 40 and breaches(cases + large, inputs) == []


@pytest.mark.nightly
@pytest.mark.slow
def test_the_contract_is_seen_to_be_broken(tmp_path):
    """The watch itself: a crash, a file left behind, something run, memory, a foreign exception."""
    from tests.fuzz import misbehaving

    inputs = make_inputs(misbehaving.READERS, tmp_path)
    names = [r.name for r in misbehaving.READERS]
    cases = [Case(name, "a.bin", b"damaged") for name in names]
    found = [r.outcome for _, r in run_cases(cases, inputs, names, "tests.fuzz.misbehaving")]
    # Each is called as what it does.
    assert found == [name.partition(":")[0] for name in names]


@pytest.mark.slow
def test_files_that_contradict_themselves_give_a_result_or_one_sentence(inputs):
    """Also FIFOs, devices, folders and links in their place; ``tools/fuzz.py --kind semantic`` tries more."""
    assert breaches(list(semantic.draw_cases(READERS, inputs, 300)), inputs) == []


@pytest.mark.nightly
def test_pairs_of_options_give_a_result_or_one_sentence(tmp_path):
    lines = make_inputs(commands.READERS, tmp_path)
    cases = list(commands.draw_cases(commands.READERS, lines, 80))
    names = [r.name for r in commands.READERS]
    found = [(case.data, report) for case, report in run_cases(cases, lines, names, commands.__name__)]
    assert [(data, report) for data, report in found if report.outcome in BREACHES] == []
    # Most get past the checks of single options, which refuse in these words.
    single = re.compile("Usage:|must lie in|must be ")
    assert sum(single.search(report.said) is None for _, report in found) > 0.7 * len(found)
