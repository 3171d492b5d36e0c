"""Notebooks as pages of the manual: their text, their code, and what it gave."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

_ANSI = re.compile(r"\x1b\[[0-9;]*m")


def page_of(path: Path, folder: Path, name: str, link: Callable[[str], str] = str) -> str:
    """The notebook ``path`` as the text of the page ``name`` in ``folder``; its pictures are written into images/
    there. ``link`` makes links of a notebook's text those of the page."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    parts = []
    for number, cell in enumerate(cells):
        text = "".join(cell["source"]).rstrip()
        if cell["cell_type"] == "markdown":
            parts.append(link(text))
        elif cell["cell_type"] == "code" and text:
            parts.append(f"```python\n{text}\n```")
            for i, output in enumerate(cell["outputs"]):
                parts.append(_output(output, folder, f"{name}-{number}-{i}"))
    note = f"*This page is the notebook `examples/{path.name}`.*"
    return "\n\n".join([parts[0], note, *parts[1:]]) + "\n"


def _output(output: dict[str, Any], folder: Path, name: str) -> str:
    """An output of a cell: its picture, else its text."""
    data = output.get("data", {})
    if "image/png" in data:
        picture = folder / "images" / f"{name}.png"
        picture.write_bytes(base64.b64decode("".join(data["image/png"])))
        return f"![Output](images/{picture.name})"
    text = "".join(output.get("text") or data.get("text/plain") or output.get("traceback") or "")
    return f"```text\n{_ANSI.sub('', text).rstrip()}\n```" if text.strip() else ""
