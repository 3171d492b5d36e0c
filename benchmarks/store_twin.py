"""The store as shapes against the store as a field, and a new display put into the field.

    python benchmarks/store_twin.py [--pair NAME] [--width 120] [--out out/benchmarks/store_twin.csv] [--picture
    FILE.png]

First table: `scenes/store/scene.xml` (a trained field) and `scenes/store/shapes.xml` (no field: the triangles that its
training pictures were taken of) with the same camera, observer, gaze field and rays (one a pixel). Depth in cm along
the ray; `agree` is the share of pixels with the same visibility (over or under 1/2); gaze as the mean absolute
difference over the mean gaze of the shapes, over all pixels, over those away from silhouettes (as in
store_visibility.py) and, of these, over those where visibility agrees; `colour dB` is the PSNR of the linear picture,
clipped to 0..1, against path tracing, whose noise is taken out.
`shapes cm` and `shapes agree`: the shapes' own depth, and visibility with a fall-off of 0, against ray casts made
outside of the integrator.

Second table: `scenes/store/display.xml` against the same scene with the display moved out of the room. What must be
hidden is computed by float64 intersections with the display's boxes: by the camera's rays, and by the segments from the
observer to the field's surface. Boxes 3 cm smaller decide what must be dark, boxes 3 cm larger what must not change.
Then the same with the display in the store of shapes (`-D place=shapes.xml`), with a fall-off of 0, against
`shapes.xml`: there boxes are 2 mm smaller and larger, and what is hidden lies 2 mm behind the display or more.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.maths.psnr import decibels

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.store_visibility import PAIRS, near_edges

AOVS = "opacity,position,visibility,gaze"
BOXES = np.array([[(4.40, 4.65, 0.00), (4.90, 5.00, 0.95)], [(4.40, 4.96, 0.95), (4.90, 5.00, 1.45)]])
"""The display of display.xml, lower and upper corners in metres."""
EYE, CAMERA, TARGET = "4.4, 2.8, 1.6", "5.75, 4.2, 2.1", "4.7, 4.95, 0.8"
# How far a surface must lie behind the display to be dark (fall-off, tolerance, and what light goes into it), and by
# how much boxes are smaller and larger; for shapes without a fall-off only the tolerance of 1 mm counts.
BEHIND, MARGIN = 0.15, 0.03
SHARP = 0.002


def vector(text: str) -> np.ndarray:
    return np.array([float(x) for x in text.split(",")])


def box_entry(o, d, boxes=None) -> np.ndarray:
    """Distance from ``o`` along unit ``d`` (..., 3) to the nearest of ``boxes`` (K, 2, 3; None: the
    display's); float64 (...), inf on a miss."""
    boxes = BOXES if boxes is None else boxes
    o, d = (np.asarray(v, np.float64)[..., None, :] for v in (o, d))
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (boxes[:, 0] - o) / d, (boxes[:, 1] - o) / d
    near, far = np.fmax.reduce(np.fmin(a, b), -1), np.fmin.reduce(np.fmax(a, b), -1)
    return np.where((near <= far) & (near > 0), near, np.inf).min(-1)


def shadowed(eye, p, grow: float, behind: float) -> np.ndarray:
    """Whether the boxes, ``grow`` metres larger on all sides, stand between ``eye`` and points ``p``, ``behind`` before
    them."""
    v = p - eye
    distance = np.linalg.norm(v, axis=-1)
    entry = box_entry(eye, v / distance[..., None], BOXES + np.array([[-grow], [grow]]))
    return entry < distance - behind


def channels(scene, spp=1, seed=1) -> dict:
    """AOVs of sensor 0 by name (h, w) or (h, w, 3), and "color"."""
    import mitsuba as mi

    image = np.array(mi.render(scene, sensor=0, spp=spp, seed=seed), np.float64)
    opacity, visibility, gaze = image[..., 3], image[..., 7], image[..., 8]
    return {
        "color": image[..., :3],
        "opacity": opacity,
        "surface": opacity >= 0.5,
        "p": image[..., 4:7],
        "visibility": visibility,
        "gaze": gaze,
    }


def load(scene: Path, width: int, **values):
    import mitsuba as mi

    return mi.load_file(str(scene), width=str(width), height=str(2 * width // 3), aovs=AOVS, **values)


# ----------------------------------------------------------------------------
# The store without a field
# ----------------------------------------------------------------------------


def measure(folder: Path, pair: str, width: int, files: dict, color_spp: int) -> dict:
    """One row of the first table."""
    from nerg_mi.scenes.store import twin

    camera, target, eye = PAIRS[pair]
    values = {"camera": camera, "target": target, "eye": eye} | {k: v for k, v in files.items() if k == "gaze"}
    field, shapes = (
        channels(load(folder / name, width, radiance="false", **values | extra))
        for name, extra in (("scene.xml", files), ("shapes.xml", {}))
    )
    both = field["surface"] & shapes["surface"]
    o, e = vector(camera), vector(eye)
    z, exact = (np.linalg.norm(v["p"] - o, axis=-1) for v in (field, shapes))
    error = 100 * np.abs(z - exact)
    cast = twin.cast(o, (shapes["p"] - o)[both] / exact[both, None])
    d = (shapes["p"] - o) / np.maximum(exact[..., None], 1e-9)
    truth = np.zeros(both.shape, bool)
    truth[both] = twin.visible(e, (shapes["p"] - 1e-3 * d)[both])
    sharp = (
        channels(load(folder / "shapes.xml", width, radiance="false", **values | {"falloff": "0"}))["visibility"] > 0.5
    )

    shown, seen = (v["visibility"] > 0.5 for v in (field, shapes))
    away = both & ~near_edges(np.where(both, exact, 1e3), seen, 2)
    gaze = np.abs(field["gaze"] - shapes["gaze"])
    mean = shapes["gaze"][both].mean()
    row = {
        "pair": pair,
        "median cm": np.median(error[both]),
        "p90 cm": np.percentile(error[both], 90),
        "p90 cm away": np.percentile(error[away], 90),
        "agree": (shown == seen)[both].mean(),
        "agree away": (shown == seen)[away].mean(),
        "gaze mean": mean,
        "gaze": gaze[both].mean() / mean,
        "gaze away": gaze[away].mean() / mean,
        "gaze away, agreeing": gaze[away & (shown == seen)].mean() / mean,
        "shapes cm": 100 * np.abs(exact[both] - cast).max(),
        "shapes agree": (sharp == truth)[both].mean(),
        "away": away.mean(),
    }
    if color_spp:
        values["width"] = width // 2
        scene = load(folder / "shapes.xml", **values)
        a = channels(load(folder / "scene.xml", **values | files), 16)["color"]
        first, second = (channels(scene, color_spp, seed)["color"] for seed in (1, 2))
        # The paths' noise is not the field's error: that of two renders is independent, and cancels in the product.
        a, first, second = (np.clip(c, 0, 1) for c in (a, first, second))
        row["colour dB"] = decibels(np.mean((a - first) * (a - second)))
    return row


# ----------------------------------------------------------------------------
# A display in the field
# ----------------------------------------------------------------------------


def move_away(scene) -> None:
    """Put the display's meshes far out of the room."""
    import mitsuba as mi

    params = mi.traverse(scene)
    for key in params.keys():
        if key.startswith("display_") and key.endswith("vertex_positions"):
            params[key] = params[key] + 1000.0
    params.update()


def measure_display(folder: Path, width: int, files: dict, shapes: bool = False) -> dict:
    """What the display hides: counts of pixels and the shares of them that are as they must be. ``shapes``: of the
    store without a field."""
    from nerg_mi.scenes.store import twin

    place, behind, margin = "scene.xml", BEHIND, MARGIN
    if shapes:
        place, behind, margin = "shapes.xml", SHARP, SHARP
        files = {k: v for k, v in files.items() if k != "field"} | {"falloff": "0"}
    scene = load(folder / "display.xml", width, radiance="false", place=place, **files)
    camera = np.ravel(np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)[:3, 3])
    there = channels(scene)
    if not shapes:
        move_away(scene)
        bare = channels(scene)
    plain = channels(load(folder / place, width, radiance="false", eye=EYE, camera=CAMERA, target=TARGET, **files))
    if shapes:
        # A display a kilometre away would make the scene, and with it the tolerance, larger.
        bare = plain

    met = bare["surface"]
    z = np.linalg.norm(bare["p"] - camera, axis=-1)
    d = (bare["p"] - camera) / z[..., None]
    entry = box_entry(camera, d)
    on, off = met & (entry < z - (SHARP if shapes else 0.05)), met & ~np.isfinite(entry)
    depth = np.linalg.norm(there["p"] - camera, axis=-1)

    eye = vector(EYE)
    was_seen = off & (bare["visibility"] > 0)
    dark = was_seen & shadowed(eye, bare["p"], -margin, behind)
    free = off & ~shadowed(eye, bare["p"], margin, -margin)
    same = np.all([there[k] == bare[k] for k in ("opacity", "visibility", "gaze")], axis=0) & (
        there["p"] == bare["p"]
    ).all(-1)

    # On the display itself: what of it the observer sees, by the boxes and by the rest of the store.
    # The point lies in front of it, as far as the tolerance of shapes is, or by a little more than rounding.
    q = camera + entry[on, None] * d[on] - (1e-3 if shapes else 2e-3) * d[on]
    seen = ~shadowed(eye, q, 0.0, 1e-4) & twin.visible(eye, q)
    shown = there["visibility"][on] > 0.5
    # Faces turned away from the observer fade over the tolerance and the fall-off from their edge on.
    faded = ~seen & ~shadowed(eye, q, 0.0, SHARP if shapes else 0.1) & twin.visible(eye, q)
    return {
        "on": on.sum(),
        "display_depth_cm": 100 * np.abs(depth - entry)[on].max(),
        "display_depth_right": (np.abs(depth - entry)[on] < 1e-3).mean(),
        "display_faded": faded.mean(),
        "display_visibility": (shown == seen)[~faded].mean(),
        "display_gaze": there["gaze"][on][shown].mean(),
        "behind_gaze": bare["gaze"][on].mean(),
        "off": off.sum(),
        "off_depth_same": (there["p"] == bare["p"])[off].mean(),
        "dark": dark.sum(),
        "dark_gaze_0": (there["gaze"][dark] == 0).mean(),
        "dark_gaze_before": bare["gaze"][dark].mean(),
        "free": free.sum(),
        "free_same": same[free].mean(),
        "undecided": (off & ~free & ~dark & (bare["visibility"] > 0)).sum(),
        "bare_is_scene": np.abs(bare["p"] - plain["p"]).max(),
        "bare_gaze_is_scene": np.abs(bare["gaze"] - plain["gaze"]).max(),
        "attention_before": bare["gaze"][met].sum(),
        "attention_after": there["gaze"][met].sum(),
    }


def picture(folder: Path, path: Path, width: int, spp: int, files: dict) -> None:
    """The display in colour, the gaze without it, and with it, side by side."""
    from nerg_mi.figures.overlay import Heat, overlay, top_of
    from nerg_mi.figures.tonemap import srgb, write_png

    scene = load(folder / "display.xml", width, **files)
    there = channels(scene, spp)
    move_away(scene)
    bare = channels(scene, spp)
    heat = Heat(top_of(bare["gaze"], bare["surface"]))
    panels = [srgb(there["color"]), *(overlay(v["color"], v["gaze"], heat, v["surface"]) for v in (bare, there))]
    gap = np.ones((panels[0].shape[0], 6, 3))
    write_png(path, np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1))


def main(argv=None) -> None:
    from output import write_rows

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--field", type=Path, help="checkpoint (default: that of the store)")
    parser.add_argument("--gaze", type=Path, help="checkpoint of the gaze field (default: the store's)")
    parser.add_argument("--width", type=int, default=120, help="width of a picture in pixels (3:2)")
    parser.add_argument(
        "--color-spp",
        type=int,
        default=64,
        help="paths a pixel for the colours of the shapes, at half the width; 0: no colours",
    )
    parser.add_argument(
        "--pair", action="append", choices=list(PAIRS), help="only this one; may be given several times"
    )
    parser.add_argument("--no-display", action="store_true", help="the first table only")
    parser.add_argument("--display-only", action="store_true", help="the second table only")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/store_twin.csv"), help="CSV file to write")
    parser.add_argument("--picture", type=Path, help="PNG file to write: the display, gaze without it, gaze with it")
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.jobs.demo import store_scene

    folder = store_scene().parent
    files = {k: str(v.resolve()) for k, v in (("field", args.field), ("gaze", args.gaze)) if v is not None}
    if not args.no_display:
        for shapes in (False, True):
            print(f"A display in the {'store of shapes' if shapes else 'field'}:")
            for key, value in measure_display(folder, args.width, files, shapes).items():
                print(f"  {key:22} {value:.6g}", flush=True)
    if args.picture:
        picture(folder, args.picture, 240, 8, files)
        print(f"wrote {args.picture}", flush=True)
    if args.display_only:
        return
    rows = []
    for pair in args.pair or PAIRS:
        rows.append(measure(folder, pair, args.width, files, args.color_spp))
        print("; ".join(v if isinstance(v, str) else f"{k} {v:.4g}" for k, v in rows[-1].items()), flush=True)
    print("; ".join(["mean", *(f"{k} {np.mean([r[k] for r in rows]):.4g}" for k in rows[0] if k != "pair")]))
    write_rows(args.out, rows)


if __name__ == "__main__":
    main()
