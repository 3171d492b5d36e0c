"""The manual is built, without a warning and without the network."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import pytest

from tests.conftest import ROOT
from tools.site import __main__ as site

LOADING = {
    ("script", "src"),
    ("link", "href"),
    ("img", "src"),
    ("iframe", "src"),
    ("source", "src"),
    ("object", "data"),
}


class Loads(HTMLParser):
    """What a page loads by itself: `addresses`."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attributes):
        self.addresses += [value for name, value in attributes if (tag, name) in LOADING and value]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder of the pages."""
    pytest.importorskip("sphinx", reason="the manual is built where the extra manual is installed (Python 3.11)")
    pytest.importorskip("furo")
    pytest.importorskip("myst_parser")
    out = tmp_path_factory.mktemp("manual")
    assert site.main(["--out", str(out)]) == 0
    return out / "html"


@pytest.mark.slow
def test_every_page_is_there_and_loads_nothing_from_elsewhere(built):
    pages = list(built.glob("*.html"))
    assert {page.stem for page in (ROOT / "docs").glob("*.md")} <= {page.stem for page in pages}
    for page in pages:
        reader = Loads()
        reader.feed(page.read_text(encoding="utf-8"))
        assert reader.addresses, page.name
        for address in reader.addresses:
            assert not re.match(r"(\w+:)?//", address), (page.name, address)
            if not address.startswith(("data:", "#")):
                assert (page.parent / address.partition("?")[0].partition("#")[0]).exists(), (page.name, address)


@pytest.mark.slow
def test_styles_and_scripts_load_nothing_from_elsewhere(built):
    for path in [*built.rglob("*.css"), *built.rglob("*.js")]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"@import|url\(\s*[\"']?(?:https?:)?//|fetch\(\s*[\"']https?:", text), path


@pytest.mark.slow
def test_every_public_name_and_command_has_its_place(built):
    import nerg_mi as nerg
    from tools import command_pages

    reference = (built / "python-reference.html").read_text(encoding="utf-8")
    assert [name for name in nerg.__all__ if f'id="nerg_mi.{name}"' not in reference] == []
    commands = (built / "commands.html").read_text(encoding="utf-8")
    assert [path for path, *_ in command_pages.commands() if f'id="{path.replace(" ", "-")}"' not in commands] == []


@pytest.mark.slow
def test_notebooks_are_pages_with_their_pictures(built):
    for path in (ROOT / "examples").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        pictures = sum("image/png" in o.get("data", {}) for cell in cells for o in cell.get("outputs", ()))
        page = (built / f"notebook-{path.stem.replace('_', '-')}.html").read_text(encoding="utf-8")
        assert page.count('<img alt="Output"') == pictures > 0
        assert "".join(cells[0]["source"]).splitlines()[0].removeprefix("# ") in page


@pytest.mark.slow
def test_options_keep_their_dashes(built):
    assert "at --time or --times" in (built / "commands.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_formulas_are_mathml(built):
    text = (built / "plugins.html").read_text(encoding="utf-8")
    assert text.count("<math") >= 14 and "MathJax" not in text


@pytest.mark.slow
def test_a_link_to_nowhere_is_an_error(tmp_path, monkeypatch, capfd):
    pytest.importorskip("furo")
    pytest.importorskip("myst_parser")
    page = "# A page\n\nTo [nowhere](index.md#nowhere).\n"
    monkeypatch.setattr(site.source, "assemble", lambda root, folder: write(folder, page))
    assert site.main(["--out", str(tmp_path)]) != 0
    assert "nowhere" in capfd.readouterr().err


def write(folder, text):
    folder.mkdir(parents=True)
    (folder / "index.md").write_text(text)
