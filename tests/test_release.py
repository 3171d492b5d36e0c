"""What a release says of itself: one version everywhere, and the files that people look for."""

from __future__ import annotations

import re

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


def test_links_of_the_pages_at_the_root_lead_somewhere():
    for page in ("CONTRIBUTING.md", "CHANGELOG.md"):
        for target in re.findall(r"\]\((?!http)([^)#]+)", (ROOT / page).read_text(encoding="utf-8")):
            assert (ROOT / target).exists(), f"{page}: {target}"
