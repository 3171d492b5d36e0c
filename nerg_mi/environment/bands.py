"""Rendering in bands of rows, which bound the memory, and in strips of samples, which bound the time of a kernel."""

from __future__ import annotations

import functools
import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.fields.mlp import set_constant_weights
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.maths.types import variant_types
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import SURFACE_OPACITY
from nerg_mi.transport.recording import Recorder, must_sample_rays

if TYPE_CHECKING:
    import mitsuba as mi


# ---- Layers: several images of the same rays ----


class LayerSource(Protocol):
    """Replaces the integrator of a scene by several images of the same rays, each with its own AOVs."""

    channel_names: list[list[str]]
    """Names of the AOV channels of each image."""

    num_channels: int
    """Number of AOV channels of a single image with all AOVs; samples are accumulated as in that image."""

    recorder: Recorder | None
    """The recordings of the scene, if these are `RecordableLayers`; None otherwise."""

    def sample(self, scene, sampler, ray, medium, active) -> Iterable[tuple]:
        """Yield ``(radiance, valid, aovs)`` of each image, as the ``sample`` method of an integrator returns them."""
        ...


class RecordableLayers(LayerSource, Protocol):
    """A `LayerSource` whose images can be recorded and replayed."""

    def list_inputs(self, scene, num_rays: int) -> list[Any]:
        """Return all objects that ``sample`` reads for ``num_rays`` rays, besides the sensor.

        What cannot be computed in a recording is computed now.
        """
        ...


class IntegratorLayer:
    """The image of an integrator, as the only layer."""

    recorder: Recorder | None = None

    def __init__(self, integrator):
        self.channel_names, self._integrator = [integrator.aov_names()], integrator
        self.num_channels = len(self.channel_names[0])

    def sample(self, scene, sampler, ray, medium, active) -> Iterable[tuple]:
        return [self._integrator.sample(scene, sampler, ray, medium, active)]


# ---- Strips of samples ----
#
# Interruptions and progress reports take place between strips.

PACKET_SIZE = 64
"""Number of samples that Dr.Jit can accumulate as one (16 on a CPU, 32 on a GPU); strips start at multiples of it."""

MIN_STRIP_SAMPLES = 1 << 12
"""Number of samples below which the overhead of a strip exceeds its work."""

STRIP_SECONDS = 0.5
"""Target time of a strip: strips get shorter above it, and longer below half of it."""


