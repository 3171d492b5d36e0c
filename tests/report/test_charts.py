"""Charts: values where their scale says, and scales of round numbers."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from nerg_mi.report.html import Point, interval_chart, nice_ticks
from tests.report.made import HOSTILE

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize("low, high", [(0, 1), (-2.3, 0.01), (1e-7, 3e-7), (5, 5), (-1e6, 1e9), (0.97, 1.02)])
def test_ticks_are_round_and_span(low, high):
    ticks = nice_ticks(low, high)
    steps = np.diff(ticks)
    assert 2 <= len(ticks) <= 6 and np.allclose(steps, steps[0]) and ticks[0] <= low and ticks[-1] >= high
    digits = f"{steps[0]:.6e}".split("e")[0]
    assert float(digits) in (1, 2, 5)


def test_values_lie_where_their_scale_says():
    points = [Point("a", 0.0, -1.0, 1.0, True), Point("b", 2.0), Point("c", math.nan, math.nan, math.nan)]
    root = ET.fromstring(interval_chart([("score", points), ("other", points)]))
    circles = root.findall(f"{SVG}circle")
    assert len(circles) == 4  # of c nothing is known
    ticks = {t.text: float(t.get("x")) for t in root.findall(f"{SVG}text") if t.get("class") == "faint"}
    assert float(circles[0].get("cx")) < float(circles[1].get("cx"))
    for circle, value in zip(circles[2:], ("0", "2")):
        assert float(circle.get("cx")) == pytest.approx(ticks[value], abs=0.02)
    assert "a 0, b 2, c nan" in root.get("aria-label")


def test_labels_are_text():
    root = ET.fromstring(interval_chart([(HOSTILE, [Point(HOSTILE, 1.0)])]))
    assert {e.tag for e in root.iter()} == {f"{SVG}{t}" for t in ("svg", "text", "line", "circle")}
