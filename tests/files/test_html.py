"""Tests of `nerg_mi.files.html`; the report tests its elements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.files.html import Summary


@dataclass(repr=False)
class Result(Summary):
    path: Path
    points: np.ndarray
    names: list[str]
    counts: dict[str, int]
    error: float
    nothing: None = None
    parts: tuple[object, ...] = (object(),)


def test_objects_are_summarised_by_their_attributes():
    result = Result(
        Path("folder/a.csv"), np.zeros((2, 3)), [str(k) for k in range(9)], {"fixation": 12, "<b>": 3}, 1 / 3
    )
    facts = "path a.csv, points 2 x 3 float64, names 9 entries, counts fixation 12, <b> 3, error 0.3333, parts 1 entry"
    assert repr(result) == f"<Result: {facts}>"
    assert "<td>fixation 12, &lt;b&gt; 3</td>" in result._repr_html_() and "nothing" not in result._repr_html_()
