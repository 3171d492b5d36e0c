"""Training a radiance field on posed pictures.

instant-ngp's training (Müller et al. 2022) in Dr.Jit, arranged for the CPU backend: rays march a grid
of occupied cells with true steps; a density-only pass drops what lies behind opaque surfaces, and lets one in many stand for
samples that hardly absorb; what remains is packed into batches of constant size, the number of rays adapting; networks run
as tensor products.
"""
from __future__ import annotations

import time

import drjit as dr
import numpy as np
from drjit.opt import Adam

from ..capture.images import View
from ..field.box import Box
from ..field.hashgrid import HashGrid
from ..field.radiance import RadianceConfig, RadianceField
from .compositing import damp_near, weights
from .density_grid import DensityGrid
from .losses import color_loss, composite, depth_loss, distortion_loss, feature_decay
from .model import density, density_color, density_of
from .pixels import PixelBank
from .preview import Preview, psnr, render_view
from .sampling import StepTable, Thinning, rays_in_box, visible_samples
from .settings import RadianceSettings

# The average is taken of every fourth step.
_AVERAGE_EVERY = 4
_MAX_RAYS = 2**14
# Training rays that decide, at the end, which cells matter.
_LOOKS, _LOOK_RAYS = 64, 2**12
# Rays whose depth loss exceeds this are drawn again; so many are kept.
_WRONG, _HARD = 0.3, 2**14


