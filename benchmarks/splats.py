"""The demo store as Gaussian splats, compared with its field and its shapes, and their speed with Mitsuba's renderer.

    python benchmarks/splats.py [--resolution 208] [--width 180] [--runs 5] [--only TABLE] [--picture FILE.png]
    [--out out/benchmarks/splats]

The splats are made of the trained field as by `nerg export splats`, or read from ``--splats``. The first table compares
field and splats with exact ray casts at the store's mesh, as store_visibility.py does. A line below it has the
difference of their depths and the fraction of pixels with equal visibility.

The second table has the time for 320 x 180 pixels with one sample each: medians of ``--runs`` alternating runs, in
wall-clock seconds and in CPU seconds of all threads, which other programs affect less. Kernels are compiled before.
Lists of Gaussians by direction are those of the first run, except in the row "from a new position each time".
`volprim_rf_basic` is Mitsuba's renderer of splats. It computes colour alone, orders Gaussians by shells, and stops at a
transmittance of a hundredth, like the row "colour, stop 0.01".

The third table has the CPU time per pixel of 1280 x 720 pixels with one sample each, for kinds of cameras, by lists and
by the tree: the minimum of ``--runs`` runs, without and with making the lists. Apertures are radii, as fractions of the
distance in focus. The similarity of both images is that of their displayed colours.

The image of ``--picture`` has the rows field, splats, shapes and the columns colour, depth, gaze, visibility.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from store_visibility import PAIRS, measure
from timing import save_result

import numpy as np

SIZE = 320, 180
CAMERA_SIZE = 1280, 720
DEEPEST = 6.0
PAIR = "demo"
PEER = "volprim_rf_basic"
MOVED = "colour, from a new position each time"
COLUMNS = {
    "median cm": "median depth error",
    "p90 cm": "90 % quantile",
    "within 5 cm": "errors below 5 cm",
    "agree": "correct visibility away from silhouettes",
    "agree all": "correct visibility everywhere",
}
"""Columns of `store_visibility.measure`, and their titles."""


def make(path: Path, resolution: int) -> None:
    """Splats of the store's field."""
    from nerg_mi.environment.conversion import export_splats
    from nerg_mi.scenes.store import SCENE_FILE

    path.parent.mkdir(parents=True, exist_ok=True)
    export_splats(SCENE_FILE.parent / "store.safetensors", resolution=resolution).save(path)


def splat_scene(folder: Path) -> Path:
    """The store's scene with splats as its field, written to ``folder``."""
    from nerg_mi.scenes.store import SCENE_FILE

    path = folder / "splats.xml"
    text = SCENE_FILE.read_text()
    path.write_text(text.replace('name="field" type="nerf"', 'name="field" type="splats"'))
    return path


def values(pair: str, width: int, height: int, **overrides: str) -> dict[str, str]:
    """Parameters of the scene files for one camera and observer."""
    camera, target, eye = PAIRS[pair]
    size = {"width": str(width), "height": str(height)}
    return {"camera": camera, "target": target, "eye": eye, **size, "falloff": "0", **overrides}


def compare(scenes: dict[str, tuple[Path, dict]], width: int) -> list[dict]:
    """A row of `store_visibility.measure` for each pair and each of the ``scenes``."""
    return [
        {"place": name, **measure(scene, pair, "median", "depth", files, width, 2)}
        for pair in PAIRS
        for name, (scene, files) in scenes.items()
    ]


def save_exact(scenes: dict[str, tuple[Path, dict]], width: int) -> None:
    """The first table, and the line below it."""
    exact, rows = compare(scenes, width), []
    for name in scenes:
        mine = [row for row in exact if row["place"] == name]
        m = {key: float(np.mean([row[key] for row in mine])) for key in COLUMNS}
        is_length = lambda key: key.endswith(" cm") and key != "within 5 cm"
        rows.append([name, *(f"{m[key]:.2g} cm" if is_length(key) else f"{m[key]:.1%}" for key in COLUMNS)])
    save_result("splats-exact", ("environment", *COLUMNS.values()), rows)
    separate = same_depth(scenes, width)
    medians, same = ([row[key] for row in separate] for key in ("median cm", "same"))
    print(
        f"splats against the field: depths are {min(medians):.2f} to {max(medians):.2f} cm apart (medians by pair), "
        f"visibility is the same for {np.mean(same):.1%} ({min(same):.1%} to {max(same):.1%} by pair)\n"
    )


