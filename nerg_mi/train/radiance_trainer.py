"""The loop that trains a radiance field, and its previews."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import numpy as np
from drjit.opt import Adam

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import encoding_from_parameters
from nerg_mi.fields.occupancy import refine_occupancy
from nerg_mi.fields.radiance import RadianceConfig, RadianceField, mean_features
from nerg_mi.formats.fields import read_number
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Float
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.photos.images import PhotoView
from nerg_mi.transport.quadrature import mean_depth_fraction

from .radiance_data import PixelBank
from .radiance_grid import GRID_STATE, DensityGrid, OccupancyExtraction
from .radiance_losses import (
    PHOTO_PARAMETER,
    PhotoColors,
    color_loss,
    composite,
    evaluate_density,
    evaluate_density_from_features,
    evaluate_samples,
    depth_loss,
    distortion_loss,
    feature_decay_loss,
    evaluate_ray_color,
)
from .radiance_sampling import StepTable, RussianRoulette, damp_near, sum_along_rays, clip_rays, select_visible_samples, compute_weights
from .radiance_settings import RadianceSettings, adapt_ray_count, limit_ray_count, refine_stride
from .trainer import StepClock, Trainer, read_count, check_shape

# ---- Pictures of a field by the trainer's own marcher, for the error that is watched while it trains ----

_CHUNK = 2**22  # Candidates (rays times steps) in flight at once


@dataclass
class Preview:
    """``color`` (h, w, 3) sRGB before the background, ``opacity`` (h, w), ``depth`` (h, w): expected distance in
    scene units, 0 where nothing absorbs; of every ``every``-th pixel of a view, from ``every // 2`` on."""

    color: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray


