"""What a deferred colour head costs in PSNR, beside the colour network at every sample.

    python benchmarks/deferred_head.py [--field FILE] [--data DIR] [--width 270] [--steps 4000]

Features are composited along a ray and the colour network is asked once (Hedman et al. 2021), in place of compositing
the colours of samples. A trained field, its densities and features as they are (by default what `fox_radiance.py
--minutes 4 --width 270` leaves); its colour network as it is, and trained on, with composited features, on every fifth
pixel of the training photos. PSNR are means over the held-out photos, a ray through the middle of each pixel.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from fox_radiance import default_data
from frame_limit import march_features
from output import print_table

import numpy as np

_EVERY, _BATCH, _RATE, _FINAL = 5, 1 << 14, 2e-3, 0.05


def main(argv=None) -> None:
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--field", type=Path, default=Path("out/benchmarks/fox_radiance/270_4.safetensors"))
    parser.add_argument("--data", type=Path, default=default_data())
    parser.add_argument("--width", type=int, default=270)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.capture.dataset import open_dataset
    from nerg_mi.field.backend import namespace
    from nerg_mi.formats.fields import load_radiance

    if not args.field.is_file():
        raise SystemExit(f"{args.field} does not exist; make it with: python benchmarks/fox_radiance.py --width 270")
    field, _ = load_radiance(args.field, namespace("llvm_ad_rgb"))
    data = open_dataset(args.data, None, args.width)
    rays = [view_of(field, view, _EVERY, args.seed + k) for k, view in enumerate(data.train)]
    inputs, opacity, truth = (np.concatenate([r[name] for r in rays]) for name in ("inputs", "opacity", "truth"))
    head = Head(field)
    held = [view_of(field, view) for view in data.held_out]
    score = lambda of: float(np.mean([psnr(of(view), view["truth"]) for view in held]))
    deferred = lambda view: view["opacity"][:, None] * head(view["inputs"])
    plain, as_it_is = score(lambda view: view["color"]), score(deferred)
    seconds = head.train(inputs, opacity, truth, args.steps, args.seed)
    trained = score(deferred)
    print(f"{len(inputs):,} rays of {len(rays)} photos, {args.steps} steps, {seconds:.0f} s")
    rows = [
        ("the network at every sample", f"{plain:.2f}", ""),
        ("deferred, the network as it is", f"{as_it_is:.2f}", f"{as_it_is - plain:+.2f}"),
        ("deferred, the network trained on", f"{trained:.2f}", f"{trained - plain:+.2f}"),
    ]
    print_table("A deferred head", ("colours", "PSNR, dB", "less the first"), rows)


def view_of(field, view, every: int = 1, seed: int = 0) -> dict[str, np.ndarray]:
    """Of one pixel in ``every`` of a view: colours by the network at every sample (N, 3), the inputs of a deferred head
    (N, I), the opacity (N,), and the photo's colours (N, 3), sRGB."""
    from nerg_mi.capture.cameras import pixel_directions
    from nerg_mi.field.encoding.harmonics import encode_direction
    from nerg_mi.transport.march.march import march
    from nerg_mi.transport.media.field import FieldMedium
    from nerg_mi.transport.media.painting import ColorPainter
    from nerg_mi.transport.place import Place
    from nerg_mi.transport.trace import default_settings

    import drjit as dr
    import mitsuba as mi

    medium = FieldMedium(field)
    settings, pose = default_settings(Place(medium)), view.camera.to_world
    local = pixel_directions(view.camera.intrinsics).reshape(-1, 3)
    which = np.random.default_rng(seed).permutation(len(local))[: len(local) // every] if every > 1 else slice(None)
    d = local[which] @ pose[:3, :3].T
    direction = mi.Vector3f(*map(mi.Float, np.ascontiguousarray(d.T, np.float32)))
    origin = mi.Point3f(*np.asarray(pose[:3, 3], float).tolist()) + dr.zeros(mi.Vector3f, len(d))
    ray = medium.local(origin, direction)

    near, painter = dr.maximum(ray.t_near, 0), ColorPainter(mi.Color3f)
    color = np.array(march(medium, ray, near, ray.t_far, mi.Bool(True), settings, color=painter).color).T
    features, opacity = march_features(medium, ray, settings)
    harmonics = encode_direction(ray.w, field.config.sh_degree)
    given = [np.broadcast_to(np.array(v), len(d)) for v in (*harmonics, *features)]
    return {
        "color": color,
        "inputs": np.stack(given, axis=1).astype(np.float32),
        "opacity": np.array(opacity),
        "truth": np.asarray(view.over(0), np.float32).reshape(-1, 3)[which],
    }


class Head:
    """The colour network of ``field`` in torch, asked with composited features."""

    def __init__(self, field):
        import torch

        self.torch = torch
        torch.set_num_threads(2)
        self.weights = [torch.from_numpy(np.array(w, np.float32)).requires_grad_() for w in field.color_net.weights]

    def forward(self, x):
        for w in self.weights[:-1]:
            x = self.torch.relu(x @ w.T)
        return self.torch.sigmoid(x @ self.weights[-1].T)

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        with self.torch.no_grad():
            return self.forward(self.torch.from_numpy(inputs)).numpy()

    def train(self, inputs: np.ndarray, opacity: np.ndarray, truth: np.ndarray, steps: int, seed: int) -> float:
        """Squared error by Adam, with a rate that decays; the seconds that it took."""
        import time

        torch, start, rng = self.torch, time.perf_counter(), np.random.default_rng(seed)
        optimizer = torch.optim.Adam(self.weights, lr=_RATE)
        decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, _FINAL ** (1 / steps))
        x, a, y = (torch.from_numpy(np.ascontiguousarray(v, np.float32)) for v in (inputs, opacity[:, None], truth))
        for _ in range(steps):
            batch = torch.from_numpy(rng.integers(0, len(x), _BATCH))
            loss = ((a[batch] * self.forward(x[batch]) - y[batch]) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            decay.step()
        return time.perf_counter() - start


def psnr(seen: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((np.clip(seen, 0, 1) - truth) ** 2)))


if __name__ == "__main__":
    main()