def same_depth(scenes: dict[str, tuple[Path, dict]], width: int) -> list[dict]:
    """Difference between depths of splats and field in centimetres, ray by ray."""
    rows = []
    for pair in PAIRS:
        depth, seen = [], []
        for scene, files in scenes.values():
            picture = render(scene, values(pair, width, 2 * width // 3, aovs="depth,visibility", **files))
            depth.append(picture[..., 3])
            seen.append(picture[..., 4] > 0.5)
        difference = 100 * np.abs(depth[0] - depth[1])
        same = float((seen[0] == seen[1]).mean())
        rows.append(
            {"pair": pair, "median cm": np.median(difference), "p90 cm": np.percentile(difference, 90), "same": same}
        )
    return rows


def render(scene: Path, parameters: dict[str, str], spp: int = 1) -> np.ndarray:
    import mitsuba as mi

    return np.array(mi.render(mi.load_file(str(scene), **parameters), sensor=0, spp=spp, seed=1), np.float64)


def times(scene: Path, files: dict, runs: int) -> list[dict]:
    """Rows of the second table."""
    import mitsuba as mi

    loaded = {}
    width, height = SIZE
    colour, observed = {"aovs": "opacity", "occlusion": "false"}, {"aovs": "depth,opacity,gaze,visibility"}
    tree = scene.with_name("tree.xml")
    tree.write_text(scene.read_text().replace('type="splats">', 'type="splats"><boolean name="lists" value="false"/>'))
    for name, overrides in {
        "colour, stop 0.01": colour | {"stop": "0.01"},
        "colour": colour,
        MOVED: colour,
        "colour, by the tree": colour,
        "colour, depth and gaze of an observer": observed,
        "the same, by the tree": observed,
        "the same, by the observer's map": observed | {"visibility": "map"},
    }.items():
        stop = overrides.pop("stop", None)
        path = tree if "tree" in name else scene
        if stop is not None:
            path = scene.with_name("stop.xml")
            text = scene.read_text().replace(
                '<string name="depth"', f'<float name="stop" value="{stop}"/><string name="depth"'
            )
            path.write_text(text)
        loaded[name] = mi.load_file(str(path), **values(PAIR, width, height, spp="1", **overrides, **files))
    camera, target, _ = ([float(v) for v in text.split(",")] for text in PAIRS[PAIR])
    sensor = {"type": "perspective", "fov": 78, "fov_axis": "x"}
    sensor["to_world"] = mi.ScalarTransform4f().look_at(camera, target, [0, 0, 1])
    sensor["film"] = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    shape = {"type": "ellipsoids", "filename": files["field"]}
    theirs = {"type": "scene", "integrator": {"type": PEER}, "sensor": sensor, "splats": shape}
    loaded[PEER] = mi.load_dict(theirs)
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in loaded}
    moved = mi.traverse(loaded[MOVED].sensors()[0])
    start = mi.Transform4f(moved["to_world"])
    # The second frame of an observer uses cached data of the first, with another kernel.
    for run in range(runs + 2):
        moved["to_world"] = mi.Transform4f().translate([0.01 * run, 0, 0]) @ start
        moved.update()
        for name, what in loaded.items():
            wall, cpu = time.perf_counter(), time.process_time()
            np.array(mi.render(what, sensor=0, spp=1, seed=run))
            if run > 1:
                taken[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    middle = {name: np.median(result, axis=0) for name, result in taken.items()}
    peer = middle[PEER]
    return [
        {"what": name, "s": float(m[0]), "CPU s": float(m[1]), "of volprim": float(m[1] / peer[1])}
        for name, m in middle.items()
    ]


def cameras(splats: Path, runs: int) -> list[list[str]]:
    """Rows of the third table."""
    from nerg_mi.figures.overlay import srgb
    from nerg_mi.maths.color import psnr

    import mitsuba as mi

    (width, height), (origin, target, _) = CAMERA_SIZE, ([float(v) for v in text.split(",")] for text in PAIRS[PAIR])
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1])
    focus = float(np.linalg.norm(np.subtract(target, origin)))
    kinds = {
        "perspective": {"type": "perspective", "fov": 78},
        "orthographic": {"type": "orthographic", "to_world": to_world @ mi.ScalarTransform4f().scale([2.5, 2.5, 1])},
        **{
            f"thin lens, {part:.1%}": {
                "type": "thinlens",
                "fov": 78,
                "aperture_radius": part * focus,
                "focus_distance": focus,
            }
            for part in (0.005, 0.02, 0.1)
        },
    }
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    rows = []
    for kind, sensor in kinds.items():
        images, seconds = [], []
        for has_lists in (True, False):
            field = {"type": "splats", "filename": str(splats), "lists": has_lists}
            integrator = {"type": "nerg", "field": field, "aovs": "opacity"}
            scene = mi.load_dict(
                {"type": "scene", "integrator": integrator, "sensor": {"to_world": to_world, "film": film, **sensor}}
            )
            for is_new in (False, True) if has_lists else (False,):
                taken = []
                # Kernels are compiled in the first run.
                for _ in range(runs + 1):
                    if is_new:
                        scene.integrator().medium.lists.clear()
                    start = time.process_time()
                    image = np.array(mi.render(scene, spp=1, seed=1))
                    taken.append(1e6 * (time.process_time() - start) / (width * height))
                seconds.append(min(taken[1:]))
            images.append(srgb(image[..., :3]))
        cached, made, tree = seconds
        row = [kind, f"{cached:.2f} µs", f"{made:.2f} µs", f"{tree:.2f} µs", f"{cached / tree:.2f}"]
        rows.append([*row, f"{psnr(*images):.1f} dB"])
    return rows


