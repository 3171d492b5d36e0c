"""Visibility and depth of the store's field, compared with exact ray casts at its mesh (the twin).

    python benchmarks/store_visibility.py [--field FILE] [--width 240]

For several pairs of a camera and an observer, the integrator `nerg` renders depth, position and visibility (fall-off 0,
one ray per pixel). The same rays are cast at the twin. A pixel is correct if its visibility is 1 where the observer
sees the twin's surface along the ray of the pixel, and 0 elsewhere.

Pixels within `--margin` pixels of a discontinuity of the exact depth or of the exact visibility are counted separately.
At such silhouettes a centimetre decides about visibility, and a field has no edges finer than its grid. The other
pixels are called "away from silhouettes", and `kept` is their fraction.

The benchmark prints means over the pairs: the fraction of pixels with a wrong visibility, away from silhouettes and in
total; the fraction of pixels away from silhouettes; the depth errors in cm over all pixels with a surface, and their
90 % quantile away from silhouettes. The CSV file has one row per pair. `agree` is the fraction of correct pixels away
from silhouettes; the others are `wrongly seen` or `wrongly hidden`. `agree all` includes silhouettes. `agree own` tests
the field's own surface point instead of the twin's, without the last 5 cm. `visible` is the fraction of pixels that the
observer sees.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

# name: (camera, target, eye). Cameras look over or around shelves; eyes are a shopper's.
PAIRS = {
    "demo": ("7.4, 3.4, 2.2", "4.8, 4.2, 1.0", "4.4, 2.8, 1.6"),
    "aisle 3, from the south": ("6.5, 0.7, 2.3", "4.6, 3.0, 1.1", "4.8, 2.2, 1.6"),
    "aisle 3, from the north": ("6.5, 5.0, 2.2", "4.5, 2.8, 0.9", "4.5, 2.0, 1.6"),
    "aisle 2, from the north": ("4.9, 5.0, 2.2", "2.8, 2.6, 0.9", "2.75, 2.0, 1.6"),
    "aisle 1, from the south": ("2.75, 0.7, 2.2", "1.0, 3.0, 1.0", "0.9, 3.2, 1.6"),
    "counter, from the west": ("4.55, 1.0, 2.2", "7.0, 2.6, 1.0", "6.3, 3.0, 1.6"),
    "coolers, from the south": ("6.3, 1.0, 2.3", "3.6, 5.6, 1.2", "3.6, 4.8, 1.6"),
    "door, level": ("6.3, 4.9, 1.6", "5.6, 1.0, 1.1", "5.6, 0.7, 1.6"),
}
CENTIMETRES = {
    "median cm": "median depth error, cm",
    "p90 cm": "90 % quantile, cm",
    "p90 cm away": "90 % quantile away from silhouettes, cm",
}
KINDS = ("expected", "median", "refined")


def near_edges(depth: np.ndarray, visible: np.ndarray, margin: int) -> np.ndarray:
    """Pixels (h, w) within ``margin`` pixels of a discontinuity of the exact depth (over 4 cm + 3 %) or of
    visibility."""
    from scipy.ndimage import binary_dilation

    edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        lo = (slice(None),) * axis + (slice(None, -1),)
        hi = (slice(None),) * axis + (slice(1, None),)
        jump = np.abs(depth[hi] - depth[lo]) > 0.04 + 0.03 * np.minimum(depth[hi], depth[lo])
        jump |= visible[hi] != visible[lo]
        edge[lo] |= jump
        edge[hi] |= jump
    # Pixels on both sides of a discontinuity are already marked.
    return binary_dilation(edge, np.ones((3, 3)), iterations=margin - 1) if margin > 1 else edge


def measure(scene: Path, pair: str, kind: str, visibility: str, files: dict, width: int, margin: int) -> dict:
    """One row of the table."""
    from nerg_mi.scenes.store import twin

    import mitsuba as mi

    camera, target, eye = PAIRS[pair]
    values = {
        "camera": camera,
        "target": target,
        "eye": eye,
        "width": str(width),
        "height": str(2 * width // 3),
        "depth": kind,
        "visibility": visibility,
        "falloff": "0",
        "radiance": "false",
        "aovs": "opacity,position,visibility",
        **files,
    }
    loaded = mi.load_file(str(scene), **values)
    start = time.perf_counter()
    picture = np.array(mi.render(loaded, sensor=0, spp=1, seed=1), np.float64)[..., 3:]
    seconds = time.perf_counter() - start
    opacity, p, seen = picture[..., 0], picture[..., 1:4], picture[..., 4]

    # Mitsuba jitters each ray within its pixel; the surface point of the field identifies it.
    surface = opacity >= 0.5
    o, e = (np.array([float(x) for x in v.split(",")]) for v in (camera, eye))
    # From the camera's centre; the AOV "depth" starts at the near plane.
    depth = np.linalg.norm(p - o, axis=-1)
    d = (p - o) / np.maximum(depth[..., None], 1e-9)
    exact = np.full(depth.shape, np.nan)
    exact[surface] = twin.cast_rays(o, d[surface])
    # A millimetre in front of the surface, so that it does not hide itself.
    truth, separate = np.zeros(depth.shape, bool), np.zeros(depth.shape, bool)
    truth[surface] = twin.is_visible(e, (o + (exact[surface, None] - 1e-3) * d[surface]))
    separate[surface] = twin.is_visible(e, p[surface], tolerance=0.05)

    far = surface & ~near_edges(np.nan_to_num(exact, nan=1e3), truth, margin)
    shown = seen > 0.5
    error = 100 * np.abs(depth - exact)[surface]
    return {
        "pair": pair,
        "depth": kind,
        "visibility": visibility,
        "agree": (shown == truth)[far].mean(),
        "wrongly seen": (shown & ~truth)[far].mean(),
        "wrongly hidden": (~shown & truth)[far].mean(),
        "agree all": (shown == truth)[surface].mean(),
        "agree own": (shown == separate)[far].mean(),
        "kept": far.mean(),
        "visible": truth[surface].mean(),
        "no surface": 1 - surface.mean(),
        "median cm": np.median(error),
        "p90 cm": np.percentile(error, 90),
        "within 5 cm": (error < 5).mean(),
        "within 10 cm": (error < 10).mean(),
        "p90 cm away": np.percentile(100 * np.abs(depth - exact)[far], 90),
        "seconds": seconds,
    }


def table(rows: list[dict]) -> list[list[str]]:
    """Cells of the means over pairs, one row per kind of depth and visibility."""
    out = []
    for key in dict.fromkeys((r["depth"], r["visibility"]) for r in rows):
        mine = [r for r in rows if (r["depth"], r["visibility"]) == key]
        mean = {k: float(np.mean([r[k] for r in mine])) for k, v in mine[0].items() if not isinstance(v, str)}
        wrong = [f"{100 * (1 - mean[k]):.2f}" for k in ("agree", "agree all")]
        out.append([*key, *wrong, f"{mean['kept']:.0%}", *(f"{mean[k]:.2f}" for k in CENTIMETRES)])
    return out


def main(argv=None) -> None:
    from timing import save_result

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", type=Path, help="Checkpoint of the radiance field. Default: that of the store.")
    parser.add_argument(
        "--gaze",
        type=Path,
        help="Checkpoint of the gaze field, which is loaded but not evaluated. Default: that of the store.",
    )
    parser.add_argument(
        "--width",
        type=int,
        default=240,
        help="Width of the images in pixels; their aspect ratio is 3:2. Default: %(default)s.",
    )
    parser.add_argument(
        "--margin",
        type=int,
        default=2,
        help="Distance from a silhouette in pixels within which pixels are left out. Default: %(default)s.",
    )
    parser.add_argument(
        "--kinds",
        default="expected,median",
        help=f"Kinds of depth, separated by commas, of {', '.join(KINDS)}. Default: %(default)s.",
    )
    parser.add_argument(
        "--visibility",
        default="depth",
        help="Kinds of visibility, separated by commas, of depth, transmittance, map. Default: %(default)s.",
    )
    parser.add_argument(
        "--pair",
        action="append",
        choices=list(PAIRS),
        help="Pair of camera and observer; can be repeated. Default: all.",
    )
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.scenes.store import SCENE_FILE

    files = {k: str(v.resolve()) for k, v in (("field", args.field), ("gaze", args.gaze)) if v is not None}
    rows = [
        measure(SCENE_FILE, pair, kind, visibility, files, args.width, args.margin)
        for visibility in args.visibility.split(",")
        for kind in args.kinds.split(",")
        for pair in args.pair or PAIRS
    ]
    head = ("depth", "visibility", "wrong visibility away from silhouettes, %", "wrong visibility, %")
    head += ("pixels away from silhouettes", *CENTIMETRES.values())
    save_result("store-visibility", head, table(rows))


if __name__ == "__main__":
    main()
