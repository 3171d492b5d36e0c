"""Small sources for datasets, and the expected rays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerg_mi.tracking.dataset import RayDataset
from nerg_mi.tracking.dataset_write import ImportRecipe, update_dataset
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import ColumnMap
from nerg_mi.tracking.readers.registry import get_reader, make_options, read_rays

MAP = "origin=x,y,z direction=a,b,c t=t person=p confidence=q hit=h,i,j cohort=g"
DAY = 20_000 * 86_400.0  # midnight of 2024-10-04, seconds since 1970


def write_source(path: Path, seed: int = 0, count: int = 400, people: int = 3, start: float = 0.0) -> Path:
    """Write a table of rays of some participants, sorted by time; the confidence of the third row is missing."""
    rng = np.random.default_rng(seed)
    origin = rng.uniform(0, 6, (count, 3)) * [1, 1, 0.1] + [0, 0, 1.5]
    direction = rng.normal(size=(count, 3))
    hit = origin + direction
    hit[rng.random(count) < 0.2] = np.nan
    rows = ["t,p,x,y,z,a,b,c,q,h,i,j,g"]
    for k in range(count):
        cells = [f"{start + 0.02 * k:.3f}", f"p{seed}_{k % people}", *(f"{v:.5f}" for v in (*origin[k], *direction[k]))]
        ends = ["" if np.isnan(v) else f"{v:.5f}" for v in hit[k]]
        rows.append(",".join([*cells, "" if k == 2 else f"{0.1 * (k % 10 + 1):.1f}", *ends, "xy"[k % 2]]))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")
    return path


def settings():
    return make_options("table", {"columns": ColumnMap.parse(MAP)})


def recipe(**changes) -> ImportRecipe:
    return ImportRecipe(**{"reader": get_reader("table"), "settings": settings(), "place": "shop", **changes})


def write_dataset(folder: Path, files: int = 3, **changes) -> tuple[RayDataset, Rays]:
    """A dataset of some files in ``folder``, and the rays of the same files imported at once."""
    paths = [write_source(folder / "files" / f"{k}.csv", k, start=DAY + 43_200 * k) for k in range(files)]
    update_dataset(folder / "shop.rays", paths, recipe(**changes))
    return RayDataset.open(folder / "shop.rays"), read_rays("table", paths, settings())


def in_order(rays: Rays) -> Rays:
    """The same rays by participant and time, an order that does not depend on their storage."""
    return rays.select(np.lexsort((rays.t, np.array(rays.persons)[rays.person])))


def assert_same(one: Rays, two: Rays) -> None:
    """Assert that both have the same rays, except for rounding of positions to float32."""
    assert len(one) == len(two)
    one, two = in_order(one), in_order(two)
    assert np.array_equal(one.t, two.t) and np.array_equal(one.confidence, two.confidence)
    assert (np.array(one.persons)[one.person] == np.array(two.persons)[two.person]).all()
    for name in ("origin", "direction", "hit"):
        assert np.allclose(getattr(one, name), getattr(two, name), rtol=1e-6, atol=1e-7, equal_nan=True), name
    if one.cohort is not None and two.cohort is not None:
        assert (np.array(one.cohorts)[one.cohort] == np.array(two.cohorts)[two.cohort]).all()


def crowd(count: int = 1000, start: float = 0.0, seed: int = 0) -> Rays:
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    names = ("zoe", "ann", "bo", "名")
    return Rays(
        start + np.arange(count) * 0.1, rng.integers(0, 4, count), names, rng.random((count, 3)), d, np.ones(count)
    )
