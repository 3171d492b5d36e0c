"""What a release says of itself: one version everywhere, and the files that people look for."""

from __future__ import annotations

import re

import pytest

import nerg_mi
from tests.conftest import ROOT


def said(file: str, pattern: str) -> str:
    """What the first line of ``file`` that matches ``pattern`` says."""
    match = re.search(pattern, (ROOT / file).read_text(encoding="utf-8"), re.M)
    assert match, f"{file} has no line {pattern}"
    return match[1]


def test_one_version():
    assert said("pyproject.toml", r'^version = "(.+)"$') == nerg_mi.__version__
    assert said("CITATION.cff", r"^version: (\S+)$") == nerg_mi.__version__
    assert said("CHANGELOG.md", r"^## (\d\S*)") == nerg_mi.__version__


def test_types_come_with_the_package():
    assert (ROOT / "nerg_mi" / "py.typed").is_file()
    assert '"nerg_mi" = ["py.typed"]' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


NEWER_NUMPY = """
trapezoid concat permute_dims matrix_transpose isdtype astype vecdot matvec vecmat unstack cumulative_sum
cumulative_prod unique_all unique_counts unique_inverse unique_values bool long ulong strings pow acos acosh
asin asinh atan atan2 atanh bitwise_invert bitwise_left_shift bitwise_right_shift linalg.outer linalg.cross
linalg.diagonal linalg.trace linalg.matmul linalg.tensordot linalg.vecdot linalg.svdvals linalg.matrix_norm
linalg.vector_norm linalg.matrix_transpose
"""


def test_nothing_is_used_that_the_oldest_numpy_lacks():
    """`make packages` tries NumPy 1.26 before a release; with a newer one nothing else would notice."""
    assert '"numpy>=1.26"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    pattern = re.compile(rf"\b(?:np|numpy)\.(?:{'|'.join(map(re.escape, NEWER_NUMPY.split()))})\b")
    sources = [
        p for room in ("nerg_mi", "plugins", "scenes", "benchmarks", "examples") for p in (ROOT / room).rglob("*.py")
    ]
    found = [f"{p.relative_to(ROOT)}: {m[0]}" for p in sources for m in pattern.finditer(p.read_text(encoding="utf-8"))]
    assert len(sources) > 200 and found == []


def test_links_of_the_pages_at_the_root_lead_somewhere():
    for page in ("CONTRIBUTING.md", "CHANGELOG.md"):
        for target in re.findall(r"\]\((?!http)([^)#]+)", (ROOT / page).read_text(encoding="utf-8")):
            assert (ROOT / target).exists(), f"{page}: {target}"


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_files_that_newcomers_are_sent_to_are_there(page):
    named = set(re.findall(r"`((?:nerg_mi|plugins|tests|tools|docs|benchmarks)/[\w/.-]+)`", (ROOT / page).read_text()))
    assert len(named) > 8 and [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_hooks_run_what_lint_runs():
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    targets = (ROOT / "Makefile").read_text(encoding="utf-8").split("\n\n")
    for target, tool in (
        ("lint", "ruff check"),
        ("lint", "ruff format"),
        ("lint", "tools.import_rules"),
        ("types", "basedpyright"),
    ):
        (recipe,) = [t for t in targets if t.startswith(f"{target}: setup\n")]
        assert tool in hooks and tool in recipe, tool
    for entry in re.findall(r"entry: \.venv/bin/(\S+)", hooks):
        assert entry in ("ruff", "python", "basedpyright"), entry
