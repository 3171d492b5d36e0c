"""Speed of frames, densities and volumes, and its growth with size; `processes.py` measures memory and start-up time.

    python benchmarks/bench.py [--only PARTS] [--long] [--mode llvm_ad_rgb]
    [--out out/benchmarks/bench]

The parts are:

- ``frames``: a frame of the demo store, compared with a renderer in PyTorch (``frames-avx2`` without AVX-512);
- ``stages``: the stages of that frame;
- ``threads``: that frame on 1, 2, 4, ... threads;
- ``kde``: kernel densities on the sphere, compared with SciPy;
- ``volume``: the transmittance of a volume, compared with Mitsuba's `volpath`;
- ``growth``: the growth of each cost with its size.

Programs that are compared do the same work, which is checked first, and their runs alternate. The figures are medians
with quartiles. The benchmark prints tables and saves them as results.
With a CUDA variant, parts without a reference program are measured in wall-clock seconds. Without a CUDA device, the
benchmark prints a message and ends.
"""

from __future__ import annotations

import argparse
import os
import sys
from functools import cached_property, partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))
from collections.abc import Callable

import nerg_mi
import torch_frames
from nerg_mi.fields.kde import SphericalKde
from nerg_mi.llvm import has_cuda
from nerg_mi.scenes.store import SCENE_FILE
from timing import at_the_end, exponent, in_turns, median, save_result, spread

import numpy as np
from tools.other_processor import has_avx512

Works = dict[str, Callable[[], np.ndarray]]


def unit_vectors(count: int, seed: int) -> np.ndarray:
    """Uniform directions (count, 3) on the sphere."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def kernel_densities(rays: int, directions: int, kappa: float = 200.0) -> tuple[Works, float]:
    """A density of ``rays`` kernels in as many ``directions``, and the largest difference relative to the mean."""
    import drjit as dr
    from scipy.special import logsumexp

    mu, x = unit_vectors(rays, 0), unit_vectors(directions, 1)
    ours = SphericalKde(mu, np.array([0, rays]), kappa)
    ns = ours.ns
    where, probe = ns.Array3f(x.T.astype(np.float32)), dr.zeros(ns.UInt32, directions)
    dr.eval(where, probe)
    constant = np.log(kappa / (2 * np.pi * -np.expm1(-2 * kappa)) / rays)

    def with_scipy() -> np.ndarray:
        parts = [logsumexp(kappa * (part @ mu.T - 1), axis=1) for part in np.array_split(x, max(1, directions // 256))]
        return np.exp(constant + np.concatenate(parts))

    def with_nerg() -> np.ndarray:
        return np.array(ours.density(probe, where))

    expected, got = with_scipy(), with_nerg()
    return {"nerg": with_nerg, "SciPy": with_scipy}, float(np.max(np.abs(got - expected)) / expected.mean())


def cloud(cells: int) -> np.ndarray:
    """Densities (z, y, x, 1) of a cloud of spheres in an otherwise empty grid, 0 to 6 per unit."""
    at = (np.stack(np.meshgrid(*[np.arange(cells)] * 3, indexing="ij"), -1) + 0.5) / cells
    value = np.zeros((cells,) * 3)
    for center in np.random.default_rng(0).uniform(0.25, 0.75, (12, 3)):
        value = np.maximum(value, 6.0 * np.clip(1.6 - np.linalg.norm(at - center, axis=-1) / 0.1, 0, 1))
    return value[..., None].astype(np.float32)


def transmittances(size: int, samples: int, cells: int = 64) -> tuple[Works, Callable[[np.ndarray], float], float]:
    """Transmittance of an absorbing cloud: by `nerg` (quadrature, one sample per pixel) and by `volpath` (``samples``
    per pixel, in a medium of albedo 0 in front of white surroundings).

    Returns programs that render images (size, size), a function for their RMS error against 16 samples per pixel with
    steps of 1/16, and the difference of both means.
    """
    import mitsuba as mi

    grid = {
        "type": "gridvolume",
        "grid": mi.VolumeGrid(cloud(cells)),
        "raw": True,
        "to_world": mi.ScalarTransform4f().translate(-1).scale(2),
    }
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "component_format": "float32"}
    view = mi.ScalarTransform4f().look_at([1.5, 1, -4], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 35, "to_world": view, "film": film}
    fine = 2 * 3**0.5 / 1024 / 16

    def marched(**overrides):
        integrator = {"type": "nerg", "density": grid, "aovs": "opacity", **overrides}
        return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})

    medium = {"type": "heterogeneous", "sigma_t": grid, "albedo": 0.0}
    box = {"type": "cube", "bsdf": {"type": "null"}, "interior": medium}
    traced = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 64},
            "sensor": sensor,
            "box": box,
            "sky": {"type": "constant"},
        }
    )
    places = {"nerg": marched(), "exact": marched(step=fine)}

    def passed(scene, spp: int, seed: int = 0) -> np.ndarray:
        return 1 - np.array(mi.render(scene, spp=spp, seed=seed))[..., -1]

    works = {
        "nerg": lambda: passed(places["nerg"], 1),
        f"volpath, {samples} samples": lambda: np.array(mi.render(traced, spp=samples))[..., 0],
    }
    truth = np.mean([passed(places["exact"], 4, seed) for seed in range(4)], axis=0)

    def error(picture: np.ndarray) -> float:
        return float(np.sqrt(np.mean((picture - truth) ** 2)))

    means = [float(work().mean()) for work in works.values()]
    return works, error, abs(means[1] - means[0]) / means[0]


STAGES = {
    "depth": {"radiance": "false", "aovs": "depth"},
    "depth, colour": {"aovs": "depth"},
    "depth, colour, the observer's pass": {"aovs": "depth,visibility"},
    "depth, colour, the observer's pass, gaze": {"aovs": "depth,gaze"},
}


class Run:
    """Shared state of the parts: the options, the variant's namespace, and the fields of the demo store."""

    def __init__(self, args: argparse.Namespace):
        from nerg_mi.fields.mlp import namespace
        from nerg_mi.formats.fields import load_gaze, load_radiance

        import mitsuba as mi

        self.long, self.out, self.threads = args.long, args.out, args.threads
        self.runs = args.runs or (9 if args.long else 5)
        self.cuda = mi.variant().startswith("cuda")
        folder, ns = SCENE_FILE.parent, namespace(mi.variant())
        self.field = load_radiance(folder / "store.safetensors", ns)[0]
        self.gaze = load_gaze(folder / "shoppers.safetensors", ns)[0]

    @cached_property
    def compiled(self) -> Path:
        """A compiled copy of the store's field, which is made once."""
        path = self.out / "store.compiled.safetensors"
        nerg_mi.compile_field(SCENE_FILE.parent / "store.safetensors").save(path)
        return path

    def cost(self, times) -> list[float]:
        """Seconds of each run: CPU time, or wall-clock time on a device."""
        return [wall if self.cuda else cpu for wall, cpu in times]

    def save(self, name: str, columns: list[str], rows: list[list[str]]) -> None:
        """Save the result ``name`` of this variant."""
        save_result(f"{name}-cuda" if self.cuda else name, columns, rows)


