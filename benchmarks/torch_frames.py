"""A frame of the demo store compared with a plain PyTorch renderer of the same checkpoints, steps and camera.

Used by `bench.py`. The frame has colour, depth and the gaze of an observer who is not at the camera, with occlusion.
The reference is eager PyTorch as commonly used for radiance fields. It marches in uniform steps of the field's own
length, in slabs, and skips the empty cells of the occupancy grid. Samples and rays are compacted. The density network
is evaluated first, and the colour network where the weight exceeds 1e-3. Rays end at a transmittance below 1e-4. Then
follow the observer's rays to the surfaces, which end at the surface or once they are opaque, and the gaze field. The
integral over the observer's sphere is kept between frames, as in nerg.

The hash grid is evaluated like by torch-ngp's fallback, with eight gathers per level. A second row needs less memory
traffic, and a third has the encoding and the networks in torch.compile. The first frame of nerg is timed without
compiled kernels.
"""

from __future__ import annotations

import atexit
import itertools
import os
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

# First frames must not find a compiled kernel. Once Dr.Jit is loaded this cannot be set.
if "drjit" not in sys.modules:
    os.environ["DRJIT_CACHE_DIR"] = tempfile.mkdtemp(prefix="kernels-")
    atexit.register(shutil.rmtree, os.environ["DRJIT_CACHE_DIR"], ignore_errors=True)
import nerg_mi as nerg
from nerg_mi.figures.overlay import srgb
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.scenes.store import SCENE_FILE
from timing import in_turns, median, spread
from torch_radiance import _PRIMES, TorchModel, harmonics

import numpy as np


class Attention:
    """Gaze as a density that integrates to one over an observer's sphere, with the weights of a ``model``
    (`TorchModel`): `nerg_mi.fields.gaze_log_density`."""

    def __init__(self, model):
        import torch

        self.model, self.config = model, model.config
        self.degree = self.config.sh_degree**2
        low, high = torch.tensor(self.config.heads)
        self.low, self.scale = low, 2 / (high - low).max()
        self.end = (high - low) * self.scale - 1

    def log_prior(self, r_o):
        """Log of the position-independent prior, bilinear in its latitude-longitude table."""
        import torch

        table = self.model.weights["prior"].detach()
        rows, columns = table.shape
        x = torch.atan2(r_o[:, 1], r_o[:, 0]).remainder(2 * np.pi) * (rows / np.pi) - 0.5
        y = (r_o[:, 2].clamp(-1, 1).acos() * (rows / np.pi) - 0.5).clamp(0, rows - 1)
        i, j = x.floor(), y.floor().clamp(max=rows - 2)
        fx, fy = x - i, y - j
        i, j = i.long() % columns, j.long()
        k = (i + 1) % columns
        upper, lower = (table[r, i].lerp(table[r, k], fx) for r in (j, j + 1))
        return upper.lerp(lower, fy)

    def unnormalized(self, p_od, p_o, r_o, escaped=None):
        """The integrand, 1/sr times a constant of the observer."""
        import torch

        c, weights = self.config, self.model.weights
        ones = torch.ones(len(r_o), 1)
        distance = (p_od - p_o).norm(dim=1, keepdim=True).clamp(min=1e-3 * self.model.box.side).log()
        inputs = [ones, distance, harmonics(-r_o)[:, : self.degree], self.model.encode(p_od)]
        emit = self.model._net("emit_net", torch.cat(inputs, 1))[:, 0]
        if escaped is not None and c.escaped == "constant":
            emit = torch.where(escaped, weights["escaped"].detach(), emit)
        u = torch.minimum((p_o - self.low) * self.scale - 1, self.end).clamp(min=-1)
        waves = [u, (u * (np.pi / 2)).sin(), (u * (np.pi / 2)).cos()]
        capture = self.model._net("capture_net", torch.cat([ones, harmonics(r_o)[:, : self.degree], *waves], 1))
        logit = self.log_prior(r_o) + emit if self.config.prior_factor else emit
        return logit.clamp(max=30).exp() * capture[:, 0].sigmoid()

    def gaze(self, p_od, p_o, r_o, integral):
        """Gaze in 1/sr of observers with the given ``integral``."""
        mix = self.config.mix
        return (1 - mix) / integral * self.unnormalized(p_od, p_o, r_o) + mix * self.log_prior(r_o).exp()


