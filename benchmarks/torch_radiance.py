"""Time of a training step of a radiance field, compared with a plain PyTorch trainer.

    python benchmarks/torch_radiance.py [--width 135] [--data DIR] [--turns 9] [--threads 2]

Both trainers have the same grid, networks, initial weights, rays, steps along a ray, occupancy grid, density pre-pass,
losses, optimiser and schedule, with fine steps along the ray from the start. The reference is eager PyTorch with
gathers, sums and autograd. Both first evaluate the same random points, and the program stops if the results differ.
Additional features of nerg's trainer are disabled: thinned samples, damped derivatives near cameras, cleared cells,
per-photo colours, and occupancy extraction.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))
import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from radiance import FOX
from timing import in_turns, median, save_result, spread

import numpy as np


def take_turns(ours, peer, turns: int, result: str, steps: int = 8, before: int = 100) -> None:
    """Save the time per step of each as ``result``, in ``turns`` of ``steps``.

    ``before`` steps clear the initial fog.
    """

    def some(trainer, count: int) -> None:
        for _ in range(count):
            trainer.step()

    works = {"nerg_mi": lambda: some(ours, steps), "PyTorch": lambda: some(peer, steps)}
    for trainer in (ours, peer):
        some(trainer, before)
    taken = in_turns(works, turns)
    rows = []
    first = [median(t) for t in zip(*taken["nerg_mi"])]
    for name, times in taken.items():
        wall, cpu = (median(t) for t in zip(*times))
        ratios = [f"{value / ours:.1f}" for value, ours in zip((wall, cpu), first)]
        quartiles = spread(1e3 * c / steps for _, c in times)
        rows.append([name, f"{1e3 * wall / steps:.1f}", f"{1e3 * cpu / steps:.1f}", quartiles, *ratios])
    head = ["trainer", "time per step, ms", "CPU time, ms", "quartiles of CPU time, ms"]
    save_result(result, [*head, "relative time", "relative CPU time"], rows, "0")


_PRIMES = (1, 2654435761, 805459861)

OFF = {
    "extraction_start": 2.0,
    "empty_weight": 0.0,
    "grid_decay": 0.0,
    "rr_min_probability": 1.0,
    "damping_distance": 0.0,
    "photo_colors": False,
}
"""Settings without the features that the reference lacks."""


class TorchModel:
    """Hash grid and networks, evaluated like torch-ngp's fallback: eight gathers per level, weighted and summed."""

    def __init__(self, field):
        import torch

        self.torch, self.config, self.box = torch, field.config, field.box
        self.weights = {
            k: torch.from_numpy(np.array(v.numpy())).requires_grad_() for k, v in field.parameters().items()
        }
        g = field.config.grid
        self.scales, self.rows, self.offsets = g.level_scales(), g.level_rows(), g.offsets()
        self.hashed = [(int(np.ceil(s)) + 2) ** 3 > r for s, r in zip(self.scales, self.rows)]
        self.corners = torch.tensor(list(np.ndindex(2, 2, 2)))
        self.center = torch.tensor(field.box.center, dtype=torch.float32)

    def encode(self, p):
        torch = self.torch
        u = ((p - self.center) / self.box.side + 0.5).clamp(0, 1)
        table, out = self.weights["grid.table"].view(-1, self.config.grid.features), []
        for scale, rows, offset, hashed in zip(self.scales, self.rows, self.offsets, self.hashed):
            x = u * float(scale) + 0.5
            cell = x.floor()
            w = (x - cell)[:, None]
            vertex = cell.long()[:, None] + self.corners
            stride = int(np.ceil(scale)) + 2
            steps = _PRIMES if hashed else (1, stride, stride**2)
            a, b, c = (vertex[..., k] * steps[k] for k in range(3))
            row = ((a ^ b ^ c) & 0xFFFFFFFF) % rows if hashed else a + b + c
            weight = torch.where(self.corners.bool(), w, 1 - w).prod(-1)
            out.append((table[row + offset] * weight[..., None]).sum(1))
        return torch.cat(out, 1)

    def _net(self, name, x):
        layers = [w for k, w in self.weights.items() if k.startswith(name + ".")]
        for i, w in enumerate(layers):
            x = x @ w.T
            x = x.relu() if i + 1 < len(layers) else x
        return x

    def sigma(self, p):
        return self.config.density_scale * self._net("density_net", self.encode(p))[:, 0].clamp(max=30).exp()

    def sigma_color(self, p, harmonics):
        torch = self.torch
        h = self._net("density_net", self.encode(p))
        color = self._net("color_net", torch.cat([harmonics, h[:, 1:]], 1)).sigmoid()
        return self.config.density_scale * h[:, 0].clamp(max=30).exp(), color


