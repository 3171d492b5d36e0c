"""Every sentence that the program says of what can be mended, and every line of help: collected from the source."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.conftest import ROOT

ERRORS = ("NergError", "MissingFile", "UnusableLLVM")
HOLE = "\N{HORIZONTAL ELLIPSIS}"
"""Stands for what is put into a message: a name, a number, the rest of a sentence."""


@dataclass(frozen=True)
class Message:
    """A sentence and where it stands, `file:line`."""

    where: str
    text: str


def errors(root: Path = ROOT) -> list[Message]:
    """What every `raise` of an error of ours says, each way that an `if` within it can go a message of its own."""
    found = []
    for folder in ("nerg_mi", "plugins"):
        for path in sorted((root / folder).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
                    function = node.exc.func
                    name = function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")
                    if name in ERRORS:
                        where = f"{path.relative_to(root)}:{node.lineno}"
                        found += [Message(where, text) for text in texts(node.exc.args[0])]
    return found


def texts(node: ast.expr) -> Iterator[str]:
    """What an expression of strings can say, with `HOLE` for what is not known before it runs."""
    if isinstance(node, ast.Constant):
        yield str(node.value)
    elif isinstance(node, ast.IfExp):
        yield from texts(node.body)
        yield from texts(node.orelse)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        ends = list(texts(node.right))
        yield from (start + end for start in texts(node.left) for end in ends)
    elif isinstance(node, ast.JoinedStr):
        yield "".join(str(part.value) if isinstance(part, ast.Constant) else HOLE for part in node.values)
    else:
        yield HOLE


def help_lines() -> list[Message]:
    """The help of every command, in paragraphs, and of every argument and option, without its default."""
    from tools.command_pages import commands, split_default

    found = []
    for path, command, context in commands():
        found += [Message(path, " ".join(part.split())) for part in (command.help or "").split("\n\n")]
        for parameter in command.params:
            record = parameter.get_help_record(context)
            if record is not None and parameter.name != "help":
                found.append(Message(f"{path} {parameter.opts[0]}", split_default(record[1])[0]))
    return found
