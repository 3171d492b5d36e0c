"""The blocks of docs/sign.md run as they stand there, one after the other, for fewer visitors."""

import re
import shutil
from pathlib import Path

import numpy as np

from nerg_mi.workflows import demo

PAGE = Path(__file__).resolve().parents[1] / "docs" / "sign.md"


def test_blocks(rgb, tmp_path, monkeypatch, capsys):
    store = tmp_path / "scenes" / "store"
    store.mkdir(parents=True)
    for name in ("twin.ply", "shoppers.safetensors"):
        shutil.copy(demo.store_scene().with_name(name), store)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for text in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S):
        exec(compile(text.replace("4.8, 9)", "4.8, 3)"), PAGE.name, "exec"), names)
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 6 and said[0].endswith("see more than half of it")
    seen, share = names["seen"], names["share"]
    assert len(share) == 12 and np.all((share >= 0) & (share < 0.2)) and share.max() > 1e-4
    # The third aisle sees it best, and what nobody can see attracts nobody.
    assert seen.reshape(4, 3).mean(axis=1).argmax() == 2
    assert np.all(share[seen == 0] < 0.3 * share.max())
