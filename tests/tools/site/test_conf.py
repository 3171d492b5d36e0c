"""What Sphinx is told: nothing that loads anything from elsewhere."""

from __future__ import annotations

from tools.site import conf


def test_nothing_is_asked_of_the_network():
    assert not {"sphinx.ext.intersphinx", "sphinx.ext.mathjax"} & set(conf.extensions)
    assert conf.html_math_renderer == "mathml" and not [path for path in conf.html_css_files if "//" in path]
