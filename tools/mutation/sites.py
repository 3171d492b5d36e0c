"""Every small mistake that can be made in a source file: its mutants, found in the syntax tree.

What no test should look at is left alone: docstrings, annotations, decorators, messages (f-strings, `raise`, logging),
`label=` and what prints an object. Strings are never changed.
"""

from __future__ import annotations

import ast
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from .changes import (
    ARITHMETIC,
    BOUNDARY,
    COMPARE,
    LARGE,
    MAKERS,
    MATHS,
    MESSAGE_CALLS,
    SCHEDULING,
    SIGNS,
    SMALL,
    TWINS,
    UNTOUCHED_FUNCTIONS,
)


@dataclass(frozen=True)
class Mutant:
    """One change: `before`, the source text of the node from byte `start` to `end`, becomes `after`.

    Named by its contents (`key`), so that changes elsewhere in the file leave its name as it is. `line`, `last`: the
    lines of the node; `statement`: the first line of the statement around it; `called`: whether it lies in the body of
    a function, and not in what runs once, when the file is imported.
    """

    file: str
    function: str
    kind: str
    before: str
    after: str
    occurrence: int
    line: int
    last: int
    statement: int
    start: int
    end: int
    called: bool

    @property
    def key(self) -> str:
        flat = " ".join(self.before.split()), " ".join(self.after.split())
        return f"{self.file} :: {self.function} :: {self.kind} :: {flat[0]} -> {flat[1]} #{self.occurrence}"

    @property
    def place(self) -> str:
        return f"{self.file}:{self.line}:{self.kind}"

    def apply(self, source: str) -> str:
        """`source` with the mistake made."""
        text = source.encode()
        return (text[: self.start] + self.after.encode() + text[self.end :]).decode()


