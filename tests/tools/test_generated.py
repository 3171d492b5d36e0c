"""Parts of pages that are made of the code: they are up to date, and nothing else of a page is touched."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tools import generated


def test_every_page_is_up_to_date():
    # In a process of its own: other tests register what is made up.
    done = subprocess.run(
        [sys.executable, "-m", "tools.generated", "--check"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]


def test_every_part_stands_on_a_page():
    text = "".join(page.read_text(encoding="utf-8") for page in generated.pages())
    for name in generated.PARTS:
        assert text.count(f"<!-- made by make docs: {name} -->") == 1, name


def test_only_the_part_is_replaced(monkeypatch):
    monkeypatch.setattr(generated, "PARTS", {"a": lambda: "| new |\n"})
    page = "# T\n\n<!-- made by make docs: a -->\nold\nolder\n<!-- end -->\n\nwords <!-- end -->\n"
    new = "# T\n\n<!-- made by make docs: a -->\n\n| new |\n\n<!-- end -->\n\nwords <!-- end -->\n"
    assert generated.renewed(page) == new == generated.renewed(new)
    with pytest.raises(KeyError):
        generated.renewed(page.replace("docs: a", "docs: b"))


def test_check_writes_nothing(monkeypatch, tmp_path, capsys):
    page = tmp_path / "page.md"
    page.write_text("<!-- made by make docs: a -->\n<!-- end -->\n")
    monkeypatch.setattr(generated, "ROOT", tmp_path)
    monkeypatch.setattr(generated, "pages", lambda: [page])
    monkeypatch.setattr(generated, "PARTS", {"a": lambda: "new"})
    assert generated.main(["--check"]) == 1 and "run make docs" in capsys.readouterr().out
    assert "new" not in page.read_text()
    assert generated.main([]) == 0 and "new" in page.read_text()
    assert generated.main(["--check"]) == 0


def test_settings_are_shown_as_they_are():
    recipes = {row.split("|")[1].strip(): row.split("|")[2:-1] for row in generated.recipes().splitlines()[2:]}
    default = {name: cells[0].strip() for name, cells in recipes.items()}
    assert default["`zones`"] == "0" and default["`steps`"] == "160" and default["`weight_decay`"] == "4"
    assert default["probes: `count`"] == "1,024" and default["probes: `weights`"] == "person"


def test_recipes_show_their_fields():
    rows = [line.split(" | ") for line in generated.recipes().splitlines()]
    assert ["| field: `grid.finest`", "32", "128", "512 |"] in rows
    assert not [row for row in rows if "heads" in row[0]]