SLAB = 16
"""Steps per batch of a ray."""

RAYS = 1 << 15
"""Rays per batch."""

WEIGHT, STOP = 1e-3, 1e-4

MAX_DIRECTIONS = 1 << 15
"""Directions of an observer's integral."""


class QuickModel(TorchModel):
    """The same grid with less memory traffic, without gradients: corners one after the other, and 32-bit indices, whose
    products overflow as the hash requires."""

    def encode(self, p):
        torch, out = self.torch, []
        u = ((p - self.center) / self.box.side + 0.5).clamp(0, 1)
        table = self.weights["grid.table"].detach().view(-1, self.config.grid.features)
        for scale, rows, offset, hashed in zip(self.scales, self.rows, self.offsets, self.hashed):
            x = u * float(scale) + 0.5
            cell = x.floor()
            w = x - cell
            stride = int(np.ceil(scale)) + 2
            steps = [np.uint32(k).astype(np.int32).item() for k in (_PRIMES if hashed else (1, stride, stride**2))]
            low = [cell[:, k].int() * steps[k] for k in range(3)]
            ends = [((1 - w[:, k], low[k]), (w[:, k], low[k] + steps[k])) for k in range(3)]
            total = None
            for (wx, x), (wy, y), (wz, z) in itertools.product(*ends):
                row = ((x ^ y ^ z) & (rows - 1)) if hashed else x + y + z
                value = table[offset : offset + rows].index_select(0, row) * (wx * wy * wz)[:, None]
                total = value if total is None else total.add_(value)
            out.append(total)
        return torch.cat(out, 1)


