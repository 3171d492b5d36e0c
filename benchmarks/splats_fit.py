"""Gaussian splats fitted to photos through ``mi.render``: PSNR of held-out views before and after, time, memory.

    python benchmarks/splats_fit.py [--resolution 96] [--views 24] [--width 96] [--steps 150] [--rays 8192] [--seeds 3]


The photos are renderings of the demo store's mesh from a photographer's cameras, chosen as for the store's field. Eight
other photos, from a shopper's eye, select the learning rates: `RATES` times one of `FACTORS`, for the disturbed splats
of seed 0. Eight more photos, unused otherwise, give the reported PSNR. Seeds determine the disturbance, the order of
the rays, and their samples; ± is the standard deviation over seeds.

The initial splats are those that `nerg export splats` makes of the field, or those of ``--splats``. They are fitted as
they are, and disturbed: opacities are multiplied by 0.7, and the other parameters change randomly, with standard
deviations of 2 cm per axis for centres, a third for scales, about 10 degrees for axes, and a tenth for colours. Adam
optimises all parameters of the Gaussians: the centre, the logarithms of the scales, the quaternion, the logit of the
opacity, and the spherical harmonics. The rays are random pixels of all photos. The loss is the squared difference of
sRGB values. No Gaussian is added or removed.

The last table has the memory of a derivative against the number of hits per ray: the maximum that Dr.Jit allocates
during one derivative, beyond what was allocated before. The same 4,096 rays pass through stacks of walls, and each
number is measured in its own process. The benchmark does not pass or fail.
"""

from __future__ import annotations

import argparse
import gc
import os
import subprocess
import sys
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit)

# BLAS threads spin while they wait, and slow down the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from nerg_mi.fields.splats import Splats, harmonics_from_colors, multiply_quaternions
from nerg_mi.figures.overlay import srgb
from nerg_mi.registration import get_plugin_class
from timing import save_result

import drjit as dr
import mitsuba as mi
import numpy as np

PREFIX = "integrator.field."
# Approximate change per step of Adam: metres, logarithms, quaternions, logits, harmonics.
RATES = {"centers": 1e-3, "log_scales": 0.02, "rotations": 0.01, "logits": 0.05, "harmonics": 0.02}
FACTORS = (0.5, 1.0, 2.0)
HITS = (16, 64, 256, 1024)
SIDE, WARM = 64, 4


def disturbed(splats: Splats, seed: int = 0) -> Splats:
    """``splats``, disturbed as documented above."""
    rng = np.random.default_rng(seed)
    noise = lambda like, size: size * rng.normal(size=like.shape)
    turn = np.concatenate([np.ones((len(splats), 1)), noise(splats.centers, 0.09)], axis=1)
    return Splats(
        splats.centers + noise(splats.centers, 0.02),
        splats.scales * np.exp(noise(splats.scales, 0.33)),
        multiply_quaternions(turn, splats.rotations),
        0.7 * splats.opacities,
        splats.harmonics + noise(splats.harmonics, 0.1) / 0.2820948,
    )


