"""Pages as a code host shows them become pages of the manual."""

from __future__ import annotations

import re

import pytest

from tests.conftest import ROOT
from tools.site import source

LATER = {"viewer.md", "pictures.md", "report.md"}
"""Pages that the index names and that may not be there yet."""


@pytest.fixture
def checkout(tmp_path):
    """A small checkout: two pages, one at the root, a script, a picture."""
    docs = tmp_path / "docs"
    (docs / "images").mkdir(parents=True)
    (docs / "images" / "a.png").write_bytes(b"")
    (tmp_path / "examples").mkdir()
    (tmp_path / "examples" / "a.py").write_text("")
    (tmp_path / "CHANGELOG.md").write_text("# Changes\n\n[one](docs/one.md#part)\n")
    (tmp_path / "CONTRIBUTING.md").write_text("# Rules\n")
    (docs / "one.md").write_text("# One\n\n## Part\n")
    (docs / "alone.md").write_text("# Alone\n")
    (docs / "index.md").write_text(
        "# Home\n\n## First\n\n- [One](one.md): a page\n- [Gone](gone.md): another\n\n"
        "See [the script](../examples/a.py), [changes](../CHANGELOG.md), [there](https://a.b).\n"
        "![picture](images/a.png)\n\n```sh\n[no link](one.md)\n```\n\n## Last\n\n- [Changes](../CHANGELOG.md)\n"
    )
    return tmp_path


def test_links_become_those_of_the_manual(checkout, tmp_path):
    source.assemble(checkout, tmp_path / "out")
    page = (tmp_path / "out" / "index.md").read_text()
    assert "See the script, [changes](changelog.md), [there](https://a.b)." in page
    assert "![picture](images/a.png)" in page and "```sh\n[no link](one.md)\n```" in page
    assert "[one](one.md#part)" in (tmp_path / "out" / "changelog.md").read_text()
    assert (tmp_path / "out" / "images" / "a.png").exists()


def test_contents_are_the_lists_of_the_index(checkout, tmp_path):
    source.assemble(checkout, tmp_path / "out")
    page = (tmp_path / "out" / "index.md").read_text()
    trees = re.findall(r"```\{toctree\}\n:hidden:\n:caption: (\w+)\n\n([\w\n]*?)\n```", page)
    assert trees == [("First", "one"), ("Last", "changelog"), ("More", "alone\ncontributing")]


def test_lines_of_pages_that_are_not_there_are_left_out(checkout, tmp_path):
    source.assemble(checkout, tmp_path / "out")
    assert "Gone" not in (tmp_path / "out" / "index.md").read_text()
    (checkout / "docs" / "gone.md").write_text("# Gone\n")
    source.assemble(checkout, tmp_path / "again")
    page = (tmp_path / "again" / "index.md").read_text()
    assert "- [Gone](gone.md): another" in page and "one\ngone\n" in page


def test_a_heading_without_pages_is_left_out(checkout, tmp_path):
    index = checkout / "docs" / "index.md"
    index.write_text("# Home\n\n## Later\n\n- [Gone](gone.md): x\n\n## Now\n\n- [One](one.md): y\n")
    source.assemble(checkout, tmp_path / "out")
    page = (tmp_path / "out" / "index.md").read_text()
    assert "Later" not in page and "## Now" in page


def test_every_page_is_in_the_index_and_every_link_leads_somewhere():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    named = {target.partition("#")[0] for _, _, target in source.LINK.findall(index)}
    assert {path.name for path in (ROOT / "docs").glob("*.md")} - {"index.md"} <= named
    pages = [ROOT / "README.md", *(ROOT / name for name in source.ROOT_PAGES), *(ROOT / "docs").glob("*.md")]
    broken = []
    for page in pages:
        prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
        for _, _, target in source.LINK.findall(re.sub(r"`[^`\n]*`", "", prose)):
            file = target.partition("#")[0]
            if file and not re.match(r"\w+:", file) and not (page.parent / file).exists():
                broken.append((page.name, file))
    assert [entry for entry in broken if entry[0] != "index.md" or entry[1] not in LATER] == []
