import importlib.util

import numpy as np
import pytest

from nerg_mi.attention.rays import FRAME, Rays

ENDINGS = [
    "npz",
    pytest.param(
        "parquet",
        marks=pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="pyarrow is not installed (pip install pyarrow)"),
    ),
]


def some(hit):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(9, 3))
    points = rng.random((9, 3))
    points[4] = np.nan
    return Rays(
        np.arange(9) / 7, np.arange(9) % 2, ("ann", "bo"), rng.random((9, 3)),
        d / np.linalg.norm(d, axis=1, keepdims=True), rng.random(9), points if hit else None,
        {"frame": dict(FRAME), "dropped": [{"reason": "blink", "count": 2, "rows": [[3, 4]]}]},
    )  # fmt: skip


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("hit", [True, False])
def test_round_trip(tmp_path, ending, hit):
    rays, path = some(hit), tmp_path / f"rays.{ending}"
    rays.save(path)
    back = Rays.load(path)
    assert back.persons == rays.persons and back.metadata == rays.metadata and (back.hit is None) == (not hit)
    for name in ("t", "person", "origin", "direction", "confidence"):
        assert np.array_equal(getattr(back, name), getattr(rays, name))
    if hit:
        assert np.array_equal(back.hit, rays.hit, equal_nan=True)


def test_refusals(tmp_path):
    with pytest.raises(ValueError, match=".npz or .parquet"):
        some(False).save(tmp_path / "rays.csv")
    np.savez(tmp_path / "other.npz", t=np.zeros(3))
    with pytest.raises(ValueError, match="not a rays file .*person.*nerg rays import"):
        Rays.load(tmp_path / "other.npz")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(ValueError, match="not a rays file"):
        Rays.load(tmp_path / "text.npz")


def test_parquet_without_pyarrow(tmp_path, monkeypatch):
    import builtins

    real = builtins.__import__

    def no_pyarrow(name, *args, **kwargs):
        if name.startswith("pyarrow"):
            raise ImportError("no module")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_pyarrow)
    with pytest.raises(ImportError, match="nerg-mi\\[parquet\\]"):
        some(False).save(tmp_path / "rays.parquet")
