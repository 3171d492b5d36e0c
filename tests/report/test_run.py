"""A run judges its evaluations."""

from __future__ import annotations

from tests.report.made import bare, whole


def test_verdicts():
    ((results, verdict),) = whole().verdicts
    assert results.split == "both" and verdict.grade == "use"
    assert bare().verdicts == [] and bare().provenance == {}
