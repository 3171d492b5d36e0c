"""The reference of the command line has every command, option and default."""

from __future__ import annotations

import pytest

from nerg_mi import cli
from tests.conftest import ROOT
from tools import command_pages

PAGE = ROOT / "docs" / "commands.md"


def test_every_command_and_every_option_stands_on_the_page():
    page = PAGE.read_text(encoding="utf-8")
    sections = {part.split("\n", 1)[0]: part for part in page.split("\n## ")[1:]}
    found = list(command_pages.commands())
    assert {path.split()[1] for path, *_ in found} == set(cli.COMMANDS)
    for path, command, _ in found:
        for parameter in (p for p in command.params if not getattr(p, "hidden", False)):
            named = [name for name in (*parameter.opts, *parameter.secondary_opts) if name.startswith("-")]
            assert all(name in sections[path] for name in named if name != "--help"), (path, named)


@pytest.mark.parametrize(
    "text, meaning, default",
    [
        ("Samples.  [default: 8]", "Samples.", "8"),
        ("File.  [required]", "File.", "required"),
        ("Seed.  [default: 0; x>=0]", "Seed. (x>=0)", "0"),
        ("Share.  [0<=x<=1]", "Share. (0<=x<=1)", ""),
        ("Processes. [default: a core each]  [x>=1]", "Processes. (x>=1)", "a core each"),
        ("Unit. [default: m; neon: mm]", "Unit.", "m; neon: mm"),
        ("Keeps rows [a, b].", "Keeps rows [a, b].", ""),
        ("Keeps rows [a, b]", "Keeps rows [a, b]", ""),
        ("Nothing.", "Nothing.", ""),
    ],
)
def test_defaults_are_told_from_what_they_mean(text, meaning, default):
    assert command_pages.split_default(text) == (meaning, default)


def test_what_markdown_would_take_for_markup_is_kept():
    assert command_pages.cell("a <default>,\n frame_* and _x") == r"a \<default>, frame\_\* and \_x"