def picture(path: Path, scenes: dict[str, tuple[Path, dict]]) -> None:
    """Field, splats and shapes, one below the other."""
    from nerg_mi.figures.overlay import srgb, write_png

    rows, brightest = [], None
    for scene, files in scenes.values():
        result = render(scene, values(PAIR, *SIZE, aovs="depth,gaze,visibility", **files), spp=16)
        brightest = brightest or result[..., 4].max()
        depth, gaze, seen = result[..., 3] / DEEPEST, np.sqrt(result[..., 4] / brightest), result[..., 5]
        grey = [np.repeat(np.clip(v, 0, 1)[..., None], 3, axis=2) for v in (depth, gaze, seen)]
        rows.append(np.concatenate([srgb(result[..., :3]), *grey], axis=1))
    write_png(path, np.concatenate(rows))


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=Path, help="File of splats. Default: made of the store's field.")
    parser.add_argument(
        "--resolution",
        type=int,
        default=208,
        help="Number of lattice cells along the longest side from which splats are made. Default: %(default)s.",
    )
    parser.add_argument(
        "--width",
        type=int,
        default=180,
        help="Width of the images of the first table in pixels; their aspect ratio is 3:2. Default: %(default)s.",
    )
    parser.add_argument("--runs", type=int, default=5, help="Number of timed runs. Default: %(default)s.")
    parser.add_argument("--only", choices=("exact", "time", "cameras"), help="Table to compute. Default: all.")
    parser.add_argument("--picture", type=Path, help="PNG file to write. Default: none.")
    parser.add_argument(
        "--out", type=Path, default=Path("out/benchmarks/splats"), help="Folder for files. Default: %(default)s."
    )
    args = parser.parse_args(argv)

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.scenes.store import SCENE_FILE

    folder = args.out
    folder.mkdir(parents=True, exist_ok=True)
    if args.splats is None:
        args.splats = folder / "store.ply"
        make(args.splats, args.resolution)
    store = SCENE_FILE
    gaze = {"gaze": str((store.parent / "shoppers.safetensors").resolve())}
    files = gaze | {"field": str(args.splats.resolve())}
    scenes = {"field": (store, gaze), "splats": (splat_scene(folder), files)}
    if args.picture:
        picture(args.picture, scenes | {"shapes": (store.parent / "shapes.xml", gaze)})
        print(f"wrote {args.picture}", flush=True)
    if args.only in (None, "exact"):
        save_exact(scenes, args.width)
    if args.only in (None, "time"):
        speed = times(scenes["splats"][0], files, args.runs)
        rows = [[r["what"], f"{r['s']:.2f}", f"{r['CPU s']:.2f} s", f"{r['of volprim']:.2g}"] for r in speed]
        save_result("splats-time", ("outputs", "time, s", "CPU time", f"relative to `{PEER}`"), rows)
    if args.only in (None, "cameras"):
        columns = "camera", "CPU time per pixel", "and making lists", "by the tree", "lists / tree", "PSNR"
        save_result("splats-cameras", columns, cameras(args.splats, args.runs))


if __name__ == "__main__":
    main()
