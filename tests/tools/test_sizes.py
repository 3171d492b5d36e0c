"""The tool that measures what memory pictures take divides them as the command does."""

from __future__ import annotations

import pytest

from tools import sizes


@pytest.mark.nightly
def test_a_smaller_budget_means_more_bands():
    one, many = (sizes.measure(48, 32, memory) for memory in (1.0, 1e-3))
    assert one["bands"] == 1 and many["bands"] == 32
    assert one["peak"] > 50e6 and one["file"] > 48 * 32 * 7 and one["seconds"] > 0


def test_only_the_sizes_that_were_asked_for(monkeypatch, capsys):
    monkeypatch.setattr(sizes, "row", lambda name, *more: (name, *map(str, more), ""))
    sizes.main(["--only", "4K,1080p", "--memory", "2"])
    head, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert head.count("|") == 6 and [r.split("|")[1].strip() for r in rows] == ["4K", "1080p"]
    with pytest.raises(SystemExit):
        sizes.main(["--only", "16K"])
    assert 'there is no size "16K"' in capsys.readouterr().err