class Photos:
    """Cameras of the store's twin with their images: ``fitted``, ``choosing`` and ``held_out``."""

    def __init__(self, count: int, width: int):
        from nerg_mi.scenes.store import cameras, layout, views

        camera = cameras.Pinhole(width, 3 * width // 4)
        plan = layout.build_store(0)
        poses = [*cameras.choose_views(plan, camera, count, 8), cameras.choose_views(plan, camera, 1, 8, seed=1)[1]]
        photographer = views.StorePhotographer(camera)
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
        film["component_format"] = "float32"
        sensor = {"type": "perspective", "fov": camera.fov_x, "fov_axis": "x", "near_clip": 0.01, "film": film}
        self.fitted, self.choosing, self.held_out = (
            (
                [mi.load_dict(sensor | {"to_world": mi.ScalarTransform4f(views.to_mitsuba_pose(p))}) for p in group],
                [srgb(photographer.render_picture(pose, seed, spp)) for seed, pose in enumerate(group)],
            )
            for group, spp in zip(poses, (16, 64, 64))
        )


def scene_of(splats: Splats):
    """The scene of splats, colour alone."""
    integrator = {
        "type": "nerg",
        "field": get_plugin_class("splats").from_network(splats),
        "occlusion": False,
        "id": "integrator",
    }
    return mi.load_dict({"type": "scene", "integrator": integrator})


def psnr(scene, cameras, photos) -> float:
    """Mean PSNR over images, with four samples per pixel."""
    result = []
    for camera, photo in zip(cameras, photos):
        picture = srgb(np.array(mi.render(scene, sensor=camera, spp=4, seed=1))[..., :3])
        result.append(-10 * np.log10(np.square(picture - photo).mean()))
    return float(np.mean(result))


def as_srgb(x):
    """sRGB values of linear ones, differentiable."""
    return dr.select(x <= 0.0031308, 12.92 * x, 1.055 * dr.power(dr.maximum(x, 0.0031308), 1 / 2.4) - 0.055)


def fit(scene, photos: Photos, steps: int, rays: int, factor: float, seed: int) -> None:
    """Optimise all Gaussians of ``scene`` with ``factor`` times the rates."""
    params = mi.traverse(scene)
    params.keep([PREFIX + name for name in ("centers", "scales", "rotations", "opacities", "harmonics")])
    opacities = dr.clip(params[PREFIX + "opacities"], 1e-4, 1 - 1e-4)
    start = {name: params[PREFIX + name] for name in ("centers", "rotations", "harmonics")}
    start |= {"log_scales": dr.log(params[PREFIX + "scales"]), "logits": dr.log(opacities / (1 - opacities))}
    opt = mi.ad.Adam(lr=1e-3, params=start)
    cameras, pictures = photos.fitted
    targets = [mi.TensorXf(picture.astype(np.float32)) for picture in pictures]
    loader = mi.ad.loaders.RayDataLoader(cameras, targets, pixels_per_batch=rays, seed=seed, regular_reshuffle=True)
    for i in range(steps):
        # Decreasing to a tenth towards the end.
        opt.set_learning_rate({name: factor * rate * 0.1 ** (i / steps) for name, rate in RATES.items()})
        for name in ("centers", "rotations", "harmonics"):
            params[PREFIX + name] = opt[name]
        params[PREFIX + "scales"] = dr.exp(opt["log_scales"])
        params[PREFIX + "opacities"] = 1 / (1 + dr.exp(-opt["logits"]))
        params.update()
        wanted, sensor = loader.next()
        picture = mi.render(scene, params, sensor=sensor, spp=1, seed=seed * steps + i)
        dr.backward(dr.mean(dr.square(as_srgb(picture[..., :3]) - wanted), axis=None))
        opt.step()


def stack(hits: int) -> Splats:
    """The same number of flat Gaussians for all ``hits``: this many in a row in front of the rays, the others aside."""
    n = HITS[-1]
    centers = np.stack([np.where(np.arange(n) < hits, 0, 50), np.zeros(n), np.linspace(-1, 1, n)], axis=1)
    scales, turned = np.tile([2, 2, 1e-4], (n, 1)), np.tile([1, 0, 0, 0], (n, 1))
    # Some light is left behind the last, so that all are hit.
    return Splats(centers, scales, turned, np.full(n, 4 / n), harmonics_from_colors(np.full((n, 3), 0.3)))


def peak(hits: int) -> float:
    """Maximum MB (10^6 bytes) that a derivative allocates, compiled before."""
    scene = scene_of(stack(hits))
    params = mi.traverse(scene)
    keys = [key for key in params.keys() if key.startswith(PREFIX)]
    sensor = {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at([0, 0, -3], [0, 0, 0], [0, 1, 0])}

    def derivative(size: int) -> None:
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
        camera = mi.load_dict(sensor | {"film": film})
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.sum(mi.render(scene, params, sensor=camera, spp=1), axis=None))
        dr.eval([dr.grad(params[key]) for key in keys])

    derivative(WARM)
    return held_at_most(lambda: derivative(SIDE))


def held_at_most(work) -> float:
    """Maximum MB that ``work`` allocates."""
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    work()
    dr.sync_thread()
    return (dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before) / 1e6


