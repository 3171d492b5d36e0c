"""Gaussian splats fitted to photos through ``mi.render``: PSNR of held-out views before and after, time, memory.

    python benchmarks/splats_fit.py [--resolution 96] [--views 24] [--width 96] [--steps 150] [--rays 8192] [--update
    docs/splats.md]

Photos are those that a photographer takes of the demo store's twin, at cameras chosen as for the store's field; held-
out ones are a shopper's. Fitted are the splats that `nerg export splats` makes of the field (`--splats FILE` takes
others), as they are and disturbed: centres moved by 2 cm in each axis, scales off by a third, axes turned by some 10
degrees, opacities cut by 3 tenths, colours off by a tenth (standard deviations, all of one seed). All that a Gaussian
has is optimised: Adam over its centre, the logarithms of its scales, its quaternion, the logit of its opacity and its
harmonics; rays are random pixels of all photos, errors are squared differences of sRGB values. None is added or taken
away.

Second table: the most that Dr.Jit holds during one derivative, beyond what it held before, against the number of hits a
ray: the same 4,096 rays through stacks of walls, each figure of its own process. Nothing passes or fails here.
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

# BLAS threads wait in a busy loop, in the way of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from nerg_mi.field.splats import Splats, harmonics_of, multiply_quaternions
from nerg_mi.figures.tonemap import srgb
from nerg_mi.registration import plugin_class
from output import print_table

import drjit as dr
import mitsuba as mi
import numpy as np

PREFIX = "integrator.field."
# A step of Adam moves by about so much: metres, logarithms, quaternions, logits, harmonics.
RATES = {"centers": 1e-3, "log_scales": 0.02, "rotations": 0.01, "logits": 0.05, "harmonics": 0.02}
HITS = (16, 64, 256, 1024)
SIDE, WARM = 64, 4


def disturbed(splats: Splats, seed: int = 0) -> Splats:
    """``splats`` as the documentation of this file says."""
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
    """Of the store's twin, from cameras to train on and others."""

    def __init__(self, count: int, width: int):
        from nerg_mi.scenes.store import cameras, layout, views

        camera = cameras.Pinhole(width, 3 * width // 4)
        poses = cameras.choose_views(layout.build(0), camera, count, 8)
        photographer = views.Photographer(camera)
        taken = [
            [photographer.picture(pose, seed, spp) for seed, pose in enumerate(group)]
            for group, spp in zip(poses, (16, 64))
        ]
        self.seen, self.held_out = ([srgb(picture) for picture in group] for group in taken)
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
        film["component_format"] = "float32"
        sensor = {"type": "perspective", "fov": camera.fov_x, "fov_axis": "x", "near_clip": 0.01, "film": film}
        self.cameras, self.others = (
            [mi.load_dict(sensor | {"to_world": mi.ScalarTransform4f(views.mitsuba_pose(p))}) for p in group]
            for group in poses
        )


def scene_of(splats: Splats):
    """Their place, colour alone."""
    integrator = {"type": "nerg", "field": plugin_class("splats").of(splats), "occlusion": False, "id": "integrator"}
    return mi.load_dict({"type": "scene", "integrator": integrator})


def psnr(scene, cameras, photos) -> float:
    """The mean over pictures, of four samples a pixel."""
    found = []
    for camera, photo in zip(cameras, photos):
        picture = srgb(np.array(mi.render(scene, sensor=camera, spp=4, seed=1))[..., :3])
        found.append(-10 * np.log10(np.square(picture - photo).mean()))
    return float(np.mean(found))


def as_srgb(x):
    """sRGB values of linear ones, with derivatives."""
    return dr.select(x <= 0.0031308, 12.92 * x, 1.055 * dr.power(dr.maximum(x, 0.0031308), 1 / 2.4) - 0.055)


def fit(scene, photos: Photos, steps: int, rays: int) -> None:
    """Optimise all Gaussians of ``scene``."""
    params = mi.traverse(scene)
    params.keep([PREFIX + name for name in ("centers", "scales", "rotations", "opacities", "harmonics")])
    opacities = dr.clip(params[PREFIX + "opacities"], 1e-4, 1 - 1e-4)
    start = {name: params[PREFIX + name] for name in ("centers", "rotations", "harmonics")}
    start |= {"log_scales": dr.log(params[PREFIX + "scales"]), "logits": dr.log(opacities / (1 - opacities))}
    opt = mi.ad.Adam(lr=1e-3, params=start)
    targets = [mi.TensorXf(photo.astype(np.float32)) for photo in photos.seen]
    loader = mi.ad.loaders.RayDataLoader(photos.cameras, targets, pixels_per_batch=rays, regular_reshuffle=True)
    for i in range(steps):
        # Slower towards the end, down to a tenth.
        opt.set_learning_rate({name: rate * 0.1 ** (i / steps) for name, rate in RATES.items()})
        for name in ("centers", "rotations", "harmonics"):
            params[PREFIX + name] = opt[name]
        params[PREFIX + "scales"] = dr.exp(opt["log_scales"])
        params[PREFIX + "opacities"] = 1 / (1 + dr.exp(-opt["logits"]))
        params.update()
        wanted, sensor = loader.next()
        picture = mi.render(scene, params, sensor=sensor, spp=1, seed=i)
        dr.backward(dr.mean(dr.square(as_srgb(picture[..., :3]) - wanted), axis=None))
        opt.step()


def stack(hits: int) -> Splats:
    """As many flat Gaussians for every ``hits``, of which so many stand one behind the other before the rays, and the
    others beside them."""
    n = HITS[-1]
    centers = np.stack([np.where(np.arange(n) < hits, 0, 50), np.zeros(n), np.linspace(-1, 1, n)], axis=1)
    scales, turned = np.tile([2, 2, 1e-4], (n, 1)), np.tile([1, 0, 0, 0], (n, 1))
    # Light is left behind the last, so that all are met.
    return Splats(centers, scales, turned, np.full(n, 4 / n), harmonics_of(np.full((n, 3), 0.3)))


def peak(hits: int) -> float:
    """MB (of 10^6 bytes) that a derivative holds at most beyond what is held before, compiled before."""
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
    """MB that ``work`` holds at most beyond what is held before."""
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    work()
    dr.sync_thread()
    return (dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before) / 1e6


def fitted(name: str, splats: Splats, photos: Photos, args) -> list[str]:
    """A row of the first table."""
    scene = scene_of(splats)
    before = [psnr(scene, photos.cameras, photos.seen), psnr(scene, photos.others, photos.held_out)]
    start, cpu = time.perf_counter(), time.process_time()
    memory = held_at_most(lambda: fit(scene, photos, args.steps, args.rays))
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    after = [psnr(scene, photos.cameras, photos.seen), psnr(scene, photos.others, photos.held_out)]
    row = [name, *(f"{v:.2f}" for v in (before[1], after[1], before[0], after[0]))]
    row += [f"{seconds:.0f}", f"{1e3 * cpu / args.steps:.0f}", f"{memory:.0f}"]
    print(row, file=sys.stderr, flush=True)
    return row


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=Path, help="file of splats (default: made of the store's field)")
    parser.add_argument("--resolution", type=int, default=96, help="lattice cells of what is made")
    parser.add_argument("--views", type=int, default=24, help="photos to fit to")
    parser.add_argument("--width", type=int, default=96, help="of a photo in pixels (4:3)")
    parser.add_argument("--steps", type=int, default=150, help="of Adam")
    parser.add_argument("--rays", type=int, default=8192, help="rays a step")
    parser.add_argument("--hits", type=int, help="print the memory for so many hits, measured in this process")
    parser.add_argument("--update", type=Path, help="a document whose tables are replaced")
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    if args.hits:
        print(f"{peak(args.hits):.2f}")
        return
    from nerg_mi.formats.splats.files import read_splats
    from splats import make

    path = args.splats
    if path is None:
        path = Path("out/benchmarks/fit.ply")
        make(path, args.resolution)
    splats, photos = read_splats(path), Photos(args.views, args.width)
    rows = [fitted("as they are", splats, photos, args), fitted("disturbed", disturbed(splats), photos, args)]
    head = ["splats", "held-out photos, before", "after", "photos fitted to, before", "after"]
    head += ["s", "CPU ms a step", "MB at most"]
    print_table("PSNR of photos, dB", head, rows, args.update)
    rows = []
    for hits in HITS:
        command = [sys.executable, __file__, "--hits", str(hits)]
        found = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
        rows.append([f"{hits:,}", found])
    print_table("Memory of a derivative", ["hits a ray", "MB at most"], rows, args.update)


if __name__ == "__main__":
    main()
