"""Notebooks as pages: text, code, pictures and words that came of it."""

from __future__ import annotations

import base64
import json

from tools.site.notebooks import page_of


def test_a_notebook_is_a_page(tmp_path):
    picture = base64.b64encode(b"png").decode()
    cells = [
        {"cell_type": "markdown", "source": ["# Title\n", "words"]},
        {
            "cell_type": "code",
            "source": "a = 1\na",
            "outputs": [
                {"output_type": "stream", "text": ["\x1b[31mtold\x1b[0m\n"]},
                {"output_type": "execute_result", "data": {"text/plain": ["1"]}},
                {"output_type": "display_data", "data": {"image/png": picture, "text/plain": "<Figure>"}},
            ],
        },
        {"cell_type": "code", "source": "", "outputs": []},
    ]
    (tmp_path / "a.ipynb").write_text(json.dumps({"cells": cells}))
    (tmp_path / "images").mkdir()
    page = page_of(tmp_path / "a.ipynb", tmp_path, "a")
    assert page.startswith(
        "# Title\nwords\n\n*This page is the notebook `examples/a.ipynb`.*\n\n```python\na = 1\na\n```"
    )
    assert "```text\ntold\n```" in page and "```text\n1\n```" in page and "<Figure>" not in page
    assert "![Output](images/a-1-2.png)" in page and (tmp_path / "images" / "a-1-2.png").read_bytes() == b"png"
