"""What mutants change and what not, and names that outlive other changes."""

from __future__ import annotations

import ast

from tools.mutation import sites

SOURCE = '''\
"""A docstring 1 + 1."""
from __future__ import annotations
import numpy as np

LIMIT = 5


class Thing:
    size: int = 1 + 2

    def __repr__(self):
        return "a" + str(3 * self.size)


def work(x, *, twice=True, power: int = 2):
    """Docstring: x - 1."""
    if x < 0 and power > 1:
        raise ValueError(f"{x + 1} is below {LIMIT * 2}")
    total = (x - 1) * (x + 1)
    total = total / power
    total += 3.5
    np.eval(total)
    scale(total, by=LIMIT)
    return np.where(twice, -total, max(x, total))
'''


def changes(source=SOURCE):
    return {(m.function, m.kind, m.before, m.after) for m in sites.find("a.py", source)}


def test_mistakes_of_every_kind():
    found = changes()
    assert {
        ("module", "integer", "5", "6"),
        ("module", "integer", "5", "4"),
        ("Thing", "arithmetic", "1 + 2", "(1 - 2)"),
        ("work", "boolean", "True", "False"),
        ("work", "integer", "2", "3"),
        ("work", "comparison", "x < 0", "(x > 0)"),
        ("work", "boundary", "x < 0", "(x <= 0)"),
        ("work", "logic", "x < 0 and power > 1", "((x < 0) or (power > 1))"),
        ("work", "condition", "x < 0 and power > 1", "(not (x < 0 and power > 1))"),
        ("work", "arithmetic", "(x - 1) * (x + 1)", "((x - 1) / (x + 1))"),
        ("work", "dropped term", "(x - 1) * (x + 1)", "(x - 1)"),
        ("work", "dropped term", "(x - 1) * (x + 1)", "(x + 1)"),
        ("work", "removed statement", "total = total / power", "pass"),
        ("work", "sign", "total += 3.5", "total -= 3.5"),
        ("work", "number", "3.5", "5.25"),
        ("work", "keyword", "scale(total, by=LIMIT)", "scale(total)"),
        ("work", "sign", "-total", "(total)"),
        ("work", "branches", "np.where(twice, -total, max(x, total))", "np.where(twice, max(x, total), -total)"),
        ("work", "twin", "max", "min"),
    } <= found


def test_what_no_test_should_look_at_is_left_alone():
    """Docstrings, annotations, messages, what prints an object, and what only schedules."""
    for function, _, before, _ in changes():
        assert "__repr__" not in function and "ring" not in before
        assert "below" not in before and before not in ("LIMIT * 2", "np.eval(total)", "int")
    assert sum(m.before == "x + 1" and m.kind == "arithmetic" for m in sites.find("a.py", SOURCE)) == 1


def test_mutants_are_single_changes_and_python():
    for mutant in sites.find("a.py", SOURCE):
        changed = mutant.apply(SOURCE)
        assert sites.compiles(mutant, SOURCE) and changed.count("\n") == SOURCE.count("\n")
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(SOURCE))
        assert changed.splitlines()[: mutant.line - 1] == SOURCE.splitlines()[: mutant.line - 1]
        assert changed.splitlines()[mutant.last :] == SOURCE.splitlines()[mutant.last :]


def test_names_stay_when_lines_move():
    moved = SOURCE.replace("LIMIT = 5\n", "LIMIT = 5\n\n\ndef more(x):\n    return x * 2 + 1\n")
    before, after = ({m.key for m in sites.find("a.py", s)} for s in (SOURCE, moved))
    assert before < after and len(before) == len(sites.find("a.py", SOURCE))