class _Finder:
    """Walks one file; `found` holds what becomes a `Mutant`."""

    def __init__(self, source: str):
        self.source = source.encode()
        self.lines = [0]
        for line in self.source.splitlines(keepends=True):
            self.lines.append(self.lines[-1] + len(line))
        self.found: list[tuple[str, str, ast.AST, str, int, bool]] = []
        self.scope: list[str] = []
        self.statement, self.depth = 0, 0

    def span(self, node: ast.AST) -> tuple[int, int]:
        return self.lines[node.lineno - 1] + node.col_offset, self.lines[node.end_lineno - 1] + node.end_col_offset

    def text(self, node: ast.AST) -> str:
        start, end = self.span(node)
        return self.source[start:end].decode()

    def exchanged(self, node: ast.AST, left: ast.AST, right: ast.AST, old: str, new: str) -> str:
        """The text of `node` with the sign between its parts `left` and `right` exchanged; parentheses stay."""
        (start, end), after, before = self.span(node), self.span(left)[1], self.span(right)[0]
        gap = self.source[after:before].decode().replace(old, new, 1)
        return f"({self.source[start:after].decode()}{gap}{self.source[before:end].decode()})"

    def put(self, kind: str, node: ast.AST, replacement: str) -> None:
        if replacement != self.text(node):
            self.found.append(
                (".".join(self.scope) or "module", kind, node, replacement, self.statement, self.depth > 0)
            )

    # -- statements ------------------------------------------------------------

    def block(self, body: list[ast.stmt]) -> None:
        for statement in body:
            docstring = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            if docstring or isinstance(statement, (ast.Raise, ast.Import, ast.ImportFrom, ast.Assert, ast.Global)):
                continue
            self.statement = statement.lineno
            self.visit_statement(statement)

    def visit_statement(self, s: ast.stmt) -> None:
        if isinstance(s, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            if s.name in UNTOUCHED_FUNCTIONS:
                return
            self.scope.append(s.name)
            if not isinstance(s, ast.ClassDef):
                for default in [*s.args.defaults, *filter(None, s.args.kw_defaults)]:
                    self.expression(default)
            self.depth += not isinstance(s, ast.ClassDef)
            self.block(s.body)
            self.depth -= not isinstance(s, ast.ClassDef)
            self.scope.pop()
            return
        if isinstance(s, ast.Expr) and isinstance(s.value, ast.Call):
            if self.is_message(s.value):
                return
            if getattr(s.value.func, "attr", "") not in SCHEDULING:
                self.put("removed statement", s, "pass")
        if isinstance(s, ast.AugAssign):
            self.put("removed statement", s, "pass")
            if isinstance(s.op, (ast.Add, ast.Sub)):
                swapped = "-=" if isinstance(s.op, ast.Add) else "+="
                self.put("sign", s, f"{self.text(s.target)} {swapped} {self.text(s.value)}")
        if isinstance(s, ast.Assign) and len(s.targets) == 1:
            target = s.targets[0]
            names = {n.id for n in ast.walk(s.value) if isinstance(n, ast.Name)}
            if isinstance(target, (ast.Attribute, ast.Subscript)) and "__init__" not in self.scope:
                self.put("removed statement", s, "pass")
            elif isinstance(target, ast.Name) and target.id in names:
                self.put("removed statement", s, "pass")
        if isinstance(s, (ast.If, ast.While)):
            self.put("condition", s.test, f"(not ({self.text(s.test)}))")
        for name, value in ast.iter_fields(s):
            if name in ("annotation", "returns", "decorator_list", "targets", "target"):
                continue
            for item in value if isinstance(value, list) else [value]:
                if isinstance(item, ast.expr):
                    self.statement = s.lineno
                    self.expression(item)
                elif isinstance(item, ast.withitem):
                    self.expression(item.context_expr)
        for name in ("body", "orelse", "finalbody"):
            self.block(getattr(s, name, []) or [])
        for handler in getattr(s, "handlers", []):
            self.block(handler.body)
        for case in getattr(s, "cases", []):
            self.block(case.body)

    # -- expressions -----------------------------------------------------------

    def is_message(self, call: ast.Call) -> bool:
        name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
        return name in MESSAGE_CALLS

    def expression(self, node: ast.expr) -> None:
        if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Call) and self.is_message(node)):
            return
        text = self.text
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            op, left, right = node.ops[0], node.left, node.comparators[0]
            sign = SIGNS[type(op)]
            self.put("comparison", node, self.exchanged(node, left, right, sign, COMPARE[sign]))
            # Two floats are equal with a probability of nil: a boundary is only told from the next one among integers.
            if sign in BOUNDARY and (_is_integer(left) or _is_integer(right)):
                self.put("boundary", node, self.exchanged(node, left, right, sign, BOUNDARY[sign]))
        elif isinstance(node, ast.BinOp):
            self.arithmetic(node)
        elif isinstance(node, ast.BoolOp):
            new = "or" if isinstance(node.op, ast.And) else "and"
            self.put("logic", node, "(" + f" {new} ".join(f"({text(v)})" for v in node.values) + ")")
        elif isinstance(node, ast.UnaryOp):
            kind = {ast.Not: "condition", ast.Invert: "condition", ast.USub: "sign"}.get(type(node.op))
            if kind:
                self.put(kind, node, f"({text(node.operand)})")
        elif isinstance(node, ast.Constant):
            self.constant(node)
        elif isinstance(node, ast.IfExp):
            self.put("branches", node, f"(({text(node.orelse)}) if ({text(node.test)}) else ({text(node.body)}))")
        elif isinstance(node, ast.Call):
            self.call(node)
        for child in self.children(node):
            self.expression(child)

    def children(self, node: ast.expr) -> Iterator[ast.expr]:
        for name, value in ast.iter_fields(node):
            for item in value if isinstance(value, list) else [value]:
                if isinstance(item, ast.keyword) and item.arg not in ("label", "name", "message"):
                    yield item.value
                elif isinstance(item, ast.comprehension):
                    yield item.iter
                    yield from item.ifs
                elif isinstance(item, ast.expr) and name not in ("target", "targets"):
                    yield item

    def arithmetic(self, node: ast.BinOp) -> None:
        left, right = self.text(node.left), self.text(node.right)
        if any(
            isinstance(side, (ast.List, ast.Tuple, ast.JoinedStr, ast.ListComp)) or _is_text(side)
            for side in (node.left, node.right)
        ):
            return
        sign, swapped = ARITHMETIC[type(node.op)]
        self.put("arithmetic", node, self.exchanged(node, node.left, node.right, sign, swapped))
        if sign in ("+", "-", "*", "/"):
            self.put("dropped term", node, f"({left})")
        if sign in ("+", "*"):
            self.put("dropped term", node, f"({right})")

    def constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self.put("boolean", node, str(not value))
        elif isinstance(value, int):
            self.put("integer", node, str(value + 1))
            if value > 0:
                self.put("integer", node, str(value - 1))
        elif isinstance(value, float):
            factor = 1000 if value and not SMALL < abs(value) < LARGE else 1.5
            self.put("number", node, repr(value * factor) if value else "1.0")

    def call(self, node: ast.Call) -> None:
        text, function = self.text, node.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        owner = (
            function.value.id if isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name) else ""
        )
        if name in TWINS:
            old = text(function)
            self.put("twin", function, old[: len(old) - len(name)] + TWINS[name])
        if owner in MATHS and node.args and name.islower() and name not in MAKERS:
            if name in ("select", "where") and len(node.args) == 3:
                a, b, c = map(text, node.args)
                self.put("branches", node, f"{text(function)}({a}, {c}, {b})")
                self.put("argument", node, f"({b})")
            elif not isinstance(node.args[0], ast.Starred):
                self.put("argument", node, f"({text(node.args[0])})")
        for keyword in node.keywords:
            if keyword.arg is None or keyword.arg in ("label", "name", "message"):
                continue
            rest = [*map(text, node.args), *(text(w) for w in node.keywords if w is not keyword)]
            self.put("keyword", node, f"{text(function)}({', '.join(rest)})")


def _is_integer(node: ast.expr) -> bool:
    if isinstance(node, ast.Call):
        return getattr(node.func, "id", "") == "len"
    return isinstance(node, ast.Constant) and type(node.value) is int


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (str, bytes))


def find(file: str, source: str) -> list[Mutant]:
    """The mutants of the source text of `file`, in the order of the lines. A few of them may be no Python
    (`compiles`)."""
    finder = _Finder(source)
    finder.block(ast.parse(source).body)
    seen: Counter = Counter()
    mutants = []
    for function, kind, node, after, statement, called in sorted(finder.found, key=lambda f: finder.span(f[2])):
        before = finder.text(node)
        same = (function, kind, " ".join(before.split()), " ".join(after.split()))
        seen[same] += 1
        place = node.lineno, node.end_lineno, statement, *finder.span(node), called
        mutants.append(Mutant(file, function, kind, before, after, seen[same], *place))
    return mutants


def compiles(mutant: Mutant, source: str) -> bool:
    """Whether `source` with the mistake made is still Python."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            compile(mutant.apply(source), mutant.file, "exec")
        except SyntaxError:
            return False
    return True
