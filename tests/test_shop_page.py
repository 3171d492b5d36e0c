"""The worked example of docs/shop.md, on a few people, and the files that docs/statistics.md shows."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np

from nerg_mi.aoi.scene import read_changes
from nerg_mi.formats.areas import read_areas
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows import demo
from tests.conftest import ROOT


def blocks(page: str, language: str) -> list[str]:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)


def shoppers(people: int = 5, each: int = 60) -> Rays:
    """People in the aisles who look about."""
    rng = np.random.default_rng(0)
    n = people * each
    origin = np.column_stack([rng.choice([2.75, 4.55, 6.3], n), rng.uniform(0.8, 4.8, n), np.full(n, 1.6)])
    d = rng.normal(size=(n, 3)) * (1, 1, 0.3)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    times, who = np.tile(0.2 * np.arange(each), people), np.repeat(np.arange(people), each)
    return Rays(times, who, tuple("abcde"[:people]), origin, d, np.ones(n))


def test01_the_example(tmp_path, monkeypatch):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    monkeypatch.chdir(tmp_path)
    folder = demo.store_scene().parent
    for name in ("shapes.xml", "twin.ply", "twin_lights.ply", "shoppers.safetensors"):
        shutil.copy(folder / name, tmp_path)
    for name, text in zip(("areas", "zones", "changes"), blocks("shop.md", "json")):
        (tmp_path / f"{name}.json").write_text(text)
    shoppers().save(tmp_path / "shop.npz")
    (code,) = blocks("shop.md", "python")
    # The page's own settings, on fewer places and directions.
    code = code.replace('output="numbers"', 'output="numbers", eyes=5, directions=512, resamples=199, samples=8')
    names: dict = {}
    exec(compile(code, "shop.md", "exec"), names)
    assert set(names["counted"]) == set(read_areas(tmp_path / "areas.json").names)
    assert names["weakest"] in names["counted"] and "display" in {r["thing"] for r in names["found"].what_if}
    assert (tmp_path / "numbers" / "things.png").is_file()


def test02_files_that_are_shown(tmp_path):
    areas, changes = blocks("statistics.md", "json")
    (tmp_path / "a.json").write_text(areas)
    (tmp_path / "c.json").write_text(changes)
    assert len(read_areas(tmp_path / "a.json").areas) == len(json.loads(areas)["regions"])
    found = read_changes(tmp_path / "c.json")
    assert found.move and found.remove and found.add and found.swap and found.observers is not None