def harmonics(d):
    """Real spherical harmonics up to degree 3, (N, 16), of unit directions (N, 3), as in torch-ngp."""
    import torch

    x, y, z = d.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479),
            -0.48860251 * y,
            0.48860251 * z,
            -0.48860251 * x,
            1.09254843 * x * y,
            -1.09254843 * y * z,
            0.94617470 * zz - 0.31539157,
            -1.09254843 * x * z,
            0.54627422 * (xx - yy),
            0.59004359 * y * (yy - 3 * xx),
            2.89061144 * x * y * z,
            0.45704580 * y * (1 - 5 * zz),
            0.37317633 * z * (5 * zz - 3),
            0.45704580 * x * (1 - 5 * zz),
            1.44530572 * z * (xx - yy),
            0.59004359 * x * (3 * yy - xx),
        ],
        1,
    )


class TorchTrainer:
    """The scheme of ``nerg_mi.train``, in eager PyTorch. ``ours``: a trainer before its first step, for the same
    initial state."""

    def __init__(self, ours, views):
        import torch

        self.torch, self.s, self.ours = torch, ours.settings, ours
        self.model = TorchModel(ours.current_field)
        self.averaged = {k: v.detach().clone() for k, v in self.model.weights.items()}
        self.optimiser = torch.optim.Adam(
            self.model.weights.values(), lr=self.s.learning_rate, betas=(0.9, 0.99), eps=1e-15
        )
        from nerg_mi.photos.cameras import pixel_directions

        o, d, c = [], [], []
        for v in views:
            e = (pixel_directions(v.camera.intrinsics).reshape(-1, 3) @ v.camera.to_world[:3, :3].T).astype(np.float32)
            d.append(e)
            o.append(np.broadcast_to(v.camera.center.astype(np.float32), e.shape))
            c.append(v.color[..., :3].reshape(-1, 3))
        self.o, self.d, self.c = (torch.from_numpy(np.concatenate(a).astype(np.float32)) for a in (o, d, c))
        self.edges = {k: torch.from_numpy(np.array(ours.get_step_table(k).edges.numpy())) for k in (*self.s.strides, 1)}
        g = ours.grid
        self.seen, self.value, self.bits = (torch.from_numpy(np.array(x.numpy())) for x in (g.seen, g.value, g.bits))
        self.bits, self.turn, self.r = self.bits.bool(), 0, g.resolution
        self.lower = self.model.center - ours.box.side / 2
        self.low, self.high = (torch.tensor(x, dtype=torch.float32) for x in (ours.box.lower, ours.box.upper))
        self.generator = torch.Generator().manual_seed(self.s.seed)
        self.steps, self.rays = 0, 256
        self.start()

    def start(self):
        self.begin = time.perf_counter()

    @property
    def seconds(self):
        return time.perf_counter() - self.begin

    @property
    def progress(self):
        return min(1.0, self.seconds / (60 * self.s.minutes))

    def cell(self, p):
        c = ((p - self.lower) / self.ours.box.side * self.r).long().clamp(0, self.r - 1)
        return c[..., 0] + self.r * (c[..., 1] + self.r * c[..., 2])

    def update(self):
        torch, r = self.torch, self.r
        index = torch.arange(self.turn % 8, r**3, 8)
        index = index[self.seen[index]]
        self.turn += 1
        corner = torch.stack([index % r, index // r % r, index // r**2], 1)
        p = self.lower + (corner + torch.rand(len(index), 3, generator=self.generator)) / r * self.ours.box.side
        with torch.no_grad():
            new = (self.model.sigma(p) * self.ours.grid.step).clamp(max=10)
        self.value[index] = torch.maximum(self.value[index] * 0.6, new)
        bound = min(self.ours.grid.threshold, 0.5 * float(self.value.sum()) / int(self.seen.sum()))
        self.bits = self.seen & (self.value > bound)

    def samples(self, o, d, stride):
        """Ray, start, length and midpoint of the contributing steps, ray by ray."""
        torch, s = self.torch, self.s
        t = torch.stack([(self.low - o) / d, (self.high - o) / d])
        t0, t1 = t.amin(0).amax(1).clamp(min=s.near * self.ours.box.side), t.amax(0).amin(1)
        e = self.edges[stride]
        u = torch.rand(len(o), 1, generator=self.generator)
        start = torch.lerp(e[:-2], e[1:-1], u)
        length = torch.lerp(e[1:-1], e[2:], u) - start
        middle = start + 0.5 * length
        ray, k = ((middle > t0[:, None]) & (middle < t1[:, None])).nonzero(as_tuple=True)
        p = o[ray] + d[ray] * middle[ray, k][:, None]
        selected = self.bits[self.cell(p)]
        ray, k, p = ray[selected], k[selected], p[selected]
        t, length = start[ray, k], length[ray, k]
        with torch.no_grad():
            tau = (self.model.sigma(p) * length).clamp(max=60)
        selected = (-self.before(tau, ray)).exp() > s.min_transmittance
        return ray[selected], t[selected], length[selected], p[selected]

    def before(self, x, ray):
        """Sum over the earlier samples of the same ray, float64 internally."""
        torch = self.torch
        running = torch.cumsum(x.double(), 0) - x.double()
        first = torch.ones_like(ray, dtype=torch.bool)
        first[1:] = ray[1:] != ray[:-1]
        start = torch.cummax(torch.where(first, torch.arange(len(ray)), 0), 0).values
        return (running - running[start]).float()

    def step(self):
        torch, s = self.torch, self.s
        if self.steps % s.grid_interval == 0 and self.steps:
            self.update()
        index = torch.randint(len(self.o), (self.rays,), generator=self.generator)
        o, d, truth = self.o[index], self.d[index], self.c[index]
        ray, _, length, p = self.samples(o, d, s.stride_at(self.progress))
        self.steps += 1
        covered = self.rays
        if len(ray) > s.batch:
            covered = int(ray[s.batch])
            selected = ray < covered
            ray, length, p = ray[selected], length[selected], p[selected]
        if len(ray):
            self.descend(d, truth, ray, length, p, covered)
        wanted = 0.95 * s.batch / max(len(ray) / max(covered, 1), 1e-3)
        self.rays = int(np.clip(min(max(0.5 * (self.rays + wanted), self.rays / 2), 2 * self.rays), 64, 2**14))

    def descend(self, d, truth, ray, length, p, covered):
        from nerg_mi.train.trainer import learning_rate_at

        torch, s = self.torch, self.s
        sigma, rgb = self.model.sigma_color(p, harmonics(d[ray]))
        tau = (sigma * length).clamp(max=60)
        weight = (-self.before(tau, ray)).exp() * -torch.expm1(-tau)
        color = torch.zeros(covered, 3).index_add(0, ray, weight[:, None] * rgb)
        opacity = torch.zeros(covered).index_add(0, ray, weight)
        background = torch.rand(covered, 3, generator=self.generator)
        error = (color + (1 - opacity)[:, None] * background - truth[:covered]).abs()
        loss = (
            torch.where(error < s.huber_delta, 0.5 * error**2, s.huber_delta * (error - 0.5 * s.huber_delta))
            .mean(1)
            .mean()
        )
        self.optimiser.zero_grad()
        loss.backward()
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate_at(s, self.progress)
        self.optimiser.step()
        if self.steps % 4 == 0:
            decay = min(s.ema_decay, (1 + self.steps) / (10 + self.steps)) ** 4
            for k, v in self.averaged.items():
                v.lerp_(self.model.weights[k].detach(), 1 - decay)


def same_model(trainer, peer) -> float:
    """Largest relative difference of densities, and of colours, at random points."""
    from nerg_mi.train.radiance_losses import evaluate_samples

    import drjit as dr
    import torch

    rng = np.random.default_rng(0)
    p = rng.uniform(trainer.box.lower, trainer.box.upper, (4096, 3)).astype(np.float32)
    d = rng.normal(size=p.shape).astype(np.float32)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    ns = trainer.ns
    scaled = {
        k: dr.detach(v) * (3e3 if k == "grid.table" else 1) for k, v in trainer.current_field.parameters().items()
    }
    old = {k: v.detach().clone() for k, v in peer.weights.items()}
    with torch.no_grad():
        peer.weights["grid.table"] *= 3e3
        theirs = peer.sigma_color(torch.from_numpy(p), harmonics(torch.from_numpy(d)))
        peer.weights["grid.table"].copy_(old["grid.table"])
    ours = evaluate_samples(trainer.config, trainer.box, scaled, ns.Array3f(p.T), ns.Array3f(d.T), ns)
    a, b = ours[0].numpy(), np.stack([c.numpy() for c in ours[1]], 1)
    return max(float(np.abs(a / theirs[0].numpy() - 1).max()), float(np.abs(b - theirs[1].numpy()).max()))


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=Path, default=FOX, help="Folder of the posed images. Default: the fox of NERG_DATA."
    )
    parser.add_argument("--width", type=int, default=135, help="Width of the photos in pixels. Default: %(default)s.")
    parser.add_argument(
        "--size", default="small", help="Size of the field: small, medium or paper. Default: %(default)s."
    )
    parser.add_argument("--threads", type=int, default=2, help="Number of CPU threads. Default: %(default)s.")
    parser.add_argument(
        "--turns",
        type=int,
        default=9,
        help="Both trainers alternate this many times for 8 steps each, after 100 steps that clear the initial fog. "
        "Default: %(default)s.",
    )
    args = parser.parse_args(argv)

    from nerg_mi.cli.declarations import select_backend
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.photos.dataset import open_dataset
    from nerg_mi.train.radiance_settings import RadianceSettings, make_radiance_config
    from nerg_mi.train.radiance_trainer import RadianceTrainer

    import torch

    select_backend("llvm_ad_rgb", args.threads)
    ns = namespace("llvm_ad_rgb")
    torch.set_num_threads(args.threads)
    data = open_dataset(args.data, None, args.width)
    if any(v.has_alpha or v.mask is not None for v in data.train):
        raise SystemExit("the peer knows neither alpha nor masks; give a set of plain photos")
    settings = RadianceSettings(minutes=60, strides=(), **OFF)
    make = lambda: RadianceTrainer(
        data.train, data.box, make_radiance_config(args.size, data.box), settings, ns, depth=False
    )
    ours, peer = make(), TorchTrainer(make(), data.train)
    difference = same_model(ours, peer.model)
    print(f"same weights, same points: densities and colours differ by {difference:.1e} at most")
    if not difference < 1e-3:
        raise SystemExit("the two are not the same model")
    take_turns(ours, peer, args.turns, f"training-step-{args.threads}")


if __name__ == "__main__":
    main()
