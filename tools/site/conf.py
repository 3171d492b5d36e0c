"""What Sphinx is told about the manual (`make manual`). Nothing here reaches for the network, and no page does."""

from nerg_mi import __version__

project = "nerg_mi"
author = "The authors of nerg_mi"
project_copyright = "the authors of nerg_mi, Apache-2.0"
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "tools.site.mathml"]
source_suffix = {".md": "markdown"}
language = "en"
# Two dashes begin an option.
smartquotes = False
nitpicky = False

# Pages are read as a code host reads them.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
myst_heading_anchors = 4
# A page may begin with a part of a notebook, whose headings are its own.
suppress_warnings = ["myst.header"]
highlight_language = "none"
default_role = "literal"

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
# Furo shows a page's source on a code host only where it is told one.
html_theme_options = {"navigation_with_keys": True}