def peers_of(run: Run, compiled: bool) -> dict[str, torch_frames.TorchRenderer]:
    """PyTorch renderers of the same image, which is checked; one that does not compile is skipped with a message."""
    import nerg_mi as nerg

    import torch

    torch.set_num_threads(run.threads)
    scene = nerg.Scene.load(SCENE_FILE, **torch_frames.PEER_SCENE)
    falloff = float(np.ravel(np.array(scene.integrator.falloff))[0])
    made = {
        "PyTorch, eager": {"model": torch_frames.TorchModel},
        "PyTorch, eager, corner by corner": {},
        **({"PyTorch, compiled": {"model": torch_frames.TorchModel, "compiled": True}} if compiled else {}),
    }
    peers = {}
    for name, how in made.items():
        peer = torch_frames.TorchRenderer(run.field, run.gaze, falloff, **how)
        try:
            result = torch_frames.agreement(scene, peer)
        except torch._dynamo.exc.TorchDynamoException as error:
            print(f"{name}: torch.compile fails here: {str(error).strip().splitlines()[0]}\n")
            continue
        print(name, ", ".join(f"{k} {v:.4g}" for k, v in result.items()), "\n", flush=True)
        if result["color_db"] < 35 or abs(result["gaze_mean"]) > 0.02:
            raise SystemExit("the two do not render the same picture")
        peers[name] = peer
    return peers


