"""Numbers of attention on things of one half of the people against the other half: the VR supermarket.

    NERG_DATA=DIR python benchmarks/object_halves.py [--splits 50]

Things are boxes over the shelves, fitted to the hit points of cells of the floor (`proxy_boxes`); rays end at their hit
points. Columns: correlation of the two halves' numbers over things, median of |a - b| / mean, and how often the two
intervals overlap; means over ways to halve.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import fields, replace
from pathlib import Path

import nerg_mi  # chooses the libLLVM, so it comes before drjit and mitsuba
from object_statistics import counting_of

import numpy as np


def halves(splits: int) -> None:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.formats.areas.kinds import Areas
    from nerg_mi.formats.regions import Region
    from nerg_mi.jobs.counting.surroundings import Surroundings
    from nerg_mi.jobs.counting.things import things_of
    from nerg_mi.jobs.counting.tracked import count_block
    from nerg_mi.maths.similarity import Similarity
    from nerg_mi.statistics.measures import MEASURES, People
    from nerg_mi.statistics.sums import ALL

    folder = Path(os.environ.get("NERG_DATA", "../shared/data")) / "vr_supermarket"
    rays = nerg_mi.import_rays(sorted(folder.glob("*.csv.gz")), "vr_supermarket")
    hit = rays.hit[np.isfinite(rays.hit).all(axis=1)]
    boxes = proxy_boxes(hit)
    areas = Areas(tuple(Region.of(f"shelf {k + 1}", *b) for k, b in enumerate(boxes)))
    around = Surroundings(None, None, Similarity())
    counting = counting_of(around, areas, things_of(areas.things, {}), seen=False)
    counting = replace(counting, hits=True)
    sums = count_block(rays, counting)
    people = People.of(sums, ALL, False)
    print(f"{len(rays):,} rays of {len(people.names)} people, {len(boxes)} boxes\n")
    rng = np.random.default_rng(0)
    print("| measure | r of halves | median difference | intervals of halves overlap |\n| --- | ---: | ---: | ---: |")
    for m in MEASURES:
        pair = m.pair(people)
        if pair is None:
            continue
        r, gap, both = [], [], []
        for _ in range(splits):
            order = rng.permutation(len(people.names))
            first, second = np.sort(order[: len(order) // 2]), np.sort(order[len(order) // 2 :])
            e = [m.estimate(part(people, who), 499, 0) for who in (first, second)]
            known = np.isfinite(e[0].value) & np.isfinite(e[1].value)
            if known.sum() > 2 and np.ptp(e[0].value[known]) > 0 and np.ptp(e[1].value[known]) > 0:
                r.append(np.corrcoef(e[0].value[known], e[1].value[known])[0, 1])
            middle = (e[0].value + e[1].value)[known] / 2
            gap.append(np.median(np.abs(e[0].value - e[1].value)[known] / np.maximum(middle, 1e-12)))
            some = np.isfinite(e[0].low) & np.isfinite(e[1].low)
            both.append(((e[0].low <= e[1].high) & (e[1].low <= e[0].high))[some].mean())
        print(f"| {m.name} | {np.mean(r):.2f} | {100 * np.mean(gap):.0f} % | {100 * np.mean(both):.0f} % |")


def part(people, who):
    made = {f.name: v[who] for f in fields(people) if isinstance(v := getattr(people, f.name), np.ndarray)}
    return replace(people, names=tuple(people.names[k] for k in who), **made)


def proxy_boxes(hit: np.ndarray, most: int = 24) -> list:
    """Boxes of 2 m over the floor's cells that most hit points between 0.3 and 2.2 m lie in, fitted to these."""
    some = hit[(hit[:, 2] > 0.3) & (hit[:, 2] < 2.2)]
    cell = np.floor(some[:, :2] / 2.0).astype(int)
    cells, of, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    found = []
    for k in np.argsort(-count)[:most]:
        mine = some[of.ravel() == k]
        low, high = np.percentile(mine, 2, axis=0), np.percentile(mine, 98, axis=0)
        found.append((low - 0.02, np.maximum(high, low + 0.05) + 0.02))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splits", type=int, default=50, help="ways to halve people (50)")
    halves(parser.parse_args().splits)


if __name__ == "__main__":
    main()
