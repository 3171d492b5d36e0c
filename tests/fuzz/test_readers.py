"""Damaged files: each reader gives a result or one sentence, within limits of time and memory, without side effects.

The cases are identical in each run; ``make fuzz`` tries twenty times as many.
"""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path

import pytest

from tests.fuzz import commands, semantic
from tests.fuzz.cases import draw_cases, make_inputs
from tests.fuzz.mutations import iter_damaged_documents
from tests.fuzz.readers import ALL, READERS
from tests.fuzz.watch import BREACHES, PYTHON_WORDS, Case, corpus, corpus_name, run_cases

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
            out.append(f"{corpus_name(case)}: {report.outcome}: {report.said}")
    return out


@pytest.mark.slow
def test_damaged_files_give_a_result_or_one_sentence(inputs):
    cases = list(draw_cases(READERS, inputs, CASES))
    assert len(cases) > 0.95 * CASES and {c.reader for c in cases} == {r.name for r in READERS}
    assert breaches(cases, inputs) == []


@pytest.mark.nightly
@pytest.mark.slow
def test_each_value_of_a_json_document_may_be_damaged(inputs):
    """Also those of the metadata in checkpoints."""
    cases = []
    for reader in READERS:
        for target, kinds in reader.targets.items():
            raw = (inputs / reader.name / target).read_bytes()
            if "json" in kinds:
                damaged = (json.dumps(d).encode() for d in iter_damaged_documents(json.loads(raw)))
            elif "safetensors" in kinds:
                size = int.from_bytes(raw[:8], "little")
                header = json.loads(raw[8 : 8 + size])
                damaged = map(
                    partial(_with_metadata, header, raw[8 + size :]),
                    iter_damaged_documents(json.loads(header["__metadata__"]["nerg"])),
                )
            else:
                continue
            cases += [Case(reader.name, target, data) for data in damaged]
    assert len(cases) > 3000
    names, wrong = [r.name for r in READERS], []
    for case, report in run_cases(cases, inputs, names):
        if report.outcome in BREACHES or PYTHON_WORDS.search(report.said):
            wrong.append((case.reader, case.data[-300:], report.outcome, report.said))
    assert wrong == []


def _with_metadata(header: dict, tensors: bytes, metadata: object) -> bytes:
    raw = json.dumps({**header, "__metadata__": {**header["__metadata__"], "nerg": json.dumps(metadata)}}).encode()
    return len(raw).to_bytes(8, "little") + raw + tensors


def test_cases_that_once_failed(inputs):
    """``tools/fuzz.py --keep`` adds them to the corpus. A sparse file of 64 GB is also tried for each file."""
    cases = [c for c in corpus(ALL) if c.reader in {r.name for r in READERS}]
    heads = [(r.name, target, (inputs / r.name / target).read_bytes()) for r in READERS for target in r.targets]
    large = [Case(name, target, start, "sparse") for name, target, data in heads for start in (b"", data)]
    assert len(cases) > 40 and breaches(cases + large, inputs) == []


@pytest.mark.nightly
@pytest.mark.slow
def test_breaches_are_detected(tmp_path):
    """The fuzzer itself detects a crash, a leftover file, executed code, excessive memory, and a foreign exception."""
    from tests.fuzz import misbehaving

    inputs = make_inputs(misbehaving.READERS, tmp_path)
    names = [r.name for r in misbehaving.READERS]
    cases = [Case(name, "a.bin", b"damaged") for name in names]
    breaches = [r.outcome for _, r in run_cases(cases, inputs, names, "tests.fuzz.misbehaving")]
    # Each reader is named by its breach.
    assert breaches == [name.partition(":")[0] for name in names]


@pytest.mark.slow
def test_contradictory_files_give_a_result_or_one_sentence(inputs):
    """Also FIFOs, devices, folders and links in place of files; ``tools/fuzz.py --kind semantic`` tries more."""
    assert breaches(list(semantic.draw_cases(READERS, inputs, 300)), inputs) == []


@pytest.mark.nightly
def test_pairs_of_options_give_a_result_or_one_sentence(tmp_path):
    lines = make_inputs(commands.READERS, tmp_path)
    cases = list(commands.draw_cases(commands.READERS, lines, 80))
    names = [r.name for r in commands.READERS]
    breaches = [(case.data, report) for case, report in run_cases(cases, lines, names, commands.__name__)]
    assert [(data, report) for data, report in breaches if report.outcome in BREACHES] == []
    # Most lines pass the checks of single options, which refuse with these words.
    single = re.compile("Usage:|must lie in|must be ")
    assert sum(single.search(report.said) is None for _, report in breaches) > 0.7 * len(breaches)