class SamplePace:
    """Chooses the number of samples in a strip from the time of previous strips.

    A strip is a range of the samples of an image that is rendered in one kernel. A sample is one camera ray, so a pixel
    has ``spp`` samples. Strips are to take between half of `STRIP_SECONDS` and `STRIP_SECONDS`: a strip that takes
    longer halves the number of samples of the next one, and a shorter one doubles it.

    An object can be used for several images in turn, as long as the Mitsuba variant stays the same: the initial and
    maximum number of samples depend on it.

    Parameters
    ----------
    fixed : int
        Constant number of samples in a strip, over all its pixels; 0 adapts the number to the time.
    """

    def __init__(self, fixed: int = 0):
        import mitsuba as mi

        self._fixed = fixed
        self._count = fixed or (1 << 20 if str(mi.variant()).startswith("cuda") else 1 << 15)
        self._max_count = 1 << 24 if str(mi.variant()).startswith("cuda") else 1 << 18
        self._last_time, self._num_strips = 0.0, 0

    def begin(self) -> None:
        """Start an image: the time since the previous one is not counted."""
        self._num_strips = 0

    def iter_strips(self, start: int, stop: int, spp: int) -> Iterator[tuple[int, int]]:
        """Divide samples into strips.

        Parameters
        ----------
        start, stop : int
            Range of sample indices within the image, in which the samples of a pixel are adjacent. The first strip
            starts at a multiple of `PACKET_SIZE`, possibly before ``start``.
        spp : int
            Samples per pixel.

        Yields
        ------
        tuple of int
            First sample and number of samples of each strip.
        """
        # Strips contain whole pixels unless a single pixel exceeds the maximum.
        unit = math.lcm(PACKET_SIZE, spp)
        unit = unit if unit <= self._max_count else PACKET_SIZE
        first = start - start % PACKET_SIZE
        while first < stop:
            last = min(max((first + self._count) // unit, first // unit + 1) * unit, stop)
            yield first, last - first
            first = last

    def wait(self) -> None:
        """Wait until the previous strip is finished, and adapt the number of samples."""
        import drjit as dr

        dr.sync_thread()
        now = time.perf_counter()
        # The first call waits for nothing, and the first strip includes compilation.
        if self._num_strips > 1 and not self._fixed:
            seconds = now - self._last_time
            if seconds > STRIP_SECONDS:
                self._count = max(self._count // 2, MIN_STRIP_SAMPLES)
            elif seconds < STRIP_SECONDS / 2:
                self._count = min(self._count * 2, self._max_count)
        self._last_time, self._num_strips = now, self._num_strips + 1


# ---- Random numbers of a range of samples ----
#
# Mitsuba's ``independent`` sampler gives each sample of an image its own PCG32 generator. State and stream are derived
# from the seed and the index of the sample by the Tiny Encryption Algorithm. The random numbers of any range of samples
# can therefore be computed separately.


def get_base_seed(sampler) -> int | None:
    """Return the ``seed`` of an ``independent`` sampler; None for other samplers and for unknown seeding schemes."""
    import mitsuba as mi

    match = re.search(r"base_seed = (\d+)", str(sampler))
    if sampler.class_name() != "IndependentSampler" or not match:
        return None
    return int(match[1]) if _can_reproduce(int(match[1]), mi.variant()) else None


@functools.cache
def _can_reproduce(base: int, variant: str) -> bool:
    """Whether `make_sampler` reproduces Mitsuba's sampler of this seed. If a release of Mitsuba seeds
    differently, images are rendered undivided and stay correct."""
    import drjit as dr
    import mitsuba as mi

    reference, count = mi.load_dict({"type": "independent", "seed": base}), 64
    reference.seed(7, count)
    sampler_copy = make_sampler(1, mi.UInt32((base + 7) & 0xFFFFFFFF), mi.UInt64(0), count)
    return bool(dr.all(reference.next_2d() == sampler_copy.next_2d(), axis=None))


def make_sampler(spp: int, key: Any, first: Any, count: int):
    """Make a sampler for a range of samples of an image.

    Parameters
    ----------
    spp : int
        Samples per pixel.
    key : mi.UInt32
        Sum of the seeds of the scene's sampler (`get_base_seed`) and of the rendering. Neither this nor ``first`` is
        compiled into the kernel if it is opaque.
    first : mi.UInt64
        First sample. Samples are numbered pixel by pixel.
    count : int
        Number of samples.

    Notes
    -----
    Mitsuba renders at most 2^32 samples at once; samples beyond that use other seeds.
    """
    import drjit as dr

    mi = variant_types()
    number = first + mi.UInt64(dr.arange(mi.UInt32, count))
    low = mi.UInt32(number & 0xFFFFFFFF)
    high = mi.UInt32(number >> 32)
    state, stream = mi.sample_tea_32(key + high * 0x9E3779B9, low)
    return _get_sampler_class(mi.variant())(spp, mi.PCG32(initstate=mi.UInt64(state), initseq=mi.UInt64(stream)))


@functools.cache
def _get_sampler_class(variant: str):
    # Mitsuba's classes depend on the variant.
    import mitsuba as mi

    class StripSampler(mi.Sampler):
        def __init__(self, spp, generator):
            super().__init__(mi.Properties())
            self.set_sample_count(spp)
            self.generator = generator

        def next_1d(self, active=True):
            return self.generator.next_float32(mi.Bool(active))

        def next_2d(self, active=True):
            x = self.next_1d(active)
            return mi.Point2f(x, self.next_1d(active))

        def clone(self):
            return StripSampler(self.sample_count(), type(self.generator)(self.generator))

        def to_string(self):
            return f"Samples[{self.sample_count()} a pixel, {variant}]"

    return StripSampler


# ---- Bands ----
#
# An image does not depend on how it is divided. Each sample has the position, the ray and the random numbers that it
# has in the undivided image, and the samples of a pixel are accumulated in the same groups. With a box filter, the
# pixels equal those of ``mi.render`` bit by bit, even if a pixel's samples are in two strips. With a wider filter, the
# samples of the rows around a band are rendered again for it; the sums have another order, and pixels differ by the
# rounding of single precision.

BYTES_PER_VALUE = 22
"""Memory of a band per value (channel of a pixel), in bytes.

Four bytes are in the block that accumulates samples, the others in copies on the way to the file.
"""


@dataclass(frozen=True)
class Band:
    """A band of rows of an image.

    Parameters
    ----------
    top, rows : int
        First row and number of rows, in the crop window of the film.
    film : mi.Film
        Contains the rows until the next band is requested, possibly followed by empty rows.
    layer : int
        Index of the image, if a `LayerSource` renders several.
    """

    top: int
    rows: int
    film: Any
    layer: int = 0


def undividable_reason(scene, sensor) -> str | None:
    """Return the reason why an image of ``sensor`` can only be rendered undivided; None if it can be divided."""
    import mitsuba as mi

    from nerg_mi.transport.observer import is_batch

    integrator, film = scene.integrator(), sensor.film()
    if str(mi.variant()).startswith("scalar") or mi.is_spectral or mi.is_polarized:
        return f"the variant {mi.variant()}"
    if not isinstance(integrator, mi.SamplingIntegrator) or isinstance(integrator, mi.CppADIntegrator):
        return f"the integrator {integrator.class_name()}"
    if not is_nerg(integrator) and _overrides_render(type(integrator), mi.SamplingIntegrator):
        return f"the integrator {integrator.class_name()}, which overrides render()"
    if film.class_name() != "HDRFilm":
        return f"the film {film.class_name()}"
    if is_batch(sensor):
        return "a batch of sensors"
    if get_base_seed(sensor.sampler()) is None:
        return f"the sampler {sensor.sampler().class_name()}"
    return None


def _overrides_render(kind: type, base: type) -> bool:
    """Whether a Python integrator class overrides ``render`` of ``base``."""
    above = kind.__mro__
    return any("render" in vars(c) for c in above[: above.index(base)])


def fit_rows_to_memory(scene, sensor, memory: float) -> int:
    """Compute how many rows of a band fit into ``memory`` bytes; at least 1.

    With a filter wider than a pixel, a band has at least eight times the radius of the filter, so that at most a
    quarter of the samples is rendered twice.
    """
    width, height = sensor.film().crop_size()
    values = 5 + len(scene.integrator().aov_names())
    return int(min(max(memory // (width * values * BYTES_PER_VALUE), 8 * _filter_radius(sensor.film()), 1), height))


def _filter_radius(film) -> int:
    """Return how many rows beyond their own the samples of ``film`` contribute to."""
    return 0 if film.rfilter().is_box_filter() else int(film.rfilter().border_size())


def render_bands(
    scene,
    sensor,
    *,
    spp: int = 0,
    seed: int = 0,
    rows: int = 0,
    on_strip: Callable[[int, int], None] | None = None,
    layers: LayerSource | None = None,
    pace: SamplePace | None = None,
) -> Iterator[Band]:
    """Render an image band by band from the top, or undivided if `undividable_reason` gives a reason.

    Parameters
    ----------
    scene : mi.Scene
        The scene.
    sensor : mi.Sensor
        The camera.
    spp : int
        Samples per pixel; 0 uses the number of the sampler.
    seed : int
        Seed of the rendering.
    rows : int
        Rows of a band; 0 renders all rows in one band.
    on_strip : callable, optional
        Called after each strip with the number of finished samples and of all samples. It may raise an exception.
    layers : LayerSource, optional
        Replaces the integrator of the scene, for images that can be divided. The bands of all layers alternate.
    pace : SamplePace, optional
        The pace of previous images.

    Yields
    ------
    Band
        The next band, of each layer in turn.

    Raises
    ------
    NergError
        There are ``layers``, and the image cannot be divided (`undividable_reason`).
    KeyboardInterrupt
        An undivided image was interrupted; Mitsuba handles the signal in this case.
    """
    if reason := undividable_reason(scene, sensor):
        if layers is not None:
            raise NergError(f"this picture cannot be rendered because of {reason}; pass a Camera, or use mi.render")
        yield _render_undivided(scene, sensor, spp, seed, on_strip)
        return
    grid = _PixelGrid(sensor.film(), spp or sensor.sampler().sample_count(), rows)
    integrator = scene.integrator()
    if layers is None:
        layers = AovLayer(integrator, sensor) if is_nerg(integrator) else IntegratorLayer(integrator)
    rendering_context = lambda: integrator.rendering_from(sensor, scene) if is_nerg(integrator) else nullcontext()
    base = cast("int", get_base_seed(sensor.sampler()))
    pace = pace or SamplePace()
    pace.begin()
    done = 0
    for top in range(0, grid.height, grid.rows):
        blocks = [grid.make_block(names) for names in layers.channel_names]
        start, stop = grid.sample_range(top)
        with rendering_context(), grid.match_accumulation(blocks[0], layers):
            for first, count in pace.iter_strips(start, stop, grid.spp):
                strip = _Strip.make(grid, base, seed, top, first, count, start)
                _render_strip(scene, sensor, layers, grid, strip, blocks)
                # This strip was traced while the previous one was computed.
                pace.wait()
                if on_strip is not None and done:
                    on_strip(min(done, grid.total), grid.total)
                for block in blocks:
                    _evaluate_block(block)
                done += count
            pace.wait()
        if on_strip is not None:
            on_strip(min(done, grid.total), grid.total)
        for layer, (names, block) in enumerate(zip(layers.channel_names, blocks)):
            grid.develop(names, block)
            yield Band(top, min(grid.rows, grid.height - top), sensor.film(), layer)


def _render_undivided(scene, sensor, spp, seed, on_strip) -> Band:
    import drjit as dr
    import mitsuba as mi

    mi.render(scene, sensor=sensor, spp=spp, seed=seed)
    dr.sync_thread()
    if scene.integrator().should_stop():
        raise KeyboardInterrupt
    if on_strip is not None:
        total = int(np.prod(sensor.film().crop_size())) * (spp or sensor.sampler().sample_count())
        on_strip(total, total)
    return Band(0, int(sensor.film().crop_size()[1]), sensor.film())


def _evaluate_block(block):
    import drjit as dr

    dr.eval(block.tensor())


@dataclass(frozen=True)
class _Strip:
    """A strip of ``count`` samples of an image. All other numbers are arrays of Dr.Jit, so that strips and images share
    a kernel."""

    count: int
    # Key of the random numbers, and index of the first sample.
    key: Any
    first: Any
    # Samples at the beginning of the strip that are masked.
    masked: Any
    # Position of the first sample: in its pixel, column and row.
    sample: Any
    column: Any
    row: Any
    # First row of the band.
    top: Any
    spp: Any

    @classmethod
    def make(cls, grid: _PixelGrid, base: int, seed: int, top: int, first: int, count: int, start: int) -> _Strip:
        """The strip from the sample ``first`` in the band at ``top``, whose samples begin at ``start``."""
        import drjit as dr

        mi = variant_types()
        number = lambda value: dr.opaque(mi.UInt32, value)
        pixel = first // grid.spp
        return cls(
            count=count,
            key=number((base + seed) & 0xFFFFFFFF),
            first=dr.opaque(mi.UInt64, first),
            masked=number(max(start - first, 0)),
            sample=number(first % grid.spp),
            column=number(pixel % grid.width),
            row=number(pixel // grid.width),
            top=dr.opaque(mi.Int32, top),
            spp=number(grid.spp),
        )

    @property
    def numbers(self) -> list[Any]:
        """The arrays."""
        return [self.key, self.first, self.masked, self.sample, self.column, self.row, self.top, self.spp]


def _render_strip(scene, sensor, layers: LayerSource, grid: _PixelGrid, strip: _Strip, blocks: list[Any]) -> None:
    """Trace a strip of samples, or replay it, and add it to ``blocks``, one per layer."""
    numbers, rays = strip.numbers, None
    if layers.recorder is not None and layers.recorder.is_enabled and must_sample_rays(sensor):
        rays = _evaluate_rays(sensor, grid, strip)
        numbers = [*numbers, *rays]

    def add() -> None:
        positions, active, layer_values = _trace_strip(scene, sensor, layers, grid, strip, rays)
        for block, values in zip(blocks, layer_values):
            block.put(positions, values, active)
            if len(blocks) > 1:
                # One kernel per layer, so that layers of the same kind share a kernel.
                _evaluate_block(block)

    if layers.recorder is None:
        add()
        return
    list_inputs = lambda: cast("RecordableLayers", layers).list_inputs(scene, strip.count)
    key = "strip", strip.count, grid.spp, grid.rows
    layers.recorder.run(add, key, list_inputs, numbers, sensor, blocks)


def _trace_strip(scene, sensor, layers: LayerSource, grid: _PixelGrid, strip: _Strip, rays: tuple[Any, Any] | None):
    """Trace a strip of samples.

    Follows ``SamplingIntegrator::render_sample`` of Mitsuba 3.9, operation by operation.

    Returns
    -------
    tuple
        Positions in the block of the band, the mask, and an iterator over the values in each layer.
    """
    samples, film = _FilmSamples(sensor, grid, strip), sensor.film()
    ray, weight = rays or samples.sample_rays()
    layer_samples = layers.sample(scene, samples.sampler, ray, sensor.get_medium(), samples.active)
    mi = variant_types()
    # With a box filter, use the pixel itself: the position can be rounded up into the next pixel.
    block_position = mi.Point2f(samples.pixel if film.rfilter().is_box_filter() else samples.position)
    if grid.is_divided:
        block_position -= mi.Vector2f(mi.Vector2i(film.crop_offset()) + mi.Vector2i(0, strip.top))
    return block_position, samples.active, (_make_block_values(film, weight, *of_layer) for of_layer in layer_samples)


def _evaluate_rays(sensor, grid: _PixelGrid, strip: _Strip) -> tuple[Any, Any]:
    """The rays of the samples, and their weights, as evaluated arrays."""
    import drjit as dr

    rays = _FilmSamples(sensor, grid, strip).sample_rays()
    dr.eval(rays)
    return rays


class _FilmSamples:
    """Random samples of the pixels of a strip, and the ``sampler`` that continues them."""

    def __init__(self, sensor, grid: _PixelGrid, strip: _Strip):
        import drjit as dr

        mi = variant_types()
        film = sensor.film()
        self.sampler = sampler = make_sampler(grid.spp, strip.key, strip.first, strip.count)
        number = dr.arange(mi.UInt32, strip.count)
        self.active = active = number >= strip.masked
        number = (number + strip.sample) // strip.spp + strip.column
        line = number // grid.width
        pixel = mi.Vector2i(number - line * grid.width, line + strip.row)
        self.pixel = pixel + (mi.Vector2i(film.crop_offset()) - grid.border)
        self.position = mi.Vector2f(self.pixel) + sampler.next_2d(active)
        self._aperture = sampler.next_2d(active) if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        self._time = sensor.shutter_open()
        if sensor.shutter_open_time() > 0:
            self._time += sampler.next_1d(active) * sensor.shutter_open_time()
        self._sensor, self._spp = sensor, grid.spp

    def sample_rays(self) -> tuple[Any, Any]:
        """Rays of the samples, with differentials, and their weights."""
        import drjit as dr

        mi = variant_types()
        film = self._sensor.film()
        scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
        offset = -mi.ScalarVector2f(film.crop_offset()) * scale
        relative = mi.Point2f(dr.fma(self.position, mi.Vector2f(scale), mi.Vector2f(offset)))
        ray, weight = self._sensor.sample_ray_differential(self._time, 0, relative, self._aperture, self.active)
        if ray.has_differentials:
            ray.scale_differential(mi.Float(np.float32(1) / np.sqrt(np.float32(self._spp))))
        return ray, weight


def _make_block_values(film, weight, radiance, valid, aovs) -> list:
    """Return the values that each sample adds to a block of the film."""
    import drjit as dr
    import mitsuba as mi

    radiance = mi.Spectrum(radiance) * weight
    color = [radiance.x] * 3 if mi.is_monochromatic else [radiance.x, radiance.y, radiance.z]
    alpha = [dr.select(valid, mi.Float(1), 0)] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
    return [*color, *alpha, mi.Float(1), *aovs]


class _PixelGrid:
    """The sampled pixels, row by row, and their division into bands."""

    def __init__(self, film, spp: int, rows: int):
        self.film, self.spp = film, spp
        self.size, self.offset = [int(v) for v in film.crop_size()], [int(v) for v in film.crop_offset()]
        self.height = self.size[1]
        self.rows = min(rows or self.height, self.height)
        self.is_divided = self.rows < self.height
        filters = film.rfilter()
        self.border = int(filters.border_size()) if film.sample_border() else 0
        self._filter_radius = _filter_radius(film)
        self.width = self.size[0] + 2 * self.border
        self.total = sum(b - a for a, b in map(self.sample_range, range(0, self.height, self.rows)))

    def sample_range(self, top: int) -> tuple[int, int]:
        """Return the first sample that contributes to the band at ``top``, and the end of the range."""
        first = max(top - self._filter_radius + self.border, 0)
        last = min(top + self.rows + self._filter_radius + self.border, self.height + 2 * self.border)
        if not self.is_divided:
            first, last = 0, self.height + 2 * self.border
        return first * self.width * self.spp, last * self.width * self.spp

    def make_block(self, aov_names: list[str]):
        """Make the block that accumulates the samples of a band."""
        with self._crop_to_band():
            self.film.prepare(aov_names)
            block = self.film.create_block()
            block.set_offset(self.film.crop_offset())
        block.set_coalesce(block.coalesce() and self.spp >= 4)
        return block

    @contextmanager
    def match_accumulation(self, block, layers: LayerSource):
        """Accumulate samples as Dr.Jit does for the undivided image.

        Dr.Jit uses another method, which rounds differently, for more than a million values
        (`dr.set_expand_threshold`). ``block`` is the block of the first layer.
        """
        import drjit as dr

        threshold = dr.expand_threshold()
        channels = block.channel_count() - len(layers.channel_names[0]) + layers.num_channels
        if self.size[0] * self.size[1] * channels > threshold:
            dr.set_expand_threshold(0)
        try:
            yield
        finally:
            dr.set_expand_threshold(threshold)

    def develop(self, aov_names: list[str], block) -> None:
        """Copy ``block`` into the film."""
        with self._crop_to_band():
            self.film.prepare(aov_names)
            self.film.put_block(block)

    @contextmanager
    def _crop_to_band(self):
        # Never while rays are traced: sensors need the size of the whole film. Each band is at the corner of the film,
        # so that its position is not compiled into the kernel.
        if not self.is_divided:
            yield
            return
        _set_crop(self.film, [self.size[0], self.rows], [0, 0])
        try:
            yield
        finally:
            _set_crop(self.film, self.size, self.offset)


def _set_crop(film, size, offset) -> None:
    import mitsuba as mi

    params = mi.traverse(film)
    params["crop_size"], params["crop_offset"] = mi.ScalarVector2u(size), mi.ScalarPoint2u(offset)
    params.update()


# ---- Channels of an image ----


@dataclass(frozen=True, eq=False)
class Channels:
    """The channels of an image.

    Parameters
    ----------
    color : ndarray of shape (h, w, 3)
        Linear radiance.
    aovs : dict of str to ndarray of shape (h, w)
        AOVs by name; components of vectors as in ``position.X``.
    bitmap : mi.Bitmap
        All channels.
    """

    color: np.ndarray
    aovs: dict[str, np.ndarray]
    bitmap: mi.Bitmap

    @property
    def mask(self) -> np.ndarray:
        """Whether a pixel shows a surface (h, w), bool. Requires the AOV ``opacity``."""
        return self.aovs["opacity"] >= SURFACE_OPACITY


def render_channels(
    scene, sensor, spp: int = 0, seed: int = 0, on_strip: Callable[[int, int], None] | None = None
) -> Channels:
    """Render an image with the integrator of the scene, as ``mi.render`` does.

    Parameters
    ----------
    scene : mi.Scene
        The scene.
    sensor : mi.Sensor
        The camera.
    spp : int
        Samples per pixel; 0 uses the number of the sampler.
    seed : int
        Seed of the rendering.
    on_strip : callable, optional
        Called several times per second with the number of finished samples and of all samples. It may raise an
        exception.

    Returns
    -------
    Channels
        Colour and AOVs.
    """
    (band,) = render_bands(scene, sensor, spp=spp, seed=seed, on_strip=on_strip)
    return read_channels(band.film, scene.integrator().aov_names())


def read_channels(film, aov_names: Sequence[str]) -> Channels:
    """Read the channels of a developed ``film`` whose last channels are the AOV channels ``aov_names``."""
    names = [name.split(".") for name in aov_names]
    pixels = np.array(film.develop())
    color = pixels[..., : pixels.shape[2] - len(names)]
    first = color.shape[2]
    vectors = {parts[0] for parts in names if [p[0] for p in names].count(parts[0]) > 1}
    key = lambda parts: ".".join(parts) if parts[0] in vectors else parts[0]
    aovs = {key(parts): pixels[..., first + k] for k, parts in enumerate(names)}
    # Mono variants render one channel.
    return Channels(np.broadcast_to(color[..., :3], (*color.shape[:2], 3)), aovs, film.bitmap())


# ---- AOVs in addition to those of a scene file ----


class AovLayer:
    """A layer with colour and AOVs of `nerg`, for the observer of the scene.

    Parameters
    ----------
    integrator : NergIntegrator
        The integrator of the scene.
    sensor : mi.Sensor
        The camera.
    aovs : sequence of str, optional
        Names of AOVs, which the scene file need not list. Default: those of the integrator, followed by those of its
        nested integrator.

    Raises
    ------
    NergError
        The integrator cannot compute one of the AOVs.
    """

    def __init__(self, integrator: Any, sensor: Any, aovs: Sequence[str] | None = None):
        self.recorder: Recorder | None = integrator.recorder
        self._sensor = sensor
        self._context = integrator.context() if aovs is None else integrator.make_context(aovs, True)
        self._has_nested, self._observer = aovs is None, None
        self.channel_names = [integrator.aov_names() if aovs is None else self._context.channel_names(aovs)]
        self.num_channels = len(self.channel_names[0])

    def list_inputs(self, scene: Any, num_rays: int) -> list[Any]:
        if self._context.observer_aovs:
            self._observer = self._observer or self._context.make_own_observer([self._sensor])
            self._observer.prepare(self._context, scene, [self._sensor], num_rays)
        return [*self._context.list_inputs(scene, [self._sensor], num_rays), self._observer]

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> Iterable[tuple]:
        camera = self._context.trace(scene, [self._sensor], sampler, ray, active)
        channels = camera.make_pixel(self._observer).compute_channels(self._context.aovs)
        radiance, shown, nested = camera.compute_radiance(scene, sampler, medium)
        return [(radiance, shown, channels + nested if self._has_nested else channels)]


def is_nerg(integrator: Any) -> bool:
    """Whether an integrator is `nerg`. Compares names, since each change of the variant creates a new class."""
    return type(integrator).__name__ == "NergIntegrator"


def require_nerg(path: Path, scene: Any) -> Any:
    """Return the integrator of ``scene``, loaded from ``path``. Raises `NergError` if it is not `nerg`."""
    integrator = scene.integrator()
    if not is_nerg(integrator):
        kind = "none" if integrator is None else f'"{integrator.class_name()}"'
        raise NergError(
            f'an overlay needs the integrator "nerg", but "{path}" has {kind}; '
            f'use "nerg scene {path} -o new.xml" to add it'
        )
    return integrator


def render_aovs(
    path: Path,
    scene: Any,
    sensor: Any,
    names: Sequence[str],
    spp: int = 0,
    seed: int = 0,
    on_strip: Callable[[int, int], None] | None = None,
) -> Channels:
    """Render colour and chosen AOVs of a scene.

    Parameters
    ----------
    path : Path
        File of the scene, for messages.
    scene : mi.Scene
        The scene, whose integrator is `nerg`.
    sensor : mi.Sensor
        The camera.
    names : sequence of str
        Names of AOVs.
    spp, seed, on_strip
        As for `render_channels`.

    Returns
    -------
    Channels
        Colour and AOVs.

    Raises
    ------
    NergError
        The integrator is not `nerg` or cannot compute an AOV, or the image cannot be divided (`undividable_reason`).
    """
    integrator = require_nerg(path, scene)
    reason = undividable_reason(scene, sensor)
    if reason is not None:
        raise NergError(f'"{path}" cannot be rendered with an overlay because of {reason}; use another sensor')
    layer = AovLayer(integrator, sensor, names)
    (band,) = render_bands(scene, sensor, spp=spp, seed=seed, on_strip=on_strip, layers=layer)
    return read_channels(band.film, layer.channel_names[0])


# ---- Long renderings ----
#
# Kernels with constant network weights take seconds to compile. Whether they are faster then depends on the processor.

LONG_RENDER_SAMPLES = 1 << 27
"""Number of samples from which the compilation of constant weights pays off: 146 images of 1280 x 720."""

_TRIAL_IMAGES = 3  # Images of each kind, of which the first one compiles and is not timed


class ConstantWeightsTrial:
    """Decides in a long sequence of images whether constant network weights are faster on this machine.

    The first images are rendered with variable weights, the next ones with constant weights, and all others with what
    was faster. Images are equal in both cases.

    Parameters
    ----------
    images : int
        Number of images of the sequence. Short sequences have variable weights only.
    """

    def __init__(self, images: int):
        self._images = images
        self._seconds: dict[bool, list[float]] = {False: [], True: []}  # Per sample, of each image

    def prepare(self, samples: int, scene: Any) -> bool:
        """Set the weights of ``scene`` for the next image, of ``samples`` samples; return whether they are constant."""
        integrator = scene.integrator()
        trained = get_trained_fields(integrator) if is_nerg(integrator) else []
        constant = bool(trained) and self._choose(samples)
        # A single image has the weights that its scene has in memory.
        for field in trained if self._images > 1 else ():
            set_constant_weights(field, constant)
        return constant

    def record(self, constant: bool, samples: int, seconds: float) -> None:
        """Record the time of an image."""
        self._seconds[constant].append(seconds / samples)

    def _choose(self, samples: int) -> bool:
        variable, constant = self._seconds[False], self._seconds[True]
        if self._images < 4 * _TRIAL_IMAGES or self._images * samples < LONG_RENDER_SAMPLES:
            return False
        if len(variable) < _TRIAL_IMAGES or len(constant) < _TRIAL_IMAGES:
            return len(variable) >= _TRIAL_IMAGES
        return min(constant[1:]) < min(variable[1:])


def get_trained_fields(integrator: Any) -> list[RadianceNetwork | GazeNetwork]:
    """Return the radiance field and the gaze field of an integrator `nerg`, if present."""
    medium, gaze = integrator.medium, integrator.gaze
    trained: list[RadianceNetwork | GazeNetwork] = [medium.field] if isinstance(medium, FieldMedium) else []
    return trained if gaze is None else [*trained, gaze.field]
