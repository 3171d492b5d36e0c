"""Kernel densities on the sphere, evaluated exactly in one Dr.Jit kernel.

A probe p holds a run of ray directions μ_i with weights w_i that sum to one, and one concentration:
p(x) = Σ_i w_i f(x; μ_i, κ_p), f von Mises-Fisher (NeRG, Section 5.1). It integrates to one over the sphere whatever κ
is.
"""

from __future__ import annotations

import math
import sys
from types import ModuleType

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.backend import namespace
from nerg_mi.maths.types import Array3f, Float, UInt32
from nerg_mi.maths.vmf import log_normaliser

Backend = str | ModuleType | dr.ArrayBase | None
"""Where a density is evaluated: a name such as ``"llvm"``, a namespace of Dr.Jit's arrays, an array, or None for that
of Mitsuba's variant (:func:`default_backend`)."""

GROUP = 16
"""Directions that a lane of `SphericalKde.evaluate` takes at once."""


def default_backend() -> str:
    """``"cuda"`` where Mitsuba was switched to a CUDA variant, else ``"llvm"``."""
    mitsuba = sys.modules.get("mitsuba")
    variant = (mitsuba.variant() if mitsuba is not None else None) or ""
    return "cuda" if variant.startswith("cuda") else "llvm"


class SphericalKde:
    """P kernel densities on one Dr.Jit backend.

    ``rays`` (n, 3): unit directions, probe after probe; ``offsets`` (P + 1,): probe p holds
    ``rays[offsets[p]:offsets[p + 1]]``, at least one; ``kappa`` (P,) or a number; ``weights`` (n,) not negative,
    normalised here per probe, or ``None`` for equal ones. ``backend``: see `Backend`. Raises ``ValueError`` for shapes
    that do not fit, `NergError` for a probe without rays, or whose rays all have weight zero.
    """

    def __init__(
        self,
        rays: np.ndarray,
        offsets: np.ndarray,
        kappa: np.ndarray | float,
        weights: np.ndarray | None = None,
        backend: Backend = None,
    ) -> None:
        rays, offsets = np.asarray(rays, dtype=np.float64), np.asarray(offsets, dtype=np.int64)
        counts = np.diff(offsets)
        if (
            rays.ndim != 2
            or rays.shape[1] != 3
            or offsets.ndim != 1
            or len(counts) == 0
            or offsets[0] != 0
            or offsets[-1] != len(rays)
        ):
            raise ValueError(
                f"rays {rays.shape} and offsets {offsets.shape} do not fit: offsets run from 0 to the number of rays"
            )
        if counts.min() < 1:
            raise NergError(f"probe {int(np.argmin(counts))} has no ray; raise min_rays")
        kappa = np.broadcast_to(np.asarray(kappa, dtype=np.float64), counts.shape)
        if weights is None:
            share = np.repeat(1.0 / counts, counts)
        else:
            weights = np.asarray(weights, dtype=np.float64)
            if weights.shape != (len(rays),) or not (weights >= 0).all():
                raise ValueError(f"weights {weights.shape} must be {len(rays)} non-negative numbers, one a ray")
            total = np.add.reduceat(weights, offsets[:-1])
            if not (total > 0).all():
                raise NergError(f"the weights of probe {int(np.argmin(total))} are all zero; leave the probe out")
            share = weights / np.repeat(total, counts)

        self.count = len(counts)
        self.ns: ModuleType = backend if isinstance(backend, ModuleType) else namespace(backend or default_backend())
        # One packet of four floats a ray: direction and weight come in one gather.
        packed = np.concatenate([rays, share[:, None]], axis=1).astype(np.float32)
        self._rays = self.ns.Float(packed.ravel())
        self._offsets = self.ns.UInt32(offsets.astype(np.uint32))
        self._kappa = self.ns.Float(kappa.astype(np.float32))
        self._log_c = self.ns.Float(log_normaliser(kappa).astype(np.float32))

    @property
    def kappa(self) -> np.ndarray:
        """Concentrations of the kernels, (P,) float32."""
        return np.array(self._kappa)

    def part(self, first: int, last: int) -> SphericalKde:
        """The densities of probes ``first`` to ``last`` - 1 as an object of their own."""
        if (first, last) == (0, self.count):
            return self
        offsets = np.array(self._offsets)[first : last + 1].astype(np.int64)
        packed = np.array(self._rays).reshape(-1, 4)[offsets[0] : offsets[-1]]
        return SphericalKde(packed[:, :3], offsets - offsets[0], self.kappa[first:last], packed[:, 3], self.ns)

    def density(self, probe: UInt32, direction: Array3f) -> Float:
        """Density of probe ``probe`` (M lanes) in ``direction`` (unit, M lanes), in 1/sr, M lanes: traced, not
        evaluated. Lanes of one probe should be neighbours: they then share their loop."""
        ns = self.ns
        first = dr.gather(ns.UInt32, self._offsets, probe)
        last = dr.gather(ns.UInt32, self._offsets, probe + 1)
        kappa = dr.gather(ns.Float, self._kappa, probe)
        log_c = dr.gather(ns.Float, self._log_c, probe)

        def body(i, total, direction, kappa, last):
            ray = dr.gather(ns.Array4f, self._rays, i)
            offset = direction - ns.Array3f(ray.x, ray.y, ray.z)
            return i + 1, dr.fma(ray.w, dr.exp(-0.5 * kappa * dr.squared_norm(offset)), total), direction, kappa, last

        _, total, *_ = dr.while_loop(
            state=(first, dr.zeros(ns.Float, dr.width(direction)), ns.Array3f(direction), kappa, last),
            cond=lambda i, total, direction, kappa, last: i < last,
            body=body,
            labels=("i", "total", "direction", "kappa", "last"),
            label="spherical KDE",
        )
        return total * dr.exp(log_c)

    def evaluate(self, directions: np.ndarray) -> np.ndarray:
        """Densities of every probe in many directions, (P, D) float32, 1/sr, in one kernel.

        ``directions``: (D, 3), the same for all, or (P, D, 3), each its own.
        """
        directions = np.asarray(directions, dtype=np.float32)
        if (
            directions.shape[-1:] != (3,)
            or directions.ndim not in (2, 3)
            or (directions.ndim == 3 and len(directions) != self.count)
        ):
            raise ValueError(f"directions have shape {directions.shape}, expected (D, 3) or ({self.count}, D, 3)")
        # A lane takes several directions of one probe, so that a ray is fetched once for all of them: four times as
        # fast.
        D = directions.shape[-2]
        G = min(GROUP, D)
        groups = -(-D // G)
        ns = self.ns
        lane = dr.arange(ns.UInt32, self.count * groups)
        probe = lane // groups
        first = (lane - probe * groups) * G
        base = 0 if directions.ndim == 2 else probe * D
        flat = ns.Float(np.ascontiguousarray(directions).ravel())
        x = [dr.gather(ns.Array3f, flat, base + dr.minimum(first + j, D - 1)) for j in range(G)]
        scale = dr.gather(ns.Float, self._kappa, probe) * (-0.5 / math.log(2.0))
        last = dr.gather(ns.UInt32, self._offsets, probe + 1)

        def body(i, total):
            ray = dr.gather(ns.Array4f, self._rays, i)
            mu = ns.Array3f(ray.x, ray.y, ray.z)
            return i + 1, [dr.fma(ray.w, dr.exp2(scale * dr.squared_norm(a - mu)), t) for a, t in zip(x, total)]

        _, total = dr.while_loop(
            state=(dr.gather(ns.UInt32, self._offsets, probe), [dr.zeros(ns.Float, dr.width(lane)) for _ in x]),
            cond=lambda i, total: i < last,
            body=body,
            label="spherical KDE of many directions",
        )
        c = dr.exp(dr.gather(ns.Float, self._log_c, probe))
        total = [t * c for t in total]
        dr.eval(total)
        return np.stack([np.array(t) for t in total], axis=-1).reshape(self.count, groups * G)[:, :D]
