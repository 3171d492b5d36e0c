"""The Python of docs/clusters.md, run as it stands."""

import re

from tests.conftest import ROOT


def test_the_page_is_run(capsys):
    (block,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "clusters.md").read_text("utf-8"), re.M | re.S)
    exec(compile(block, "clusters.md", "exec"), {"__name__": "page"})
    assert capsys.readouterr().out == ".txt 2.0\n"
