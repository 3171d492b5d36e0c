"""Formulas of the manual as MathML, which browsers draw by themselves: no script and no network."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml


def inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext(), block=False))
    raise nodes.SkipNode


def displayed(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math-block">{_mathml(node.astext(), block=True)}</div>')
    raise nodes.SkipNode


def _mathml(code: str, block: bool) -> str:
    return latex2mathml.tex2mathml(code, as_block=block)


def setup(app: Any) -> dict[str, bool]:
    """What Sphinx calls: makes "mathml" known as a way to write formulas."""
    app.add_html_math_renderer("mathml", (inline, None), (displayed, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