class RadianceTrainer:
    """One run: state, ``step()``, and ``field()`` for what it has come to.

    ``views``: the training pictures; ``box``: where density may be, in their coordinates; ``depth``: supervise with
    the views' depth. Equal seeds draw equal rays; sums over threads are not ordered, so that weights agree
    between runs to rounding (and bit for bit only with one thread).
    """

    def __init__(self, views: list[View], box: Box, config: RadianceConfig, settings: RadianceSettings, ns,
                 depth: bool = True):
        if not views:
            raise ValueError("there are no pictures to train on")
        self.config, self.settings, self.box, self.ns = config, settings, box, ns
        self.rng = np.random.default_rng(settings.seed)
        self.pixels = PixelBank(ns, views)
        self.use_depth = depth and self.pixels.has_depth
        self.live = RadianceField.random(config, box, ns, settings.seed)
        self.optimiser = Adam(settings.learning_rate, self.live.parameters(), beta_2=0.99, epsilon=1e-15)
        self.averaged = {k: type(v)(dr.detach(v)) for k, v in self.live.parameters().items()}
        self.march_step = settings.march_step * box.side
        self.grid = DensityGrid(ns, box, settings.resolution, self.march_step, [v.camera for v in views],
                                settings.min_views, near=settings.near * box.side)
        # With exact depth everywhere the free space is known from the start, and there is no fog to clear.
        self.carved = self.use_depth and self.pixels.depth_everywhere
        if self.carved:
            self.grid.carve(self.pixels.surface_points())
        self.grid.update(self.density, self.rng, everywhere=True)
        self._tables: dict[int, StepTable] = {}
        self.settled, self.hard, self.misplaced = False, np.zeros(0, np.uint32), None
        self.steps, self.rays, self.loss, self.samples = 0, 256, 0.0, 0
        self._started = time.perf_counter()

    def restore(self, steps: int, rays: int, samples: int, seconds: float, settled: bool, hard: np.ndarray) -> None:
        """Go on from stored numbers; see ``run_state``."""
        self.steps, self.rays, self.samples, self.settled, self.hard = steps, rays, samples, settled, hard
        self._started = time.perf_counter() - seconds

    @property
    def seconds(self) -> float:
        """Wall time of the run, without that between an interruption and its resumption."""
        return time.perf_counter() - self._started

    @property
    def progress(self) -> float:
        """Share of the run that is done, 0..1."""
        s = self.settings
        return min(1.0, self.steps / s.steps if s.steps is not None else self.seconds / (60 * s.minutes))

    def table(self, stride: int = 1) -> StepTable:
        """Step edges ``stride`` times as coarse as the finest."""
        if stride not in self._tables:
            s, side = self.settings, self.box.side
            self._tables[stride] = StepTable(self.ns, s.near * side, self._far(), stride * self.march_step,
                                             stride * s.growth)
        return self._tables[stride]

    def _far(self) -> float:
        """The farthest that a training camera can be from a point of the box."""
        corners = np.array([[b[i] for i, b in zip(k, zip(self.box.lower, self.box.upper))]
                            for k in np.ndindex(2, 2, 2)])
        return float(max(np.linalg.norm(corners - c, axis=1).max() for c in self.pixels.centers))

    def density(self, p, active):
        """Current density at world points, without gradient."""
        with dr.suspend_grad():
            return self.live.density(p, active)

    def _look(self, p, active):
        """Density at ``p`` for the choice of samples, and the grid's features, which need no second look-up."""
        now = {k: dr.detach(v) for k, v in self._parameters().items()}
        features = HashGrid(self.config.grid, now["grid.table"]).by_level(self.box.to_unit(p), active)
        return density_of(self.config, now, features), features

    def _parameters(self) -> dict:
        return {k: self.optimiser[k] for k in self.averaged}

    def step(self) -> None:
        """Draw rays, march, composite, and move the weights once."""
        s, ns = self.settings, self.ns
        if self.steps % s.grid_every == 0 and self.steps > 0:
            self.live.set_parameters({k: dr.detach(v) for k, v in self._parameters().items()})
            if not self.settled and self.progress >= s.settle:
                with dr.suspend_grad():
                    self.grid.settle(self.density, self.rng, self._lit)
                self.settled = True
            self.grid.update(self.density, self.rng)
        index = self._draw()
        pixels = self.pixels.batch(ns.UInt32(index))
        rays = rays_in_box(pixels.o, pixels.d, self.box, s.near * self.box.side)
        offset = ns.Float(self.rng.random(self.rays, np.float32))
        stride = 1 if self.carved else s.stride(self.progress)
        thinning = Thinning(s.thin_sure, s.thin_least, int(self.rng.integers(2**63))) if s.thin_least < 1 else None
        samples, covered = visible_samples(rays, self.table(stride), offset, self.grid.occupied, self._look,
                                           s.stop, s.batch, thinning)
        self.steps += 1
        if samples is None:
            self._adapt(0)
            return
        background = ns.Array3f(*[ns.Float(self.rng.random(self.rays, np.float32)) for _ in range(3)])
        self._descend(samples, pixels, background, covered, stride)
        if self.use_depth:
            self._remember(index[:covered])
        self._adapt(samples.count / covered)

    def _draw(self) -> np.ndarray:
        """Indices of the pixels of a batch: at random, a share of them from those whose depth was wrong before."""
        index = self.rng.integers(0, self.pixels.size, self.rays, np.uint32)
        if self.hard.size and self.progress > self.settings.hold:
            again = int(self.settings.replay * self.rays)
            index[:again] = self.hard[self.rng.integers(0, self.hard.size, again)]
            # In mixed order, because the last rays of a batch may not fit into it.
            self.rng.shuffle(index)
        return index

    def _remember(self, index: np.ndarray) -> None:
        """Keep the pixels of this batch whose depth was wrong, in place of the oldest kept."""
        wrong = self.misplaced.numpy()[:len(index)] > _WRONG
        self.hard = np.concatenate([self.hard, index[wrong]])[-_HARD:]

    def _descend(self, samples, pixels, background, covered: int, stride: int) -> None:
        s, ns = self.settings, self.ns
        d = dr.gather(ns.Array3f, pixels.d, samples.ray)
        parameters = self._parameters()
        sigma, rgb = density_color(self.config, self.box, parameters, samples.p, d, ns, samples.features)
        reach = s.damped_within(self.progress) * self.box.side
        if reach > 0:
            sigma, *rgb = damp_near([sigma, *rgb], samples.t, dr.opaque(ns.Float, reach))
        # Now: each sum along the rays would evaluate the networks again.
        dr.eval(sigma, rgb)
        weight, tau, color, opacity = composite(sigma, rgb, samples)
        loss = color_loss(color, opacity, pixels, background, s.huber)
        if self.use_depth:
            # In units of the step at hand: while marching is coarse, no more can be asked for.
            placed = depth_loss(weight, tau, samples, pixels, s.depth_margin * self.march_step, stride * self.march_step)
            # Places first, colours later: once surfaces stand, colour has more to say.
            loss += s.depth_weight * s.final_depth ** self.progress * placed
            self.misplaced = dr.detach(placed)
        if s.distortion_weight > 0:
            loss += s.distortion_weight * distortion_loss(weight, samples, self.box.side)
        complete = dr.arange(ns.UInt32, self.rays) < dr.opaque(ns.UInt32, covered)
        loss = dr.sum(dr.select(complete, loss, 0)) / dr.opaque(ns.Float, covered)
        dr.backward(loss + self._clear(parameters) + s.grid_decay * feature_decay(parameters["grid.table"]))
        self.optimiser.set_learning_rate(s.rate(self.progress))
        self.optimiser.step()
        self.loss, self.samples = loss, samples.count
        if self.steps % _AVERAGE_EVERY == 0:
            # A short memory at first: the start of a run is not worth remembering.
            decay = min(s.average, (1 + self.steps) / (10 + self.steps)) ** _AVERAGE_EVERY
            for k, old in self.averaged.items():
                self.averaged[k] = old + (dr.detach(self.optimiser[k]) - old) * (1 - decay)
            dr.eval(self.averaged)

    def _clear(self, parameters: dict):
        """Penalty on density in cells that are not sampled.

        Nothing else would hold them to what they are taken for, empty, and hashing fills them with the echoes of
        surfaces elsewhere. The logarithm pulls at fog and at echoes alike.
        """
        s = self.settings
        p = self.grid.empty_points(s.batch // 16, self.rng)
        if p is None or s.empty_weight == 0:
            return 0
        cell = self.box.side / s.resolution
        sigma = density(self.config, self.box, parameters, p, self.ns)
        return s.empty_weight * dr.mean(dr.log(1 + sigma * cell))

    def _lit(self, density, occupied):
        """Points (Array3f) of the samples that give a training ray more than a thousandth of its light."""
        s, ns = self.settings, self.ns
        rng = np.random.default_rng(s.seed)
        for _ in range(min(_LOOKS, -(-self.pixels.size // _LOOK_RAYS))):
            pixels = self.pixels.batch(ns.UInt32(rng.integers(0, self.pixels.size, _LOOK_RAYS, np.uint32)))
            rays = rays_in_box(pixels.o, pixels.d, self.box, s.near * self.box.side)
            offset = ns.Float(rng.random(_LOOK_RAYS, np.float32))
            samples, _ = visible_samples(rays, self.table(), offset, occupied, density, s.stop)
            if samples is not None:
                weight = weights(density(samples.p, True) * samples.length, samples.segments)
                yield dr.gather(ns.Array3f, samples.p, dr.compress(weight > 1e-3))

    def _adapt(self, samples_a_ray: float) -> None:
        """Choose the number of rays that will fill a batch."""
        wanted = 0.95 * self.settings.batch / max(samples_a_ray, 1e-3)
        # Damped, because a batch of few rays is a noisy estimate.
        rays = min(max(0.5 * (self.rays + wanted), self.rays / 2), 2 * self.rays)
        self.rays = int(np.clip(rays, 64, _MAX_RAYS))

    def measure(self, views: list[View], every: int = 1, field: RadianceField | None = None) -> list[float]:
        """PSNR in dB on each of ``views``, before black, on every ``every``-th pixel of those that their masks leave in.

        Of ``field``, by its own occupancy; without one, of the averaged weights so far.
        """
        field, part = field or self.field(bound=False), (slice(every // 2, None, every),) * 2
        return [psnr(self.render(v, every, field).color, v.over(0)[part], None if v.mask is None else v.mask[part]) for v in views]

    def render(self, view: View, every: int = 1, field: RadianceField | None = None) -> Preview:
        """``view`` by the trainer's own marcher; ``every`` and ``field`` as `measure` has them."""
        field, occupied = field or self.field(bound=False), self.grid.occupied
        if field.occupancy is not None:
            occupied = lambda p, active: active & (field.occupancy.empty_cells(self.box.to_unit(p), active) == 0)
        return render_view(field, occupied, self.table(), view, self.settings.near * self.box.side, every=every)

    def field(self, bound: bool = True) -> RadianceField:
        """The field with averaged weights. ``bound``: with the occupancy that rendering may rest on."""
        out = RadianceField.random(self.config, self.box, self.ns, 0, march_step=self.march_step)
        out.set_parameters({k: type(v)(v) for k, v in self.averaged.items()})
        if bound:
            with dr.suspend_grad():
                out.occupancy = self.grid.bound(out.density, np.random.default_rng(self.settings.seed), self._lit)
        return out
