"""The source of the manual's pages: the Markdown of docs/ and of the root, which stays as a code host shows it, made
ready for Sphinx.

Nothing of Sphinx stands in the pages: the contents are made of the lists of links in docs/index.md, links between
folders become links between pages, and what is no page is named and not linked. Notebooks become pages with their
outputs.
"""

from __future__ import annotations

import os
import re
import shutil
from functools import partial
from pathlib import Path

from tools.site.notebooks import page_of

ROOT_PAGES = {"CONTRIBUTING.md": "contributing", "CHANGELOG.md": "changelog"}
"""Pages at the root that belong to the manual -> their names in it."""

_FENCE = re.compile(r"^( *)(```+|~~~+)")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^()\s]+)\)")


def assemble(root: Path, folder: Path) -> None:
    """Write the source of the manual of the checkout ``root`` into ``folder``, which is made."""
    docs = root / "docs"
    folder.mkdir(parents=True)
    shutil.copytree(docs / "images", folder / "images")
    pages = {(docs / f"{name}.md"): name for name in page_names(docs)}
    pages |= {root / file: name for file, name in ROOT_PAGES.items()}
    # A notebook may be called as a page of docs/ is.
    books = {path: f"notebook-{path.stem.replace('_', '-')}" for path in sorted((root / "examples").glob("*.ipynb"))}
    known = {path.resolve(): name for path, name in (pages | books).items()}
    for path, name in pages.items():
        text = path.read_text(encoding="utf-8")
        if name == "index":
            text += toctrees(text, known, docs)
        text = linked(text, path, known, docs)
        if name == "index":
            text = re.sub(r"^## [^\n]*\n\s*(?=^## |\Z)", "", text, flags=re.M)
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    for path, name in books.items():
        link = partial(linked, page=path, known=known, docs=docs)
        text = page_of(path, folder, name, link)
        (folder / f"{name}.md").write_text(text, encoding="utf-8")


def page_names(docs: Path) -> list[str]:
    """The pages of ``docs``, by name without its suffix."""
    return sorted(path.stem for path in docs.glob("*.md"))


def toctrees(index: str, known: dict[Path, str], docs: Path) -> str:
    """The contents, hidden, after the lists of links of ``index``: one for each of its headings. A page that is not
    there is left out; one that is there and in no list follows at the end."""
    trees, named = [], set()
    for part in re.split(r"^## ", index, flags=re.M)[1:]:
        title, _, body = part.partition("\n")
        targets = re.findall(r"^- \[[^\]]*\]\(([^()#\s]+)", body, flags=re.M)
        names = [known.get((docs / target).resolve(), "") for target in targets]
        names = [name for name in dict.fromkeys(names) if name and name not in named]
        named |= set(names)
        if names:
            trees.append((title.strip(), names))
    if rest := sorted(set(known.values()) - named - {"index"}):
        trees.append(("More", rest))
    blocks = ["```{toctree}", ":hidden:", ":caption: "]
    return "".join(
        "\n" + "\n".join([*blocks[:2], blocks[2] + title, "", *names, "```"]) + "\n" for title, names in trees
    )


def linked(text: str, page: Path, known: dict[Path, str], docs: Path) -> str:
    """``text`` of a ``page`` with its links as Sphinx knows them. Lines of a list whose only link is to a page that is
    not there are left out."""
    lines, fence = [], ""
    for line in text.split("\n"):
        mark = _FENCE.match(line)
        if mark and not fence:
            fence = mark[2]
        elif fence:
            fence = "" if line.strip() == fence else fence
        else:
            found = [target for _, _, target in LINK.findall(line)]
            if len(found) == 1 and line.startswith("- [") and _is_absent(found[0], page):
                continue
            line = LINK.sub(lambda m: _link(m, page, known, docs), line)
        lines.append(line)
    return "\n".join(lines)


def _is_absent(target: str, page: Path) -> bool:
    return target.endswith(".md") and "/" not in target and not (page.parent / target).exists()


def _link(found: re.Match, page: Path, known: dict[Path, str], docs: Path) -> str:
    mark, shown, target = found.groups()
    if re.match(r"\w+:|#", target):
        return found[0]
    file, hash_, anchor = target.partition("#")
    path = (page.parent / file).resolve()
    if path in known:
        return f"{mark}[{shown}]({known[path]}.md{hash_}{anchor})"
    if path.is_relative_to(docs.resolve()) and path.exists():
        return f"{mark}[{shown}]({os.path.relpath(path, docs.resolve())})"
    # A file of the checkout, which the manual does not hold.
    return shown
