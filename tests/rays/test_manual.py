"""The example of docs/rays.md runs."""

import re
from pathlib import Path

import numpy as np

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "rays.md"


def test_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(3000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    Rays(
        np.arange(3000) * 0.1,
        np.arange(3000) % 3,
        tuple("abc"),
        rng.uniform([0, 0, 1.5], [1, 1, 1.7], (3000, 3)),
        d,
        np.ones(3000),
    ).save("day.npz")
    names = {
        "directions": fibonacci_directions(500),
        "observer": np.array([0.5, 0.5, 1.6]),
        "position": rng.uniform(2, 3, (6, 8, 3)),
    }
    (example,) = re.findall(r"```python\n(.*?)```", MANUAL.read_text(), re.S)
    exec(compile(example, str(MANUAL), "exec"), names)
    assert np.allclose(names["density"].mean(axis=1) * 4 * np.pi, 1, atol=0.05) and names["picture"].shape == (6, 8)
