"""Radiance training loop, and its previews."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from drjit.opt import Adam

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.occupancy import refine_occupancy
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork, mean_features
from nerg_mi.formats.fields import read_number
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Float
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.photos.images import PhotoView
from nerg_mi.transport.quadrature import mean_depth_fraction

from .radiance_data import FreeSpace, PixelBank, PixelBatch, find_focus_distances
from .radiance_grid import GRID_STATE, NUM_PARTS, MarchGrid, OccupancyExtraction
from .radiance_losses import (
    PHOTO_PARAMETER,
    LossInputs,
    PhotoColors,
    TrainingLoss,
    composite,
    feature_decay_gradient,
    make_density_prepass,
)
from .radiance_sampling import (
    RaySamples,
    RussianRoulette,
    StepTable,
    clip_rays,
    compute_weights,
    select_visible_samples,
    sum_along_rays,
)
from .radiance_settings import RadianceSettings, adapt_ray_count, limit_ray_count, refine_stride
from .trainer import StepClock, Trainer, check_shape, learning_rate_at, read_count

# ---- Previews rendered with the trainer's march, for the validation error ----

_CHUNK = 2**22  # Maximum number of candidates (rays times steps) per launch


@dataclass
class Preview:
    """Rendering of every ``every``-th pixel of a view, starting at ``every // 2``.

    ``color`` (h, w, 3) is sRGB over black, ``opacity`` (h, w), ``depth`` (h, w) the expected distance in scene units, 0
    where nothing absorbs.
    """

    color: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray


def render_view(
    field: RadianceNetwork,
    is_occupied,
    table: StepTable,
    view: PhotoView,
    near: float,
    every: int = 1,
    min_transmittance: float = 1e-3,
) -> Preview:
    """Render every ``every``-th pixel of ``view``.

    Parameters
    ----------
    field : RadianceNetwork
        Field to render.
    is_occupied : callable
        Maps points (Array3f) and a mask to the mask of points in occupied cells.
    table : StepTable
        Step edges.
    view : PhotoView
        View to render.
    near : float
        Near distance in scene units.
    every : int
        Pixel stride.
    min_transmittance : float
        Samples reached by less light are dropped.
    """
    ns = field.ns
    d = pixel_directions(view.camera.intrinsics)[every // 2 :: every, every // 2 :: every]
    shape = d.shape[:2]
    d = (d.reshape(-1, 3) @ view.camera.to_world[:3, :3].T).astype(np.float32)
    parts = []
    size = max(1, _CHUNK // table.steps)
    with dr.suspend_grad():
        for first in range(0, len(d), size):
            parts.append(
                _march_rays(
                    field, is_occupied, table, view.camera.center, d[first : first + size], near, min_transmittance, ns
                )
            )
    color, opacity, moment = (np.concatenate([p[k] for p in parts]) for k in range(3))
    depth = np.where(opacity > 0, moment / np.where(opacity > 0, opacity, 1), 0)
    return Preview(color.reshape(*shape, 3), opacity.reshape(shape), depth.reshape(shape))


def _march_rays(field, occupied, table, center, d, near: float, stop: float, ns):
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
# The training of instant-ngp (Müller et al. 2022) in Dr.Jit, arranged for the CPU backend: rays march through occupied
# cells with true steps; a density-only pass drops samples behind opaque surfaces, and Russian roulette thins out
# samples that hardly absorb; the remaining samples are packed into batches of constant size, with an adaptive number of
# rays; networks run as tensor products.


# Groups and sizes of training rays that determine the final occupancy, and their sample limit: in fog a ray has
# hundreds.
_RAY_GROUPS, _GROUP_RAYS, _EXTRACTION_SAMPLES = 64, 2**12, 2**25
_PROBES = 3  # Points per cell and axis at which the density is evaluated for the final occupancy
# Limit of the steps that the marching kernel visits, in batches; one costs a fiftieth of a sample of the density pass.
_MAX_CANDIDATES = 128
# Pixels whose depth loss exceeds the first value are drawn again; the second is the size of their buffer
_MIN_DEPTH_LOSS, _MAX_HARD_PIXELS = 0.3, 2**14
_NUMBERS = {
    "rays": "rays",
    "samples": "samples",
    "stride": "stride",
    "looked": "prepass_samples_per_ray",
}  # Numbers in the run state


@dataclass(frozen=True)
class Snapshot:
    """State of a training that can be made into a field later.

    ``weights`` are the averaged weights by name, ``bits`` (UInt8 per cell of the density grid) the sampled cells, and
    ``row`` its evaluation (JSON).
    """

    weights: dict[str, Any]
    bits: Any
    row: dict


class RadianceTrainer(Trainer):
    """Trainer of a radiance field: its state, `step`, and `make_field` for the result.

    Parameters
    ----------
    views : list of PhotoView
        Training photos.
    box : AnyBox
        Bounds of the field in the coordinates of the photos.
    config : RadianceConfig
        Configuration of the field.
    settings : RadianceSettings
        Training settings.
    ns : module
        Dr.Jit backend.
    depth : bool
        Use depth supervision if the photos have depth.

    Notes
    -----
    Equal seeds draw equal rays. Sums over threads are not ordered, so weights of equal runs agree to rounding error,
    and exactly only with one thread.
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
            raise NergError(f"there are no photos to train on; hold out fewer with {parameter('holdout')}")
        super().__init__(settings, ns)
        self.config, self.box, self.clock = config, box, StepClock()
        self.pixels = PixelBank(ns, views)
        self.use_depth = depth and self.pixels.has_depth
        self.use_points = not self.use_depth and settings.point_weight > 0 and len(self.pixels.points) > 0
        self.current_field = RadianceNetwork.random(config, box, ns, settings.seed)
        # One photo has nothing to differ from.
        self.photos = PhotoColors(ns, len(views)) if settings.photo_colors and len(views) > 1 else None
        start = self.current_field.parameters() | (
            {} if self.photos is None else {PHOTO_PARAMETER: self.photos.init_parameter()}
        )
        self.start(Adam(settings.learning_rate, start, beta_2=0.99, epsilon=1e-15))
        self._evaluate_prepass = make_density_prepass(config, box)
        self.march_step = settings.march_step * box.side
        self._damping_distance = settings.damping_distance * box.side
        if (focus_distance := float(np.median(find_focus_distances(views)))) > 0:
            self._damping_distance = min(self._damping_distance, settings.max_focus_damping * focus_distance)
        near = settings.near * box.side
        free_space = FreeSpace.find(views, near, settings.clear_fraction, settings.surrounding_fraction)
        self._ray_starts = ns.Float(free_space.ray_starts)
        self.grid = MarchGrid(
            ns,
            box,
            settings.resolution,
            self.march_step,
            [v.camera for v in views],
            settings.min_views,
            free_space=free_space,
            growth=settings.step_growth,
        )
        loss = TrainingLoss(config, box, settings, ns, self.photos, self.use_depth, self.grid.cell_size_at)
        # The networks of a deferred field are evaluated at rays, whose number would be recorded.
        self._compute_gradients = dr.freeze(loss.compute_gradients, enabled=not config.deferred)
        # With exact depth everywhere the free space is known from the start, and there is no fog to clear.
        self.is_carved = self.use_depth and self.pixels.has_full_depth
        if self.is_carved:
            self.grid.carve(self.pixels.iter_surface_points())
        # Empty space of the last part of the run, if it differs
        late = FreeSpace.within(len(views), near)
        self._late_free_space = None if self.is_carved or (free_space.ray_starts <= late.near).all() else late
        self.grid.update(self.evaluate_density, self.rng, everywhere=True)
        self._tables: dict[int, StepTable] = {}
        self.extraction = OccupancyExtraction(self.grid)
        self.hard_pixels = np.zeros(0, np.uint32)
        self.rays, self.loss, self.samples = 256, 0.0, 0
        # Measured at updates of the grid, with all that they do
        self.seconds_per_density = 0.0
        # State with the best evaluation so far
        self.best: Snapshot | None = None
        # March stride in units of `march_step`, and samples per ray of the last density pass.
        self.stride, self.prepass_samples_per_ray = 1 if self.is_carved else max(settings.strides, default=1), 0.0
        self.start()

    def get_state(self) -> tuple[dict, dict]:
        tensors, meta = super().get_state()
        tensors |= {f"grid.{name}": getattr(self.grid, name).numpy() for name in GRID_STATE}
        settling = self.extraction
        tensors |= {
            "settling.found": settling.dense_cells.numpy(),
            "settling.shown": settling.contributing_cells.numpy(),
            "grid.unsampled": self.grid.unsampled.numpy(),
        }
        if settling.dilated_dense is not None:
            tensors["settling.dilated"] = settling.dilated_dense.numpy()
        meta |= {key: getattr(self, name) for key, name in _NUMBERS.items()}
        meta |= {"settling": settling.pieces_done, "turn": self.grid.turn, "clock": self.clock.to_dict()}
        if self.best is not None:
            best = {**self.best.weights, "cells": self.best.bits}
            tensors |= {f"best.{name}": value.numpy() for name, value in best.items()}
            meta["best"] = self.best.row
        return {**tensors, "hard": self.hard_pixels}, meta

    def keep_if_best(self, row: dict) -> None:
        """Keep the present state if its evaluation ``row`` has the largest PSNR so far."""
        if self.best is None or row["psnr"] > self.best.row["psnr"]:
            # Not copied, because training replaces these arrays and never modifies them.
            self.best = Snapshot(dict(self.averaged), self.grid.bits, row)

    def restore(self, tensors: dict, meta: dict) -> None:
        counts = {name: read_count(meta, key) for key, name in _NUMBERS.items()}
        for name in GRID_STATE:
            check_shape(tensors, f"grid.{name}", getattr(self.grid, name))
        dense, contributing = (tensors[f"settling.{name}"] for name in ("found", "shown"))
        for name, cells in (("found", self.extraction.dense_cells), ("shown", self.extraction.contributing_cells)):
            check_shape(tensors, f"settling.{name}", cells)
        dilated, unsampled = tensors.get("settling.dilated"), tensors.get("grid.unsampled")
        if dilated is not None:
            check_shape(tensors, "settling.dilated", self.extraction.dense_cells)
        if unsampled is not None and (unsampled.ndim != 1 or np.any(unsampled >= self.grid.resolution**3)):
            raise ValueError('its array "grid.unsampled" has cells outside the grid')
        super().restore(tensors, meta)
        turn = int(read_count(meta, "turn"))
        self.grid.restore(**{name: tensors[f"grid.{name}"] for name in GRID_STATE}, turn=turn, unsampled=unsampled)
        self.extraction.restore(int(read_number(meta, "settling", "state")), dense, contributing, dilated)
        self.clock.restore(meta["clock"])
        if "best" in meta:
            best = {}
            for name, value in {**self.averaged, "cells": self.grid.bits}.items():
                check_shape(tensors, f"best.{name}", value)
                best[name] = type(value)(tensors[f"best.{name}"])
            row = {**meta["best"], "psnr": read_number(meta["best"], "psnr", "state")}
            self.best = Snapshot(best, best.pop("cells"), row)
        self.hard_pixels = tensors["hard"]
        for name, value in counts.items():
            setattr(self, name, value)

    def get_step_table(self, stride: int = 1) -> StepTable:
        """Return the step edges at a march ``stride``."""
        if stride not in self._tables:
            s, side = self.settings, self.box.side
            # The largest distance from a camera to a corner of the box.
            bounds = self.box.lower, self.box.upper
            corners = np.array([[bounds[k][axis] for axis, k in enumerate(corner)] for corner in np.ndindex(2, 2, 2)])
            far = float(max(np.linalg.norm(corners - c, axis=1).max() for c in self.pixels.centers))
            self._tables[stride] = StepTable(
                self.ns, s.near * side, far, stride * self.march_step, stride * s.step_growth
            )
        return self._tables[stride]

    def evaluate_density(self, p, active):
        """Evaluate the current density at world points without gradient."""
        self.clock.add_evaluations(dr.width(p))
        return self._evaluate_prepass(self.current_field.parameters(), p, active)[0]

    def _density_prepass(self, p, active):
        """Evaluate the density at ``p`` to select samples, and the grid features, which are reused."""
        self.clock.add_evaluations(dr.width(p))
        return self._evaluate_prepass({k: dr.detach(v) for k, v in self._get_parameters().items()}, p, active)

    def _get_parameters(self) -> dict:
        """Return the weights of the field with gradients enabled."""
        return {k: self.optimiser[k] for k in self.current_field.parameters()}

    def step(self) -> None:
        """Run one optimisation step: draw rays, march, composite and update the weights."""
        with self.clock:
            s, ns, max_prepass_samples = self.settings, self.ns, self.settings.max_prepass_samples
            if self.progress >= s.free_space_end:
                self.end_free_space()
            self._update_density_grid()
            self._refine_stride()
            table = self.get_step_table(self.stride)
            limit = limit_ray_count(
                self.rays, self.prepass_samples_per_ray, table.steps, max_prepass_samples, _MAX_CANDIDATES * s.batch
            )
            # Odd, unlike the lengths of other arrays of a step: Dr.Jit evaluates arrays of equal length together, so
            # that each coincidence would record other kernels.
            self.rays = (limit - 1) | 1
            index = self._draw_pixels()
            point_depth = self._draw_points(index) if self.use_points else None
            pixels = self.pixels.gather_batch(ns.UInt32(copy_aligned(index, np.uint32)))
            rays = clip_rays(pixels.o, pixels.d, self.box, dr.gather(ns.Float, self._ray_starts, pixels.frame))
            offset = ns.Float(copy_aligned(self.rng.random(self.rays, np.float32)))
            thinning = (
                RussianRoulette(s.rr_weight, s.rr_min_probability, int(self.rng.integers(2**63)))
                if s.rr_min_probability < 1
                else None
            )
            samples, covered = select_visible_samples(
                rays,
                table,
                offset,
                self.grid.is_occupied,
                self._density_prepass,
                s.min_transmittance,
                s.batch,
                thinning,
                max_prepass_samples,
                with_features=True,
            )
            self.steps += 1
            if samples is None:
                self.rays = adapt_ray_count(self.rays, 0, 0, s.batch, max_prepass_samples)
                return
            depth_errors = self._optimize_step(samples, pixels, covered, point_depth)
            if depth_errors is not None:
                # The newest pixels replace the oldest.
                is_hard = depth_errors.numpy()[:covered] > _MIN_DEPTH_LOSS
                self.hard_pixels = np.concatenate([self.hard_pixels, index[:covered][is_hard]])[-_MAX_HARD_PIXELS:]
            self.prepass_samples_per_ray = samples.prepass_samples_per_ray
            self.rays = adapt_ray_count(
                self.rays, samples.count / covered, self.prepass_samples_per_ray, s.batch, max_prepass_samples
            )

    def end_free_space(self) -> None:
        """Allow density in the empty space near the cameras from now on."""
        if (late := self._late_free_space) is not None:
            self.grid.set_free_space(late)
            self._ray_starts, self._late_free_space = self.ns.Float(late.ray_starts), None

    def _update_density_grid(self) -> None:
        """Update a part of the density grid if due, and extract a piece of the occupancy."""
        s = self.settings
        is_extracting = self.progress >= s.extraction_start and not self.extraction.is_done
        is_due = self.steps % s.grid_interval == 0 and self.steps > 0
        if is_extracting or is_due:
            self.update_current_field()
        if is_extracting:
            self.extract_occupancy_piece()
        if is_due:
            dr.sync_thread()
            start = time.perf_counter()
            self.grid.update(self.evaluate_density, self.rng)
            dr.sync_thread()
            self.seconds_per_density = (time.perf_counter() - start) / max(self.grid.seen_count / NUM_PARTS, 1)

    def estimate_extraction_seconds(self) -> float:
        """Estimate the duration of `make_field`, based on the last update of the grid and on the last step."""
        return self.seconds_per_density * (_PROBES**3 * self.grid.seen_count + self._count_extraction_samples())

    def _count_extraction_samples(self) -> float:
        """Estimate the number of samples along rays of an extraction."""
        rays = min(_RAY_GROUPS * _GROUP_RAYS, self.pixels.size)
        return min(rays * max(self.prepass_samples_per_ray * self.stride, 1.0), _EXTRACTION_SAMPLES)

    def update_current_field(self) -> None:
        """Copy the weights of this step to ``current_field``."""
        self.current_field.set_parameters({k: dr.detach(v) for k, v in self._get_parameters().items()})

    def extract_occupancy_piece(self) -> None:
        """Extract a piece of the occupancy with the weights of ``current_field``."""
        with dr.suspend_grad():
            self.extraction.advance(self.evaluate_density, self._few_contributing_samples, self.settings.seed)

    def _refine_stride(self) -> None:
        """Refine the march stride if the schedule and the cleared space allow it."""
        s = self.settings
        wait_for_clearing = self.progress < 2 * s.stride_fraction
        stride = refine_stride(
            self.stride,
            s.strides,
            s.stride_at(self.progress),
            self.prepass_samples_per_ray,
            s.max_prepass_samples,
            wait_for_clearing,
        )
        self.prepass_samples_per_ray, self.stride = self.prepass_samples_per_ray * self.stride / stride, stride

    def _draw_pixels(self) -> np.ndarray:
        """Draw the pixel indices of a batch: random ones, and a fraction from pixels with a large depth error."""
        index = self.rng.integers(0, self.pixels.size, self.rays, np.uint32)
        if self.hard_pixels.size and self.progress > self.settings.lr_hold_fraction:
            num_hard = int(self.settings.hard_pixel_fraction * self.rays)
            index[:num_hard] = self.hard_pixels[self.rng.integers(0, self.hard_pixels.size, num_hard)]
            self.rng.shuffle(index)  # Shuffle, because the last rays of a batch may be dropped
        return index

    def _draw_points(self, index: np.ndarray) -> tuple[Float, Float]:
        """Replace a fraction of the pixel indices of a batch by pixels that show a point of the reconstruction.

        Returns the distance of each ray's point, 0 for other rays, and its standard error, both in scene units.
        """
        points = self.pixels.points
        is_point = self.rng.random(len(index)) < self.settings.point_fraction
        drawn = self.rng.integers(0, len(points), np.count_nonzero(is_point))
        distance, error = np.zeros((2, len(index)), np.float32)
        index[is_point], distance[is_point], error[is_point] = (
            points.index[drawn],
            points.distance[drawn],
            points.error[drawn],
        )
        return self.ns.Float(copy_aligned(distance)), self.ns.Float(copy_aligned(error))

    def _optimize_step(
        self, samples: RaySamples, pixels: PixelBatch, covered: int, point_depth: tuple[Float, Float] | None
    ) -> Float | None:
        """Update the weights once; returns the depth loss of each ray, or None without depth supervision.

        ``point_depth`` has the distance of each ray's point, and its error, as `_draw_points` returns them.
        """
        s, ns, opaque = self.settings, self.ns, lambda value: dr.opaque(self.ns.Float, value)
        background = ns.Array3f(*[ns.Float(copy_aligned(self.rng.random(self.rays, np.float32))) for _ in range(3)])
        empty_points = self.grid.empty_points(max(2, s.batch // 32 * 2), self.rng) if s.empty_weight > 0 else None
        inputs = LossInputs(
            # Numbers would be recorded, and nothing depends on these.
            replace(samples, count=0, prepass_samples_per_ray=0.0),
            pixels,
            background,
            dr.opaque(ns.UInt32, covered),
            opaque(self.stride),
            # Never 0, because distances are divided by it.
            opaque(max(self._damping_distance * s.damping_factor_at(self.progress), 1e-6 * self.box.side)),
            # Depth matters most at first; later colour provides more information.
            opaque(s.depth_weight * s.depth_weight_final_ratio**self.progress),
            opaque(s.point_weight * s.point_weight_final_ratio**self.progress),
            point_depth,
            empty_points,
        )
        self.clock.add_evaluations(s.batch + (0 if empty_points is None else dr.width(empty_points)))
        weights = {k: dr.detach(v) for k, v in self.optimiser.items()}
        loss, depth_errors, gradients = self._compute_gradients(weights, inputs)
        for name, gradient in gradients.items():
            if name.startswith("grid."):
                gradient = gradient + feature_decay_gradient(weights[name], s.grid_decay)
            dr.set_grad(self.optimiser[name], gradient)
        self.optimiser.set_learning_rate(learning_rate_at(s, self.progress))
        self.optimiser.step()
        self.loss, self.samples = loss, samples.count
        if self.steps % self.AVERAGE_INTERVAL == 0:
            self.average_weights()
        return depth_errors

    def _contributing_samples(self, density, occupied, on_progress: Callable[[float], None] = lambda part: None):
        """Yield the points (Array3f) of samples with more than a thousandth of the light of a training ray."""
        rng, num_samples = np.random.default_rng(self.settings.seed), 0
        groups = min(_RAY_GROUPS, -(-self.pixels.size // _GROUP_RAYS))
        for k in range(groups):
            samples, p = self._find_contributing_samples(density, occupied, rng, _GROUP_RAYS)
            if samples is not None:
                num_samples += samples.prepass_samples_per_ray * _GROUP_RAYS
                yield p
            on_progress(min(max((k + 1) / groups, num_samples / _EXTRACTION_SAMPLES), 1.0))
            if num_samples > _EXTRACTION_SAMPLES:
                break

    def _few_contributing_samples(self, density, occupied, rng: np.random.Generator):
        """Return such points, or None, for as many rays as fit in a step."""
        max_prepass_samples = self.settings.max_prepass_samples
        samples_per_ray, candidates = self.prepass_samples_per_ray * self.stride, _MAX_CANDIDATES * self.settings.batch
        rays = limit_ray_count(
            _GROUP_RAYS, samples_per_ray, self.get_step_table().steps, max_prepass_samples, candidates
        )
        return self._find_contributing_samples(density, occupied, rng, rays, max_prepass_samples)[1]

    def _find_contributing_samples(
        self, density, occupied, rng: np.random.Generator, count: int, max_prepass_samples: int | None = None
    ) -> tuple:
        s, ns = self.settings, self.ns
        pixels = self.pixels.gather_batch(
            ns.UInt32(copy_aligned(rng.integers(0, self.pixels.size, count, np.uint32), np.uint32))
        )
        rays = clip_rays(pixels.o, pixels.d, self.box, s.near * self.box.side)
        offset = ns.Float(copy_aligned(rng.random(count, np.float32)))
        samples, _ = select_visible_samples(
            rays,
            self.get_step_table(),
            offset,
            occupied,
            density,
            s.min_transmittance,
            max_prepass_samples=max_prepass_samples,
        )
        if samples is None:
            return None, None
        weight = compute_weights(density(samples.p, True) * samples.length, samples.segments)
        is_contributing: Any = dr.compress(weight > 1e-3)
        return samples, dr.gather(ns.Array3f, samples.p, is_contributing)

    def choose_pixel_stride(self, views: list[PhotoView], max_samples: int) -> int:
        """Choose ``every`` of `render` so that rendering ``views`` takes about ``max_samples``, based on the last
        step."""
        rays = sum(v.pixels.shape[0] * v.pixels.shape[1] for v in views)
        return max(1, int(np.ceil((rays * max(self.prepass_samples_per_ray * self.stride, 1) / max_samples) ** 0.5)))

    def estimate_samples(self, view: PhotoView, stride: int = 1) -> float:
        """Estimate the number of samples of all pixels of ``view`` at a march ``stride``, based on the last step."""
        height, width = view.shape
        return height * width * max(self.prepass_samples_per_ray * self.stride / stride, 1.0)

    def render(self, view: PhotoView, every: int = 1, field: RadianceNetwork | None = None, stride: int = 1) -> Preview:
        """Render every ``every``-th pixel of ``view`` with the trainer's march at a march ``stride``.

        Renders ``field`` with its own occupancy, or by default the averaged weights.
        """
        field, occupied = field or self.make_field(with_occupancy=False), self.grid.is_occupied
        bound = field.occupancy
        if bound is not None:
            occupied = lambda p, active: active & (bound.distance_to_occupied(self.box.to_cube(p), active) == 0)
        return render_view(
            field, occupied, self.get_step_table(stride), view, self.settings.near * self.box.side, every=every
        )

    def make_field(
        self,
        with_occupancy: bool = True,
        snapshot: Snapshot | None = None,
        on_progress: Callable[[float], None] = lambda part: None,
    ) -> RadianceNetwork:
        """Return the field with averaged weights, and its occupancy for rendering if ``with_occupancy``.

        With a ``snapshot``, it is the field of that state, sampled in the cells that were sampled then.
        ``on_progress`` is called with the completed part of the extraction of the occupancy of the present state.
        """
        growth = self.settings.step_growth if self.box.is_contracted else 0.0
        out = RadianceNetwork.random(self.config, self.box, self.ns, 0, march_step=self.march_step, march_growth=growth)
        weights = self.averaged if snapshot is None else snapshot.weights
        out.set_parameters({k: type(v)(v) for k, v in weights.items() if k != PHOTO_PARAMETER})
        if not with_occupancy:
            return out
        with dr.suspend_grad():
            if snapshot is None:
                rng = np.random.default_rng(self.settings.seed)
                probing = _PROBES**3 * self.grid.seen_count
                probing_part = probing / max(probing + self._count_extraction_samples(), 1.0)
                contributing_samples = partial(
                    self._contributing_samples,
                    on_progress=lambda part: on_progress(probing_part + (1 - probing_part) * part),
                )
                out.occupancy = self.grid.extract_occupancy(
                    out.density, rng, contributing_samples, _PROBES, lambda part: on_progress(probing_part * part)
                )
            else:
                # A young field is thin fog, of which a threshold, or a refined occupancy, would leave nothing.
                cells = snapshot.bits.numpy().reshape((self.grid.resolution,) * 3) > 0
                out.occupancy = self.grid.select_contributing(cells, out.density, self._contributing_samples)
                return out
        out.occupancy = refine_occupancy(out) or out.occupancy
        return out
