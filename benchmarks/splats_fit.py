"""Gaussian splats fitted to photos through ``mi.render``: PSNR of held-out views before and after, time, memory.

    python benchmarks/splats_fit.py [--resolution 96] [--views 24] [--width 96] [--steps 80]

The photos are renderings of the demo store's mesh from a photographer's cameras, chosen as for the store's field. Eight
other photos, from a shopper's eye, select the learning rates: `RATES` times one of `FACTORS`. Eight more photos, unused
otherwise, are the held-out ones.

The initial splats are those that `nerg export splats` makes of the field, or those of ``--splats``. They are fitted as
they are, and disturbed: opacities are multiplied by 0.7, and the other parameters change randomly, with standard
deviations of 2 cm per axis for centres, a third for scales, about 10 degrees for axes, and a tenth for colours. Adam
optimises all parameters of the Gaussians: the centre, the logarithms of the scales, the quaternion, the logit of the
opacity, and the spherical harmonics. The loss is the squared difference of sRGB values. No Gaussian is added or
removed.

The rays of a step are those of one photo, which read lists of Gaussians by direction, or as many random pixels of all
photos, which search the tree: for as many steps, and for as much CPU time. The time of a step is the median, on one
thread, since threads that wait for others take CPU time, too. The memory is the maximum that Dr.Jit allocates during a
fit, beyond what was allocated before. The benchmark does not pass or fail.
"""

from __future__ import annotations

import argparse
import gc
import os
import sys
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit)

# BLAS threads spin while they wait, and slow down the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from nerg_mi.fields.splats import Splats, multiply_quaternions
from nerg_mi.figures.overlay import srgb
from nerg_mi.maths.sphere import SH_C0
from nerg_mi.registration import get_plugin_class
from timing import save_result

import drjit as dr
import mitsuba as mi
import numpy as np

FIELD = "integrator.field."
# Approximate change per step of Adam: metres, logarithms, quaternions, logits, harmonics.
RATES = {"centers": 1e-3, "log_scales": 0.02, "rotations": 0.01, "logits": 0.05, "harmonics": 0.02}
FACTORS = (1.0, 2.0, 4.0)
COLUMNS = ("splats", "rays of a step", "rates", "steps", "held-out photos, dB", "training photos, dB")
COLUMNS += ("validation photos, dB", "CPU time per step, ms", "peak memory, MB")


def disturb(splats: Splats) -> Splats:
    """``splats``, disturbed as documented above."""
    rng = np.random.default_rng(0)
    noise = lambda like, size: size * rng.normal(size=like.shape)
    turn = np.concatenate([np.ones((len(splats), 1)), noise(splats.centers, 0.09)], axis=1)
    return Splats(
        splats.centers + noise(splats.centers, 0.02),
        splats.scales * np.exp(noise(splats.scales, 0.33)),
        multiply_quaternions(turn, splats.rotations),
        0.7 * splats.opacities,
        splats.harmonics + noise(splats.harmonics, 0.1) / SH_C0,
    )


