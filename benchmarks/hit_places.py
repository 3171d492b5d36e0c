"""How right a place made of hit points is (`--geometry hits`): a room with a window in closed form, and recorded
people.

    python benchmarks/hit_places.py [--rays 200000]

Depths along rays that the place was not made of (the room) or all rays (recorded) are compared with where those rays
ended: of looks that stay near, and of those that go far. The supermarket (../shared/data, or $NERG_DATA) is left out
where it is not there.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
import nerg_mi  # noqa: E402, F401 (before Mitsuba, since it chooses the libLLVM)
from nerg_mi.files.tables import markdown_table  # noqa: E402


def row(name: str, rays, seen, far: np.ndarray) -> str:
    """A row of the table: the place of ``rays``, looked at along ``seen``, of which ``far`` (N,) go far."""
    from nerg_mi.training.geometry.places import place_of_hits
    from nerg_mi.transport.trace import trace_depth

    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        place = place_of_hits(rays, Path(folder) / "place.vol")
        seconds = time.perf_counter() - start
        depth, opacity = trace_depth(place.medium, seen.origin, seen.direction)
    made = place.about["geometry_file"]
    off, met = depth - np.linalg.norm(seen.hit - seen.origin, axis=1), opacity > 0.99
    near = np.abs(off[met & ~far])
    nearer = f"{-np.median(off[met & far]):.1f}" if far.any() else "-"
    share = f"{100 * met[far].mean():.1f}" if far.any() else "-"
    cells = [
        name,
        " x ".join(map(str, made["shape"])),
        f"{made['voxel']:.3g}",
        f"{100 * made['beyond']:.1f}",
        f"{100 * met[~far].mean():.1f}",
        f"{np.median(near):.3f}",
        f"{np.quantile(near, 0.9):.3f}",
        f"{np.quantile(near, 0.99):.3f}",
        share,
        nearer,
        f"{seconds:.1f}",
    ]
    return cells


def supermarket(count: int):
    """Rays of recorded people with hit points, at most ``count``; None where the recording is not there."""
    from nerg_mi.rays.readers.registry import read_rays

    folder = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data")) / "vr_supermarket"
    if not folder.is_dir():
        return None
    rays = read_rays("vr_supermarket", sorted(folder.glob("*.csv.gz")))
    known = np.nonzero(np.isfinite(rays.hit).all(axis=1))[0]
    return rays.select(np.sort(np.random.default_rng(0).permutation(known)[:count]))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rays", type=int, default=200_000)
    options = parser.parse_args(arguments)

    import mitsuba as mi
    from tests.reference.office import looks_out, office

    mi.set_variant("llvm_ad_rgb")
    head = (
        "place",
        "voxels",
        "edge, m",
        "hits on the shell, %",
        "near looks that meet something, %",
        "off by, median m",
        "90 %",
        "99 %",
        "far looks that meet something, %",
        "too near, median m",
        "made in, s",
    )
    seen = office(20_000, seed=1)
    rows = [row("room of 8 x 6 x 3 m, window", office(options.rays), seen, looks_out(seen.origin, seen.direction))]
    rays = supermarket(options.rays)
    if rays is not None:
        rows.append(row("supermarket, recorded", rays, rays, np.zeros(len(rays), bool)))
    print(markdown_table(head, rows))


if __name__ == "__main__":
    main()
