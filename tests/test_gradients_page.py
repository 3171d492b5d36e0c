"""The blocks of docs/gradients.md run as they stand there, one after the other, only smaller and on untrained
fields."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.workflows import demo
from tests.figures.standins import write_standins

PAGE = Path(__file__).resolve().parents[1] / "docs" / "gradients.md"


@pytest.mark.nightly
def test01_blocks(rgb, tmp_path, monkeypatch):
    store = tmp_path / "scenes" / "store"
    store.mkdir(parents=True)
    shutil.copy(demo.store_scene(), store)
    write_standins(store)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
    names = {}
    for text in blocks:
        small = text.replace("width=480, height=320", "width=12, height=8").replace("batch=4096", "batch=64")
        exec(compile(small, PAGE.name, "exec"), names)
    assert np.isfinite(np.array(names["change"])).all() and np.any(np.array(names["change"]) != 0)
    losses, errors = ([x.numpy().item() for x in names[name]] for name in ("losses", "errors"))
    # From whole views, then frozen; and of a camera that nothing was trained on, before and after, then with batches of
    # rays.
    assert len(losses) == 14 and max(losses[9:]) < losses[0] and losses[-1] < losses[9]
    assert len(errors) == 4 and errors[1] < errors[0] and errors[3] < errors[2], errors


def test02_what_it_names_is_there():
    root = PAGE.parents[1]
    for path in re.findall(r"`((?:tests|benchmarks|nerg_mi)/[\w/.]+\.py)`", PAGE.read_text(encoding="utf-8")):
        assert (root / path).is_file(), path