def render_view(
    field: RadianceField, is_occupied, table: StepTable, view: PhotoView, near: float, every: int = 1, min_transmittance: float = 1e-3
) -> Preview:
    """March every ``every``-th pixel of ``view`` through ``field``.

    ``occupied``: mask of points (Array3f, mask) in cells that may hold density; ``near``: where rays start, in units.
    """
    ns = field.ns
    d = pixel_directions(view.camera.intrinsics)[every // 2 :: every, every // 2 :: every]
    shape = d.shape[:2]
    d = (d.reshape(-1, 3) @ view.camera.to_world[:3, :3].T).astype(np.float32)
    parts = []
    size = max(1, _CHUNK // table.steps)
    with dr.suspend_grad():
        for first in range(0, len(d), size):
            parts.append(_march(field, is_occupied, table, view.camera.center, d[first : first + size], near, min_transmittance, ns))
    color, opacity, moment = (np.concatenate([p[k] for p in parts]) for k in range(3))
    depth = np.where(opacity > 0, moment / np.where(opacity > 0, opacity, 1), 0)
    return Preview(color.reshape(*shape, 3), opacity.reshape(shape), depth.reshape(shape))


def _march(field, occupied, table, center, d, near: float, stop: float, ns):
    count = len(d)
    direction = ns.Array3f(d.T)
    origin = ns.Array3f(*[ns.Float(np.full(count, c, np.float32)) for c in center])
    rays = clip_rays(origin, direction, field.box, near)
    offset = ns.Float(np.full(count, 0.5, np.float32))
    samples, _ = select_visible_samples(rays, table, offset, occupied, field.density, stop)
    if samples is None:
        return np.zeros((count, 3)), np.zeros(count), np.zeros(count)
    sigma, features = field.density_features(samples.p)
    deferred = field.config.deferred
    parts = features if deferred else list(field.color(features, dr.gather(ns.Array3f, direction, samples.ray)))
    weight, tau, sums, opacity = composite(sigma, parts, samples)
    color = [opacity * c for c in field.color(mean_features(sums, opacity), direction)] if deferred else sums
    moment = sum_along_rays(weight * (samples.t + samples.length * mean_depth_fraction(tau)), samples.segments)
    return np.stack([c.numpy() for c in color], axis=1), opacity.numpy(), moment.numpy()


# ---- Training a radiance field on posed pictures ----
#
# instant-ngp's training (Müller et al. 2022) in Dr.Jit, arranged for the CPU backend: rays march a grid of occupied
# cells with true steps; a density-only pass drops what lies behind opaque surfaces, and lets one in many stand for
# samples that hardly absorb; what remains is packed into batches of constant size, the number of rays adapting;
# networks run as tensor products.


# Training rays that decide, at the end, which cells matter, and their samples at most: in fog each ray has hundreds.
_LOOKS, _LOOK_RAYS, _LOOK_SAMPLES = 64, 2**12, 2**25
# Steps of rays that the marching kernel goes through, in batches: they cost a fiftieth of a sample of the density pass.
_CANDIDATES = 128
_WRONG, _HARD = 0.3, 2**14  # Rays whose depth loss exceeds this are drawn again; so many are kept
_NUMBERS = ("rays", "samples", "stride", "looked")  # Attributes that the state of a run keeps as numbers


class RadianceTrainer(Trainer):
    """One run: state, ``step()``, and ``field()`` for what it has come to.

    ``views``: the training pictures; ``box``: where density may be, in their coordinates; ``depth``: supervise with
    the views' depth. Equal seeds draw equal rays; sums over threads are not ordered, so that weights agree
    between runs to rounding (and bit for bit only with one thread).
    """

    AVERAGE_INTERVAL = 4

    def __init__(
        self,
        views: list[PhotoView],
        box: AnyBox,
        config: RadianceConfig,
        settings: RadianceSettings,
        ns,
        depth: bool = True,
    ):
        if not views:
            raise NergError("there are no pictures to train on")
        super().__init__(settings, ns)
        self.config, self.box, self.clock = config, box, StepClock()
        self.pixels = PixelBank(ns, views)
        self.use_depth = depth and self.pixels.has_depth
        self.current_field = RadianceField.random(config, box, ns, settings.seed)
        # One photo has nothing to differ from.
        self.photos = PhotoColors(ns, len(views)) if settings.photo_colors and len(views) > 1 else None
        start = self.current_field.parameters() | ({} if self.photos is None else {PHOTO_PARAMETER: self.photos.init_parameter()})
        self.start(Adam(settings.learning_rate, start, beta_2=0.99, epsilon=1e-15))
        self.march_step = settings.march_step * box.side
        self.grid = DensityGrid(
            ns,
            box,
            settings.resolution,
            self.march_step,
            [v.camera for v in views],
            settings.min_views,
            near=settings.near * box.side,
            growth=settings.step_growth,
        )
        # With exact depth everywhere the free space is known from the start, and there is no fog to clear.
        self.is_carved = self.use_depth and self.pixels.has_full_depth
        if self.is_carved:
            self.grid.carve(self.pixels.iter_surface_points())
        self.grid.update(self.evaluate_density, self.rng, everywhere=True)
        self._tables: dict[int, StepTable] = {}
        self.extraction = OccupancyExtraction(self.grid)
        self.hard_pixels = np.zeros(0, np.uint32)
        self.rays, self.loss, self.samples = 256, 0.0, 0
        # Of the marching: how many times coarser than `march_step`, and samples a ray of the last density-only pass.
        self.stride, self.looked = 1 if self.is_carved else max(settings.strides, default=1), 0.0
        self.start()

    def get_state(self) -> tuple[dict, dict]:
        tensors, meta = super().state()
        tensors |= {f"grid.{name}": getattr(self.grid, name).numpy() for name in GRID_STATE}
        settling = self.extraction
        tensors |= {"settling.found": settling.dense_cells.numpy(), "settling.shown": settling.contributing_cells.numpy()}
        meta |= {name: getattr(self, name) for name in _NUMBERS}
        meta |= {"settling": settling.pieces_done, "turn": self.grid.turn, "clock": self.clock.to_dict()}
        return {**tensors, "hard": self.hard_pixels}, meta

    def restore(self, tensors: dict, meta: dict) -> None:
        counts = {name: read_count(meta, name) for name in _NUMBERS}
        for name in GRID_STATE:
            check_shape(tensors, f"grid.{name}", getattr(self.grid, name))
        found, shown = (tensors[f"settling.{name}"] for name in ("found", "shown"))
        for name, cells in (("found", self.extraction.dense_cells), ("shown", self.extraction.contributing_cells)):
            check_shape(tensors, f"settling.{name}", cells)
        super().restore(tensors, meta)
        self.grid.restore(**{name: tensors[f"grid.{name}"] for name in GRID_STATE}, turn=int(read_count(meta, "turn")))
        self.extraction.restore(int(read_number(meta, "settling", "state")), found, shown)
        self.clock.restore(meta["clock"])
        self.hard_pixels = tensors["hard"]
        for name, value in counts.items():
            setattr(self, name, value)

    def get_step_table(self, stride: int = 1) -> StepTable:
        """Step edges ``stride`` times as coarse as the finest."""
        if stride not in self._tables:
            s, side = self.settings, self.box.side
            self._tables[stride] = StepTable(
                self.ns, s.near * side, self._far(), stride * self.march_step, stride * s.growth
            )
        return self._tables[stride]

    def _far(self) -> float:
        """The farthest that a training camera can be from a point of the box."""
        corners = np.array(
            [[b[i] for i, b in zip(k, zip(self.box.lower, self.box.upper))] for k in np.ndindex(2, 2, 2)]
        )
        return float(max(np.linalg.norm(corners - c, axis=1).max() for c in self.pixels.centers))

    def evaluate_density(self, p, active):
        """Current density at world points, without gradient."""
        self.clock.add_evaluations(dr.width(p))
        with dr.suspend_grad():
            return self.current_field.density(p, active)

    def _look(self, p, active):
        """Density at ``p`` for the choice of samples, and the grid's features, which need no second look-up."""
        self.clock.add_evaluations(dr.width(p))
        now = {k: dr.detach(v) for k, v in self._parameters().items()}
        features = encoding_from_parameters(self.config.grid, now).evaluate_eagerly(self.box.to_unit(p), active)
        return evaluate_density_from_features(self.config, self.box, now, p, features), features

    def _parameters(self) -> dict:
        """The weights of the field, with their derivatives."""
        return {k: self.optimiser[k] for k in self.current_field.parameters()}

    def step(self) -> None:
        """Draw rays, march, composite, and move the weights once."""
        with self.clock:
            self._step()

    def _step(self) -> None:
        s, ns, most = self.settings, self.ns, self.settings.max_prepass_samples
        self._keep_grid()
        self._refine()
        table = self.get_step_table(self.stride)
        self.rays = limit_ray_count(self.rays, self.looked, table.steps, most, _CANDIDATES * s.batch)
        index = self._draw()
        pixels = self.pixels.gather_batch(ns.UInt32(copy_aligned(index, np.uint32)))
        rays = clip_rays(pixels.o, pixels.d, self.box, s.near * self.box.side)
        offset = ns.Float(copy_aligned(self.rng.random(self.rays, np.float32)))
        thinning = RussianRoulette(s.rr_weight, s.rr_min_probability, int(self.rng.integers(2**63))) if s.rr_min_probability < 1 else None
        samples, covered = select_visible_samples(
            rays, table, offset, self.grid.is_occupied, self._look, s.stop, s.batch, thinning, most, with_features=True
        )
        self.steps += 1
        if samples is None:
            self.rays = adapt_ray_count(self.rays, 0, 0, s.batch, most)
            return
        background = ns.Array3f(*[ns.Float(copy_aligned(self.rng.random(self.rays, np.float32))) for _ in range(3)])
        misplaced = self._descend(samples, pixels, background, covered, self.stride)
        if misplaced is not None:
            self._remember(index[:covered], misplaced)
        self.looked = samples.prepass_samples_per_ray
        self.rays = adapt_ray_count(self.rays, samples.count / covered, self.looked, s.batch, most)

    def _keep_grid(self) -> None:
        """Look over a part of the density grid if it is time to, and find a piece of what rendering will visit."""
        s = self.settings
        settling = self.progress >= s.extraction_start and not self.extraction.is_done
        due = self.steps % s.grid_interval == 0 and self.steps > 0
        if settling or due:
            self.update_current_field()
        if settling:
            self.extract_occupancy_piece()
        if due:
            self.grid.update(self.evaluate_density, self.rng)

    def update_current_field(self) -> None:
        """Have ``live`` hold the weights of this step."""
        self.current_field.set_parameters({k: dr.detach(v) for k, v in self._parameters().items()})

    def extract_occupancy_piece(self) -> None:
        """Find a piece of what rendering will visit, by the weights that ``live`` holds."""
        with dr.suspend_grad():
            self.extraction.advance(self.evaluate_density, self._lit_by_a_few, self.settings.seed)

    def _refine(self) -> None:
        """March finer if it is time to and what is cleared allows it."""
        s = self.settings
        waits = self.progress < 2 * s.stride_fraction
        stride = refine_stride(self.stride_at, s.strides, s.stride_at(self.progress), self.looked, s.max_prepass_samples, waits)
        self.looked, self.stride = self.looked * self.stride / stride, stride

    def _draw(self) -> np.ndarray:
        """Indices of the pixels of a batch: at random, a share of them from those whose depth was wrong before."""
        index = self.rng.integers(0, self.pixels.size, self.rays, np.uint32)
        if self.hard_pixels.size and self.progress > self.settings.lr_hold_fraction:
            again = int(self.settings.hard_pixel_fraction * self.rays)
            index[:again] = self.hard_pixels[self.rng.integers(0, self.hard_pixels.size, again)]
            self.rng.shuffle(index)  # In mixed order, because the last rays of a batch may not fit into it
        return index

    def _remember(self, index: np.ndarray, misplaced: Float) -> None:
        """Keep the pixels of this batch whose depth was wrong, in place of the oldest kept."""
        wrong = misplaced.numpy()[: len(index)] > _WRONG
        self.hard_pixels = np.concatenate([self.hard_pixels, index[wrong]])[-_HARD:]

    def _descend(self, samples, pixels, background, covered: int, stride: int) -> Float | None:
        """Move the weights once; returns how wrong the depth of each ray was, None where that is not asked for."""
        s, ns, misplaced = self.settings, self.ns, None
        d = dr.gather(ns.Array3f, pixels.d, samples.ray)
        parameters = self._parameters()
        sigma, parts = evaluate_samples(self.config, self.box, parameters, samples.p, d, ns, samples.features)
        if s.reach > 0:
            # Never 0, and never left out: that would compile other kernels in the middle of the run.
            reach = max(s.damping_distance_at(self.progress), 1e-6) * self.box.side
            sigma, *parts = damp_near([sigma, *parts], samples.t, dr.opaque(ns.Float, reach))
        # Now: each sum along the rays would evaluate the networks again.
        dr.eval(sigma, parts)
        self.clock.add_evaluations(s.batch)
        weight, tau, sums, opacity = composite(sigma, parts, samples)
        color = evaluate_ray_color(self.config, parameters, sums, opacity, pixels.d, ns)
        total = 0
        if self.photos is not None:
            changes = self.photos.compute_changes(cast("Float", self.optimiser[PHOTO_PARAMETER]))
            color = self.photos.apply(changes, color, opacity, pixels.frame)
            total = s.photo_decay * self.photos.decay_loss(changes)
        loss = color_loss(color, opacity, pixels, background, s.huber_delta)
        if self.use_depth:
            # In units of the step at hand: while marching is coarse, no more can be asked for.
            unit, margin = dr.opaque(ns.Float, stride * self.march_step), s.depth_margin * self.march_step
            if self.box.is_contracted:
                step = dr.maximum(s.growth * pixels.depth, self.march_step)
                unit, margin = step * stride, step * s.depth_margin
            placed = depth_loss(weight, tau, samples, pixels.depth, margin, unit)
            # Places first, colours later: once surfaces stand, colour has more to say.
            loss += dr.opaque(ns.Float, s.depth_weight * s.depth_weight_final_ratio**self.progress) * placed
            misplaced = dr.detach(placed)
        if s.distortion_weight > 0:
            loss += s.distortion_weight * distortion_loss(weight, samples, self.box.side)
        complete = dr.arange(ns.UInt32, self.rays) < dr.opaque(ns.UInt32, covered)
        loss = dr.sum(dr.select(complete, loss, 0)) / dr.opaque(ns.Float, covered)
        total += loss + self._clear(parameters)
        for name, value in parameters.items():
            if name.startswith("grid."):
                total = total + s.grid_decay * feature_decay_loss(value.array if dr.is_tensor_v(value) else value)
        dr.backward(total)
        self.move_weights()
        self.loss, self.samples = loss, samples.count
        if self.steps % self.AVERAGE_INTERVAL == 0:
            self.average_weights()
        return misplaced

    def _clear(self, parameters: dict):
        """Penalty on density in cells that are not sampled.

        Nothing else would hold them to what they are taken for, empty, and hashing fills them with the echoes of
        surfaces elsewhere. The logarithm pulls at fog and at echoes alike.
        """
        s = self.settings
        p = self.grid.empty_points(s.batch // 16, self.rng)
        if p is None or s.empty_weight == 0:
            return 0
        self.clock.add_evaluations(dr.width(p))
        sigma, cell = evaluate_density(self.config, self.box, parameters, p, self.ns), self.grid.cell_size_at(p)
        return s.empty_weight * dr.mean(dr.log(1 + sigma * cell))

    def _lit(self, density, occupied):
        """Points (Array3f) of the samples that give a training ray more than a thousandth of its light."""
        rng, looked = np.random.default_rng(self.settings.seed), 0
        for _ in range(min(_LOOKS, -(-self.pixels.size // _LOOK_RAYS))):
            samples, p = self._lit_points(density, occupied, rng, _LOOK_RAYS)
            if samples is not None:
                looked += samples.looked * _LOOK_RAYS
                yield p
            if looked > _LOOK_SAMPLES:
                break

    def _lit_by_a_few(self, density, occupied, rng: np.random.Generator):
        """Such points, or None, of as many rays as a step may take."""
        most = self.settings.max_prepass_samples
        looked, candidates = self.looked * self.stride, _CANDIDATES * self.settings.batch
        rays = limit_ray_count(_LOOK_RAYS, looked, self.get_step_table().steps, most, candidates)
        return self._lit_points(density, occupied, rng, rays, most)[1]

    def _lit_points(self, density, occupied, rng: np.random.Generator, count: int, most: int | None = None) -> tuple:
        s, ns = self.settings, self.ns
        pixels = self.pixels.gather_batch(ns.UInt32(copy_aligned(rng.integers(0, self.pixels.size, count, np.uint32), np.uint32)))
        rays = clip_rays(pixels.o, pixels.d, self.box, s.near * self.box.side)
        offset = ns.Float(copy_aligned(rng.random(count, np.float32)))
        samples, _ = select_visible_samples(rays, self.get_step_table(), offset, occupied, density, s.stop, max_prepass_samples=most)
        if samples is None:
            return None, None
        weight = compute_weights(density(samples.p, True) * samples.length, samples.segments)
        seen: Any = dr.compress(weight > 1e-3)
        return samples, dr.gather(ns.Array3f, samples.p, seen)

    def choose_pixel_stride(self, views: list[PhotoView], max_samples: int) -> int:
        """The ``every`` of `render` with which ``views`` take about so many ``samples``, by those of the last step."""
        rays = sum(v.pixels.shape[0] * v.pixels.shape[1] for v in views)
        return max(1, int(np.ceil((rays * max(self.looked * self.stride, 1) / max_samples) ** 0.5)))

    def render(self, view: PhotoView, every: int = 1, field: RadianceField | None = None) -> Preview:
        """Every ``every``-th pixel of ``view`` by the trainer's own marcher.

        Of ``field``, by its own occupancy; without one, of the averaged weights so far.
        """
        field, occupied = field or self.make_field(with_occupancy=False), self.grid.is_occupied
        bound = field.occupancy
        if bound is not None:
            occupied = lambda p, active: active & (bound.distance_to_occupied(self.box.to_cube(p), active) == 0)
        return render_view(field, occupied, self.get_step_table(), view, self.settings.near * self.box.side, every=every)

    def make_field(self, with_occupancy: bool = True) -> RadianceField:
        """The field with averaged weights. ``bound``: with the occupancy that rendering may rest on."""
        growth = self.settings.growth if self.box.is_contracted else 0.0
        out = RadianceField.random(self.config, self.box, self.ns, 0, march_step=self.march_step, march_growth=growth)
        out.set_parameters({k: type(v)(v) for k, v in self.averaged.items() if k != PHOTO_PARAMETER})
        if with_occupancy:
            with dr.suspend_grad():
                out.occupancy = self.grid.extract_occupancy(out.density, np.random.default_rng(self.settings.seed), self._lit)
            out.occupancy = refine_occupancy(out) or out.occupancy
        return out