class TorchRenderer:
    """Frames of a radiance field and a gaze field, in torch."""

    def __init__(self, field, gaze, falloff: float, model: type[TorchModel] = QuickModel, compiled: bool = False):
        import torch

        self.torch, self.falloff = torch, falloff
        self.model, self.attention = model(field), Attention(model(gaze))
        self.bits = torch.from_numpy(field.occupancy.bits.ravel().copy())
        self.cells, self.dt = field.occupancy.resolution, float(field.march_step)
        self.side = float(field.box.side)
        self.lower = self.model.center - self.side / 2
        self.low, self.high = (torch.tensor(v, dtype=torch.float32) for v in (field.box.lower, field.box.upper))
        self.density, self.color, self.gaze = self._density, self._color, self.attention.gaze
        self.integrals: dict[tuple, float] = {}
        if compiled:
            self.density, self.color, self.gaze = (
                torch.compile(f, dynamic=True) for f in (self._density, self._color, self.attention.gaze)
            )

    def _density(self, p):
        h = self.model._net("density_net", self.model.encode(p))
        return self.model.config.density_scale * h[:, 0].clamp(max=30).exp(), h[:, 1:]

    def _color(self, features, d):
        return self.model._net("color_net", self.torch.cat([harmonics(d), features], 1)).sigmoid()

    def occupied(self, p):
        """Whether the cells of ``p`` (..., 3) are occupied."""
        c = ((p - self.lower) * (self.cells / self.side)).long().clamp_(0, self.cells - 1)
        return self.bits[c[..., 0] + self.cells * (c[..., 1] + self.cells * c[..., 2])]

    def march(self, o, d, end=None, colored=True):
        """Colour (N, 3), opacity and median depth (N,) of rays, which end at ``end`` (N,) or leave the box."""
        torch, dt = self.torch, self.dt
        n = len(o)
        ends = torch.stack([(self.low - o) / d, (self.high - o) / d])
        t0, t1 = ends.amin(0).amax(1).clamp(min=0), ends.amax(0).amin(1)
        t1 = t1 if end is None else torch.minimum(t1, end)
        color, through = torch.zeros(n, 3), torch.ones(n)
        depth = torch.full((n,), torch.inf)
        alive = (t1 > t0).nonzero()[:, 0]
        steps = torch.arange(SLAB) * dt
        start = t0.clone()
        while len(alive):
            t = start[alive, None] + steps
            p = o[alive, None] + d[alive, None] * (t + 0.5 * dt)[..., None]
            row, column = (self.occupied(p) & (t < t1[alive, None])).nonzero(as_tuple=True)
            tau = torch.zeros(len(alive), SLAB)
            if len(row):
                sigma, features = self.density(p[row, column])
                tau[row, column] = sigma * dt
                before = tau.cumsum(1) - tau
                first = through[alive, None] * (-before).exp()
                weight = first * -torch.expm1(-tau)
                after = first * (-tau).exp()
                crossed = (first > 0.5) & (after <= 0.5)
                at = crossed.any(1).nonzero()[:, 0]
                k = crossed[at].to(torch.uint8).argmax(1)
                depth[alive[at]] = t[at, k] + dt * (first[at, k] / 0.5).log() / tau[at, k]
                if colored:
                    w = weight[row, column]
                    selected = w > WEIGHT
                    ray = alive[row[selected]]
                    color.index_add_(0, ray, w[selected, None] * self.color(features[selected], d[ray]))
                through[alive] = after[:, -1]
            start[alive] = t[:, -1] + dt
            going = start[alive] < t1[alive]
            going &= (through[alive] > STOP) if colored else (through[alive] > 0.5)
            alive = alive[going]
        return color, 1 - through, depth

    def frame(self, o, d, observer):
        """Linear colour (N, 3), depth and gaze (N,) as arrays, of rays from ``o`` along unit ``d`` (N, 3)."""
        torch = self.torch
        rays, result = [torch.from_numpy(np.ascontiguousarray(v, np.float32)) for v in (o, d)], []
        p_o = torch.tensor(observer, dtype=torch.float32)
        with torch.no_grad():
            integral = self.integral(p_o)
            for a in range(0, len(o), RAYS):
                result.append(self._part(*(v[a : a + RAYS] for v in rays), p_o, integral))
        color, depth, gaze = (np.concatenate(v) for v in zip(*result))
        return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4), depth, gaze

    def integral(self, p_o) -> float:
        """Integral of gaze over the sphere of the observer at ``p_o``; cached while they stay there, as in nerg."""
        torch, at = self.torch, tuple(p_o.tolist())
        if at not in self.integrals:
            result = []
            for r_o in torch.from_numpy(fibonacci_directions(MAX_DIRECTIONS).astype(np.float32)).split(RAYS):
                o = p_o.expand(len(r_o), 3)
                distance = self.march(o, r_o, colored=False)[2]
                escaped = ~distance.isfinite()
                p_od = p_o + r_o * distance.masked_fill(escaped, 0.0)[:, None]
                result.append(self.attention.unnormalized(p_od, o, r_o, escaped))
            self.integrals[at] = 4 * np.pi * torch.cat(result).mean().item()
        return self.integrals[at]

    def _part(self, o, d, p_o, integral):
        torch = self.torch
        color, _, depth = self.march(o, d)
        gaze = torch.zeros(len(o))
        has_surface = depth.isfinite().nonzero()[:, 0]
        p_d = o[has_surface] + depth[has_surface, None] * d[has_surface]
        tolerance = 2 * self.dt
        away = p_d - d[has_surface] * tolerance - p_o
        distance = away.norm(dim=1)
        r_o = away / distance[:, None]
        _, _, d_o = self.march(p_o.expand(len(has_surface), 3), r_o, distance, colored=False)
        seen = torch.where(d_o.isfinite(), (1 - (distance - d_o - tolerance) / self.falloff).clamp(0, 1), 1.0)
        lit = (seen > 0).nonzero()[:, 0]
        blocked = d_o[lit] < distance[lit] - tolerance
        p_od = torch.where(blocked[:, None], p_o + r_o[lit] * d_o[lit, None].nan_to_num(posinf=0.0), p_d[lit])
        gaze[has_surface[lit]] = seen[lit] * self.gaze(p_od, p_o.expand(len(lit), 3), r_o[lit], integral)
        return color.numpy(), depth.numpy(), gaze.numpy()


