"""Formulas are MathML."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

nodes = pytest.importorskip("docutils.nodes", reason="the extra manual is not installed")


@pytest.mark.parametrize("block", [False, True])
def test_a_formula(block):
    from tools.site import mathml

    writer = SimpleNamespace(body=[])
    node = (nodes.math_block if block else nodes.math)("", r"\frac{d_f}{2}")
    with pytest.raises(nodes.SkipNode):
        (mathml.displayed if block else mathml.inline)(writer, node)
    (text,) = writer.body
    assert "<mfrac>" in text and "<msub>" in text and ('display="block"' in text) == block