def fitted(splats: Splats, photos: Photos, args, factor: float, seed: int) -> dict[str, float]:
    """Results of one fit, by the column names of the first table."""
    scene = scene_of(splats)
    before = {"before": psnr(scene, *photos.held_out), "fitted to, before": psnr(scene, *photos.fitted)}
    start, cpu = time.perf_counter(), time.process_time()
    memory = held_at_most(lambda: fit(scene, photos, args.steps, args.rays, factor, seed))
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    after = {"after": psnr(scene, *photos.held_out), "fitted to, after": psnr(scene, *photos.fitted)}
    row = before | after | {"choosing": psnr(scene, *photos.choosing), "s": seconds}
    row |= {"CPU ms a step": 1e3 * cpu / args.steps, "MB at most": memory}
    print(factor, seed, row, file=sys.stderr, flush=True)
    return row


def summary(result: list[dict[str, float]]) -> list[str]:
    """Cells of a row for several fits."""
    make = lambda key: np.array([row[key] for row in result])
    keys = ("before", "after", "fitted to, before", "fitted to, after")
    cells = [f"{make(k).mean():.2f} ± {make(k).std(ddof=1):.2f}" for k in keys]
    return cells + [f"{make(k).mean():.0f}" for k in ("s", "CPU ms a step", "MB at most")]


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=Path, help="File of splats. Default: made of the store's field.")
    parser.add_argument(
        "--resolution",
        type=int,
        default=96,
        help="Number of lattice cells along the longest side from which splats are made. Default: %(default)s.",
    )
    parser.add_argument("--views", type=int, default=24, help="Number of training photos. Default: %(default)s.")
    parser.add_argument(
        "--width",
        type=int,
        default=96,
        help="Width of the photos in pixels; their aspect ratio is 4:3. Default: %(default)s.",
    )
    parser.add_argument("--steps", type=int, default=150, help="Number of steps of Adam. Default: %(default)s.")
    parser.add_argument("--rays", type=int, default=8192, help="Number of rays per step. Default: %(default)s.")
    parser.add_argument(
        "--seeds", type=int, default=3, help="Number of fits of each kind, at least 2. Default: %(default)s."
    )
    parser.add_argument(
        "--hits",
        type=int,
        help="Print only the memory in MB for this number of hits per ray, measured in this process. Default: none.",
    )
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    if args.hits:
        print(f"{peak(args.hits):.2f}")
        return
    from nerg_mi.formats.splats import read_splats
    from splats import make

    path = args.splats
    if path is None:
        path = Path("out/benchmarks/fit.ply")
        make(path, args.resolution)
    splats, photos = read_splats(path), Photos(args.views, args.width)
    tried = {factor: fitted(disturbed(splats), photos, args, factor, 0) for factor in FACTORS}
    factor = max(tried, key=lambda f: tried[f]["choosing"])
    rows = [[f"{f:g}", f"{row['choosing']:.2f}"] for f, row in tried.items()]
    save_result("splats-fit-rates", ["factor of the learning rate", "PSNR of validation photos, dB"], rows, "0")
    kinds = {"as they are": lambda seed: splats, "disturbed": lambda seed: disturbed(splats, seed)}
    rows = []
    for name, of_seed in kinds.items():
        expected = tried[factor] if name == "disturbed" else None
        result = [
            expected if seed == 0 and expected else fitted(of_seed(seed), photos, args, factor, seed)
            for seed in range(args.seeds)
        ]
        rows.append([name, *summary(result)])
    head = ["splats", "held-out photos, before", "after", "training photos, before", "after"]
    head += ["time, s", "CPU time per step, ms", "peak memory, MB"]
    save_result("splats-fit", head, rows, f"0 to {args.seeds - 1}")
    rows = []
    for hits in HITS:
        command = [sys.executable, __file__, "--hits", str(hits)]
        result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
        rows.append([f"{hits:,}", result])
    save_result("splats-fit-memory", ["hits per ray", "peak memory, MB"], rows)


if __name__ == "__main__":
    main()
