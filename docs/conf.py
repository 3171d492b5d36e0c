"""Sphinx configuration of the manual (`make manual`). Neither the build nor a page uses the network.

The source folder is the whole checkout, so that links between pages, notebooks and files also work on a code host. The
pages in docs/reference are written from the code when a build starts.
"""

import os
import re
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

from nerg_mi import __version__

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tools import reference, results

project = "nerg_mi"
author = "The authors of nerg_mi"
project_copyright = "the authors of nerg_mi, Apache-2.0"
release = version = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
include_patterns = ["docs/index.md", "docs/*/*.md", "CONTRIBUTING.md", "CHANGELOG.md", "examples/*.ipynb"]
root_doc = "docs/index"
language = "en"
# Options begin with two dashes.
smartquotes = False

# Pages are parsed as a code host parses them.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4
# Notebooks have headings of their own.
suppress_warnings = ["myst.header"]
nb_execution_mode = "off"
highlight_language = "none"
default_role = "literal"

# Types in docstrings are prose ("path, optional") and no names to be linked.
napoleon_google_docstring = False
napoleon_use_param = False
napoleon_use_rtype = False
napoleon_use_ivar = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_class_signature = "mixed"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80
add_module_names = False
toc_object_entries_show_parents = "hide"

html_math_renderer = "mathml"
html_theme = "furo"
html_title = f"nerg_mi {release}"
html_static_path = ["static"]
html_css_files = ["manual.css"]
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}


def add_contents(app, page, source):
    """Add a table of contents to each section of docs/index.md: hidden, with the pages listed there; or visible, with
    the pages of the reference, to which the repository has no links."""
    if page != root_doc:
        return
    parts = re.split(r"^(?=## )", source[0], flags=re.M)
    for k, part in enumerate(parts[1:], 1):
        title = part.partition("\n")[0].removeprefix("## ")
        targets = re.findall(r"^- \[[^\]]*\]\(([^()#\s]+)", part, flags=re.M)
        entries = [f"/{Path('docs', target)}".replace("/docs/../", "/").rsplit(".", 1)[0] for target in targets]
        options = ":hidden:"
        if title == "Reference":
            entries, options = [f"/docs/reference/{name}" for name in reference.PAGES], ":maxdepth: 1"
        parts[k] += "\n".join(["```{toctree}", options, f":caption: {title}", "", *entries, "```", "", ""])
    source[0] = "".join(parts)


def link_reference(app, page, source):
    """Lead links to a file whose docstring is a section of the reference to that section."""
    folder = Path(page).parent
    sections = reference.find_sections()

    def target(match):
        path = os.path.normpath(folder / match[1])
        return (
            f"]({os.path.relpath(reference.FOLDER / sections[path], reference.ROOT / folder)})"
            if path in sections
            else match[0]
        )

    source[0] = re.sub(r"\]\(([\w./-]+\.py)\)", target, source[0])


def add_results(app, page, source):
    """Insert the tables of benchmarks at their markers."""
    source[0] = results.insert(source[0])


def add_inline(writer, node):
    """Write an inline formula as MathML, which browsers render without scripts."""
    writer.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def add_displayed(writer, node):
    """Write a displayed formula as MathML."""
    writer.body.append(f'<div class="math-block">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app):
    app.connect("config-inited", lambda app, config: reference.write_pages())
    app.connect("source-read", add_contents)
    app.connect("source-read", add_results)
    app.connect("source-read", link_reference)
    app.add_html_math_renderer("mathml", (add_inline, None), (add_displayed, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