def frames(run: Run) -> None:
    peers = {} if run.cuda else peers_of(run, compiled=True)
    rows = []
    for width, height in ((320, 180), (1280, 720)):
        o, d = torch_frames.camera_rays(width, height)
        values = {"width": width, "height": height, "spp": 1, "aovs": "depth,gaze"}
        works: dict = {**torch_frames.our_frames(values, run.compiled)}
        if width < 640 or run.long:
            works |= {name: partial(peer.frame, o, d, (4.4, 2.8, 1.6)) for name, peer in peers.items()}
        runs = run.runs if width < 640 else max(run.runs // 3, 1)
        rows += torch_frames.measure(works, f"{width} x {height}", runs)
    titles = {"frame": "image size", "s": "time, s", "quartiles": "quartiles, s", "CPU s": "CPU time, s"}
    titles["times nerg"] = "relative to nerg"
    name = "frames" if run.cuda or has_avx512() else "frames-avx2"
    run.save(name, [titles.get(key, key) for key in rows[0]], [list(map(str, r.values())) for r in rows])


def stages(run: Run) -> None:
    """Each stage with those before it, at 640 x 360."""
    width, height = 640, 360
    values = {"width": width, "height": height, "spp": 1}
    works = {name: torch_frames.Ours({**values, **more}, "depth") for name, more in STAGES.items()}
    last = list(works)[-1]
    works["... same observer again"] = torch_frames.Ours({**values, **STAGES[last]}, "map")
    works["... with re-aimed hits"] = torch_frames.Ours({**values, **STAGES[last], "reaimed_hits": True}, "depth")
    compiled = {**values, "field": str(run.compiled)}
    works |= {
        f"compiled field: {name}": torch_frames.Ours({**compiled, **more}, "depth") for name, more in STAGES.items()
    }
    works["... same observer again, compiled field"] = torch_frames.Ours({**compiled, **STAGES[last]}, "map")
    taken = in_turns(works, run.runs)
    theirs = {} if run.cuda else peer_stages(run, width // 2, height // 2)
    rows, before = [], 0.0
    for name, times in taken.items():
        each = [1e6 * c / (width * height) for c in run.cost(times)]
        before = 0.0 if name.endswith(next(iter(STAGES))) else before  # The first stage has none above it
        overrides = "" if name.startswith("...") else f"{median(each) - before:.2f}"
        before = median(each)
        peer = theirs.get(name)
        clock = 1e6 * median(wall for wall, _ in times) / (width * height)
        cells = [f"{peer / clock:.0f}"] if peer else [""]
        rows.append([name, f"{median(each):.2f}", spread(each), overrides, *cells])
    head = ["computed quantities", f"{'time' if run.cuda else 'CPU time'} per pixel, µs", "quartiles, µs"]
    run.save("stages", [*head, "increase over the row above, µs", "speed-up over eager PyTorch"], rows)


def threads(run: Run) -> None:
    """Frames on fewer threads than the others, and the speed-up."""
    from nerg_mi.threads import set_thread_count

    if run.cuda:
        print("the number of threads matters on processors only\n")
        return
    counts = [n for n in (2**k for k in range(10)) if n < run.threads] + [run.threads]
    works = {}
    for size in ((320, 180), (1280, 720)):
        values = dict(zip(("width", "height"), size)) | {"spp": 1, "aovs": "depth,gaze"}
        for field, changed in (("field", {}), ("compiled field", {"field": str(run.compiled)})):
            for name, visibility in (("", "depth"), (", same observer again", "map")):
                works[f"{size[0]} x {size[1]}", field + name] = torch_frames.Ours({**values, **changed}, visibility)
    seconds: dict = {}
    for count in counts:
        set_thread_count(count)
        taken = in_turns({str(name): work for name, work in works.items()}, run.runs)
        seconds[count] = {name: median(wall for wall, _ in taken[str(name)]) for name in works}
    rows = [
        [*name, *(f"{seconds[n][name]:.3g}" for n in counts), f"{seconds[1][name] / seconds[counts[-1]][name]:.2f}"]
        for name in works
    ]
    head = ["image size", "renderer", *(f"time, {n} threads, s" for n in counts)]
    run.save("threads", [*head, f"speed-up of {counts[-1]} over 1"], rows)


def peer_stages(run: Run, width: int, height: int) -> dict[str, float]:
    """Microseconds per pixel of the eager renderer, by the names of `STAGES`: wall-clock, since its threads spin while
    they wait."""
    import nerg_mi as nerg

    import torch

    torch.set_num_threads(run.threads)
    scene = nerg.Scene.load(SCENE_FILE, **torch_frames.PEER_SCENE)
    falloff = float(np.ravel(np.array(scene.integrator.falloff))[0])
    peer = torch_frames.TorchRenderer(run.field, run.gaze, falloff, torch_frames.TorchModel)
    o, d = torch_frames.camera_rays(width, height)
    rays = [torch.from_numpy(np.ascontiguousarray(v, np.float32)) for v in (o, d)]

    def marched(colored: bool) -> None:
        with torch.no_grad():
            for a in range(0, len(o), torch_frames.RAYS):
                peer.march(*(v[a : a + torch_frames.RAYS] for v in rays), colored=colored)

    works = {
        "depth": partial(marched, False),
        "depth, colour": partial(marched, True),
        "depth, colour, the observer's pass, gaze": lambda: peer.frame(o, d, np.asarray(scene.observer, float)),
    }
    taken = in_turns(works, 1 if not run.long else 3)
    return {name: 1e6 * median(wall for wall, _ in times) / len(o) for name, times in taken.items()}


def kde(run: Run) -> None:
    rows = []
    for rays in (1000, 10_000, *((100_000,) if run.long else ())):
        works, difference = kernel_densities(rays, 1 << 13)
        if not difference < 1e-4:
            raise SystemExit(f"the two do not give the same densities: {difference:.1e} apart")
        costs = {name: run.cost(times) for name, times in in_turns(works, run.runs).items()}
        ours, theirs = costs["nerg"], costs["SciPy"]
        times = f"{median(theirs) / median(ours):.0f}"
        rows.append(
            [f"{rays:,}", *(f"{1e3 * median(c):.3g} ({spread(1e3 * t for t in c)})" for c in (ours, theirs)), times]
        )
        rows[-1].append(f"{difference:.0e}")
    head = ["rays", *(f"{name}: CPU time (quartiles), ms" for name in ("nerg", "SciPy"))]
    run.save("kde", [*head, "speed-up", "maximum difference"], rows)


def volume(run: Run) -> None:
    works, error, difference = transmittances(256, 64 if run.long else 16)
    if not difference < 0.01:
        raise SystemExit(f"the two do not render the same cloud: means are {difference:.1%} apart")
    errors = {name: error(work()) for name, work in works.items()}
    costs = {name: run.cost(times) for name, times in in_turns(works, run.runs).items()}
    # A Monte Carlo estimate costs n times as much for 1 / sqrt(n) of the error.
    worth = {name: median(cost) * errors[name] ** 2 for name, cost in costs.items()}
    rows = [
        [
            name,
            f"{1e3 * median(cost):.3g}",
            spread(1e3 * c for c in cost),
            f"{errors[name]:.4f}",
            f"{worth[name] / worth['nerg']:.0f}",
        ]
        for name, cost in costs.items()
    ]
    head = ["renderer", "CPU time, ms", "quartiles, ms", "RMS error", "relative cost at equal error"]
    run.save("volume", head, rows)


def growth(run: Run) -> None:
    import sizes

    rows = []
    for result in sizes.growths(run.long):
        taken = in_turns({str(n): work for n, work in result.works.items()}, run.runs, warm=2)
        counts, costs = list(result.works), [run.cost(times) for times in taken.values()]
        middle = [1e3 * median(c) for c in costs]
        steps = ", ".join(f"{n:,}: {c:,.0f}" if c >= 1e3 else f"{n:,}: {c:.3g}" for n, c in zip(counts, middle))
        last = f"{at_the_end(counts, middle):.2f}"
        rows.append([result.what, result.axis, steps, f"{exponent(counts, middle):.2f}", last, result.aim])
    head = ["computation", "size", f"{'time' if run.cuda else 'CPU time'} by size, ms", "exponent"]
    run.save("growth", [*head, "exponent between the two largest", "target exponent"], rows)


PARTS = {part.__name__: part for part in (frames, stages, threads, kde, volume, growth)}


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only",
        default=",".join(PARTS),
        help=f"Parts to measure, separated by commas. Default: all ({', '.join(PARTS)}).",
    )
    parser.add_argument(
        "--long",
        action="store_true",
        help="Measure more runs, larger sizes, and the PyTorch renderer at 1280 x 720 pixels.",
    )
    parser.add_argument(
        "--runs", type=int, default=0, help="Number of runs of each program. Default: 5; with --long 9."
    )
    parser.add_argument(
        "--threads",
        type=int,
        default=os.cpu_count() or 1,
        help="Number of CPU threads. Default: all cores (%(default)s).",
    )
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant. Default: %(default)s.")
    parser.add_argument(
        "--out", type=Path, default=Path("out/benchmarks/bench"), help="Folder for the results. Default: %(default)s."
    )
    args = parser.parse_args(argv)
    requested = args.only.split(",")
    if unknown := [name for name in requested if name not in PARTS]:
        parser.error(f'there is no part "{unknown[0]}"; choose among {", ".join(PARTS)}')
    if args.mode.startswith("cuda") and not has_cuda():
        print(f"No CUDA device is here, so {args.mode} was not measured; run this on a machine with an NVIDIA driver.")
        return
    import mitsuba as mi

    mi.set_variant(args.mode)
    import drjit as dr

    dr.set_thread_count(args.threads)
    run = Run(args)
    for name in requested:
        PARTS[name](run)


if __name__ == "__main__":
    main()
