"""Plugin manual pages, converted from the docstrings of their modules to Markdown.

Supported is the part of reStructuredText that Mitsuba's plugin manuals use: the list of parameters, inline roles,
formulas, bullets and examples in tabs. Anything else raises `ValueError`, so that no page shows raw markup.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from dataclasses import dataclass

from tools.page import wrapped

FLAGS = {
    "exposed": "set through `mi.traverse`",
    "differentiable": "differentiable",
    "discontinuous": "moves edges, whose derivatives are missing",
}
"""Parameter flags of Mitsuba's manual -> their meaning."""


@dataclass(frozen=True)
class PluginParameter:
    """A parameter of a plugin; `flags` are its roles in Mitsuba besides being set."""

    name: str
    type: str
    meaning: str
    flags: tuple[str, ...]


@dataclass(frozen=True)
class PluginManual:
    """A plugin's page: `title`, `parameters`, and `body`, the rest as Markdown."""

    title: str
    parameters: list[PluginParameter]
    body: str

    def parameter_list(self) -> str:
        flags = lambda p: f" *({', '.join(FLAGS[f] for f in p.flags)})*" if p.flags else ""
        items = (f"- `{p.name}` ({p.type}): {p.meaning}{flags(p)}" for p in self.parameters)
        return "\n".join(map(wrapped, items))


def convert_inline(text: str) -> str:
    """Convert inline reStructuredText to Markdown."""
    text = re.sub(r":math:`([^`]+)`", r"$\1$", text)
    text = re.sub(r":ref:`([^`<]+?)\s+<[^`>]+>`", r"`\1`", text)
    text = re.sub(r":(?:paramtype|monosp):`([^`]+)`", r"`\1`", text)
    text = re.sub(r"\|(\w+)\|", r"\1", text)
    text = re.sub(r"``([^`]+)``", r"`\1`", text)
    if unknown := re.search(r":\w+:`", text):
        raise ValueError(f"the role {unknown[0]}...` is not supported; add it to tools/manual.py")
    return text


def parse_parameters(block: str) -> list[PluginParameter]:
    """Parse the entries of a ``pluginparameters`` list."""
    entries = []
    for entry in re.split(r"^ \* - ", block, flags=re.M)[1:]:
        name, kind, meaning, *flags = (" ".join(part.split()) for part in re.split(r"^   - ", entry, flags=re.M))
        marks = tuple(re.findall(r"\|(\w+)\|", " ".join(flags)))
        entries.append(PluginParameter(name, convert_inline(kind).replace("`", ""), convert_inline(meaning), marks))
    return entries


def convert_examples(block: str) -> str:
    """Convert the examples of a ``tabs`` block to fenced code."""
    fences = []
    for language, code in re.findall(r"^ {4}\.\. code-tab:: (\w+)\n((?:(?: {8}.*)?\n)+)", block + "\n", flags=re.M):
        code = re.sub(r"^\s*:name:.*\n", "", code).strip("\n")
        fences.append(f"```{language}\n{textwrap.dedent(code).rstrip()}\n```")
    return "\n\n".join(fences)


def parse_manual(docstring: str) -> PluginManual:
    """Parse the manual page in a plugin's docstring. Raises `ValueError` for unsupported markup."""
    blocks = re.split(r"\n\n(?=\S)", inspect.cleandoc(docstring))
    title, parameters, body = "", [], []
    for block in blocks:
        if block.startswith(".. _"):
            continue
        if re.fullmatch(r".+\n-{3,}", block):
            title = convert_inline(block.splitlines()[0])
        elif block.startswith(".. pluginparameters::"):
            parameters = parse_parameters(block)
        elif block.startswith(".. tabs::"):
            body.append(convert_examples(block))
        elif block.startswith(".. math::"):
            body.append(f"```math\n{textwrap.dedent(block.split('::', 1)[1].strip(chr(10))).rstrip()}\n```")
        elif block.startswith(".. "):
            raise ValueError(
                f'the manual page "{title}" has an unsupported {block.split()[1]}; add it to tools/manual.py'
            )
        else:
            body.append(convert_inline(block))
    return PluginManual(title, parameters, wrapped("\n\n".join(body)))
