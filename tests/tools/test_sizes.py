"""The tool that measures what memory pictures take divides them as the command does."""

from __future__ import annotations

from tools import sizes


def test_a_smaller_budget_means_more_bands():
    one, many = (sizes.measure(48, 32, memory) for memory in (1.0, 1e-3))
    assert one["bands"] == 1 and many["bands"] == 32
    assert one["peak"] > 50e6 and one["file"] > 48 * 32 * 7 and one["seconds"] > 0