def camera_rays(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (width * height, 3) of the pixel centres of the scene's first sensor."""
    import mitsuba as mi

    sensor = nerg.Scene.load(SCENE_FILE, width=width, height=height).mitsuba.sensors()[0]
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    at = mi.Point2f(x.ravel().astype(np.float32), y.ravel().astype(np.float32))
    ray, _ = sensor.sample_ray(0, 0.5, at, mi.Point2f(0.5), True)
    return np.array(ray.o).T, np.array(ray.d).T


def agreement(scene, peer: TorchRenderer, width: int = 160, height: int = 90) -> dict[str, float]:
    """Agreement of both on the same rays."""
    o, d = camera_rays(width, height)
    observer = np.asarray(scene.observer, float)
    result = nerg.trace(scene, o, d, ["color", "depth", "gaze"], observers=observer[None])
    color, depth, gaze = peer.frame(o, d, observer)
    mse = np.mean((srgb(np.reshape(result["color"], (-1, 3))) - srgb(color)) ** 2)
    truth = np.ravel(result["depth"])
    both = np.isfinite(depth) & np.isfinite(truth)
    difference = np.abs(depth - truth)[both]
    mean = float(np.mean(result["gaze"]))
    return {
        "color_db": float(-10 * np.log10(mse)),
        "depth_mm": float(1e3 * np.median(difference)),
        "depth_mae_mm": float(1e3 * np.mean(difference)),
        "gaze_mean": float(np.mean(gaze)) / mean - 1,
    }


PEER_SCENE = {"reaimed_hits": False}
"""Values of the demo store's scene: the PyTorch renderers have the networks, but not the re-aimed hits."""


class Ours:
    """A function that renders frames of the demo store with these ``values`` of its scene; ``constant``: with constant
    weights of its networks; ``moves``: of an observer at another position in each frame. ``first``: seconds of the
    first frame, with compilation."""

    def __init__(self, values: dict, visibility: str, constant: bool = False, moves: bool = False):
        import mitsuba as mi

        scene = nerg.Scene.load(SCENE_FILE, **{**PEER_SCENE, **values}, visibility=visibility)
        if constant:
            scene.set_constant_weights()
        self.render = partial(nerg.render_tensor, scene, spp=1)
        self.params, self.moves, self.frames = mi.traverse(scene.integrator), moves, 0
        start = time.perf_counter()
        self()
        self.first = time.perf_counter() - start
        # The observer's data is cached now; these compile the kernel that reads it, and record it to be replayed.
        self()
        self()

    def __call__(self) -> np.ndarray:
        if self.moves:
            import mitsuba as mi

            self.frames += 1
            eye = mi.ScalarPoint3f(4.4, 2.8 + 0.002 * self.frames, 1.6)
            self.params["observer.to_world"] = mi.Transform4f().look_at(eye, [4.8, 4.4, 1.2], [0, 0, 1])
            self.params.update()
        return np.array(self.render())


def our_frames(values: dict, compiled: Path) -> dict[str, Ours]:
    """nerg's programs by name, with these ``values`` of the scene and with the ``compiled`` field in place of its own.

    Those with constant weights give bit-identical images, and those of the compiled field images of at least 40 dB,
    which is checked.
    """

    frames, names = {}, (("", "depth"), (", same observer again", "map"))
    for field, changed in (("nerg", {}), ("nerg, compiled field", {"field": str(compiled)})):
        for constant, overrides in ((False, ""), (True, ", constant weights")):
            for name, visibility in names:
                frames[f"{field}{name}{overrides}"] = Ours({**values, **changed}, visibility, constant)
        for name, _ in names:
            if not np.array_equal(frames[field + name](), frames[f"{field}{name}, constant weights"]()):
                raise SystemExit("constant weights give another picture")
        frames[f"{field}, observer moves"] = Ours({**values, **changed}, "depth", moves=True)
    ours, other = (np.clip(frames[name]()[..., :3], 0, 1) for name in ("nerg", "nerg, compiled field"))
    if not np.mean((ours - other) ** 2) < 1e-4:
        raise SystemExit("the compiled field gives another picture")
    return frames


def measure(frames: dict, size: str, runs: int) -> list[dict]:
    """A row for each of ``frames``, functions by name, which alternate."""
    seconds = in_turns(frames, runs)
    medians = {name: median(wall for wall, _ in taken) for name, taken in seconds.items()}
    first = medians[next(iter(frames))]
    return [
        {
            "frame": size,
            "renderer": name,
            "s": f"{medians[name]:.3g}",
            "quartiles": spread(wall for wall, _ in taken),
            "CPU s": f"{median(cpu for _, cpu in taken):.3g}",
            "times nerg": f"{medians[name] / first:.2g}",
            "first frame, s": f"{frames[name].first:.2g}" if isinstance(frames[name], Ours) else "",
        }
        for name, taken in seconds.items()
    ]