class Photos:
    """Cameras of the store's twin with their images: for training, validation, and held out."""

    def __init__(self, count: int, width: int):
        from nerg_mi.scenes.store import cameras, layout, views

        camera = cameras.Pinhole(width, 3 * width // 4)
        plan = layout.build_store(0)
        poses = [*cameras.choose_views(plan, camera, count, 8), cameras.choose_views(plan, camera, 1, 8, seed=1)[1]]
        photographer = views.StorePhotographer(camera)
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
        film["component_format"] = "float32"
        sensor = {"type": "perspective", "fov": camera.fov_x, "fov_axis": "x", "near_clip": 0.01, "film": film}
        self.training, self.validation, self.held_out = (
            (
                [mi.load_dict(sensor | {"to_world": mi.ScalarTransform4f(views.to_mitsuba_pose(p))}) for p in group],
                [srgb(photographer.render_picture(pose, seed, spp)) for seed, pose in enumerate(group)],
            )
            for group, spp in zip(poses, (16, 64, 64))
        )


def psnr(scene, cameras, photos) -> str:
    """Mean PSNR over images, with four samples per pixel."""
    result = []
    for camera, photo in zip(cameras, photos):
        picture = srgb(np.array(mi.render(scene, sensor=camera, spp=4, seed=1))[..., :3])
        result.append(-10 * np.log10(np.square(picture - photo).mean()))
    return f"{np.mean(result):.2f}"


def as_srgb(x):
    """sRGB values of linear ones, differentiable."""
    return dr.select(x <= 0.0031308, 12.92 * x, 1.055 * dr.power(dr.maximum(x, 0.0031308), 1 / 2.4) - 0.055)


def batches(photos: Photos, is_random: bool):
    """Sensors of the steps with their targets: photos in random order, or as many random pixels of all."""
    cameras, pictures = photos.training
    targets = [mi.TensorXf(picture.astype(np.float32)) for picture in pictures]
    size, rng = pictures[0][..., 0].size, np.random.default_rng(0)
    if is_random:
        loader = mi.ad.loaders.RayDataLoader(cameras, targets, pixels_per_batch=size, regular_reshuffle=True)
        while True:
            target, sensor = loader.next()
            yield sensor, target
    while True:
        yield from ((cameras[k], targets[k]) for k in rng.permutation(len(cameras)))


def fit(scene, photos: Photos, steps: int, factor: float, is_random: bool) -> float:
    """Optimise all Gaussians of ``scene`` with ``factor`` times the rates; CPU seconds of a step."""
    params = mi.traverse(scene)
    params.keep([FIELD + name for name in ("centers", "scales", "rotations", "opacities", "harmonics")])
    opacities = dr.clip(params[FIELD + "opacities"], 1e-4, 1 - 1e-4)
    start = {name: params[FIELD + name] for name in ("centers", "rotations", "harmonics")}
    start |= {"log_scales": dr.log(params[FIELD + "scales"]), "logits": dr.log(opacities / (1 - opacities))}
    opt, seconds = mi.ad.Adam(lr=1e-3, params=start), []
    for i, (sensor, target) in zip(range(steps), batches(photos, is_random)):
        begin = time.process_time()
        # Decreasing to a tenth towards the end.
        opt.set_learning_rate({name: factor * rate * 0.1 ** (i / steps) for name, rate in RATES.items()})
        for name in ("centers", "rotations", "harmonics"):
            params[FIELD + name] = opt[name]
        params[FIELD + "scales"] = dr.exp(opt["log_scales"])
        params[FIELD + "opacities"] = 1 / (1 + dr.exp(-opt["logits"]))
        params.update()
        picture = mi.render(scene, params, sensor=sensor, spp=1, seed=i)
        dr.backward(dr.mean(dr.square(as_srgb(picture[..., :3]) - target), axis=None))
        opt.step()
        dr.sync_thread()
        seconds.append(time.process_time() - begin)
    return float(np.median(seconds)) if steps else 0.0


def measure(name: str, splats: Splats, photos: Photos, steps: int, factor=1.0, is_random=False) -> list[str]:
    """A row of the table: a fit of ``splats``, or its start with 0 ``steps``."""
    integrator = {"type": "nerg", "field": get_plugin_class("splats").from_network(splats), "id": "integrator"}
    scene = mi.load_dict({"type": "scene", "integrator": integrator | {"occlusion": False}})
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.LLVM)
    milliseconds = 1e3 * fit(scene, photos, steps, factor, is_random)
    memory = (dr.detail.malloc_watermark(dr.JitBackend.LLVM) - before) / 1e6
    row = [name, "random pixels" if is_random else "one photo", f"{factor:g}", f"{steps}"]
    row = row if steps else [name, "", "", "0"]
    row += [psnr(scene, *group) for group in (photos.held_out, photos.training, photos.validation)]
    row += [f"{milliseconds:.0f}", f"{memory:.0f}"] if steps else ["", ""]
    print(row, file=sys.stderr, flush=True)
    return row


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
    parser.add_argument("--steps", type=int, default=80, help="Number of steps of Adam. Default: %(default)s.")
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    from nerg_mi.formats.splats import read_splats
    from splats import make

    path = args.splats
    if path is None:
        path = Path("out/benchmarks/fit.ply")
        make(path, args.resolution)
    splats, photos = read_splats(path), Photos(args.views, args.width)
    disturbed = disturb(splats)
    start = [measure(name, s, photos, 0) for name, s in (("as made", splats), ("disturbed", disturbed))]
    rows = [measure("disturbed", disturbed, photos, args.steps, factor) for factor in FACTORS]
    best = max(range(len(FACTORS)), key=lambda k: float(rows[k][6]))
    factor = FACTORS[best]
    made = measure("as made", splats, photos, args.steps, factor)
    equal_steps = measure("disturbed", disturbed, photos, args.steps, factor, True)
    ratio = float(rows[best][7]) / float(equal_steps[7])
    equal_time = measure("disturbed", disturbed, photos, round(args.steps * ratio), factor, True)
    save_result("splats-fit", COLUMNS, [start[0], made, start[1], *rows, equal_steps, equal_time], "0")


if __name__ == "__main__":
    main()
