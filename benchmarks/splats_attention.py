"""Attention of each Gaussian of the store's splats, beside that of the twin's mesh for the same observers.

    python benchmarks/splats_attention.py [--splats FILE] [--resolution 208] [--shoppers 40]
        [--out out/benchmarks/splats_attention.csv]

Both are what `nerg bake` writes, on the splats that `nerg export splats` makes of the field (or `--splats FILE`) and on
`twin.ply`. A Gaussian is compared with the face of the cut mesh whose middle is nearest, where that is within 5 cm and
its normal within 25 degrees of the Gaussian's shortest axis: `matched` of them are. `cc`: correlation; `ratio`: median
over Gaussians and faces that both receive something; `agree`: share in which both do or neither does; `lost`: share of
the twin's gaze on matched faces that Gaussians have none of. First table: observers of the store's field. Second: the
rays of simulated shoppers themselves (`--from rays`), by lines and by cones, smoothed along the surface or not;
`halves` and `of the twin`: CC between the halves of the people, on the Gaussians and on the mesh; `on`: share of gaze
on either. Files of the last lie beside `--out`.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

NEAR, ALIKE = 0.05, np.cos(np.radians(25))
CASES = ((0.0, 0.0), (1.5, 0.0), (1.5, 0.05), (1.5, 0.1))
EYES = ((4.4, 2.8, 1.6), (2.0, 1.2, 1.6), (6.4, 3.2, 1.6))


def axes_of(splats) -> np.ndarray:
    """The shortest axis (N, 3) of each Gaussian; quaternions are scalar first."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(splats.rotations, scalar_first=True).as_matrix()
    return np.take_along_axis(turned, splats.scales.argmin(axis=1)[:, None, None], axis=2)[..., 0]


def compare(splats, attention: np.ndarray, mesh, density: np.ndarray) -> dict[str, float]:
    """Scores of ``attention`` (N,) beside the vertices' ``density`` (V,) of ``mesh``."""
    from scipy.spatial import KDTree

    theirs = density[mesh.faces].mean(axis=1)
    far, nearest = KDTree(mesh.corners.mean(axis=1)).query(splats.centers)
    cosine = np.abs((axes_of(splats) * mesh.normals[nearest]).sum(axis=1))
    matched = (far < NEAR) & (cosine > ALIKE)
    ours, theirs = attention[matched], theirs[nearest[matched]]
    both = (ours > 0) & (theirs > 0)
    return {
        "matched": float(matched.mean()),
        "cc": float(np.corrcoef(ours, theirs)[0, 1]),
        "ratio": float(np.median(ours[both] / theirs[both])),
        "agree": float(((ours > 0) == (theirs > 0)).mean()),
        "lost": float(theirs[ours == 0].sum() / theirs.sum()),
    }


def of_rays(args, twin: Path) -> list[dict]:
    """Rows of the second table."""
    from bake import shoppers
    from nerg_mi.jobs.bake import bake
    from nerg_mi.jobs.bake_splats import bake_splats
    from nerg_mi.jobs.options.bake import BakeOptions

    args.rays, rows = None, []
    rays = shoppers(args)
    print(f"{len(rays):,} rays of {args.shoppers} shoppers", flush=True)
    for cone, smooth in CASES:
        options = BakeOptions(source="rays", cone=cone, smooth=smooth, halves=True)
        outputs = [args.out.parent / f"rays-{kind}.ply" for kind in ("splats", "twin")]
        started = time.perf_counter()
        ours = bake_splats(args.splats, outputs[:1], options, rays=rays)
        middle = time.perf_counter()
        theirs = bake(twin, outputs[1:], options, rays=rays)
        row = {"cone": f"{cone:g}", "smoothed cm": f"{100 * smooth:g}"}
        row |= compare(ours.splats, ours.attention, theirs.mesh, theirs.density)
        row |= {"halves": ours.summary["halves_cc"], "of the twin": theirs.summary["halves_cc"]}
        row |= {"on": ours.summary["on_splats"], "on the twin": theirs.on_surface}
        row["unaccounted"] = ours.summary["unaccounted"]
        rows.append(row | {"s": middle - started, "s of the twin": time.perf_counter() - middle})
    return rows


def main(argv=None) -> None:
    from output import write_rows
    from splats import make, show

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--splats", type=Path, help="file of splats (default: made of the field)")
    parser.add_argument("--resolution", type=int, default=208, help="lattice cells of what is made")
    parser.add_argument("--shoppers", type=int, default=40, help="people whose rays are put on both")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/splats_attention.csv"))
    args = parser.parse_args(argv)
    from nerg_mi.jobs.backend import select_backend
    from nerg_mi.jobs.bake import bake
    from nerg_mi.jobs.bake_splats import bake_splats
    from nerg_mi.jobs.demo import store_scene
    from nerg_mi.jobs.options.bake import BakeOptions

    args.out.parent.mkdir(parents=True, exist_ok=True)
    if args.splats is None:
        args.splats = args.out.parent / "store.ply"
        select_backend("llvm_ad_rgb", None)
        make(args.splats, args.resolution)
    store, rows = store_scene().parent, []
    for eye in EYES:
        options = BakeOptions(gaze=store / "shoppers.safetensors", observer=eye)
        started = time.perf_counter()
        ours = bake_splats(args.splats, (), options)
        seconds = time.perf_counter() - started
        theirs = bake(store / "twin.ply", (), options)
        found = compare(ours.splats, ours.attention, theirs.mesh, theirs.density)
        rows.append({"observer": ", ".join(f"{v:g}" for v in eye), **found, "s": seconds})
    show("Attention of Gaussians beside that of the twin", rows)
    write_rows(args.out, rows)
    rows = of_rays(args, store / "twin.ply")
    show("Tracked rays on Gaussians beside those on the twin", rows)
    write_rows(args.out.with_name("splats_rays.csv"), rows)


if __name__ == "__main__":
    main()
